"""Rigid-body mechanics: the equations of Newton and Euler."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.rotation import add_cross, cross, dot, matvec, multiply

MAX_EXPLICIT_ANGLE = 0.04
"""Rotation per step, rad, up to which ``stable_angular_acceleration`` is the exact derivative.

This is 20 rad/s at 500 Hz. A free wobble then grows by at most 0.04^2 / 2 of its size per step.
"""
MIN_STABLE_ANGLE = 0.06
"""Rotation per step, rad, from which on, up to 1 rad, no free wobble grows with ``stable_angular_acceleration``."""


def linear_acceleration(force: Array, mass: Array, gravity_vec: Array) -> Array:
    """Newton's second law: the acceleration of the centre of mass, world frame, m/s^2. (..., 3)

    Args:
        force: Sum of all forces except gravity, world frame, N. (..., 3)
        mass: Mass, kg. (..., 1)
        gravity_vec: Gravitational acceleration, world frame, m/s^2. (..., 3)
    """
    return force / mass + gravity_vec


def angular_acceleration(torque: Array, ang_vel: Array, J: Array, J_inv: Array, rotor_momentum: Array) -> Array:
    """Euler's equation: the angular acceleration, body frame, rad/s^2. (..., 3)

    ``J w' = torque - w x (J w + h)``

    Args:
        torque: Torque about the centre of mass, body frame, N m. (..., 3)
        ang_vel: Angular velocity w, body frame, rad/s. (..., 3)
        J: Inertia about the centre of mass, body frame, kg m^2. (..., 3, 3)
        J_inv: Inverse of the inertia, 1/(kg m^2). (..., 3, 3)
        rotor_momentum: Angular momentum h of the rotors relative to the body, body frame, N m s. (..., 3)
    """
    return matvec(J_inv, add_cross(torque, matvec(J, ang_vel, rotor_momentum), ang_vel))


def stable_angular_acceleration(
    torque: Array, ang_vel: Array, J: Array, J_inv: Array, rotor_momentum: Array, dt: float
) -> Array:
    """Return the angular acceleration for one Euler step, with a gyroscopic torque that does not amplify a wobble.

    A spinning body wobbles at a frequency k below its spin rate, if the momentum of its rotors is neglected. An
    explicit Euler step of the wobble, ``z = i k dt``, multiplies its size by ``|1 + z| = sqrt(1 + (k dt)^2)``: at 60
    rad/s and 500 Hz the wobble of a quadrotor grows by a factor of 175 in 2 s. Here the gyroscopic torque is evaluated
    at the angular velocity that this torque alone would produce after ``theta dt``, so the factor is ``|1 + z + theta
    z^2|``. ``theta = 1/2`` gives Heun's method; its factor exceeds one in fourth order only. ``theta = (1 + x^2) / 2``,
    at a rotation of ``x = |w| dt`` per step, keeps the factor at most one up to ``k dt = 1``, with a loss of energy of
    fourth order.

    Up to ``MAX_EXPLICIT_ANGLE``, theta is zero and the result equals ``angular_acceleration``. From
    ``MIN_STABLE_ANGLE`` on, theta is ``(1 + x^2) / 2``. In between, theta rises with the square of the rate.

    Args:
        torque: Torque about the centre of mass, body frame, N m. (..., 3)
        ang_vel: Angular velocity w, body frame, rad/s. (..., 3)
        J: Inertia about the centre of mass, body frame, kg m^2. (..., 3, 3)
        J_inv: Inverse of the inertia, 1/(kg m^2). (..., 3, 3)
        rotor_momentum: Angular momentum h of the rotors relative to the body, body frame, N m s. (..., 3)
        dt: Duration of the step, s.

    Returns:
        Mean angular acceleration over the step, body frame, rad/s^2. (..., 3)
    """
    # Implicit share of the gyroscopic torque; zero for slow rotation.
    square = dot(ang_vel, ang_vel)
    slope = 0.5 * dt * (1 + MIN_STABLE_ANGLE**2) / (MIN_STABLE_ANGLE**2 - MAX_EXPLICIT_ANGLE**2)
    ramp = jnp.maximum(slope * dt**2 * square - slope * MAX_EXPLICIT_ANGLE**2, 0.0)
    theta_dt = jnp.minimum(ramp, 0.5 * dt + 0.5 * dt**3 * square)

    ang_momentum = matvec(J, ang_vel, rotor_momentum)
    impulse = theta_dt * cross(ang_momentum, ang_vel)
    return matvec(J_inv, add_cross(torque, ang_momentum + impulse, matvec(J_inv, impulse, ang_vel)))


def free_rotation(quat: Array, ang_vel: Array, inertia: Array, dt: float) -> tuple[Array, Array]:
    """Return attitude (..., 4) and angular velocity (..., 3) of a free body after a step of turns about principal axes.

    The kinetic energy has one term for each principal axis. Under one term alone, the body turns about that axis at the
    constant rate ``H_k / J_k``. The step consists of turns about x, y, z, y, x; the turns about x and y last half the
    step, and the turn about z lasts the whole step (McLachlan 1993; Touma and Wisdom 1994). The method is of order 2,
    explicit and symplectic. It conserves the angular momentum in the world frame up to rounding at any rate, so the
    energy is bounded, and its error does not grow.

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        ang_vel: Angular velocity, body frame, along the principal axes, rad/s. (..., 3)
        inertia: Principal moments of inertia, kg m^2. (..., 3)
        dt: Duration of the step, s.
    """
    w = [ang_vel[..., k] for k in range(3)]
    inertia = jnp.broadcast_to(inertia, ang_vel.shape)
    # Strang splitting: turns about x, y, z, y and x.
    for axis, duration in ((0, dt / 2), (1, dt / 2), (2, dt), (1, dt / 2), (0, dt / 2)):
        second, third = (axis + 1) % 3, (axis + 2) % 3
        half = 0.5 * duration * w[axis]
        sin, cos = jnp.sin(half), jnp.cos(half)
        zero = jnp.zeros_like(sin)
        quat = multiply(quat, jnp.stack([sin if k == axis else zero for k in range(3)] + [cos], axis=-1))
        twice_sin, twice_cos = 2 * sin * cos, cos * cos - sin * sin
        # The angular momentum stays in the world and turns back in the body.
        momentum = inertia[..., second] * w[second], inertia[..., third] * w[third]
        w[second] = (twice_cos * momentum[0] + twice_sin * momentum[1]) / inertia[..., second]
        w[third] = (twice_cos * momentum[1] - twice_sin * momentum[0]) / inertia[..., third]
    return quat, jnp.stack(w, axis=-1)
