"""A load on a rod or a cable below each drone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import Objects, SimData, SimStateDeriv
from crazysim.core.integration import rk4
from crazysim.core.plugin import Param, Simulation, StagePlacement, param
from crazysim.core.settings import as_mask, color, setting
from crazysim.engine.pytree import device_array, select_worlds
from crazysim.plugins.payloads.colliders import LoadBody, rest_height
from crazysim.plugins.payloads.link import LinkParams, couple_bodies, end_relative_motion, link_geometry
from crazysim.plugins.payloads.point_load import (
    CABLE_SEGMENTS,
    HangingLoad,
    PointLoad,
    add_to_scene,
    find_integrator,
    free_acceleration,
    hanging_state,
    link_pieces,
    rotation_from_z,
)

ABSENT_LOAD_DEPTH = 1000.0
"""Depth by which loads that do not exist are moved out of sight, m."""


class SlungLoad(PointLoad, HangingLoad):
    """A load on a rod or a cable, a point mass that hangs from each drone.

    Load and drone are integrated together. A cable is slack while the load is nearer than the cable's length, and pulls
    as soon as it is taut. The load starts at rest below the drone's position at the time when the plugin is added.
    """

    mass: Param = param(low=0.0)
    """Mass of the load, kg; at zero the drone flies as without a load. (1,)"""
    length: Param = param(default=0.4, positive=True)
    """Length of rod or cable, m. (1,)"""
    cable: bool = False
    """True for a cable, False for a rigid rod."""
    attach: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Attachment point relative to the drone's centre of mass, body frame, m. (3,)"""
    damping: Param = param(default=0.0, low=0.0)
    """Viscous torque of the joint per angular velocity, N m s. (1,)"""
    restitution: Param = param(default=0.0, low=0.0, high=1.0)
    """Ratio of the radial speeds after and before a cable becomes taut, 0 to 1. (1,)"""
    drag: Param = param(default=0.0, low=0.0)
    """Linear drag coefficient of the load, N s/m, through which wind and downwash act on the load. (1,)"""
    friction: Param = param(default=0.6, low=0.0)
    """Coulomb's coefficient between load and floor, 1. (1,)"""
    size: ArrayLike = setting(default=0.03, positive=True, shapes=((), (3,)), keep=False)
    """Radius of a ball, or full lengths of a box, m, for contacts, the floor and images. () or (3,)"""
    rgba: ArrayLike | None = color()
    """Colour; None for the default. (4,)"""
    in_scene: bool = True
    """Whether to put loads and links into the scene, where they are drawn and reported as contacts of drones."""
    name: str = "load"

    def bind(self, sim: Simulation) -> SlungLoad:
        return bind_load(self, sim, self.cable, rest_height(self.size))

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        placements = [StagePlacement(self.stage(self.stop_at_floor), "measurements", name=f"{self.name}_floor")]
        method = find_integrator(sim)
        if self.cable and method is rk4:
            placements.append(StagePlacement(self.stage(self.become_taut), "integration", name=f"{self.name}_taut"))
        return placements

    def constrain(self, data: SimData, deriv: SimStateDeriv, dt: float | None) -> SimStateDeriv:
        p, free_acc = data.params, free_acceleration(data, self, dt)
        motion = couple_bodies(
            data.states,
            deriv,
            p.mass,
            p.J_inv,
            self._link_params(),
            self.pos,
            self.vel,
            free_acc,
            dt,
            data.core.freq,
        )
        rates = {"pos": motion.pos_rate, "vel": motion.acc}
        return motion.deriv.replace(plugins=deriv.plugins | {self.name: rates})

    def become_taut(self, data: SimData) -> SimData:
        """Apply the impulse of one drone's cable if it is taut while the load moves outwards."""
        p = data.params
        states, vel = end_relative_motion(data.states, p.mass, p.J_inv, self._link_params(), self.pos, self.vel)
        return self.write(data.replace(states=states), self.replace(vel=vel))

    def hang(self, data: SimData, mask: ArrayLike | None = None) -> SimData:
        """Return the data of all worlds with every load attached, and at rest below its drone.

        Use it after moving drones.

        Args:
            data: Data of all worlds.
            mask: True in the worlds to change; None for all. (n_worlds,)
        """
        load, mask = self.read(data), as_mask(mask, data.core.steps.shape[:1])
        pos, vel = hanging_state(data.states, load.attach, load.length, load.clearance, self.cable)
        new_load = load.replace(
            pos=select_worlds(mask, pos, load.pos),
            vel=select_worlds(mask, vel, load.vel),
            attached=select_worlds(mask, jnp.ones_like(load.attached), load.attached),
        )
        return self.write(data, new_load)

    def move_objects(self, data: SimData) -> Objects:
        if not self.in_scene:
            return data.objects  # type: ignore[return-value]
        return move_loads(data, self, self.pos, self.attached, CABLE_SEGMENTS if self.cable else 1)

    def body(self, data: SimData) -> LoadBody:
        load = self.read(data)
        mass = jnp.broadcast_to(load.mass, (*load.pos.shape[:-1], 1))
        return LoadBody(load.pos, rotation_from_z(shape_axis(data, load, load.pos)), load.vel, mass)

    def with_vel(self, data: SimData, vel: Array) -> SimData:
        return self.write(data, self.read(data).replace(vel=vel))

    def joined_mask(self, data: SimData) -> Array:
        n = data.states.pos.shape[0]
        return np.eye(n, dtype=bool) & self.read(data).attached & (not self.cable)

    def _link_params(self) -> LinkParams:
        restitution = self.restitution if self.cable else None
        return LinkParams(self.attach, self.length, self.mass, self.damping, restitution, self.attached, self.cable)


def bind_load(plugin: Any, sim: Simulation, is_cable: bool, clearance: float, ring: float | None = None) -> Any:
    """Return a plugin with loads at rest below their drones.

    Args:
        plugin: The plugin, a ``HangingLoad``.
        is_cable: Whether the links are cables.
        clearance: Height of a load's position above the floor when it rests there, m.
        ring: Height above the middle of the load of the ring that a hook holds, m; None without a hook.
    """
    states = sim.data.states
    height_at_rest = device_array([clearance], states.pos.dtype)
    load = plugin.with_arrays(sim, clearance=height_at_rest, attached=device_array(np.ones(states.pos.shape[:2]), bool))
    # A setting that is zero everywhere becomes None and is not computed.
    optional_names = [name for name in ("attach", "damping", "restitution", "drag") if hasattr(load, name)]
    load = load.replace(**{name: None for name in optional_names if not np.any(np.asarray(getattr(load, name)))})
    if load.drag is None:
        load = load.replace(air_vel=None, wind_vel=None)
    if plugin.in_scene:
        add_to_scene(
            sim, plugin.name, plugin.size, plugin.rgba, float(np.max(load.length)), sim.n_drones,
            CABLE_SEGMENTS if is_cable else 1, ring,
        )  # fmt: skip
    pos, vel = hanging_state(states, load.attach, load.length, height_at_rest, is_cable)
    return load.replace(pos=pos, vel=vel)


def move_loads(
    data: SimData,
    load: Any,
    tip: Array,
    is_held: Array,
    n_pieces: int,
    ring: float = 0.0,
    show_free_links: bool = False,
) -> Objects:
    """Return the objects of one world's scene with loads and links at their poses.

    Loads without mass, which do not exist, are out of sight.

    Args:
        data: Data of one world.
        load: Plugin of the loads.
        tip: Ends of the links, world frame, m. (n_drones, 3)
        is_held: True for links with a load or hook at their end; other links point down the body's z axis. (n_drones,)
        n_pieces: Number of straight pieces of a link.
        ring: Height above the middle of the load of the point from which the load hangs, m.
        show_free_links: Whether to show links of loads that do not exist.
    """
    hidden_offset = jnp.where(load.mass > 0, 0.0, ABSENT_LOAD_DEPTH) * np.array([0.0, 0.0, 1.0], tip.dtype)
    link = link_geometry(data.states, tip, load.vel, load.attach)
    offset = jnp.where(is_held[..., None], link.offset, -load.length * link.rot[..., 2])
    load_axis = shape_axis(data, load, tip)
    top = data.states.pos if link.arm is None else data.states.pos + link.arm
    links = link_pieces(top if show_free_links else top - hidden_offset, offset, load.length, n_pieces)
    middle = load.pos - hidden_offset - ring * load_axis
    poses = {load.name: (middle, rotation_from_z(load_axis)), f"{load.name}_link": links}
    return data.objects.with_poses(poses)  # type: ignore[union-attr]


def shape_axis(data: SimData, load: Any, tip: Array) -> Array:
    """Return the axis of the loads' shapes: along the link where a load hangs, else vertical. (..., 3)

    Args:
        data: Data of one drone or one world.
        load: Plugin of the loads.
        tip: Ends of the links, world frame, m. (..., 3)
    """
    direction = link_geometry(data.states, tip, load.vel, load.attach).direction
    return jnp.where(load.attached[..., None], -direction, jnp.asarray([0.0, 0.0, 1.0], tip.dtype))
