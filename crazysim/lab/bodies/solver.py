"""Impulses at the contacts of several bodies, for one world.

Projected Jacobi iterations with momentum (Nesterov's method, as Mazhar et al. 2015 use it for contact), preconditioned
by mass splitting (Tonge, Benevolenski and Voroshilov 2012): each contact gets a share of the masses of its bodies, so
that all contacts act at once. An impulse acts on both bodies at the same point, which conserves momentum and angular
momentum.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.engine.jaxcompat import fori_loop
from crazysim.lab.bodies.small_matrices import matmul, matvec
from crazysim.plugins.contacts.impulse import BOUNCE_SPEED, MAX_PUSH_SPEED

MAX_ACTING_GAP = 1e-3
"""Largest gap at which a contact may act in a step, in addition to the distance of approach, m."""


class Bodies(NamedTuple):
    """Bodies of a world, world frame. Bodies that cannot be pushed have zero inverse mass and inertia."""

    pos: Array
    """Position of the centre of mass, m. (n, 3)"""
    vel: Array
    """Velocity, m/s. (n, 3)"""
    ang_vel: Array
    """Angular velocity, rad/s. (n, 3)"""
    inv_mass: Array
    """Inverse of the mass, 1/kg. (n,)"""
    inv_inertia: Array
    """Inverse of the moment of inertia, 1/(kg m^2). (n, 3, 3)"""


class Contacts(NamedTuple):
    """Contact points between pairs of bodies, world frame; the points of a pair are neighbours."""

    first: np.ndarray
    """Index of the body that the normals point to. (n_pairs,)"""
    second: np.ndarray
    """Index of the body that the normals point from. (n_pairs,)"""
    n_points: np.ndarray
    """Number of points of each pair, ascending. (n_pairs,)"""
    gap: Array
    """Distance, m, negative where the bodies overlap. (k,)"""
    normal: Array
    """Unit normal. (k, 3)"""
    point: Array
    """Position, m. (k, 3)"""
    friction: Array
    """Coulomb's coefficient, 1. (k,)"""
    restitution: Array
    """Ratio of the speeds after and before a bounce, 1. (k,)"""

    def sum_pairs(self, values: Array) -> Array:
        """Return the sums of values of the points over the points of every pair. (n_pairs, m)"""
        sums, end = [], 0
        for n_points, n_pairs in zip(*np.unique(self.n_points, return_counts=True), strict=True):
            start, end = end, end + n_points * n_pairs
            sums.append(jnp.sum(values[start:end].reshape(n_pairs, n_points, -1), axis=1))
        return jnp.concatenate(sums)


class Impulses(NamedTuple):
    """Impulses at the contacts, on the first bodies."""

    normal: Array
    """Impulses along the normals, N s. (k,)"""
    friction: Array
    """Impulses across the normals, world frame, N s. (k, 3)"""


class SolvedBodies(NamedTuple):
    """Bodies after contact."""

    bodies: Bodies
    """The bodies with their new velocities and positions."""
    rotvec: Array
    """Rotations that remove overlaps, world frame, rad. (n, 3)"""
    contact_impulses: Impulses
    """Impulses at the contacts, the initial impulses of the next step."""
    impulse: Array
    """Sum of the impulses on each body, world frame, N s. (n, 3)"""


def solve_contacts(
    bodies: Bodies, contacts: Contacts, initial_impulses: Impulses, dt: float, softness: float, iterations: int
) -> SolvedBodies:
    """Return the bodies after contact.

    At every contact the bodies approach at most fast enough to close the gap within the step. After an impact faster
    than 0.1 m/s they separate with at least ``restitution`` times the speed of approach. Friction opposes slip up to
    Coulomb's limit. Where impacts of several bodies with restitution and friction (Kane 1984), or too few iterations,
    would add energy, all impulses are scaled down to conserve it.

    Overlaps shrink with the time constant ``softness``, at up to 0.25 m/s. For this the bodies are moved without
    changing their velocities, because added velocities would set a stack in motion.

    Args:
        contacts: The contacts, each with at least one body that can be pushed.
        initial_impulses: Initial impulses. With the impulses of the last step, bodies at rest stay at rest from the
            first iteration on.
        dt: Duration of the step, s.
        softness: Time constant with which an overlap is pushed out, s.
    """
    n, k = bodies.pos.shape[0], len(contacts.gap)
    dtype = bodies.pos.dtype
    a, b = contacts.first, contacts.second
    pair = np.repeat(np.arange(len(a)), contacts.n_points)
    sum_matrices = [jnp.asarray(np.eye(n)[:, body_indices], dtype) for body_indices in (a, b)]  # (n, n_pairs)
    normal = contacts.normal
    offset = bodies.pos[a] - bodies.pos[b]
    arm = contacts.point - bodies.pos[a][pair]

    def contact_velocity(vel: Array, ang_vel: Array) -> Array:
        relative_vel = vel[a] - vel[b] - rotation.cross(ang_vel[b], offset)
        return relative_vel[pair] + rotation.cross((ang_vel[a] - ang_vel[b])[pair], arm)

    def velocity_change(impulse: Array) -> tuple[Array, Array]:
        # The impulses act on the first bodies, and their opposites on the second bodies.
        force, torque = contacts.sum_pairs(impulse), contacts.sum_pairs(rotation.cross(arm, impulse))
        second_torque = torque + rotation.cross(offset, force)
        force, torque = (
            _sum_for_bodies(sum_matrices[0] - sum_matrices[1], force),
            _sum_for_bodies(sum_matrices[0], torque) - _sum_for_bodies(sum_matrices[1], second_torque),
        )
        return bodies.inv_mass[:, None] * force, matvec(bodies.inv_inertia, torque)

    initial_vel = contact_velocity(bodies.vel, bodies.ang_vel)
    separation_speed = rotation.dot(initial_vel, normal)[:, 0]
    is_near = contacts.gap < MAX_ACTING_GAP + dt * jnp.abs(separation_speed)
    closing_speed = jnp.minimum(-contacts.gap / dt, 0.0)
    is_bouncing = (separation_speed < -BOUNCE_SPEED) & (contacts.gap + dt * separation_speed < 0)
    target_speed = jnp.where(is_bouncing, -contacts.restitution * separation_speed, closing_speed)

    # Step sizes: how much the impulses at all points change the speed at each.
    normal_response, slip_response = jnp.zeros(k, dtype), jnp.zeros(k, dtype)
    for body_indices, sum_matrix, lever in ((a, sum_matrices[0], arm), (b, sum_matrices[1], arm + offset[pair])):
        lever_matrix = rotation.cross_matrix(lever)
        inv_inertia, inv_mass = bodies.inv_inertia[body_indices][pair], bodies.inv_mass[body_indices][pair]
        angular_response = matmul(inv_inertia, lever_matrix)
        normal_compliance = (
            inv_mass + rotation.dot(rotation.cross(lever, normal), matvec(angular_response, normal))[:, 0]
        )
        slip_compliance = 0.5 * (
            3 * inv_mass + jnp.sum(lever_matrix * angular_response, axis=(-2, -1)) - normal_compliance
        )
        is_active = is_near & (normal_compliance > 0)
        normal_weight, slip_weight = (
            jnp.where(is_active, 1 / jnp.where(is_active, x, 1.0), 0.0) for x in (normal_compliance, slip_compliance)
        )
        shared_response = _shared_response(
            bodies, sum_matrix, contacts, normal, lever_matrix, normal_weight, slip_weight
        )[body_indices][pair]
        normal_response, slip_response = (
            normal_response + shared_response * normal_compliance,
            slip_response + shared_response * slip_compliance,
        )
    normal_response, slip_response = (jnp.where(x > 0, x, 1.0) for x in (normal_response, slip_response))

    def iterate(_: int, carry: tuple[Impulses, Impulses, Array]) -> tuple[Impulses, Impulses, Array]:
        current, previous, n_accelerated = carry
        momentum = n_accelerated / (n_accelerated + 3)
        # y and z are the extrapolated impulses, along and across the normals.
        y = current.normal + momentum * (current.normal - previous.normal)
        z = current.friction + momentum * (current.friction - previous.friction)
        contact_vel = initial_vel + contact_velocity(*velocity_change(y[:, None] * normal + z))
        speed = rotation.dot(contact_vel, normal)[:, 0]
        normal_impulse = jnp.where(is_near, jnp.maximum(y + (target_speed - speed) / normal_response, 0.0), 0.0)
        friction_impulse = z - (contact_vel - speed[:, None] * normal) / slip_response[:, None]
        friction_size, limit = rotation.safe_norm(friction_impulse), (contacts.friction * normal_impulse)[:, None]
        friction_impulse = jnp.where(
            friction_size > limit,
            friction_impulse * (limit / jnp.where(friction_size > 0, friction_size, 1.0)),
            friction_impulse,
        )
        # Momentum that points uphill is dropped (O'Donoghue and Candes 2015).
        normal_slope = (y - normal_impulse) * normal_response * (normal_impulse - current.normal)
        friction_slope = (z - friction_impulse) * slip_response[:, None] * (friction_impulse - current.friction)
        slope = jnp.sum(normal_slope) + jnp.sum(friction_slope)
        return Impulses(normal_impulse, friction_impulse), current, jnp.where(slope > 0, 0.0, n_accelerated + 1)

    normal_start = jnp.where(is_near, initial_impulses.normal, 0.0)
    friction_start = jnp.where(
        is_near[:, None], initial_impulses.friction - rotation.dot(initial_impulses.friction, normal) * normal, 0.0
    )
    initial = Impulses(normal_start, friction_start)
    impulses, *_ = fori_loop(iterations, iterate, (initial, initial, jnp.zeros((), dtype)))
    total = impulses.normal[:, None] * normal + impulses.friction
    # Impulses are scaled down where they would add energy.
    vel_change, ang_vel_change = velocity_change(total)
    energy_factor = _energy_factor(total, initial_vel, contact_velocity(vel_change, ang_vel_change))
    impulses, total, vel_change, ang_vel_change = jax.tree.map(
        lambda x: energy_factor * x, (impulses, total, vel_change, ang_vel_change)
    )

    # One gradient step with exact line search reduces the overlaps; the next time step continues.
    separation_rate = separation_speed + rotation.dot(contact_velocity(vel_change, ang_vel_change), normal)[:, 0]
    push_speed = jnp.minimum(jnp.maximum(-contacts.gap, 0.0) / softness, MAX_PUSH_SPEED) - jnp.maximum(
        separation_rate, 0.0
    )
    push_speed = jnp.maximum(push_speed, 0.0)
    push_vel, push_ang_vel = velocity_change((push_speed / normal_response)[:, None] * normal)
    gap_rate = jnp.sum(
        push_speed / normal_response * rotation.dot(contact_velocity(push_vel, push_ang_vel), normal)[:, 0]
    )
    step_size = dt * jnp.sum(push_speed / normal_response * push_speed) / jnp.where(gap_rate > 0, gap_rate, 1.0)
    moved_bodies = bodies._replace(
        pos=bodies.pos + step_size * push_vel,
        vel=bodies.vel + vel_change,
        ang_vel=bodies.ang_vel + ang_vel_change,
    )
    impulse = _sum_for_bodies(sum_matrices[0] - sum_matrices[1], contacts.sum_pairs(total))
    return SolvedBodies(moved_bodies, step_size * push_ang_vel, impulses, impulse)


def _shared_response(
    bodies: Bodies,
    sum_matrix: Array,
    contacts: Contacts,
    normal: Array,
    lever_matrix: Array,
    normal_weight: Array,
    slip_weight: Array,
) -> Array:
    # The ratio is an upper bound of the largest eigenvalue of ``M^-1 sum(B W B^T)``, too large by at most a quarter.
    # ``M`` is the inertia of the body, ``B`` maps the impulse at a contact to force and torque, and ``W`` contains the
    # inverse responses.
    eye = jnp.eye(3, dtype=normal.dtype)
    weight = (
        slip_weight[:, None, None] * eye
        + (normal_weight - slip_weight)[:, None, None] * normal[:, :, None] * normal[:, None]
    )
    angular = matmul(lever_matrix, weight)
    upper = jnp.concatenate([weight, jnp.swapaxes(angular, -1, -2)], axis=-1)
    lower = jnp.concatenate([angular, matmul(angular, jnp.swapaxes(lever_matrix, -1, -2))], axis=-1)
    blocks = jnp.concatenate([upper, lower], axis=-2).reshape(-1, 36)
    total = _sum_for_bodies(sum_matrix, contacts.sum_pairs(blocks)).reshape(-1, 6, 6)
    response = jnp.concatenate(
        [bodies.inv_mass[:, None, None] * total[:, :3], matmul(bodies.inv_inertia, total[:, 3:])], axis=-2
    )
    fourth_power = matmul(matmul(response, response), matmul(response, response))
    trace = jnp.sum(fourth_power * jnp.swapaxes(fourth_power, -1, -2), axis=(-2, -1))
    return jnp.where(trace > 0, jnp.where(trace > 0, trace, 1.0) ** 0.125, 1.0)


def _energy_factor(impulse: Array, initial_vel: Array, vel_change: Array) -> Array:
    # The energy that the impulses add, in the frame of immovable bodies, is the sum of the products of each impulse
    # with the mean of the contact's velocities before and after it.
    linear, quadratic = jnp.sum(impulse * initial_vel), jnp.sum(impulse * vel_change)
    adds_energy = linear + 0.5 * quadratic > 0
    return jnp.where(adds_energy, jnp.maximum(-2 * linear, 0.0) / jnp.where(adds_energy, quadratic, 1.0), 1.0)


def _sum_for_bodies(sum_matrix: Array, values: Array) -> Array:
    return jnp.sum(sum_matrix[:, :, None] * values[None], axis=1)
