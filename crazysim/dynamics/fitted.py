"""Dynamics fitted to flights: roll, pitch and yaw respond to a command like damped springs.

    rpy'' = rpy_coef rpy + rpy_rates_coef rpy' + cmd_rpy_coef cmd_rpy

The fits were made near level flight, and Euler angles are singular at a pitch of 90 degrees. Therefore the fit is used
up to 80 degrees of pitch. Between 80 and 88 degrees it is blended into a spring and damper on the attitude error, which
are defined at every attitude. The same blend is used between body rates of 100 and 200 rad/s, and between commands of
100 and 200 rad: there, a drone passes the vertical so often that the singularity would add energy without bound.
Outside of the fitted range the motion is bounded and continuous, but not identified.
"""

from __future__ import annotations

import math
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.drones import Airframe
from crazysim.drones.keys import TABLES
from crazysim.dynamics.drag import body_drag_force
from crazysim.dynamics.models import BodyParams, Dynamics, require_support
from crazysim.engine.pytree import leaf
from crazysim.rotation import along_z, matvec

MIN_FITTED_COSINE = math.cos(math.radians(80))
MIN_BLENDED_COSINE = math.cos(math.radians(88))
"""Cosines of the pitch at which the blend of the fit into the spring begins, and of the pitch at which it ends."""
MAX_FITTED_MAGNITUDE = 100.0
"""Body rate, rad/s, and commanded angles, rad, up to which the fit is used; the blend ends at twice as much.

This is about three times the 2,000 degrees per second that a Crazyflie's gyroscope can measure (BMI088, data sheet),
and sixteen revolutions.
"""


class Params(BodyParams):
    """Parameters of a fitted model, each shared or one per drone. The inertia affects external torques only."""

    J_inv: Array = leaf("parameter", 2, airframe=lambda airframe: np.linalg.inv(airframe.inertia))
    """Inverse of the inertia, body frame, 1/(kg m^2). (3, 3)"""
    acc_coef: Array = leaf("parameter", 1, (1,))
    """Thrust at command zero, N. (1,)"""
    cmd_f_coef: Array = leaf("parameter", 1, (1,))
    """Thrust per commanded thrust, dimensionless. (1,)"""
    rpy_coef: Array = leaf("parameter", 1)
    """Stiffness of roll, pitch and yaw, 1/s^2. (3,)"""
    rpy_rates_coef: Array = leaf("parameter", 1)
    """Damping of roll, pitch and yaw, 1/s. (3,)"""
    cmd_rpy_coef: Array = leaf("parameter", 1)
    """Gain on the commanded roll, pitch and yaw, 1/s^2. (3,)"""
    thrust_dyn_coef: Array | None = leaf("parameter", 1)
    """Rate of the lag of the thrust behind its command, 1/s; None without lag. (1,)"""
    drag_matrix: Array | None = leaf("parameter", 2)
    """Linear drag coefficients, body frame, N s/m; None without drag. (3, 3)"""
    thrust_min: Array = leaf(
        "parameter", 1, airframe=lambda airframe: airframe.n_rotors * airframe.value("rotors.thrust_min", ())
    )
    """Minimum collective thrust of rotors that are on, N. (1,)"""
    thrust_max: Array = leaf(
        "parameter", 1, airframe=lambda airframe: airframe.n_rotors * airframe.value("rotors.thrust_max", ())
    )
    """Maximum collective thrust, N. (1,)"""

    @classmethod
    def create(cls, airframe: Airframe, dynamics: Dynamics) -> Self:
        require_support(airframe, dynamics)
        fit = dict.fromkeys(("thrust_dyn_coef", "drag_matrix")) | fitted_numbers(airframe, dynamics)
        return super().create(airframe, **fit)


def fitted_numbers(airframe: Airframe, dynamics: Dynamics) -> dict[str, Any]:
    """Return an airframe's numbers of a fitted model, by field of ``Params``."""
    table = f"fitted.{dynamics.value}"
    numbers = {key: airframe.value(f"{table}.{key}") for key in TABLES[table] if key != "drag_coefficients"}
    if "drag_coefficients" in TABLES[table]:
        numbers["drag_matrix"] = airframe.matrix(f"{table}.drag_coefficients")
    return numbers


def dynamics(
    pos: Array,
    quat: Array,
    vel: Array,
    ang_vel: Array,
    cmd: Array,
    rotor_vel: Array,
    dist_f: Array | None = None,
    dist_t: Array | None = None,
    *,
    params: Params,
) -> tuple[Array, Array, Array, Array]:
    """Return the time derivatives of one drone under a fitted model.

    Args:
        pos: Position of the centre of mass, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        cmd: Roll, pitch, yaw, rad, and collective thrust, N. (..., 4)
        rotor_vel: Current collective thrust, N, in every entry; unused by ``so_rpy``. (..., k)
        dist_f: External force on the centre of mass, world frame, N. (..., 3)
        dist_t: External torque, world frame, N m. (..., 3)
        params: Parameters, shared or with the leading axes of the state.

    Returns:
        Velocity, m/s, acceleration, m/s^2 (both world frame), angular acceleration, rad/s^2 (body frame),
        and the rate of the thrust entries, N/s.
    """
    del pos  # the argument gives all models one signature
    p = params
    thrust_cmd = cmd[..., 3:4]
    # Thrust of the command, at once or with a lag.
    if p.thrust_dyn_coef is None:
        thrust, thrust_rate = thrust_cmd, jnp.zeros_like(rotor_vel)
    else:
        thrust, thrust_rate = rotor_vel[..., :1], p.thrust_dyn_coef * (thrust_cmd - rotor_vel)
    # Force, world frame.
    body_force = along_z((p.acc_coef + p.cmd_f_coef * thrust)[..., 0])
    if p.drag_matrix is not None:
        body_force = body_force + body_drag_force(quat, vel, p.drag_matrix)
    force = rotation.rotate(quat, body_force, offset=dist_f)

    # Attitude as a damped spring that follows the command.
    ang_acc = _fitted_angular_acceleration(quat, ang_vel, cmd[..., :3], p)
    if dist_t is not None:
        ang_acc = ang_acc + matvec(p.J_inv, rotation.rotate_inverse(quat, dist_t))
    return vel, force / p.mass + p.gravity_vec, ang_acc, thrust_rate


def saturate(cmd: Array, params: Params) -> Array:
    """Return the attitude command with its thrust within the limits of the rotors; zero or less is off. (..., 4)"""
    thrust = cmd[..., 3:4]
    clipped_thrust = jnp.where(thrust <= 0, 0.0, rotation.clip(thrust, params.thrust_min, params.thrust_max))
    return jnp.concatenate([cmd[..., :3], clipped_thrust], axis=-1)


def _fitted_angular_acceleration(quat: Array, ang_vel: Array, cmd_rpy: Array, p: Params) -> Array:
    x, y, z, w = quat[..., 0:1], quat[..., 1:2], quat[..., 2:3], quat[..., 3:4]
    cos_pitch = rotation.safe_norm(jnp.concatenate([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)], axis=-1))
    blend = jnp.clip((cos_pitch - MIN_BLENDED_COSINE) / (MIN_FITTED_COSINE - MIN_BLENDED_COSINE), 0.0, 1.0)
    squared_magnitude = (
        jnp.maximum(rotation.dot(ang_vel, ang_vel), rotation.dot(cmd_rpy, cmd_rpy)) / MAX_FITTED_MAGNITUDE**2
    )
    blend = blend * jnp.clip((4 - squared_magnitude) / 3, 0.0, 1.0)
    weight = blend * blend * blend * (10 - 15 * blend + 6 * blend * blend)

    # Where the weight is zero the fit is evaluated at rest: 0 * inf is NaN, in gradients too.
    level_quat = jnp.asarray([0.0, 0.0, 0.0, 1.0], quat.dtype)
    is_fitted = weight > 0
    fitted_acc = _euler_spring(
        jnp.where(is_fitted, quat, level_quat),
        jnp.where(is_fitted, ang_vel, 0.0),
        jnp.where(is_fitted, cmd_rpy, 0.0),
        p,
    )

    error = rotation.multiply(rotation.conjugate(rotation.from_rpy(cmd_rpy)), quat)
    spring_acc = p.rpy_coef * 2 * error[..., 3:] * error[..., :3] + p.rpy_rates_coef * ang_vel
    return weight * fitted_acc + (1 - weight) * spring_acc


def _euler_spring(quat: Array, ang_vel: Array, cmd_rpy: Array, p: Params) -> Array:
    rpy = rotation.to_rpy(quat)
    sin, cos = jnp.sin(rpy), jnp.cos(rpy)
    sr, sp, cr, cp = sin[..., 0], sin[..., 1], cos[..., 0], cos[..., 1]
    wx, wy, wz = ang_vel[..., 0], ang_vel[..., 1], ang_vel[..., 2]
    yaw_rate = (sr * wy + cr * wz) / cp
    roll_rate, pitch_rate = wx + sp * yaw_rate, cr * wy - sr * wz
    rates = jnp.stack([roll_rate, pitch_rate, yaw_rate], axis=-1)

    acc = p.rpy_coef * rpy + p.rpy_rates_coef * rates + p.cmd_rpy_coef * cmd_rpy
    roll_acc, pitch_acc, yaw_acc = acc[..., 0], acc[..., 1], acc[..., 2]
    # ang_vel = E(rpy) rpy', so ang_vel' = E rpy'' + E' rpy'.
    y_terms = -sr * roll_rate * pitch_rate + (cr * cp * roll_rate - sr * sp * pitch_rate) * yaw_rate
    z_terms = -cr * roll_rate * pitch_rate - (sr * cp * roll_rate + cr * sp * pitch_rate) * yaw_rate
    return jnp.stack(
        [
            roll_acc - sp * yaw_acc - cp * pitch_rate * yaw_rate,
            cr * pitch_acc + sr * cp * yaw_acc + y_terms,
            -sr * pitch_acc + cr * cp * yaw_acc + z_terms,
        ],
        axis=-1,
    )
