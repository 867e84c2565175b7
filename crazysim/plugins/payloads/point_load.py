"""Parts common to all loads: forces of air and floor, poses in the scene, and the swing of the rod."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData, SimState
from crazysim.core.plugin import Plugin, Simulation, derived, state
from crazysim.core.settings import as_mask, as_rgba
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import select_worlds
from crazysim.plugins.effects.ground import ground_height
from crazysim.plugins.effects.moving_air import BodiesInAir
from crazysim.plugins.effects.wind import wind_at
from crazysim.plugins.effects.wind_field import WindField
from crazysim.plugins.payloads.colliders import CollidingPlugin
from crazysim.plugins.payloads.link import drag_rate, link_geometry

CABLE_SEGMENTS = 8
"""Number of straight pieces with which a cable is drawn."""
LINK_RADIUS = 0.004
"""Radius of a drawn rod or cable, m."""
WIRE_RADIUS, HOOK_RADIUS = 0.003, 0.0045
"""Radii of the wires by which a drawn load hangs, and of a drawn hook, m."""
HOOK_OUTLINE = ((0, -0.045), (-0.02, -0.025), (-0.014, -0.004), (0, 0.003), (0.014, -0.004), (0.02, -0.02))
"""Drawn shape of a hook: x, and z towards the load from the hook's position, m."""
HEAD_RADIUS, HEAD_HEIGHT = 0.0245, 0.021
"""Radius of the ball that represents a hook in collisions, and height of its centre above the hook's position, m."""
DARK, STEEL, YELLOW = (0.15, 0.15, 0.15, 1.0), (0.35, 0.35, 0.4, 1.0), (0.95, 0.75, 0.1, 1.0)
"""Colours of rods, wires and hooks."""
DRONE_TOUCH_ATTRIBUTES = 'contype="0" conaffinity="2"'
"""MJCF attributes of a geom that drones touch."""


class HangingLoad(CollidingPlugin, BodiesInAir, abstract=True):
    """Base class of plugins with a load below each drone."""

    vel: Array = state((3,))
    """Velocity, world frame, m/s. (n_worlds, n_drones, 3)"""
    attached: Array = state((), dtype=bool)
    """Whether the load hangs from its drone. (n_worlds, n_drones)"""
    clearance: Array = derived()
    """Height of the load's position above the floor when it rests there, m. (1,)"""


class LoadForce(Plugin, abstract=True):
    """Base class of plugins that push the loads of another plugin.

    Their settings have ``load``, the name of the loads' plugin, and their state has ``force``, N, in the world frame.
    """


class PointLoad(CollidingPlugin, abstract=True):
    """Base class of plugins with loads that are point masses on links, one per drone or one for all."""

    def stop_at_floor(self, data: SimData) -> SimData:
        """Stop the load of one drone or one world at the floor."""
        load = self.read(data)
        clearance = load.clearance + ground_height(data, load.pos)
        pos, vel = clip_to_floor(load.pos, load.vel, clearance, load.friction)
        return self.write(data, load.replace(pos=pos, vel=vel))

    def release(self, data: SimData, mask: ArrayLike | None = None) -> SimData:
        """Return the data with the links of some loads cut.

        Args:
            data: Data of all worlds.
            mask: True for drones that let go of their loads, or for worlds in which all drones do; None for all.
                (n_worlds, n_drones) or (n_worlds,)
        """
        load = self.read(data)
        shape = load.attached.shape
        mask = as_mask(mask, shape, shape[:-1], item="drone or world")
        return self.write(
            data, load.replace(attached=select_worlds(mask, jnp.zeros_like(load.attached), load.attached))
        )


def find_integrator(sim: Simulation) -> Callable[..., SimData] | None:
    """Return the function of the integrator, such as ``core.integration.rk4``, or None if the stage is not built in."""
    return getattr(getattr(sim.step_pipeline.get("integration"), "fn", None), "method", None)


def free_acceleration(data: SimData, load: Any, dt: float | None) -> Array:
    """Return the acceleration of one drone's load by gravity, drag and plugins, without its link, m/s^2. (3,)

    Drag cannot reverse a motion (``drag_rate``), and a load without mass moves with the air.

    Args:
        data: Data of one drone.
        load: Plugin of the load.
        dt: Duration of the step, s; None for the derivative at an instant.
    """
    acc = data.params.gravity_vec
    forces = [x.force for x in data.plugins.values() if isinstance(x, LoadForce) and x.load == load.name]
    if forces:
        force = sum(forces[1:], forces[0])
        acc = acc + jnp.where(load.mass > 0, force / jnp.where(load.mass > 0, load.mass, 1.0), 0.0)
    if load.air_vel is None or load.drag is None:
        return acc
    air_vel = wind_at(data, load.pos) + load.air_vel
    if any(isinstance(record, WindField) for record in data.plugins.values()):
        air_vel = air_vel + load.wind_vel
    return acc + drag_rate(load.drag, load.mass, dt, data.core.freq) * (air_vel - load.vel)


def clip_to_floor(pos: Array, vel: Array, clearance: Array, friction: Array) -> tuple[Array, Array]:
    """Return position and velocity of a body that does not fall through the floor.

    On the floor, friction brakes the body along x and y separately.

    Args:
        pos: Position, world frame, m. (..., 3)
        vel: Velocity, world frame, m/s. (..., 3)
        clearance: Height of the body above the floor when it rests there, m. (..., 1)
        friction: Coulomb's coefficient, 1. (..., 1)
    """
    height, climb_rate, horizontal_vel = pos[..., 2:], vel[..., 2:], vel[..., :2]
    is_landed = height <= clearance
    max_speed_loss = jnp.where(is_landed, friction * jnp.maximum(-climb_rate, 0.0), 0.0)
    horizontal_vel = horizontal_vel - jnp.maximum(jnp.minimum(horizontal_vel, max_speed_loss), -max_speed_loss)
    vel = jnp.concatenate([horizontal_vel, jnp.where(is_landed, jnp.maximum(climb_rate, 0.0), climb_rate)], axis=-1)
    return jnp.concatenate([pos[..., :2], jnp.maximum(height, clearance)], axis=-1), vel


@jit_eager_calls("is_cable")
def hanging_state(
    state: SimState, attach: Array | None, length: Array, clearance: Array, is_cable: bool
) -> tuple[Array, Array]:
    """Return position and velocity of a load that hangs at rest below its drone, or rests on the floor.

    Args:
        state: State of the drones. Leaves (..., k)
        attach: Attachment point, body frame, m; None for the centre of mass. (..., 3)
        length: Length of the link, m. (..., 1)
        clearance: Height of the load above the floor when it rests there, m. (..., 1)
        is_cable: Whether the link is a cable, which is slack where the load rests; a rod then lies behind the drone.
    """
    rot = rotation.matrix(state.quat)
    arm = jnp.zeros(3, state.pos.dtype) if attach is None else attach
    attach_pos = state.pos + rotation.matvec(rot, arm)
    drop = jnp.clip(attach_pos[..., 2:] - clearance, -length, length)
    horizontal_offset = jnp.zeros_like(drop) if is_cable else rotation.safe_sqrt((length - drop) * (length + drop))
    heading = rotation.yaw(state.quat)[..., None]
    offset = jnp.concatenate(
        [-horizontal_offset * jnp.cos(heading), -horizontal_offset * jnp.sin(heading), -drop], axis=-1
    )
    vel = state.vel + rotation.matvec(rot, rotation.cross(state.ang_vel, jnp.broadcast_to(arm, state.ang_vel.shape)))
    return attach_pos + offset, vel


@jit_eager_calls("name")
def direction(data: SimData, name: str = "load") -> tuple[Array, Array]:
    """Return the unit vector from attachment to load, world frame, and its rate, 1/s, for one drone or all. (..., 3)

    Args:
        data: Data of a simulation with a ``SlungLoad`` or a ``Hook``.
        name: Name of the plugin.
    """
    load: Any = data.plugins[name]
    pos, vel = (load.tip_pos, load.tip_vel) if hasattr(load, "tip_pos") else (load.pos, load.vel)
    link = link_geometry(data.states, pos, vel, load.attach)
    swing_vel = link.vel - rotation.dot(link.direction, link.vel) * link.direction
    is_zero = link.distance == 0
    return link.direction, jnp.where(is_zero, 0.0, swing_vel / jnp.where(is_zero, 1.0, link.distance))


def load_pos(data: SimData, name: str = "load") -> Array:
    """Return the position of the load, world frame, m. (..., 3)"""
    return data.plugins[name].pos


def load_vel(data: SimData, name: str = "load") -> Array:
    """Return the velocity of the load, world frame, m/s. (..., 3)"""
    return data.plugins[name].vel


# Scene ------------------------------------------------------------------------------------------------------


def add_to_scene(
    sim: Simulation,
    name: str,
    size: ArrayLike,
    rgba: ArrayLike | None,
    length: float,
    n_loads: int,
    n_pieces: int,
    ring: float | None = None,
) -> None:
    """Add the loads and links of a plugin to the scene, if they are not there yet.

    Args:
        name: Name of the plugin, and of the loads: ``name:0``, ...
        size: Radius of a ball, or full lengths of a box, m.
        length: Length of a link, m.
        n_loads: Number of loads in a world; there is a link for each drone.
        n_pieces: Number of straight pieces of each link.
        ring: Height of the loads' rings above their middles, m, for links that end in a hook; None for others.
    """
    rgba = as_rgba((0.85, 0.55, 0.2, 1.0) if rgba is None else rgba)
    half_size = np.full(3, size, float) if np.ndim(size) == 0 else np.asarray(size, float) / 2
    geom_type = "sphere" if np.ndim(size) == 0 else "box"
    shape = f'type="{geom_type}" size="{_join_numbers(half_size)}" rgba="{_join_numbers(rgba)}"'
    load_xml = f"<geom {shape} {DRONE_TOUCH_ATTRIBUTES}/>"
    shank = 0.0 if ring is None else HOOK_OUTLINE[0][1]
    link_xml = _rod_xml((0, 0, -length / n_pieces / 2), (0, 0, length / n_pieces / 2 + shank), LINK_RADIUS, DARK)
    objects = [(load_xml, name, n_loads), (link_xml, f"{name}_link", sim.n_drones * n_pieces)]
    if ring is not None:
        wire_ends = [(side * half_size[0], 0, 0 if geom_type == "sphere" else half_size[2]) for side in (-1, 1)]
        load_xml += "".join(_rod_xml(end, (0, 0, ring), WIRE_RADIUS, STEEL) for end in wire_ends)
        hook_xml = (
            f'<geom type="sphere" pos="0 0 {HEAD_HEIGHT}" size="{HEAD_RADIUS}" group="3" {DRONE_TOUCH_ATTRIBUTES}/>'
        )
        hook_xml += "".join(
            _rod_xml((x, 0, -z), (x_2, 0, -z_2), HOOK_RADIUS, YELLOW) for (x, z), (x_2, z_2) in pairwise(HOOK_OUTLINE)
        )
        objects = [(load_xml, name, n_loads), objects[1], (hook_xml, f"{name}_hook", n_loads)]
    for xml, object_name, count in objects:
        sim.scene.add_once(f"<mujoco><worldbody>{xml}</worldbody></mujoco>", object_name, count)


def _rod_xml(start: Iterable[float], end: Iterable[float], radius: float, rgba: Iterable[float]) -> str:
    ends, color = f"{_join_numbers(start)} {_join_numbers(end)}", _join_numbers(rgba)
    return f'<geom type="capsule" fromto="{ends}" size="{radius}" contype="0" conaffinity="0" rgba="{color}"/>'


def _join_numbers(values: Iterable[float]) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)


def link_pieces(top: Array, offset: Array, length: Array, n: int) -> tuple[Array, Array]:
    """Return centres and attitudes of the straight pieces of links; a slack cable sags like a parabola.

    Args:
        top: Upper ends, world frame, m. (k, 3)
        offset: Lower ends relative to the upper ends, m. (k, 3)
        length: Lengths, m. (k, 1) or (1,)
        n: Pieces per link.

    Returns:
        Positions (k n, 3), attitudes, xyzw (k n, 4).
    """
    distance = rotation.safe_norm(offset)
    # Length of a flat parabola of sag d over a span b: b + 8 d^2 / (3 b).
    excess = jnp.maximum(length - distance, 0.0)
    sag = rotation.safe_sqrt(0.375 * excess * jnp.maximum(distance, 0.1 * length)) if n > 1 else 0.0
    fraction = jnp.linspace(0.0, 1.0, n + 1)[:, None, None]
    downwards = jnp.asarray([0.0, 0.0, -1.0], top.dtype)
    nodes = top + fraction * offset + 4 * fraction * (1 - fraction) * sag * downwards
    centre, axis = (nodes[1:] + nodes[:-1]) / 2, nodes[1:] - nodes[:-1]
    return tuple(jnp.swapaxes(x, 0, 1).reshape(-1, x.shape[-1]) for x in (centre, rotation_from_z(axis)))  # type: ignore[return-value]


def rotation_from_z(axis: Array) -> Array:
    """Return the smallest rotation of the z axis to a vector, as a quaternion, xyzw. (..., 4)"""
    z = rotation.safe_normalize(axis, jnp.asarray([0.0, 0.0, 1.0], axis.dtype))
    quat = jnp.stack([-z[..., 1], z[..., 0], jnp.zeros_like(z[..., 0]), 1 + z[..., 2]], axis=-1)
    return rotation.safe_normalize(quat, jnp.asarray([1.0, 0.0, 0.0, 0.0], axis.dtype))
