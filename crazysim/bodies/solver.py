"""Impulses at the contacts of several bodies, for one world.

Projected Jacobi iterations with momentum (Nesterov's method, as Mazhar et al. 2015 use it for contact), preconditioned
by shares of the bodies' masses, one for each contact (mass splitting: Tonge, Benevolenski and Voroshilov 2012), so that
all contacts act at once. Impulses act on both bodies at one point: momentum and angular momentum are kept.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.geometry.linear import apply
from crazysim.scene.impulse import FASTEST_PUSH, SLOW

NEAR = 1e-3
"""Gap up to which a contact may act in a step beyond the distance of approach, m."""
COUPLED = 1.5
"""Factor of the diagonal of a contact by which it bounds normal and tangential impulses together; 2 bounds any."""


class Bodies(NamedTuple):
    """Bodies of a world, world frame; those that cannot be pushed have zero inverse mass and inertia."""

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
    """Contact points between bodies, world frame."""

    first: np.ndarray
    """Number of the body that the normal points to. (k,)"""
    second: np.ndarray
    """Number of the body that it points from. (k,)"""
    gap: Array
    """Distance, m, negative where they overlap. (k,)"""
    normal: Array
    """Unit normal. (k, 3)"""
    point: Array
    """Position, m. (k, 3)"""
    friction: Array
    """Coulomb's coefficient, 1. (k,)"""
    restitution: Array
    """Ratio of the speeds after and before a bounce, 1. (k,)"""


class Impulses(NamedTuple):
    """Impulses at the contacts, on the first bodies."""

    press: Array
    """Along the normals, N s. (k,)"""
    drag: Array
    """Across them, world frame, N s. (k, 3)"""


def solve_contacts(
    bodies: Bodies, contacts: Contacts, before: Impulses, dt: float, softness: float, iterations: int
) -> tuple[Bodies, Impulses, Array]:
    """Return the bodies with the velocities after contact, the impulses, and their sum on each body, N s. (n, 3)

    At every contact the speed of separation becomes at least: the one that closes a gap within the step; that which
    removes an overlap within ``softness`` seconds, up to 0.25 m/s; and ``restitution`` times the speed of an approach
    faster than 0.1 m/s. Friction opposes slip up to Coulomb's limit.

    Args:
        bodies: The bodies.
        contacts: The contacts, each with at least one body that can be pushed.
        before: Impulses to begin with: those of the last step bring bodies at rest to rest at once.
        dt: Step, s.
        softness: Time constant with which an overlap is pushed out, s.
        iterations: Iterations of the solver.
    """
    n, k = bodies.pos.shape[0], len(contacts.first)
    dtype = bodies.pos.dtype
    a, b = contacts.first, contacts.second
    sums = [jnp.asarray(np.eye(n)[:, numbers], dtype) for numbers in (a, b)]  # (n, k)
    normal = contacts.normal
    arm_a, arm_b = contacts.point - bodies.pos[a], contacts.point - bodies.pos[b]

    def slip(vel: Array, ang_vel: Array) -> Array:
        """Return the velocities of the first bodies relative to the second at the contacts, m/s. (k, 3)"""
        at_a = vel[a] + rotation.cross(ang_vel[a], arm_a)
        return at_a - vel[b] - rotation.cross(ang_vel[b], arm_b)

    def pushed(impulse: Array) -> tuple[Array, Array]:
        """Return the velocities after impulses on the first bodies, and against the second."""
        force = _gather(sums[0], impulse) - _gather(sums[1], impulse)
        torque = _gather(sums[0], rotation.cross(arm_a, impulse)) - _gather(sums[1], rotation.cross(arm_b, impulse))
        turned = apply(bodies.inv_inertia, torque)
        return bodies.vel + bodies.inv_mass[:, None] * force, bodies.ang_vel + turned

    out = rotation.dot(slip(bodies.vel, bodies.ang_vel), normal)[:, 0]
    near = contacts.gap < NEAR + dt * jnp.abs(out)
    closes = jnp.where(contacts.gap < 0, jnp.minimum(-contacts.gap / softness, FASTEST_PUSH), -contacts.gap / dt)
    bounces = (out < -SLOW) & (contacts.gap + dt * out < 0)
    wanted = jnp.maximum(closes, jnp.where(bounces, -contacts.restitution * out, closes))
    wanted = jnp.where(near, wanted, 0.0)

    parts = jnp.maximum(_gather(sums[0] + sums[1], near.astype(dtype)[:, None])[:, 0], 1.0)
    along, across = jnp.zeros(k, dtype), jnp.zeros(k, dtype)
    for numbers, arm in ((a, arm_a), (b, arm_b)):
        inverse, inv_mass = bodies.inv_inertia[numbers], bodies.inv_mass[numbers]
        turn = rotation.cross(arm, normal)
        of_normal = inv_mass + rotation.dot(turn, apply(inverse, turn))[:, 0]
        trace = jnp.trace(inverse, axis1=-2, axis2=-1) * rotation.dot(arm, arm)[:, 0]
        trace = trace - rotation.dot(arm, apply(inverse, arm))[:, 0] + 3 * inv_mass
        along = along + parts[numbers] * of_normal
        across = across + parts[numbers] * (trace - of_normal)
    along, across = COUPLED * along, COUPLED * across

    def turn_once(_: int, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        press, drag, old_press, old_drag, age = carry
        ahead = age / (age + 3)
        y, z = press + ahead * (press - old_press), drag + ahead * (drag - old_drag)
        moving = slip(*pushed(y[:, None] * normal + z))
        speed = rotation.dot(moving, normal)[:, 0]
        new = jnp.where(near, jnp.maximum(y + (wanted - speed) / along, 0.0), 0.0)
        held = z - (moving - speed[:, None] * normal) / across[:, None]
        size, limit = rotation.safe_norm(held), (contacts.friction * new)[:, None]
        held = jnp.where(size > limit, held * (limit / jnp.where(size > 0, size, 1.0)), held)
        # Momentum that points uphill is dropped (O'Donoghue and Candes 2015).
        rise = jnp.sum((y - new) * along * (new - press)) + jnp.sum((z - held) * across[:, None] * (held - drag))
        return new, held, press, drag, jnp.where(rise > 0, 0.0, age + 1)

    press = jnp.where(near, before.press, 0.0)
    drag = jnp.where(near[:, None], before.drag - rotation.dot(before.drag, normal) * normal, 0.0)
    start = (press, drag, press, drag, jnp.zeros((), dtype))
    press, drag, *_ = jax.lax.fori_loop(0, iterations, turn_once, start)
    total = press[:, None] * normal + drag
    vel, ang_vel = pushed(total)
    impulse = _gather(sums[0], total) - _gather(sums[1], total)
    return bodies._replace(vel=vel, ang_vel=ang_vel), Impulses(press, drag), impulse


def _gather(sums: Array, values: Array) -> Array:
    """Return the sums of the contacts' values for every body; by components, as a GPU may round products. (n, m)"""
    return jnp.sum(sums[:, :, None] * values[None], axis=1)
