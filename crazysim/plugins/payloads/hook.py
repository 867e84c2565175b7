"""A hook on a rod below each drone, which picks up a load and sets it down."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import Objects, SimData, SimStateDeriv
from crazysim.core.plugin import Param, Simulation, StagePlacement, check_parameter, param, state
from crazysim.core.settings import as_mask, color, setting
from crazysim.engine.pytree import device_array, select_worlds
from crazysim.errors import ConfigError, short_repr
from crazysim.geometry import Shape
from crazysim.plugins.effects.ground import ground_height
from crazysim.plugins.payloads.colliders import Collider, LoadBody, rest_height
from crazysim.plugins.payloads.link import MIN_MASS, LinkParams, couple_bodies, end_relative_motion, link_geometry
from crazysim.plugins.payloads.point_load import (
    HEAD_HEIGHT,
    HEAD_RADIUS,
    HangingLoad,
    clip_to_floor,
    free_acceleration,
    hanging_state,
    rotation_from_z,
)
from crazysim.plugins.payloads.slung import bind_load, move_loads, shape_axis
from crazysim.rotation import dot


class Hook(HangingLoad):
    """A hook on a rigid rod, with one load for each drone.

    With two degrees of freedom the rod swings freely. With one degree of freedom it turns about the body's y axis, and
    passes roll and yaw torque to the drone. A load is a point mass at its ring. The hook picks up a load if hook and
    ring are near each other and their relative speed is low; they stay together after the impact. A load that is let go
    falls freely.
    """

    mass: Param = param(low=0.0)
    """Mass of the load, kg; zero for no load. (1,)"""
    dof: int = setting(default=2, low=1, high=2)
    """Degrees of freedom of the rod, 1 or 2."""
    length: Param = param(default=0.4, positive=True)
    """Length of the rod, m. (1,)"""
    attach: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Position of the joint relative to the drone's centre of mass, body frame, m. (3,)"""
    hook_mass: Param = param(default=0.0203, low=0.0)
    """Mass of the hook, kg. (1,)"""
    damping: Param = param(default=0.001, low=0.0)
    """Viscous torque of the joint per angular velocity, N m s. (1,)"""
    reach: Param = param(default=0.05, low=0.0)
    """Distance between hook and ring below which the hook picks up the load, m. (1,)"""
    max_speed: Param = param(default=0.5, low=0.0)
    """Relative speed of hook and ring below which the hook picks up the load, m/s. (1,)"""
    drag: Param = param(default=0.0, low=0.0)
    """Linear drag coefficient of the load, N s/m. (1,)"""
    friction: Param = param(default=0.6, low=0.0)
    """Coulomb's coefficient between load and floor, 1. (1,)"""
    size: ArrayLike = setting(default=(0.14, 0.14, 0.08), positive=True, shapes=((), (3,)), keep=False)
    """Radius of a ball, or full lengths of a box, m. () or (3,)"""
    ring: float = setting(default=0.1275, low=0.0)
    """Height of the ring above the middle of the load, m."""
    load_at: ArrayLike | None = setting(default=None, keep=False)
    """Initial position of the loads' rings, world frame, m; None for loads on the hooks. (3,) or (n_worlds, n_drones,
    3)"""
    rgba: ArrayLike | None = color()
    """Colour of the loads; None for the default. (4,)"""
    in_scene: bool = True
    """Whether to put loads and rods into the scene."""
    tip_pos: Array = state((3,))
    """Position of the hook, world frame, m. (n_worlds, n_drones, 3)"""
    tip_vel: Array = state((3,))
    """Velocity of the hook, world frame, m/s. (n_worlds, n_drones, 3)"""
    grip: Array = state((), dtype=bool)
    """Command: True to pick up a load within reach and to hold it, False to let go. (n_worlds, n_drones)"""
    name: str = "load"

    @staticmethod
    def bumblebee(mass: ArrayLike = 0.2, dof: int = 2, **settings: Any) -> Hook:
        """Return the hook of AIMotionLab's Bumblebee with a load; the rod turns about the drone's centre of mass.

        Rod of 0.4 m, hook of 0.0203 kg, joint damping 0.001 N m s, ring 0.1275 m above the load's middle (from
        AIMotionLab-Virtual, July 2026; the joint lies at (0.0085, 0, 0) of the lab's body frame, as the centre of mass
        does).

        Args:
            mass: Mass of the load, kg.
            dof: Degrees of freedom of the rod, 1 or 2.
        """
        return Hook(mass, dof, **settings)

    def bind(self, sim: Simulation) -> Hook:
        load = bind_load(self, sim, False, rest_height(self.size) + self.ring, self.ring)
        if self.load_at is None:
            grip = device_array(load.attached, bool)
            return load.replace(tip_pos=device_array(load.pos), tip_vel=device_array(load.vel), grip=grip)
        load_pos = check_parameter(sim, "load_at", self.load_at, (3,))
        pos = np.array(np.broadcast_to(load_pos, load.pos.shape))
        pos[..., 2] = np.maximum(pos[..., 2], np.asarray(load.clearance)[..., 0])
        no_clearance = device_array(np.zeros(load.clearance.shape))
        tip_pos, tip_vel = hanging_state(sim.data.states, load.attach, load.length, no_clearance, False)
        return load.replace(
            pos=device_array(pos),
            vel=device_array(np.zeros_like(pos)),
            tip_pos=tip_pos,
            tip_vel=tip_vel,
            attached=device_array(np.zeros(load.attached.shape), bool),
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        return [
            StagePlacement(self.stage(self.pick_up_and_release), "integration", name=f"{self.name}_grip"),
            StagePlacement(self.stage(self.stop_at_floor), "measurements", name=f"{self.name}_floor"),
        ]

    def constrain(self, data: SimData, deriv: SimStateDeriv, dt: float | None) -> SimStateDeriv:
        p, link = data.params, self._link_params()
        fall_acc = free_acceleration(data, self, dt)
        tip_free_acc = jnp.where(
            self.attached,
            p.gravity_vec + self.mass / (link.mass + MIN_MASS) * (fall_acc - p.gravity_vec),
            p.gravity_vec,
        )
        motion = couple_bodies(
            data.states, deriv, p.mass, p.J_inv, link, self.tip_pos, self.tip_vel, tip_free_acc, dt, data.core.freq
        )
        free_pos_rate = self.vel if dt is None else self.vel + dt * fall_acc
        rates = {
            "tip_pos": motion.pos_rate,
            "tip_vel": motion.acc,
            "pos": jnp.where(self.attached, motion.pos_rate, free_pos_rate),
            "vel": jnp.where(self.attached, motion.acc, fall_acc),
        }
        return motion.deriv.replace(plugins=deriv.plugins | {self.name: rates})

    def pick_up_and_release(self, data: SimData) -> SimData:
        """Pick up one drone's load if it is near and slow, or let it go, as commanded by ``grip``.

        Hook and ring stay together after an impact that conserves momentum: they get the mass-weighted mean of their
        velocities. Then the rigid rod transmits an impulse along its axis to the drone.
        """
        p, s = data.params, data.states
        offset, relative_vel = self.pos - self.tip_pos, self.vel - self.tip_vel
        # A load in reach, slow, and with a mass.
        can_grip = (
            (dot(offset, offset) < self.reach**2)
            & (dot(relative_vel, relative_vel) < self.max_speed**2)
            & (self.mass > 0)
        )
        is_picked_up = self.grip & ~self.attached & can_grip[..., 0]
        new_load = self.replace(attached=self.grip & (self.attached | is_picked_up))
        # Inelastic impact of hook and load; the link ends the motion along it.
        link = new_load._link_params()
        common_vel = self.tip_vel + self.mass / (link.mass + MIN_MASS) * relative_vel
        new_state, tip_vel = end_relative_motion(s, p.mass, p.J_inv, link, self.tip_pos, common_vel)

        def select_picked_up(new: Array, old: Array) -> Array:
            return jnp.where(is_picked_up, new, old)

        tip_vel = select_picked_up(tip_vel, self.tip_vel)
        new_load = new_load.replace(
            tip_vel=tip_vel, vel=select_picked_up(tip_vel, self.vel), pos=select_picked_up(self.tip_pos, self.pos)
        )
        states = s.replace(
            vel=select_picked_up(new_state.vel, s.vel), ang_vel=select_picked_up(new_state.ang_vel, s.ang_vel)
        )
        return self.write(data.replace(states=states), new_load)

    def stop_at_floor(self, data: SimData) -> SimData:
        """Stop one drone's hook and load at the floor."""
        height = jnp.where(self.attached, self.clearance, jnp.zeros_like(self.clearance))
        height = height + ground_height(data, self.tip_pos)
        tip_pos, tip_vel = clip_to_floor(self.tip_pos, self.tip_vel, height, self.friction)
        pos, vel = clip_to_floor(self.pos, self.vel, self.clearance + ground_height(data, self.pos), self.friction)
        pos, vel = jnp.where(self.attached, tip_pos, pos), jnp.where(self.attached, tip_vel, vel)
        return self.write(data, self.replace(pos=pos, vel=vel, tip_pos=tip_pos, tip_vel=tip_vel))

    def command(self, data: SimData, grip: ArrayLike) -> SimData:
        """Return the data with another command to the hooks.

        Args:
            data: Data of all worlds.
            grip: True to pick up a load within reach and to hold it, False to let go. (n_worlds, n_drones), or a shape
                that broadcasts to it
        """
        load = self.read(data)
        flags = grip if isinstance(grip, jax.Array) else np.asarray(grip)
        lengths = zip(flags.shape[::-1], load.grip.shape[::-1], strict=False)
        has_valid_shape = flags.ndim <= load.grip.ndim and all(n in (1, length) for n, length in lengths)
        if flags.dtype != bool or not has_valid_shape:
            raise ConfigError(
                f"expected grip as True or False, or a bool for each drone {load.grip.shape} = (n_worlds, n_drones), "
                f"got {short_repr(grip)}"
            )
        return self.write(data, load.replace(grip=jnp.broadcast_to(flags, load.grip.shape)))

    def hang(self, data: SimData, mask: ArrayLike | None = None) -> SimData:
        """Return the data of all worlds with hooks, and the loads on them, at rest below their drones.

        Use it after moving drones.

        Args:
            data: Data of all worlds.
            mask: True in the worlds to change; None for all. (n_worlds,)
        """
        load, mask = self.read(data), as_mask(mask, data.core.steps.shape[:1])
        height = jnp.where(load.attached[..., None], load.clearance, 0.0)
        tip_pos, tip_vel = hanging_state(data.states, load.attach, load.length, height, False)
        tip_pos, tip_vel = select_worlds(mask, tip_pos, load.tip_pos), select_worlds(mask, tip_vel, load.tip_vel)
        is_held = load.attached[..., None]
        new_load = load.replace(
            tip_pos=tip_pos,
            tip_vel=tip_vel,
            pos=jnp.where(is_held, tip_pos, load.pos),
            vel=jnp.where(is_held, tip_vel, load.vel),
        )
        return self.write(data, new_load)

    def move_objects(self, data: SimData) -> Objects:
        if not self.in_scene:
            return data.objects  # type: ignore[return-value]
        has_load = np.ones(self.tip_pos.shape[0], bool)
        objects = move_loads(data, self, self.tip_pos, has_load, 1, self.ring, show_free_links=True)  # type: ignore[arg-type]
        heads = {f"{self.name}_hook": (self.tip_pos, rotation_from_z(-self._rod_directions(data)))}
        return objects.with_poses(heads)

    @property
    def solid_kinds(self) -> tuple[str, ...]:
        return (self.name, f"{self.name}_hook")

    def colliders(self) -> tuple[Collider, ...]:
        head = Collider(Shape("sphere", (HEAD_RADIUS,)), self.head, self.with_head_vel, self.joined_head_mask)
        return (*super().colliders(), head)

    def body(self, data: SimData) -> LoadBody:
        load = self.read(data)
        up = shape_axis(data, load, load.tip_pos)
        held_mass = jnp.where(load.attached[..., None], load.hook_mass, jnp.zeros_like(load.hook_mass))
        return LoadBody(load.pos - self.ring * up, rotation_from_z(up), load.vel, load.mass + held_mass)

    def with_vel(self, data: SimData, vel: Array) -> SimData:
        load = self.read(data)
        return self.write(data, load.replace(vel=vel, tip_vel=jnp.where(load.attached[..., None], vel, load.tip_vel)))

    def joined_mask(self, data: SimData) -> Array:
        return np.eye(data.states.pos.shape[0], dtype=bool) & self.read(data).attached

    def head(self, data: SimData) -> LoadBody:
        """Return the heads of the hooks, balls that collide while a hook carries nothing, of one drone or one world."""
        load = self.read(data)
        up = -load._rod_directions(data)
        mass = jnp.broadcast_to(load.hook_mass, (*load.tip_pos.shape[:-1], 1))
        return LoadBody(load.tip_pos + HEAD_HEIGHT * up, rotation_from_z(up), load.tip_vel, mass, ~load.attached)

    def with_head_vel(self, data: SimData, vel: Array) -> SimData:
        """Return the data with other velocities of hooks that carry nothing. (..., 3)"""
        load = self.read(data)
        return self.write(data, load.replace(tip_vel=jnp.where(load.attached[..., None], load.tip_vel, vel)))

    def joined_head_mask(self, data: SimData) -> Array:
        """Whether a hook hangs from a drone, in one world. (n_hooks, n_drones)"""
        return np.eye(data.states.pos.shape[0], dtype=bool)  # type: ignore[return-value]

    def _rod_directions(self, data: SimData) -> Array:
        return link_geometry(data.states, self.tip_pos, self.tip_vel, self.attach).direction

    def _link_params(self) -> LinkParams:
        mass = self.hook_mass + jnp.where(self.attached, self.mass, jnp.zeros_like(self.mass))
        return LinkParams(self.attach, self.length, mass, self.damping, is_hinge=self.dof == 1)
