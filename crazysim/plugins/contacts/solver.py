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
from crazysim.geometry.small_matrices import matmul, matvec
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

    press: Array
    """Along the normals, N s. (k,)"""
    drag: Array
    """Across the normals, world frame, N s. (k, 3)"""


class SolvedBodies(NamedTuple):
    """Bodies after contact."""

    bodies: Bodies
    """The bodies with their new velocities and positions."""
    turned: Array
    """Rotations that remove overlaps, world frame, rad. (n, 3)"""
    at: Impulses
    """Impulses at the contacts, with which the next step begins."""
    impulse: Array
    """Sum of the impulses on each body, world frame, N s. (n, 3)"""


def solve_contacts(
    bodies: Bodies, contacts: Contacts, before: Impulses, dt: float, softness: float, iterations: int
) -> SolvedBodies:
    """Return the bodies after contact.

    At every contact the bodies approach at most fast enough to close the gap within the step. After an impact faster
    than 0.1 m/s they separate with at least ``restitution`` times the speed of approach. Friction opposes slip up to
    Coulomb's limit. Where impacts of several bodies with restitution and friction (Kane 1984), or too few iterations,
    would add energy, all impulses are scaled down to conserve it.

    Overlaps are removed within ``softness`` seconds, at up to 0.25 m/s, by moving the bodies without changing their
    velocities, so that this does not drive the motion of a stack.

    Args:
        bodies: The bodies.
        contacts: The contacts, each with at least one body that can be pushed.
        before: Initial impulses. With the impulses of the last step, bodies at rest stay at rest from the first
            iteration on.
        dt: Step, s.
        softness: Time constant with which an overlap is pushed out, s.
        iterations: Iterations of the solver.
    """
    n, k = bodies.pos.shape[0], len(contacts.gap)
    dtype = bodies.pos.dtype
    a, b = contacts.first, contacts.second
    pair = np.repeat(np.arange(len(a)), contacts.n_points)
    sums = [jnp.asarray(np.eye(n)[:, numbers], dtype) for numbers in (a, b)]  # (n, n_pairs)
    normal = contacts.normal
    offset = bodies.pos[a] - bodies.pos[b]
    arm = contacts.point - bodies.pos[a][pair]

    def slip(vel: Array, ang_vel: Array) -> Array:
        """Return the velocities of the first bodies relative to the second at the contacts, m/s. (k, 3)"""
        between = vel[a] - vel[b] - rotation.cross(ang_vel[b], offset)
        return between[pair] + rotation.cross((ang_vel[a] - ang_vel[b])[pair], arm)

    def change(impulse: Array) -> tuple[Array, Array]:
        """Return the changes of the velocities by impulses on the first bodies and opposite ones on the second."""
        force, torque = contacts.sum_pairs(impulse), contacts.sum_pairs(rotation.cross(arm, impulse))
        against = torque + rotation.cross(offset, force)
        force, torque = (
            _sum_for_bodies(sums[0] - sums[1], force),
            _sum_for_bodies(sums[0], torque) - _sum_for_bodies(sums[1], against),
        )
        return bodies.inv_mass[:, None] * force, matvec(bodies.inv_inertia, torque)

    start = slip(bodies.vel, bodies.ang_vel)
    out = rotation.dot(start, normal)[:, 0]
    is_near = contacts.gap < MAX_ACTING_GAP + dt * jnp.abs(out)
    closes = jnp.minimum(-contacts.gap / dt, 0.0)
    bounces = (out < -BOUNCE_SPEED) & (contacts.gap + dt * out < 0)
    target_speed = jnp.where(bounces, -contacts.restitution * out, closes)

    along, across = jnp.zeros(k, dtype), jnp.zeros(k, dtype)
    for numbers, sum_of, lever in ((a, sums[0], arm), (b, sums[1], arm + offset[pair])):
        turn = rotation.cross_matrix(lever)
        inverse, inv_mass = bodies.inv_inertia[numbers][pair], bodies.inv_mass[numbers][pair]
        spun = matmul(inverse, turn)
        of_normal = inv_mass + rotation.dot(rotation.cross(lever, normal), matvec(spun, normal))[:, 0]
        of_slip = 0.5 * (3 * inv_mass + jnp.sum(turn * spun, axis=(-2, -1)) - of_normal)
        acts = is_near & (of_normal > 0)
        n_weight, s_weight = (jnp.where(acts, 1 / jnp.where(acts, x, 1.0), 0.0) for x in (of_normal, of_slip))
        together = _shared_response(bodies, sum_of, contacts, normal, turn, n_weight, s_weight)[numbers][pair]
        along, across = along + together * of_normal, across + together * of_slip
    along, across = (jnp.where(x > 0, x, 1.0) for x in (along, across))

    def turn_once(_: int, carry: tuple[Impulses, Impulses, Array]) -> tuple[Impulses, Impulses, Array]:
        (press, drag), old, age = carry
        ahead = age / (age + 3)
        y, z = press + ahead * (press - old.press), drag + ahead * (drag - old.drag)
        moving = start + slip(*change(y[:, None] * normal + z))
        speed = rotation.dot(moving, normal)[:, 0]
        new = jnp.where(is_near, jnp.maximum(y + (target_speed - speed) / along, 0.0), 0.0)
        held = z - (moving - speed[:, None] * normal) / across[:, None]
        size, limit = rotation.safe_norm(held), (contacts.friction * new)[:, None]
        held = jnp.where(size > limit, held * (limit / jnp.where(size > 0, size, 1.0)), held)
        # Momentum that points uphill is dropped (O'Donoghue and Candes 2015).
        rise = jnp.sum((y - new) * along * (new - press)) + jnp.sum((z - held) * across[:, None] * (held - drag))
        return Impulses(new, held), Impulses(press, drag), jnp.where(rise > 0, 0.0, age + 1)

    press = jnp.where(is_near, before.press, 0.0)
    drag = jnp.where(is_near[:, None], before.drag - rotation.dot(before.drag, normal) * normal, 0.0)
    first = Impulses(press, drag)
    impulses, *_ = jax.lax.fori_loop(0, iterations, turn_once, (first, first, jnp.zeros((), dtype)))
    total = impulses.press[:, None] * normal + impulses.drag
    vel, ang_vel = change(total)
    share = _energy_share(total, start, slip(vel, ang_vel))
    impulses, total, vel, ang_vel = jax.tree.map(lambda x: share * x, (impulses, total, vel, ang_vel))

    # One gradient step with exact line search reduces the overlaps; the next time step continues.
    leaves = out + rotation.dot(slip(vel, ang_vel), normal)[:, 0]
    push = jnp.minimum(jnp.maximum(-contacts.gap, 0.0) / softness, MAX_PUSH_SPEED) - jnp.maximum(leaves, 0.0)
    push = jnp.maximum(push, 0.0)
    vel_change, ang_vel_change = change((push / along)[:, None] * normal)
    slip_change = jnp.sum(push / along * rotation.dot(slip(vel_change, ang_vel_change), normal)[:, 0])
    size = dt * jnp.sum(push / along * push) / jnp.where(slip_change > 0, slip_change, 1.0)
    after = bodies._replace(pos=bodies.pos + size * vel_change, vel=bodies.vel + vel, ang_vel=bodies.ang_vel + ang_vel)
    impulse = _sum_for_bodies(sums[0] - sums[1], contacts.sum_pairs(total))
    return SolvedBodies(after, size * ang_vel_change, impulses, impulse)


def _shared_response(
    bodies: Bodies, sum_of: Array, contacts: Contacts, normal: Array, turn: Array, along: Array, across: Array
) -> Array:
    """Return for each body its contacts' response to all impulses, divided by their response to their own one. (n,)

    It is an upper bound of the largest eigenvalue of ``M^-1 sum(B W B^T)``, too large by at most a quarter. ``M`` is
    the inertia of the body, ``B`` maps the impulse at a contact to force and torque, and ``W`` holds the inverse
    responses.

    Args:
        bodies: The bodies.
        sum_of: 1 where a pair contains the body, and else 0. (n, n_pairs)
        contacts: The contacts.
        normal: Normals. (k, 3)
        turn: Torque of impulses about the body. (k, 3, 3)
        along: Inverse responses to impulses along the normals, kg; zero where nothing acts. (k,)
        across: The same across the normals. (k,)
    """
    eye = jnp.eye(3, dtype=normal.dtype)
    weight = across[:, None, None] * eye + (along - across)[:, None, None] * normal[:, :, None] * normal[:, None]
    angular = matmul(turn, weight)
    upper = jnp.concatenate([weight, jnp.swapaxes(angular, -1, -2)], axis=-1)
    lower = jnp.concatenate([angular, matmul(angular, jnp.swapaxes(turn, -1, -2))], axis=-1)
    blocks = jnp.concatenate([upper, lower], axis=-2).reshape(-1, 36)
    total = _sum_for_bodies(sum_of, contacts.sum_pairs(blocks)).reshape(-1, 6, 6)
    response = jnp.concatenate(
        [bodies.inv_mass[:, None, None] * total[:, :3], matmul(bodies.inv_inertia, total[:, 3:])], axis=-2
    )
    fourth = matmul(matmul(response, response), matmul(response, response))
    trace = jnp.sum(fourth * jnp.swapaxes(fourth, -1, -2), axis=(-2, -1))
    return jnp.where(trace > 0, jnp.where(trace > 0, trace, 1.0) ** 0.125, 1.0)


def _energy_share(impulse: Array, before: Array, change: Array) -> Array:
    """Return the share of impulses, at most one, with which they add no kinetic energy. ()

    The energy that the impulses add, in the frame of immovable bodies, is the sum of the products of each impulse with
    the mean of the contact's velocities before and after it.

    Args:
        impulse: Impulses on the first bodies, N s. (k, 3)
        before: Velocities of the contacts before, m/s. (k, 3)
        change: Their changes by the impulses, m/s. (k, 3)
    """
    first, second = jnp.sum(impulse * before), jnp.sum(impulse * change)
    gains = first + 0.5 * second > 0
    return jnp.where(gains, jnp.maximum(-2 * first, 0.0) / jnp.where(gains, second, 1.0), 1.0)


def _sum_for_bodies(sums: Array, values: Array) -> Array:
    """Sum the pairs' values for every body, element-wise because a GPU may round matrix products. (n, m)"""
    return jnp.sum(sums[:, :, None] * values[None], axis=1)
