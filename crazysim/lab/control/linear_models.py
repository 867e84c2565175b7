"""Rigid-body models of a drone, alone and with a load on a rod, and their linearisation about an equilibrium."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.rotation import cross, dot, matvec

Model = Callable[[Array, Array], Array]
"""Function from a state and an input to the derivative of the state."""


def drone_derivative(x: Array, u: Array, mass: Array, J: Array, gravity_vec: Array) -> Array:
    """Return the derivative of the state of a rigid body under a wrench, per second. (12,)

    Args:
        x: Position, m, and velocity, m/s, world frame; roll, pitch, yaw, rad; body rates, rad/s. (12,)
        u: Collective thrust, N, and body torque, N m. (4,)
        mass: Mass, kg. (1,)
        J: Inertia, body frame, kg m^2. (3, 3)
        gravity_vec: Gravitational acceleration, m/s^2. (3,)
    """
    vel, rpy, ang_vel = x[3:6], x[6:9], x[9:12]
    acc = u[0] * _z_axis(rpy) / mass + gravity_vec
    return jnp.concatenate([vel, acc, *_rotational_derivatives(rpy, ang_vel, u[1:], J)])


def load_derivative(
    x: Array,
    u: Array,
    mass: Array,
    J: Array,
    gravity_vec: Array,
    load_mass: Array,
    length: Array,
    attach: Array | None = None,
) -> Array:
    """Return the derivative of a drone with a point load on a rigid, massless rod, per second. (16,)

    The rod hangs from a frictionless joint. A joint at the centre of mass exerts no torque on the drone. With thrust f,
    masses m of the drone and m_L of the load, length L of the rod and unit vector q from joint to load (Sreenath, Lee
    and Kumar 2013):

        m L q'' = q x (q x f) - m L |q'|^2 q
        (m + m_L) (v' - g) = f - m_L L q''

    For a joint at the vector d from the centre of mass, let p'' be the acceleration of the joint, v_0', w_0' and p_0''
    the accelerations without the rod, and m_L t q the force of the rod on the drone:

        t (1 + m_L / m + m_L (d x q).J^-1 (d x q)) = q.(g - p_0'') + L |q'|^2
        L q'' = g - t q - p'',   v' = v_0' + m_L / m t q,   w' = w_0' + m_L t J^-1 (d x q)

    Two angles determine the direction, ``q = (-sin b cos a, sin a, -cos b cos a)``: the rod turns by b about y, and
    then by a about its own x axis.

    Args:
        x: The 12 states of ``drone_derivative``; a, b, rad; a', b', rad/s. (16,)
        u: Collective thrust, N, and body torque, N m. (4,)
        mass: Mass of the drone, kg. (1,)
        J: Inertia of the drone, body frame, kg m^2. (3, 3)
        gravity_vec: Gravitational acceleration, m/s^2. (3,)
        load_mass: Mass of the load, kg. (1,)
        length: Length of the rod, m. (1,)
        attach: Position of the joint relative to the centre of mass, body frame, m; None for zero. (3,)
    """
    vel, rpy, ang_vel, angles, angle_rates = x[3:6], x[6:9], x[9:12], x[12:14], x[14:16]
    force = u[0] * _z_axis(rpy)
    q, q_rate = jax.jvp(rod_direction, (angles,), (angle_rates,))
    rpy_rate, ang_acc = _rotational_derivatives(rpy, ang_vel, u[1:], J)
    if attach is None:
        q_acc = cross(q, cross(q, force)) / (mass * length) - dot(q_rate, q_rate) * q
        acc = (force - load_mass * length * q_acc) / (mass + load_mass) + gravity_vec
    else:
        matrix = rotation.matrix(rotation.from_rpy(rpy))
        lever = cross(attach, matvec(matrix.T, q))
        ang_acc_per_pull = jnp.linalg.solve(J, lever)

        def joint_acceleration(acc: Array, ang_acc: Array) -> Array:
            return acc + matvec(matrix, cross(ang_acc, attach) + cross(ang_vel, cross(ang_vel, attach)))

        acc = force / mass + gravity_vec
        rod_acc = dot(q, gravity_vec - joint_acceleration(acc, ang_acc)) + length * dot(q_rate, q_rate)
        pull = rod_acc / (1 + load_mass / mass + load_mass * dot(lever, ang_acc_per_pull))
        acc, ang_acc = acc + load_mass / mass * pull * q, ang_acc + load_mass * pull * ang_acc_per_pull
        q_acc = (gravity_vec - pull * q - joint_acceleration(acc, ang_acc)) / length
    # q'' = D a'' + D' a' with D = dq/da: its columns are orthogonal, so the angles' accelerations are two projections.
    slope, slope_rate = jax.jvp(jax.jacfwd(rod_direction), (angles,), (angle_rates,))
    residual_acc = q_acc - slope_rate @ angle_rates
    angles_acc = slope.T @ residual_acc / jnp.sum(slope * slope, axis=0)
    return jnp.concatenate([vel, acc, rpy_rate, ang_acc, angle_rates, angles_acc])


def rod_direction(angles: Array) -> Array:
    """Return the direction of a rod from its angles a and b, rad: straight down at zero. (2,) -> (3,)"""
    a, b = angles[0], angles[1]
    return jnp.stack([-jnp.sin(b) * jnp.cos(a), jnp.sin(a), -jnp.cos(b) * jnp.cos(a)])


def rod_angles(direction: Array, direction_rate: Array) -> tuple[Array, Array]:
    """Return the angles a, b of a rod, rad, and their rates, rad/s; the inverse of ``rod_direction``.

    The result is always finite: if the rod is level along y, b is zero and the rates are limited.

    Args:
        direction: Unit vector from drone to load. (..., 3)
        direction_rate: Derivative of the direction, 1/s. (..., 3)

    Returns:
        Angles (..., 2), rates (..., 2).
    """
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    xz_length = rotation.safe_norm(jnp.stack([x, z], axis=-1))[..., 0]
    angles = jnp.stack([jnp.arctan2(y, xz_length), rotation.safe_arctan2(-x, -z)], axis=-1)
    safe_length = jnp.maximum(xz_length, 1e-3)
    b_rate = (direction_rate[..., 0] * z - x * direction_rate[..., 2]) / safe_length**2
    a_rate = direction_rate[..., 1] / safe_length
    return angles, jnp.stack([a_rate, b_rate], axis=-1)


def linearize(model: Model, x: Array, u: Array) -> tuple[Array, Array]:
    """Return the matrices A (n, n) and B (n, m) of ``x' = A x + B u`` about a state and an input."""
    return jax.jacfwd(model, 0)(x, u), jax.jacfwd(model, 1)(x, u)


def _z_axis(rpy: Array) -> Array:
    return rotation.z_axis(rotation.from_rpy(rpy))


def _rotational_derivatives(rpy: Array, ang_vel: Array, torque: Array, J: Array) -> tuple[Array, Array]:
    roll, pitch = rpy[0], rpy[1]
    heading_rate = jnp.sin(roll) * ang_vel[1] + jnp.cos(roll) * ang_vel[2]
    yaw_rate = heading_rate / jnp.cos(pitch)
    pitch_rate = jnp.cos(roll) * ang_vel[1] - jnp.sin(roll) * ang_vel[2]
    rpy_rate = jnp.stack([ang_vel[0] + jnp.sin(pitch) * yaw_rate, pitch_rate, yaw_rate])
    return rpy_rate, jnp.linalg.solve(J, torque - cross(ang_vel, matvec(J, ang_vel)))
