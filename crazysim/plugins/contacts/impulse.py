"""Impulses of surfaces on a body: a drone, or a load, which is a point mass."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.engine.jaxcompat import fori_loop
from crazysim.plugins.contacts.contact_points import ContactPoints

BOUNCE_SPEED = 0.1
"""Approach speed below which nothing bounces, m/s: five steps of free fall at 500 Hz."""
PENALTY_STIFFNESS = 300.0
"""Penalty on the speed into a surface, as a multiple of the mass. With this value a bounce loses a third of a percent
of its speed to the penalty, and the linear systems can be solved in float32."""
STICKING_SPEED = 1e-4
"""Slip speed treated as zero, m/s."""
MAX_PUSH_SPEED = 0.25
"""Largest speed at which an overlap is pushed out, m/s."""


class Material(NamedTuple):
    """Parameters of a contact."""

    friction: Array
    """Coulomb's coefficient. (1,)"""
    restitution: Array
    """Ratio of the speeds after and before a bounce. (1,)"""
    softness: Array
    """Time constant with which an overlap is pushed out, s. (1,)"""


def velocity_after_contact(
    points: ContactPoints, initial_vel: Array, mass: Array, inertia: Array, material: Material, iterations: int
) -> Array:
    """Return the velocity of a body after the impulses of the surfaces that it touches. (..., 6) or (..., 3)

    In the compression phase, the velocity u = (vel, ang_vel) minimises the kinetic energy of the change plus stiff
    penalties on the speed into a surface and on slip. The penalty on slip grows no faster than the friction force
    allows (iteratively reweighted least squares). Every iteration solves one linear system of six unknowns, or of three
    for a load. In the restitution phase, a fraction of the normal impulses is applied again (Poisson). Finally, the
    function removes energy that was created by friction combined with bounces at several points (Kane 1984), or by
    points that push against each other.

    Args:
        points: Contact points, in the frame of the velocity.
        initial_vel: Velocity, m/s, followed by the angular velocity, rad/s, for a drone. (..., 6) or (..., 3)
        mass: Mass, kg. (..., 1)
        inertia: Mass and moment of inertia, as ``inertia_matrix`` returns them. (..., 6, 6) or (..., 3, 3)
    """
    n, p, s = points.normal, points.point, points.vel
    is_active = points.gap < 0
    stiffness = PENALTY_STIFFNESS * mass
    normal_wrench = _force_and_torque(n, p)
    surface_speed = jnp.sum(n * s, axis=-1)

    def point_speeds(u: Array) -> tuple[Array, Array]:
        vel = u[..., None, :3] - s
        vel = vel if p is None else vel + rotation.cross(u[..., None, 3:], p)
        normal_speed = jnp.sum(vel * n, axis=-1)
        return normal_speed, rotation.safe_norm(vel - normal_speed[..., None] * n)[..., 0]

    # Impacts bounce; other overlaps are pushed out softly.
    is_impact = is_active & (-point_speeds(initial_vel)[0] > BOUNCE_SPEED)
    target_speed = jnp.where(is_impact, 0.0, jnp.minimum(-points.gap / material.softness, MAX_PUSH_SPEED))

    def iterate(k: Array, u: Array) -> Array:
        normal_speed, slip_speed = point_speeds(u)
        is_pressed = is_active & (normal_speed < target_speed)
        normal_impulse = jnp.where(is_pressed, stiffness * (target_speed - normal_speed), 0.0)
        # Weights of the squares of the normal speed and of the slip speed.
        w_n = jnp.where(is_pressed, stiffness, 0.0)
        # In the first iteration every normal impulse is as large as if its point stopped the body alone. So friction,
        # which depends on the normal impulses, begins in the second iteration.
        w_t = jnp.where(
            k == 0, 0.0, jnp.minimum(w_n, material.friction * normal_impulse / (slip_speed + STICKING_SPEED))
        )
        w_rest = w_n - w_t
        normal_stiffness = jnp.sum(
            w_rest[..., None, None] * normal_wrench[..., None] * normal_wrench[..., None, :], axis=-3
        )
        matrix = inertia + _weighted_inertia(w_t, p, n.dtype) + normal_stiffness
        friction_pull = w_t[..., None] * _force_and_torque(s, p)
        normal_pull = (w_rest * surface_speed + w_n * target_speed)[..., None] * normal_wrench
        return solve_symmetric(
            matrix, rotation.matvec(inertia, initial_vel) + jnp.sum(friction_pull + normal_pull, axis=-2)
        )

    new_vel = fori_loop(iterations, iterate, initial_vel)
    # Restitution after all iterations.
    normal_impulse = jnp.where(is_active, stiffness * jnp.maximum(target_speed - point_speeds(new_vel)[0], 0.0), 0.0)
    new_vel = new_vel + material.restitution * solve_symmetric(
        inertia, jnp.sum(jnp.where(is_impact, normal_impulse, 0.0)[..., None] * normal_wrench, axis=-2)
    )
    # Energy is measured relative to the surfaces that push.
    total_impulse = jnp.sum(normal_impulse, axis=-1, keepdims=True)
    surface_vel = jnp.sum(normal_impulse[..., None] * s, axis=-2) / jnp.where(total_impulse > 0, total_impulse, 1.0)
    surface_vel = surface_vel if p is None else jnp.concatenate([surface_vel, jnp.zeros_like(surface_vel)], axis=-1)
    energy_before, energy_after = (
        rotation.dot(u - surface_vel, rotation.matvec(inertia, u - surface_vel)) for u in (initial_vel, new_vel)
    )
    max_energy = energy_before + mass * MAX_PUSH_SPEED**2
    new_vel = jnp.where(
        energy_after > max_energy,
        surface_vel
        + (new_vel - surface_vel) * rotation.safe_sqrt(max_energy / jnp.where(energy_after > 0, energy_after, 1.0)),
        new_vel,
    )
    return jnp.where(jnp.any(is_active, axis=-1, keepdims=True), new_vel, initial_vel)


def inertia_matrix(mass: Array, inertia: Array | None = None) -> Array:
    """Return mass and moment of inertia as one matrix; for a point mass, the mass alone. (..., 6, 6) or (..., 3, 3)"""
    upper = mass[..., None] * jnp.eye(3, dtype=mass.dtype)
    if inertia is None:
        return upper
    zero = jnp.zeros_like(inertia)
    upper = jnp.concatenate([upper + zero, zero], axis=-1)
    return jnp.concatenate([upper, jnp.concatenate([zero, inertia], axis=-1)], axis=-2)


def _force_and_torque(force: Array, p: Array | None) -> Array:
    return force if p is None else jnp.concatenate([force, rotation.cross(p, force)], axis=-1)


def _weighted_inertia(weight: Array, p: Array | None, dtype: jnp.dtype) -> Array:
    translation = jnp.sum(weight, axis=-1)[..., None, None] * jnp.eye(3, dtype=dtype)
    if p is None:
        return translation
    x, y, z = (jnp.sum(weight * p[..., k], axis=-1) for k in range(3))
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack(r, axis=-1) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], axis=-2)
    square = jnp.sum(weight * jnp.sum(p * p, axis=-1), axis=-1)[..., None, None] * jnp.eye(3, dtype=p.dtype)
    angular = square - jnp.sum(weight[..., None, None] * p[..., None] * p[..., None, :], axis=-3)
    upper = jnp.concatenate([translation, -cross], axis=-1)
    return jnp.concatenate([upper, jnp.concatenate([cross, angular], axis=-1)], axis=-2)


def solve_symmetric(matrix: Array, b: Array) -> Array:
    """Solve ``matrix x = b`` for a symmetric positive definite matrix, unrolled. (..., n)

    The matrix is first scaled to a unit diagonal, because mass and moments of inertia differ by four orders of
    magnitude.
    """
    n = b.shape[-1]
    scale = [jax.lax.rsqrt(matrix[..., k, k]) for k in range(n)]
    a = [[matrix[..., i, j] * scale[i] * scale[j] for j in range(i + 1)] for i in range(n)]
    y = [b[..., k] * scale[k] for k in range(n)]
    lower: list[list[Array]] = []
    for i in range(n):
        lower.append([])
        for j in range(i):
            lower[i].append((a[i][j] - sum(lower[i][k] * lower[j][k] for k in range(j))) / lower[j][j])
        lower[i].append(jnp.sqrt(a[i][i] - sum(lower[i][k] ** 2 for k in range(i))))
    for i in range(n):
        y[i] = (y[i] - sum(lower[i][k] * y[k] for k in range(i))) / lower[i][i]
    for i in reversed(range(n)):
        y[i] = (y[i] - sum(lower[k][i] * y[k] for k in range(i + 1, n))) / lower[i][i]
    return jnp.stack([y[k] * scale[k] for k in range(n)], axis=-1)
