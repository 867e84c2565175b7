"""Fly any quadrotor: another one in every episode."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import drawn_data, state
from crazysim.core.random import normal, world_key
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.actions import Actions, hover_rotor_states, rotor_speeds
from crazysim.envs.random import draw, scale_symmetric
from crazysim.envs.spawn import flying, random_attitude
from crazysim.envs.tasks.goals import GoalTask
from crazysim.lab.control.any_airframe import state_from_goal
from crazysim.lab.plugins.random_airframe import RandomAirframe
from crazysim.plugins.effects import Latency, Randomize
from crazysim.sim.sim import Sim

MIDDLE = np.array([0.0, 0.0, 10.0])
"""Middle of the box of goals at the start, m: high enough for drones that start upside down."""


NOISE = {"pos": 0.01, "attitude": 0.01, "vel": 0.03, "ang_vel": 0.05}
"""Standard deviations of the errors of the observed state, m, rad, m/s, rad/s: an assumption about estimators that fuse
motion capture."""
MAX_RATE = 2.0
"""Largest angular velocity of moving goals, which move on ellipses around ``MIDDLE``, rad/s."""


class AnyAirframe(GoalTask):
    """Fly a quadrotor that the policy does not know to a point that may move, and stay there, by speeds of its rotors.

    Every episode has another quadrotor (``RandomAirframe``), another delay of commands and another wind. Half of the
    drones start near their goal; the others start with any attitude, at up to 3 m/s. Observations are relative to the
    goal and its yaw, with the errors of an estimator, and include the previous action, as RAPTOR's do (arXiv
    2509.11481). An action is the speed of each rotor, from 0 at -1 to the largest at 1. An episode ends when a drone
    touches the floor, rises above 20 m, or is more than 10 m from the z axis along x or y.
    """

    name = "any"
    control = "rotor_vel"
    freq = 100
    film_view = {"elevation": -15}
    half_width, height = 10.0, 20.0
    recipe = {
        "shape": "raptor",
        "memory": 16,
        "critic": "privileged",
        "n_worlds": 16384,
        "iterations": 6000,
        "evaluate_every": 500,
        "minibatches": 8,
        "learning_rate": 5e-3,
        "discount": 0.995,
        "init_std": 0.4,
        "entropy": 0.006,
    }

    drawn: bool = True
    """Whether airframes are drawn; False for the airframe of the simulation."""
    tumbling: float = setting(default=0.5, low=0.0, high=1.0)
    """Fraction of starts with any attitude."""
    speed: float = setting(default=2.0, low=0.0)
    """Largest component of the velocity of a goal at the start, m/s. Half of the goals move."""
    delay: float = setting(default=0.01, low=0.0, high=1.0)
    """Largest delay of commands, s."""
    wind: float = setting(default=2.0, low=0.0)
    """Largest speed of the mean wind, m/s."""
    seconds: float = 10.0
    """Length of an episode, s."""
    tolerance: float = 0.2
    """Distance below which the drone is at its goal, m."""
    noise: float = setting(default=1.0, low=0.0)
    """Factor of ``NOISE``."""
    goal_vel: Array = state((3,))
    """Velocity of the goal, world frame, m/s."""
    goal_rate: Array = state((1,))
    """Angular velocity of the goal on its ellipse around ``MIDDLE``, rad/s."""
    goal_yaw: Array = state((1,))
    """Yaw of the goal, rad."""

    def install(self, sim: Sim) -> None:
        n_steps, batch = int(self.delay * sim.freq), (sim.n_worlds, sim.n_drones)
        if self.drawn:
            sim.add(RandomAirframe())
        sim.add(Latency(np.zeros(batch, int), max_delay=n_steps))
        # Delays are rounded down, so that each has the same probability.
        sim.add(
            Randomize(
                delay=(0, np.nextafter(n_steps + 1, 0)),
                wind=(0.0, self.wind),
                rotor_thrust=(0.9, 1.0),
                optional=("wind",),
            )
        )
        self.add_states(sim)

    def actions(self, sim: Sim) -> Actions:
        return rotor_speeds(sim.default_data.params)

    def spawn(self, data: SimData, key: Array) -> SimData:
        x = draw(key, data.core.n_drones, start=3, rpy=3, vel=3, ang_vel=3, attitude=3, goal=3, goal_vel=3, yaw=1,
                 tumbling=1, moving=1, rate=1)  # fmt: skip
        tumbles = x["tumbling"] < self.tumbling
        tilt = rotation.from_rpy(scale_symmetric(x["rpy"], np.array([0.2, 0.2, np.pi])))
        quat = jnp.where(tumbles, random_attitude(x["attitude"]), tilt)
        speed = jnp.where(tumbles, 3.0, 0.5)
        goal = MIDDLE + scale_symmetric(x["goal"], 1.0)
        pos = goal + scale_symmetric(x["start"], 0.5)
        data = flying(
            data, pos, quat, speed * scale_symmetric(x["vel"], 1.0), speed * scale_symmetric(x["ang_vel"], 1.0)
        )
        rotor_vel = jnp.broadcast_to(hover_rotor_states(drawn_data(data).params), data.states.rotor_vel.shape)
        data = data.replace(states=data.states.replace(rotor_vel=rotor_vel))
        moves = x["moving"] < 0.5
        goal_vel = jnp.where(moves, scale_symmetric(x["goal_vel"], self.speed), 0.0)
        goal_rate = jnp.where(moves, MAX_RATE * (0.25 + 0.75 * x["rate"]), 0.0)
        goal_yaw = scale_symmetric(x["yaw"], np.pi)
        return self.write(data, goal=goal, goal_vel=goal_vel, goal_rate=goal_rate, goal_yaw=goal_yaw)

    def after_substep(self, data: SimData) -> SimData:
        record = self.read(data)
        goal_vel = record.goal_vel - record.goal_rate**2 * (record.goal - MIDDLE) / data.core.freq
        return self.write(data, goal=record.goal + goal_vel / data.core.freq, goal_vel=goal_vel)

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return what RAPTOR observes, in the frame of the goal, as PX4 limits it."""
        s, record = data.states, self.read(data)
        errors = normal(world_key(data, self.name), (*s.pos.shape[:-1], 12), s.pos.dtype)
        std = np.repeat([self.noise * x for x in NOISE.values()], 3)
        pos_error, attitude_error, vel_error, ang_vel_error = jnp.split(std * errors, 4, axis=-1)
        quat = rotation.multiply(s.quat, rotation.from_rpy(attitude_error))
        pos, vel = s.pos + pos_error, s.vel + vel_error
        return state_from_goal(pos, quat, vel, record.goal, record.goal_vel, record.goal_yaw) | {
            "ang_vel": s.ang_vel + ang_vel_error,
            "last_action": 2 * data.controls.rotor_vel / data.params.rotor_vel_max - 1,  # type: ignore[operator]
        }

    def privileged(self, data: SimData) -> dict[str, Array]:
        record = self.read(data)
        return {"difference": data.states.pos - record.goal, "vel": data.states.vel - record.goal_vel}

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        turn = self.read(data).goal_yaw[..., 0] - rotation.yaw(data.states.quat)
        return {
            "proximity": terms.proximity(self.error(data), coarse=1.0, fine=10.0),
            "upright": 0.3 * rotation.z_axis(data.states.quat)[..., 2],
            "yaw": 0.2 * jnp.cos(turn),
            "spin": -0.005 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "beyond": -0.05 * jnp.sum(jnp.square(action - rotation.clip(action, -1.0, 1.0)), axis=-1),
            "crash": -20.0 * self.crashed(data),
        }
