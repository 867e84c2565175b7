"""A load on a rod or a cable below each drone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import Objects, SimData, SimStateDeriv
from crazysim.core.integration import rk4
from crazysim.core.plugin import Plugin, Simulation, StagePlacement, check_parameter, parameter
from crazysim.core.settings import as_mask, color, setting
from crazysim.core.stage import Stage
from crazysim.plugins.payloads.colliders import LoadBody, rest_height
from crazysim.plugins.payloads.link import LinkParams, couple_bodies, end_relative_motion, link_geometry
from crazysim.plugins.payloads.point_load import (
    CABLE_SEGMENTS,
    LoadData,
    PointLoad,
    add_to_scene,
    find_integrator,
    free_acceleration,
    hanging_state,
    link_pieces,
    rotation_from_z,
)
from crazysim.pytree import device_array, select_worlds

L = TypeVar("L", bound=LoadData)

ABSENT_LOAD_DEPTH = 1000.0
"""Depth by which loads that do not exist are moved out of sight, m."""


class SlungLoad(PointLoad, Plugin):
    """A load on a rod or a cable, a point mass that hangs from each drone.

    Load and drone are integrated together. A cable is slack while the load is nearer than the cable's length, and pulls
    as soon as it is taut. The load starts at rest below the drone's position at the time when the plugin is added.
    """

    mass: ArrayLike = parameter(low=0.0)
    """Mass of the load, kg; at zero the drone flies as without a load. () or (n_worlds, n_drones)"""
    length: ArrayLike = parameter(default=0.4, positive=True)
    """Length of rod or cable, m. () or (n_worlds, n_drones)"""
    cable: bool = False
    """True for a cable, False for a rigid rod."""
    attach: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Attachment point relative to the drone's centre of mass, body frame, m. (3,) or (n_worlds, n_drones, 3)"""
    damping: ArrayLike = parameter(default=0.0, low=0.0)
    """Viscous torque of the joint per angular velocity, N m s. () or (n_worlds, n_drones)"""
    restitution: ArrayLike = parameter(default=0.0, low=0.0, high=1.0)
    """Ratio of the radial speeds after and before a cable becomes taut, 0 to 1. () or (n_worlds, n_drones)"""
    drag: ArrayLike = parameter(default=0.0, low=0.0)
    """Linear drag coefficient of the load, N s/m, through which wind and downwash act on the load.
    () or (n_worlds, n_drones)"""
    friction: ArrayLike = parameter(default=0.6, low=0.0)
    """Coulomb's coefficient between load and floor. () or (n_worlds, n_drones)"""
    size: ArrayLike = setting(default=0.03, positive=True, shapes=((), (3,)))
    """Radius of a ball, or full lengths of a box, m, for contacts, the floor and images. () or (3,)"""
    rgba: ArrayLike | None = color()
    """Colour; None for the default. (4,)"""
    in_scene: bool = True
    """True to put loads and links into the scene, where they are drawn and reported as contacts of drones."""
    name: str = "load"

    def record(self, sim: Simulation) -> LoadData:
        return load_record(self, sim, LoadData, self.cable, rest_height(self.size))

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        """Return the stage that stops loads at the floor, and for cables with ``rk4`` the stage of their impulses."""
        placements = [StagePlacement(Stage(self.stop_at_floor, "drone"), "measurements", name=f"{self.name}_floor")]
        method = find_integrator(sim)
        if self.cable and method is rk4:
            placements.append(StagePlacement(Stage(self.become_taut, "drone"), "integration", name=f"{self.name}_taut"))
        return placements

    def constrain(self, data: SimData, deriv: SimStateDeriv, dt: float | None) -> SimStateDeriv:
        load, p = self.read(data), data.params
        free_acc = free_acceleration(data, load, self.name, dt)
        motion = couple_bodies(
            data.states,
            deriv,
            p.mass,
            p.J_inv,
            self._link_params(load),
            load.pos,
            load.vel,
            free_acc,
            dt,
            data.core.freq,
        )
        rates = {"pos": motion.pos_rate, "vel": motion.acc}
        return motion.deriv.replace(plugins=deriv.plugins | {self.name: rates})

    def become_taut(self, data: SimData) -> SimData:
        """Apply the impulse of one drone's cable if it is taut while the load moves outwards."""
        load, p = self.read(data), data.params
        states, vel = end_relative_motion(data.states, p.mass, p.J_inv, self._link_params(load), load.pos, load.vel)
        return self.write(data.replace(states=states), load.replace(vel=vel))

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
        load = self.read(data)
        return move_loads(data, self.name, load, load.pos, load.attached, CABLE_SEGMENTS if self.cable else 1)

    def body(self, data: SimData) -> LoadBody:
        load = self.read(data)
        mass = jnp.broadcast_to(load.mass, (*load.pos.shape[:-1], 1))
        return LoadBody(load.pos, rotation_from_z(shape_axis(data, load, load.pos)), load.vel, mass)

    def with_vel(self, data: SimData, vel: Array) -> SimData:
        return self.write(data, self.read(data).replace(vel=vel))

    def joined_mask(self, data: SimData) -> Array:
        n = data.states.pos.shape[0]
        return np.eye(n, dtype=bool) & self.read(data).attached & (not self.cable)

    def _link_params(self, load: LoadData) -> LinkParams:
        return LinkParams(
            load.attach, load.length, load.mass, load.damping, load.restitution, load.attached, self.cable
        )


def load_record(
    plugin: Plugin,
    sim: Simulation,
    record_type: type[L],
    is_cable: bool,
    clearance: float,
    ring: float | None = None,
    **fields: Any,
) -> L:
    """Return the record of loads at rest below their drones, from the settings of a plugin, after checks.

    Args:
        plugin: The plugin.
        sim: Simulation.
        record_type: Class of the record.
        is_cable: True for cables.
        clearance: Height of a load's position above the floor when it rests there, m.
        ring: Height above the middle of the load of the ring that a hook holds, m; None without a hook.
        **fields: Further fields of the record.
    """
    height_at_rest, states = check_parameter(sim, "size", clearance, low=0.0), sim.data.states
    attached = device_array(np.ones(states.pos.shape[:2]), bool)
    fields |= {} if is_cable else {"restitution": None}
    load = plugin.fill_record(sim, record_type, clearance=height_at_rest, attached=attached, **fields)
    # A setting that is zero everywhere becomes None and is not computed.
    optional_names = [name for name in ("attach", "damping", "restitution", "drag") if getattr(load, name) is not None]
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
    name: str,
    load: LoadData,
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
        name: Name of the plugin.
        load: Record of the loads.
        tip: Ends of the links, world frame, m. (n_drones, 3)
        is_held: True for links with a load or hook at their end; other links point down the body's z axis. (n_drones,)
        n_pieces: Number of straight pieces of a link.
        ring: Height above the middle of the load of the point from which the load hangs, m.
        show_free_links: True to show links of loads that do not exist.
    """
    hidden_offset = jnp.where(load.mass > 0, 0.0, ABSENT_LOAD_DEPTH) * np.array([0.0, 0.0, 1.0], tip.dtype)
    link = link_geometry(data.states, tip, load.vel, load.attach)
    offset = jnp.where(is_held[..., None], link.offset, -load.length * link.rot[..., 2])
    load_axis = shape_axis(data, load, tip)
    top = data.states.pos if link.arm is None else data.states.pos + link.arm
    links = link_pieces(top if show_free_links else top - hidden_offset, offset, load.length, n_pieces)
    poses = {name: (load.pos - hidden_offset - ring * load_axis, rotation_from_z(load_axis)), f"{name}_link": links}
    return data.objects.with_poses(poses)  # type: ignore[union-attr]


def shape_axis(data: SimData, load: LoadData, tip: Array) -> Array:
    """Return the axis of the loads' shapes: along the link where a load hangs, else vertical. (..., 3)

    Args:
        data: Data of one drone or one world.
        load: Record of the loads.
        tip: Ends of the links, world frame, m. (..., 3)
    """
    direction = link_geometry(data.states, tip, load.vel, load.attach).direction
    return jnp.where(load.attached[..., None], -direction, jnp.asarray([0.0, 0.0, 1.0], tip.dtype))
