"""Impulses at the contacts of several bodies, for one world.

Projected Jacobi iterations on velocities. So that all contacts of a body can act at once, each acts on a share of its
mass (mass splitting: Tonge, Benevolenski and Voroshilov 2012); the parts then move with their mean velocity, which
keeps momentum and angular momentum.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.scene.impulse import FASTEST_PUSH, SLOW

NEAR = 1e-3
"""Gap up to which a contact may act in a step beyond the distance of approach, m."""


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


def solve_contacts(
    bodies: Bodies, contacts: Contacts, dt: float, softness: float, iterations: int
) -> tuple[Bodies, Array]:
    """Return the bodies with the velocities after contact, and the impulse on each, N s. (n, 3)

    At every contact the speed of separation becomes at least: the one that closes a gap within the step; that which
    removes an overlap within ``softness`` seconds, up to 0.25 m/s; and ``restitution`` times the speed of an approach
    faster than 0.1 m/s. Friction opposes slip up to Coulomb's limit.

    Args:
        bodies: The bodies.
        contacts: The contacts, each with at least one body that can be pushed.
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

    def pushed(vel: Array, ang_vel: Array, impulse: Array) -> tuple[Array, Array]:
        """Return the velocities after impulses on the first bodies, and against the second."""
        force = _gather(sums[0], impulse) - _gather(sums[1], impulse)
        torque = _gather(sums[0], rotation.cross(arm_a, impulse)) - _gather(sums[1], rotation.cross(arm_b, impulse))
        return vel + bodies.inv_mass[:, None] * force, ang_vel + rotation.matvec(bodies.inv_inertia, torque)

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
        of_normal = inv_mass + rotation.dot(turn, rotation.matvec(inverse, turn))[:, 0]
        trace = jnp.trace(inverse, axis1=-2, axis2=-1) * rotation.dot(arm, arm)[:, 0]
        trace = trace - rotation.dot(arm, rotation.matvec(inverse, arm))[:, 0] + 3 * inv_mass
        along = along + parts[numbers] * of_normal
        across = across + parts[numbers] * (trace - of_normal)

    def turn_once(_: int, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        vel, ang_vel, press, drag = carry
        speed = rotation.dot(slip(vel, ang_vel), normal)[:, 0]
        new = jnp.where(near, jnp.maximum(press + (wanted - speed) / along, 0.0), 0.0)
        vel, ang_vel = pushed(vel, ang_vel, (new - press)[:, None] * normal)
        moving = slip(vel, ang_vel)
        moving = moving - rotation.dot(moving, normal) * normal
        held = drag - moving / across[:, None]
        size = rotation.safe_norm(held)
        limit = (contacts.friction * new)[:, None]
        held = jnp.where(size > limit, held * (limit / jnp.where(size > 0, size, 1.0)), held)
        vel, ang_vel = pushed(vel, ang_vel, held - drag)
        return vel, ang_vel, new, held

    start = (bodies.vel, bodies.ang_vel, jnp.zeros(k, dtype), jnp.zeros((k, 3), dtype))
    vel, ang_vel, press, drag = jax.lax.fori_loop(0, iterations, turn_once, start)
    total = press[:, None] * normal + drag
    return bodies._replace(vel=vel, ang_vel=ang_vel), _gather(sums[0], total) - _gather(sums[1], total)


def _gather(sums: Array, values: Array) -> Array:
    """Return the sums of the contacts' values for every body; by components, as a GPU may round products. (n, m)"""
    return jnp.sum(sums[:, :, None] * values[None], axis=1)
