"""Land on a pad, which stands or moves."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, grid_2d
from crazysim.core.pipeline import insert_fn_before
from crazysim.core.plugin import FunctionPlugin, Placement, Simulation
from crazysim.core.stage import stage
from crazysim.envs.env import Task
from crazysim.envs.random import uniform
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.core import NAME, pick, state_of
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf

RADIUS, HEIGHT = 0.25, 0.2
"""Radius of a pad, and height of its upper side, m."""
SPACING = 3.0
"""Distance of the pads of several drones, m; each has its own, and is told of no other."""
HALF_WIDTH, CEILING = 1.4, 2.5
"""Farthest from the middle of the pad's way along x and y, and highest, that a drone may be, m."""
CIRCLE = (0.3, 0.7)
"""Least and largest radius of the circle that a moving pad goes round, m."""
SOFT = 0.5
"""Largest speed relative to the pad at touch-down, m/s."""
UPRIGHT = np.cos(np.pi / 9)
"""Least vertical part of the body z axis at touch-down: 20 degrees of tilt."""


class Landing(PyTree):
    """Where each drone's pad goes, and how its landing ended."""

    circle: Array = leaf("drone", 1)
    """Radius of the circle that the pad goes round, m; zero for one that stands. (n_worlds, n_drones, 1)"""
    rate: Array = leaf("drone", 1)
    """Its angular velocity on the circle, rad/s. (n_worlds, n_drones, 1)"""
    phase: Array = leaf("drone", 1)
    """Its angle at the episode's beginning, rad. (n_worlds, n_drones, 1)"""
    landed: Array = leaf("drone", 0)
    """Whether the drone has touched down softly. (n_worlds, n_drones)"""
    crashed: Array = leaf("drone", 0)
    """Whether it has hit something otherwise, or left its part of the arena. (n_worlds, n_drones)"""
    out_before: Array = leaf("drone", 0)
    """Whether it had landed or crashed before this environment step. (n_worlds, n_drones)"""
    to_go_before: Array = leaf("drone", 0)
    """Distance from the pad before this environment step, m. (n_worlds, n_drones)"""

    @property
    def out(self) -> Array:
        """Whether the drone has landed or crashed. (n_worlds, n_drones)"""
        return self.landed | self.crashed


def land(sim: Simulation, speed: float = 0.0, radius: float = RADIUS, seconds: float = 6.0) -> Task:
    """Return the task of landing on a pad, 0.2 m above the floor.

    Landed is who touches the pad from above, within its radius, with at most 0.5 m/s relative to it and a tilt of at
    most 20 degrees; contact is checked at every physics step. Any other touch is a crash, and so is leaving the 2.8 m
    around the middle of the pad's way. An episode ends when every drone has landed or crashed.

    Args:
        sim: The simulation, which is given a pad per drone.
        speed: Speed with which a pad goes round a circle of 0.3 to 0.7 m, either way, m/s; zero for pads that stand.
        radius: Radius of a pad, m.
        seconds: Length of an episode, s.

    Raises:
        ConfigError: If speed or radius cannot be.
    """
    for name, value, low, high in (("speed", speed, 0.0, 10.0), ("radius", radius, 0.05, 0.5)):
        if not isinstance(value, (int, float)) or not low <= value <= high:
            raise ConfigError(f"{name} is {value!r}; a pad has from {low} to {high} (m/s, and m)")
    n_drones = sim.n_drones
    middle = np.concatenate([SPACING * grid_2d(n_drones), np.full((n_drones, 1), HEIGHT)], axis=-1)
    pads = sim.scene.add("landing_pad", "pad", count=n_drones, pos=middle, radius=radius)
    contacts = sim.scene.contact_fn([pads], drones=False)
    zero, no = jnp.zeros_like(sim.data.states.pos[..., :1]), jnp.zeros((sim.n_worlds, n_drones), bool)
    record = Landing(zero, zero, zero, no, no, no, zero[..., 0])

    def around(data: SimData) -> Array:
        """Return the middle of the way of each drone's pad; a stage of one drone finds its own by its number, m."""
        return pick(jnp.asarray(middle, data.states.pos.dtype), data.core.drone_id)

    def pad(data: SimData, steps: Array) -> tuple[Array, Array]:
        """Return position, m, and velocity, m/s, of each drone's pad after some steps. (..., 3) each"""
        own = data.plugins[NAME]
        angle = own.phase + own.rate * (steps / data.core.freq)
        out = jnp.concatenate([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=-1)
        along = jnp.concatenate([-jnp.sin(angle), jnp.cos(angle), 0 * angle], axis=-1)
        return around(data) + own.circle * out, own.circle * own.rate * along

    def now(data: SimData) -> tuple[Array, Array]:
        return pad(data, data.core.steps[..., None])

    @stage("world")
    def move(data: SimData) -> SimData:
        """Have the pads where they are at the end of this step."""
        pos, vel = pad(data, data.core.steps + 1)
        return pads.set_pose(data, pos, vel=vel)

    @stage("drone")
    def touch(data: SimData) -> SimData:
        """Tell at the first touch whether it is a landing."""
        own, s, report = data.plugins[NAME], data.states, contacts(data)
        pos, vel = pad(data, data.core.steps + 1)
        if report.objects is None or report.floor is None:
            raise TypeError("report.objects, report.floor: None, where the kind has one")
        mine = np.arange(n_drones) == data.core.drone_id
        on_pad, elsewhere = jnp.any(report.objects & mine), jnp.any(report.objects & ~mine) | report.floor
        apart, past = s.pos - pos, s.vel - vel
        above = (apart[2] > 0) & (apart[0] * apart[0] + apart[1] * apart[1] < radius**2)
        soft = (rotation.dot(past, past)[0] <= SOFT**2) & (rotation.z_axis(s.quat)[2] >= UPRIGHT)
        good = on_pad & above & soft & ~elsewhere
        bad = (on_pad & ~good) | elsewhere | beyond(data)
        new = own.replace(landed=own.landed | (good & ~own.crashed), crashed=own.crashed | (bad & ~own.landed))
        return data.replace(plugins=data.plugins | {NAME: new})

    def beyond(data: SimData) -> Array:
        pos = data.states.pos
        return jnp.any(jnp.abs(pos - around(data))[..., :2] > HALF_WIDTH, axis=-1) | (pos[..., 2] > CEILING)

    sim.add(FunctionPlugin(NAME, record, [Placement(touch, before="increment_steps")]))
    if speed > 0:
        insert_fn_before(sim.step_pipeline, NAME, move, f"{NAME}_pads")
        sim.build_step_fn()

    def spawn(data: SimData, keys: Array) -> SimData:
        x = uniform(keys, n_drones, 12)
        off, rpy, vel = jnp.split(2 * x[..., :9] - 1, 3, axis=-1)
        at = middle.astype(x.dtype) + off * np.array([1.0, 1.0, 0.4], x.dtype) + np.array([0, 0, 1.0], x.dtype)
        data = flying(data, at, rotation.from_rpy(0.2 * rpy), 0.3 * vel)
        circle = CIRCLE[0] + (CIRCLE[1] - CIRCLE[0]) * x[..., 9:10]
        rate = jnp.where(x[..., 10:11] < 0.5, -speed, speed) / circle
        moves = float(speed > 0)
        new = record_of(data).replace(circle=moves * circle, rate=moves * rate, phase=2 * jnp.pi * x[..., 11:12])
        data = data.replace(plugins=data.plugins | {NAME: new})
        pos, along = now(data)
        return pads.set_pose(data, pos, vel=along) if speed > 0 else data

    def to_pad(data: SimData) -> Array:
        return rotation.safe_norm(now(data)[0] - data.states.pos)[..., 0]

    def observe(data: SimData) -> dict[str, Array]:
        pos, vel = now(data)
        return state_of(data) | {
            "difference_to_pad": pos - data.states.pos,
            "difference_to_pad_vel": vel - data.states.vel,
        }

    def mark(data: SimData) -> SimData:
        own = record_of(data)
        new = own.replace(out_before=own.out, to_go_before=to_pad(data))
        return data.replace(plugins=data.plugins | {NAME: new})

    def reward(data: SimData, action: Array, last_action: Array) -> Array:
        """Twice the way gained, m; less for speed near the pad, turning, jerky actions; 10 landed, -10 crashed."""
        own, d = record_of(data), to_pad(data)
        past = rotation.safe_norm(now(data)[1] - data.states.vel)[..., 0]
        spin = jnp.sum(jnp.square(data.states.ang_vel), axis=-1)
        jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
        paid = 2.0 * (own.to_go_before - d) - 0.1 * past * jnp.exp(-4 * d) - 0.002 * spin - 0.02 * jerk
        paid = paid + 10.0 * own.landed - 10.0 * own.crashed
        return jnp.where(own.out_before, 0, paid)

    def info(data: SimData) -> dict[str, Array]:
        return {"landed": record_of(data).landed, "crashed": record_of(data).crashed}

    return Task(
        "land",
        spawn,
        observe,
        reward,
        terminated=lambda data: jnp.all(record_of(data).out, axis=-1),
        error=to_pad,
        info=info,
        target=lambda data: now(data)[0],
        camera={"lookat": (0, 0, 0.6), "distance": 3.5, "elevation": -20},
        mark=mark,
        succeeded=lambda data: record_of(data).landed,
        seconds=seconds,
        settings={"speed": speed, "radius": radius, "seconds": seconds},
    )


def record_of(data: SimData) -> Landing:
    """Return the task's record."""
    return data.plugins[NAME]
