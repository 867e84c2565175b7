"""Pick up a load from a moving trailer with a hook, and carry it to a goal."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, grid_2d
from crazysim.core.plugin import state
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.random import draw, scale_symmetric, scale_to
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.goals import pick_entry, state_of
from crazysim.lab.tasks.bring_load import BringLoad
from crazysim.lab.vehicles.car_state import to_world_frame
from crazysim.lab.vehicles.cars import Cars
from crazysim.lab.vehicles.model import load_vehicle
from crazysim.lab.vehicles.trailer import trailer_axles, trailer_rates
from crazysim.plugins.payloads import Hook
from crazysim.sim.sim import Sim

CARS, VEHICLE = "cars", "f1tenth_ros"
"""Name of the population of cars, and name of the vehicle model."""
SPACING = 10.0
"""Distance between the initial positions of the cars of several drones, m."""
HALF_WIDTH, MIN_HEIGHT, CEILING = 4.5, 0.25, 2.5
"""Largest distance of a drone from its car's initial position along x and y, and its smallest and largest height, m. A
drone at the smallest height is above cars and trailers."""
LOAD_SIZE, RING_HEIGHT = (0.08, 0.08, 0.05), 0.07
"""Length, width and height of a load, and height of its ring above its middle, m."""
HOOK_MASS, HOOK_DAMPING, HOOK_REACH, MAX_HOOK_SPEED = 0.003, 2e-4, 0.07, 0.6
"""Mass of the hook, kg; damping of its joint, N m s; largest distance from a ring, m, and largest speed relative to the
ring, m/s, at which the hook picks up a load."""
MIN_SPEED_FRACTION = 0.3
"""Smallest speed of a car, as a fraction of its setting ``speed``."""
MAX_STEER = 0.25
"""Largest steering angle of a car, rad; the car then drives on a circle of 1.3 m radius."""
GOAL_BOX = ((-1.0, -1.0, 0.8), (1.0, 1.0, 1.3))
"""Lower and upper corner of the box of a load's goals, relative to its car's initial position, m."""
DROP_HEIGHT = 0.15
"""Height of a ring below which a load that was taken is dropped, m; rings on trailers are higher."""


class Deliver(BringLoad):
    """Pick up a load from a moving trailer with a hook, and hold it at a goal.

    A car that drives in circles, or straight ahead, pulls a trailer with a load. The load has a ring, and does not slip
    on the trailer. A drone starts in flight above the load with a hook on a swinging rod. The hook picks up the load
    within 7 cm of the ring, at a relative speed below 0.6 m/s. The load is delivered when it has been within
    ``tolerance`` of its goal, slower than 0.2 m/s, for ``hold`` seconds. A drone crashes when it is lower than 0.25 m,
    higher than 2.5 m or more than 4.5 m from its car's initial position along x or y, or when the ring of its load
    sinks below 0.15 m after the pick-up. A crash ends the episode.
    """

    name = "deliver"
    film_view = {"elevation": -20}

    mass: float = setting(default=0.008, low=1e-4, high=1.0)
    """Mass of the load, kg."""
    length: float = setting(default=0.3, low=0.2, high=1.0)
    """Length of the rod, m."""
    speed: float = setting(default=0.5, low=0.0, high=2.0)
    """Largest speed of a car, m/s; the smallest speed is 0.3 times that."""
    seconds: float = 8.0
    """Length of an episode, s."""
    taken: Array = state((), dtype=bool)
    """Whether the hook has taken the load off the trailer."""

    def install(self, sim: Sim) -> None:
        car_positions = SPACING * grid_2d(sim.n_drones)
        settings: dict[str, Any] = {"pos": car_positions, "level": "speed", "trailer": True, "name": CARS}
        sim.add(Cars(sim.n_drones, vehicle=VEHICLE, **settings))
        rings = np.broadcast_to(np.pad(car_positions, ((0, 0), (0, 1))), (sim.n_worlds, sim.n_drones, 3))
        hook: dict[str, Any] = {
            "hook_mass": HOOK_MASS,
            "damping": HOOK_DAMPING,
            "reach": HOOK_REACH,
            "max_speed": MAX_HOOK_SPEED,
        }
        sim.add(Hook(self.mass, length=self.length, size=LOAD_SIZE, ring=RING_HEIGHT, load_at=rings, **hook))

        self.add_states(sim)

    def after_substep(self, data: SimData) -> SimData:
        load = data.plugins["load"]
        taken = self.read(data).taken | load.attached
        ring, vel = (pick_entry(x, data.core.drone_id) for x in ring_motion(data.plugins[CARS]))
        load = load.replace(pos=jnp.where(taken, load.pos, ring), vel=jnp.where(taken, load.vel, vel))
        data = data.replace(plugins=data.plugins | {"load": load})
        crashed = has_left_arena(data) | (taken & (load.pos[2] < DROP_HEIGHT))
        return self.write(self.update_outcome(data, crashed), taken=taken)

    def spawn(self, data: SimData, key: Array) -> SimData:
        car, load = data.plugins[CARS], data.plugins["load"]
        x = draw(key, data.core.n_drones, start=3, rpy=3, vel=3, yaw=1, speed=1, steer=1, goal=3)
        speed, steer = (
            self.speed * scale_to(x["speed"], MIN_SPEED_FRACTION, 1.0),
            scale_symmetric(x["steer"], MAX_STEER),
        )
        yaw = scale_symmetric(x["yaw"], np.pi)
        car = car.replace(
            yaw=yaw,
            body_vel=jnp.concatenate([speed, 0 * speed], axis=-1),
            joints=jnp.concatenate([yaw, yaw], axis=-1),
            steer=0 * steer,
            command=jnp.concatenate([speed, steer], axis=-1),
        )
        ring, ring_vel = ring_motion(car)
        pos = ring + scale_symmetric(x["start"], np.array([0.8, 0.8, 0.3])) + np.array([0.0, 0.0, self.length + 0.6])
        vel = scale_symmetric(x["vel"], 0.3)
        data = flying(data, pos, rotation.from_rpy(scale_symmetric(x["rpy"], 0.1)), vel)
        s = data.states
        load = load.replace(
            pos=ring,
            vel=ring_vel,
            tip_pos=s.pos - np.array([0.0, 0.0, self.length], pos.dtype),
            tip_vel=s.vel,
            grip=jnp.ones_like(load.grip),
        )
        data = data.replace(plugins=data.plugins | {CARS: car, "load": load})
        goal = scale_to(x["goal"], *np.array(GOAL_BOX)) + initial_car_pos(data)
        return self.write(data, goal=goal)

    def remaining_way(self, data: SimData) -> Array:
        load = data.plugins["load"]
        return rotation.safe_norm(load.pos - load.tip_pos)[..., 0] + self.error(data)

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return the drone's state, the relative motion of hook and load, and the vector to the goal.

        ``hook_pos``, m, and ``hook_vel``, m/s, are relative to the drone. ``difference_to_load``, m, and
        ``difference_to_load_vel``, m/s, are position and velocity of the ring relative to the hook.
        ``difference_to_goal``, m, is the vector from the ring to its goal. ``taken`` is 1 after the hook has taken the
        load, and 0 before.
        """
        s, load, record = data.states, data.plugins["load"], self.read(data)
        return state_of(data) | {
            "hook_pos": load.tip_pos - s.pos,
            "hook_vel": load.tip_vel - s.vel,
            "difference_to_load": load.pos - load.tip_pos,
            "difference_to_load_vel": load.vel - load.tip_vel,
            "difference_to_goal": record.goal - load.pos,
            "taken": record.taken[..., None].astype(s.pos.dtype),
        }

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        record, load = self.read(data), data.plugins["load"]
        distance = rotation.safe_norm(load.pos - load.tip_pos)[..., 0]
        relative_speed = rotation.safe_norm(load.vel - load.tip_vel)[..., 0]
        return {
            "progress": 5.0 * self.progress(data),
            "meeting": jnp.where(record.taken, 1.0, 0.1 * jnp.exp(-4 * distance) * (1 + jnp.exp(-2 * relative_speed))),
            "proximity": 2.0 * record.taken * terms.proximity(self.error(data), coarse=1.5, fine=10.0),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "crash": -5.0 * record.failure,
        }

    def info(self, data: SimData) -> dict[str, Array]:
        return {"taken": self.read(data).taken} | super().info(data)

    def subjects(self, data: SimData) -> Array:
        return data.plugins["load"].pos


def ring_positions(car: Cars) -> Array:
    """Return the positions of the rings of loads on the trailers of one world, m. (n_members, 3)"""
    vehicle = load_vehicle(VEHICLE)
    centre, thickness = vehicle.value("trailer.deck_centre"), vehicle.value("trailer.deck")[2]
    front, _ = trailer_axles(car.state, car.params)
    deck_offset = jnp.concatenate([car.yaw * 0 + centre[0], car.yaw * 0], axis=-1)
    deck_centre = front + to_world_frame(car.joints[..., 1:], deck_offset)  # type: ignore[index]
    height = vehicle.number("trailer.wheel_radius") + centre[2] + thickness / 2 + LOAD_SIZE[2] / 2 + RING_HEIGHT
    return jnp.concatenate([deck_centre, jnp.full_like(car.yaw, height)], axis=-1)


def ring_motion(car: Cars) -> tuple[Array, Array]:
    """Return positions, m, and velocities, m/s, of the rings of loads on the trailers of one world. (n_members, 3) each

    The velocities are exact derivatives. A difference of two float32 positions, times 500 Hz, has errors of 2e-4 m/s.
    """

    def positions_of_state(*state: Array) -> Array:
        return ring_positions(car.replace(**dict(zip(("pos", "yaw", "joints"), state, strict=True))))

    derivatives = car.vel, car.yaw_rate, trailer_rates(car.state, car.params)
    return jax.jvp(positions_of_state, (car.pos, car.yaw, car.joints), derivatives)


def initial_car_pos(data: SimData) -> Array:
    """Return the initial position of each drone's car, for the data of one drone or one world, m. (..., 3)"""
    car_positions = np.pad(SPACING * grid_2d(data.core.n_drones), ((0, 0), (0, 1)))
    return pick_entry(jnp.asarray(car_positions, data.states.pos.dtype), data.core.drone_id)


def has_left_arena(data: SimData) -> Array:
    """Whether a drone is too far from its car's initial position, too low or too high. (...)"""
    pos = data.states.pos
    is_far = jnp.any(jnp.abs(pos - initial_car_pos(data))[..., :2] > HALF_WIDTH, axis=-1)
    return is_far | (pos[..., 2] < MIN_HEIGHT) | (pos[..., 2] > CEILING)
