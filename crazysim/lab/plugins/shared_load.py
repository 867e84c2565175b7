"""One load that all drones of a world carry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import Objects, SimData, SimState, SimStateDeriv
from crazysim.core.integration import euler, rk4
from crazysim.core.plugin import Param, Simulation, StagePlacement, derived, param, state
from crazysim.core.settings import color, setting
from crazysim.eager import jit_eager_calls
from crazysim.engine.jaxcompat import fori_loop
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.lab.bodies.small_matrices import matvec
from crazysim.plugins.contacts.impulse import solve_symmetric
from crazysim.plugins.payloads.colliders import LoadBody, rest_height
from crazysim.plugins.payloads.link import TAUT_BAND, UnitPull, acceleration_at, correction_rate, link_geometry
from crazysim.plugins.payloads.point_load import (
    CABLE_SEGMENTS,
    PointLoad,
    add_to_scene,
    find_integrator,
    link_pieces,
    rotation_from_z,
)

TENSION_REGULARIZATION = 1e-6
"""Term added to the diagonal of the matrix of tensions, 1. The ratio of the masses of load and drone on the diagonal
makes the tensions unique already. With four or more links and a light load, the matrix is close to singular without
this term."""
N_BLOCK_PIVOTS, PIVOTS_PER_CABLE = 2, 3
"""Number of pivots that exchange all cables that are taut but push, or slack but separate; number of all pivots per
cable. 100,000 random problems of each n from 2 to 8 needed at most 2.5 n."""
PIVOT_TOLERANCE = 64.0
"""Negative tension that is zero, relative to the largest number of the problem and in units of its rounding."""


@jit_eager_calls()
def hanging_load(states: SimState, length: Array, clearance: Array) -> tuple[Array, Array]:
    """Return position and velocity of a load at rest below the drones of each world.

    Args:
        states: States of the drones. (n_worlds, n_drones, ...)
        length: Length of each rod or cable, m. (1,) or (n_worlds, n_drones, 1)
        clearance: Height of the load above the floor when it rests there, m. (1,)

    Returns:
        Position and velocity, world frame, m and m/s. (n_worlds, 1, 3) each
    """
    mean = states.pos.mean(axis=1, keepdims=True)
    # The load is as low as all links allow.
    horizontal_distance = rotation.safe_norm((states.pos - mean)[..., :2])
    drop = rotation.safe_sqrt((length - horizontal_distance) * (length + horizontal_distance))
    height = jnp.maximum(jnp.max(states.pos[..., 2:] - drop, axis=1, keepdims=True), clearance)
    return jnp.concatenate([mean[..., :2], height], axis=-1), states.vel.mean(axis=1, keepdims=True)


class SharedLoad(PointLoad):
    """One load, a point mass, on rods or cables from all drones of a world.

    The tensions follow from one system of equations of all drones. The integrator must update positions with the new
    velocities: ``symplectic_euler`` or ``rk4``. The load starts at rest below the drones' mean position. Its
    gravitational acceleration is the mean of the drones' gravitational accelerations.
    """

    coupling: ClassVar[Literal["drone", "world"]] = "world"
    mass: Param = param(scope="shared", positive=True, shapes=((),))
    """Mass of the load, kg. (1,)"""
    length: Param = param(default=1.0, positive=True)
    """Length of rods or cables, m. (1,)"""
    cable: bool = True
    """True for cables, False for rigid rods."""
    attach: Param = param(default=(0.0, 0.0, 0.0), core=(3,))
    """Attachment point relative to the drone's centre of mass, body frame, m. (3,)"""
    friction: Param = param(default=0.6, scope="shared", low=0.0, shapes=((),))
    """Coulomb's coefficient between load and floor, 1. (1,)"""
    size: ArrayLike = setting(default=0.05, positive=True, shapes=((), (3,)), keep=False)
    """Radius of a ball, or full lengths of a box, m. () or (3,)"""
    rgba: ArrayLike | None = color()
    """Colour; None for the default. (4,)"""
    in_scene: bool = True
    """Whether to put load and links into the scene."""
    pos: Array = state((3,), scope="world")
    """Position, world frame, m. (n_worlds, 1, 3)"""
    vel: Array = state((3,), scope="world")
    """Velocity, world frame, m/s. (n_worlds, 1, 3)"""
    attached: Array = state((), dtype=bool)
    """True for drones that hold the load. (n_worlds, n_drones)"""
    clearance: Array = derived(scope="shared")
    """Height of the load above the floor when it rests there, m. (1,)"""
    name: str = "load"

    def bind(self, sim: Simulation) -> SharedLoad:
        method = find_integrator(sim)
        if method is euler:
            raise ConfigError(
                "expected an integrator that moves positions with new velocities, which a load between several drones "
                "needs, got 'euler'. Use Sim(integrator='symplectic_euler') or 'rk4'."
            )
        states = sim.data.states
        clearance = device_array([rest_height(self.size)], states.pos.dtype)
        load = self.with_arrays(sim, clearance=clearance, attached=device_array(np.ones(states.pos.shape[:2]), bool))
        if self.in_scene:
            add_to_scene(
                sim, self.name, self.size, self.rgba, float(np.max(load.length)), 1,
                CABLE_SEGMENTS if self.cable else 1,
            )  # fmt: skip
        pos, vel = hanging_load(states, load.length, clearance)
        return load.replace(pos=pos, vel=vel, attach=load.attach if np.any(np.asarray(load.attach)) else None)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        placements = [
            StagePlacement(self.stage(self.stop_at_floor, "world"), "measurements", name=f"{self.name}_floor")
        ]
        if self.cable and find_integrator(sim) is rk4:
            placements.append(
                StagePlacement(self.stage(self.become_taut, "world"), "integration", name=f"{self.name}_taut")
            )
        return placements

    def constrain(self, data: SimData, deriv: SimStateDeriv, dt: float | None) -> SimStateDeriv:
        # The equations of ``link.couple_bodies``, for all links of a world at once.
        p, s, freq = data.params, data.states, data.core.freq
        m, n = self.mass, s.pos.shape[0]
        # Accelerations along the links without tension.
        gravity = p.gravity_vec if p.gravity_vec.ndim == 1 else jnp.mean(p.gravity_vec, axis=0)
        link = link_geometry(s, self.pos, self.vel, self.attach)
        q, radial_speed = link.direction, rotation.dot(link.direction, link.vel)
        pull = UnitPull.create(q, link.rot, p.J_inv, self.attach)
        swing_factor = 1.0 if dt is None else 0.5
        rel_acc = gravity - acceleration_at(s, deriv, link.rot, self.attach, swing_factor)
        rhs = rotation.dot(q, rel_acc) + swing_factor / self.length * (
            rotation.dot(link.vel, link.vel) - radial_speed * radial_speed
        )
        # Taut links, and the correction of their lengths.
        is_active = self.attached
        if dt is None:
            rhs = rhs + 2 * correction_rate(freq) * radial_speed
            is_active = is_active & (link.distance > (1 - TAUT_BAND) * self.length)[..., 0] if self.cable else is_active
        else:
            gap = jnp.maximum(self.length - link.distance, 0.0) if self.cable else 0.0
            rhs = rhs + freq * (radial_speed - freq * gap)
        tension = _solve_tensions(_tension_matrix(pull, m, p.mass), rhs[:, 0], is_active, self.cable)[:, None]

        # Effect of the tensions on drones and load.
        force = tension * q
        acc = m / p.mass * force
        tip_acc = gravity - jnp.sum(force, axis=0)
        changes = {"acc": deriv.acc + acc}
        if dt is not None:
            changes["vel"] = deriv.vel + dt * acc
        if pull.ang_acc is not None:
            ang_acc = m * tension * pull.ang_acc
            changes["ang_acc"] = deriv.ang_acc + ang_acc
            if dt is not None:
                changes["ang_vel"] = deriv.ang_vel + dt * ang_acc
        # The load moves back where links are too long.
        stretch = link.distance - self.length
        stretch = jnp.maximum(stretch, 0.0) if self.cable else stretch
        error = jnp.sum(jnp.where(self.attached[:, None], stretch * q, 0.0), axis=0) / n
        pos_rate = self.vel - correction_rate(freq) * error if dt is None else self.vel + dt * tip_acc - freq * error
        rates = {"pos": pos_rate, "vel": tip_acc}
        return deriv.replace(**changes, plugins=deriv.plugins | {self.name: rates})

    def become_taut(self, data: SimData) -> SimData:
        """Apply the impulses of cables that would be longer than ``length`` after the next step of one world."""
        p, s, freq = data.params, data.states, data.core.freq
        link = link_geometry(s, self.pos, self.vel, self.attach)
        pull = UnitPull.create(link.direction, link.rot, p.J_inv, self.attach)
        gap = jnp.maximum(self.length - link.distance, 0.0)
        excess_speed = rotation.dot(link.direction, link.vel) - freq * gap
        speed_change = _solve_tensions(
            _tension_matrix(pull, self.mass, p.mass), excess_speed[:, 0], self.attached, True
        )[:, None]
        change = speed_change * link.direction
        s = s.replace(vel=s.vel + self.mass / p.mass * change)
        if pull.ang_acc is not None:
            s = s.replace(ang_vel=s.ang_vel + self.mass * speed_change * pull.ang_acc)
        return self.write(data.replace(states=s), self.replace(vel=self.vel - jnp.sum(change, axis=0)))

    def move_objects(self, data: SimData) -> Objects:
        if not self.in_scene:
            return data.objects  # type: ignore[return-value]
        link = link_geometry(data.states, self.pos, self.vel, self.attach)
        offset = jnp.where(self.attached[:, None], link.offset, -self.length * link.rot[..., 2])
        top = data.states.pos if link.arm is None else data.states.pos + link.arm
        links = link_pieces(top, offset, self.length, CABLE_SEGMENTS if self.cable else 1)
        z_axis = jnp.asarray([[0.0, 0.0, 1.0]], self.pos.dtype)
        poses = {self.name: (self.pos[None], rotation_from_z(z_axis)), f"{self.name}_link": links}
        return data.objects.with_poses(poses)  # type: ignore[union-attr]

    def body(self, data: SimData) -> LoadBody:
        load = self.read(data)
        identity = jnp.asarray([[0.0, 0.0, 0.0, 1.0]], load.pos.dtype)
        return LoadBody(load.pos[None], identity, load.vel[None], load.mass[None])

    def with_vel(self, data: SimData, vel: Array) -> SimData:
        return self.write(data, self.read(data).replace(vel=vel[0]))

    def joined_mask(self, data: SimData) -> Array:
        return self.read(data).attached[None] & (not self.cable)


def _tension_matrix(pull: UnitPull, load_mass: Array, drone_mass: Array) -> Array:
    q = pull.direction
    ratio = jnp.broadcast_to(load_mass / drone_mass, (q.shape[0], 1))
    if pull.lever is not None and pull.ang_acc is not None:
        ratio = ratio + load_mass * rotation.dot(pull.lever, pull.ang_acc)
    return jnp.sum(q[:, None] * q[None], axis=-1) + jnp.eye(q.shape[0], dtype=q.dtype) * (
        ratio + TENSION_REGULARIZATION
    )


def _solve_tensions(matrix: Array, rhs: Array, is_active: Array, one_sided: bool) -> Array:
    # Cables: tensions t >= 0 with ``matrix t >= rhs``, and for each cable equality in one of the two, a linear
    # complementarity problem. It has one solution, found by principal pivoting (Murty 1974; the first pivots exchange
    # all cables at once, as Judice and Pires 1994 do).
    n = rhs.shape[0]

    def solve(matrix: Array, rhs: Array, is_taut: Array) -> Array:
        pairs = is_taut[:, None] & is_taut[None]
        return solve_symmetric(jnp.where(pairs, matrix, jnp.eye(n, dtype=rhs.dtype)), jnp.where(is_taut, rhs, 0.0))

    if not one_sided:
        return solve(matrix, rhs, is_active)
    constant_matrix, constant_rhs = jax.lax.stop_gradient((matrix, rhs))

    def pivot(k: Array, is_taut: Array) -> Array:
        tension = solve(constant_matrix, constant_rhs, is_taut)
        excess = matvec(constant_matrix, tension) - constant_rhs
        scale = jnp.max(jnp.where(is_active, jnp.abs(constant_rhs), 0.0)) + jnp.max(jnp.abs(tension))
        tolerance = PIVOT_TOLERANCE * jnp.finfo(rhs.dtype).eps * scale
        is_wrong = is_active & (jnp.where(is_taut, tension, excess) < -tolerance)
        # Exchanges of the last cable alone cannot cycle.
        index = np.arange(n, dtype=np.int32)
        is_last = index == jnp.max(jnp.where(is_wrong, index, np.int32(-1)))
        return is_taut ^ (is_wrong & (is_last | (k < N_BLOCK_PIVOTS)))

    is_taut = fori_loop(PIVOTS_PER_CABLE * n, pivot, is_active)
    return jnp.maximum(solve(matrix, rhs, is_taut), 0.0)
