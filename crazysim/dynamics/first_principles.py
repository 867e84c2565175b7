"""Dynamics of a multirotor from first principles: rotors, rigid body and drag."""

from __future__ import annotations

from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.drones import Airframe
from crazysim.dynamics.drag import body_drag_force
from crazysim.dynamics.models import BodyParams, Dynamics, require_support
from crazysim.dynamics.rigid_body import angular_acceleration, linear_acceleration, stable_angular_acceleration
from crazysim.dynamics.rotor import (
    quadratic_curve,
    reaction_torque,
    rotor_acceleration,
    rotor_momentum,
    rotor_torque,
    rotor_vel_of_thrust,
)
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import leaf
from crazysim.rotation import along_z


class Params(BodyParams):
    """Parameters of the first-principles model, each shared or one per drone."""

    L: Array = leaf("parameter", 1, airframe=lambda airframe: airframe.arm)
    """Arm that scales the first two rows of the mixing matrix, m. (n_rotors,) if rotors differ, else (1,)"""
    prop_inertia: Array = leaf("parameter", 1, airframe="rotors.inertia")
    """Inertia of a propeller and motor about its axis, kg m^2. (n_rotors,) if rotors differ, else (1,)"""
    J_inv: Array = leaf("parameter", 2, airframe=lambda airframe: np.linalg.inv(airframe.inertia))
    """Inverse of the inertia, body frame, 1/(kg m^2). (3, 3)"""
    rpm2thrust: Array = leaf("parameter", 2, airframe="rotors.thrust_curve")
    """Thrust curve, N, N/rpm, N/rpm^2. (n_rotors, 3) if rotors differ, else (1, 3)"""
    rpm2torque: Array = leaf("parameter", 2, airframe="rotors.torque_curve")
    """Drag torque curve, N m, N m/rpm, N m/rpm^2. (n_rotors, 3) if rotors differ, else (1, 3)"""
    mixing_matrix: Array = leaf("parameter", 2, airframe=lambda airframe: airframe.mixing_matrix)
    """Mixing matrix, rotor thrusts to torque: positions over L, and signs of the drag torque. (3, n_rotors)"""
    drag_matrix: Array = leaf("parameter", 2, airframe=lambda airframe: airframe.matrix("drag.coefficients"))
    """Linear drag coefficients, body frame, N s/m. (3, 3)"""
    rotor_dyn_coef: Array = leaf("parameter", 2, airframe="rotors.lag")
    """Coefficients of ``rotor_acceleration`` on spin-up, then on spin-down, 1/s, 1/(s rpm). (n_rotors, 4) if
    rotors differ, else (1, 4)"""
    rotor_vel_min: Array = leaf("parameter", 1, airframe=lambda airframe: airframe.rotor_vel_limits[0])
    """Minimum speed of a rotor that is on, rpm. (n_rotors,) if rotors differ, else (1,)"""
    rotor_vel_max: Array = leaf("parameter", 1, airframe=lambda airframe: airframe.rotor_vel_limits[1])
    """Maximum rotor speed, rpm. (n_rotors,) if rotors differ, else (1,)"""

    @classmethod
    def create(cls, airframe: Airframe, **values: Any) -> Self:
        require_support(airframe, Dynamics.first_principles)
        return super().create(airframe, **values)


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
    dt: float | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Return the time derivatives of one multirotor.

    Args:
        pos: Position of the centre of mass, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        cmd: Commanded rotor speeds, rpm. (..., n_rotors)
        rotor_vel: Rotor speeds, rpm. (..., n_rotors)
        dist_f: External force on the centre of mass, world frame, N. (..., 3)
        dist_t: External torque, world frame, N m. (..., 3)
        params: Parameters, shared or with the leading axes of the state.
        dt: Duration of an Euler step, s, to return ``stable_angular_acceleration``, which differs from the exact
            derivative above 20 rad/s at 500 Hz. None for the exact derivatives.

    Returns:
        Velocity, m/s, acceleration, m/s^2 (both world frame), angular acceleration, rad/s^2 (body frame),
        and rotor acceleration, rpm/s.
    """
    del pos  # the argument gives all models one signature
    p = params
    # Rotors: thrust, drag torque and acceleration.
    thrust = quadratic_curve(rotor_vel, p.rpm2thrust)
    drag_torque = quadratic_curve(rotor_vel, p.rpm2torque)
    rotor_acc = rotor_acceleration(cmd, rotor_vel, p.rotor_dyn_coef)

    # Force on the centre of mass, world frame.
    body_force = along_z(jnp.sum(thrust, axis=-1)) + body_drag_force(quat, vel, p.drag_matrix)
    force = rotation.rotate(quat, body_force, offset=dist_f)

    # Torque about the centre of mass, body frame.
    yaw_torque_sign = p.mixing_matrix[..., 2, :]
    torque = rotor_torque(thrust, drag_torque, p.L, p.mixing_matrix)
    torque = torque + reaction_torque(rotor_acc, yaw_torque_sign, p.prop_inertia)
    if dist_t is not None:
        torque = rotation.rotate_inverse(quat, dist_t, offset=torque)

    # Newton and Euler.
    acc = linear_acceleration(force, p.mass, p.gravity_vec)
    momentum = rotor_momentum(rotor_vel, yaw_torque_sign, p.prop_inertia)
    if dt is None:
        ang_acc = angular_acceleration(torque, ang_vel, p.J, p.J_inv, momentum)
    else:
        ang_acc = stable_angular_acceleration(torque, ang_vel, p.J, p.J_inv, momentum, dt)
    return vel, acc, ang_acc, rotor_acc


def saturate(cmd: Array, params: Params) -> Array:
    """Limit rotor speed commands as the motors do, rpm; zero or less switches a motor off. (..., n_rotors)

    Args:
        cmd: Commanded rotor speeds, rpm. (..., n_rotors)
    """
    return jnp.where(cmd <= 0, 0.0, rotation.clip(cmd, params.rotor_vel_min, params.rotor_vel_max))


@jit_eager_calls()
def hover_rotor_vel(params: Params) -> Array:
    """Solve for the rotor speeds at which equal thrusts of all rotors carry the weight, rpm. (..., n_rotors)"""
    n_rotors = params.mixing_matrix.shape[-1]
    weight = params.mass * rotation.safe_norm(params.gravity_vec)
    if params.rotor_vel_max.shape[-1] == 1:
        thrusts = jnp.broadcast_to(weight / n_rotors, (*weight.shape[:-1], n_rotors))
        return rotor_vel_of_thrust(thrusts, params.rpm2thrust)
    has_rotor = params.rotor_vel_max > 0
    thrusts = jnp.broadcast_to(weight / jnp.sum(has_rotor, axis=-1, keepdims=True), has_rotor.shape)
    curves = jnp.where(has_rotor[..., None], params.rpm2thrust, jnp.ones(3, params.rpm2thrust.dtype))
    return jnp.where(has_rotor, rotor_vel_of_thrust(thrusts, curves), 0.0)


def pad_rotors(params: Params, n_rotors: int) -> Params:
    """Return the parameters of an airframe padded to ``n_rotors``; added rotors have no thrust, torque or speed."""
    n_own_rotors = params.mixing_matrix.shape[-1]
    if n_own_rotors == n_rotors:
        return params

    def extend(x: Array, axis: int, mode: Any = "constant") -> np.ndarray:
        array = np.asarray(x)
        per_rotor = (
            np.broadcast_to(array, [*array.shape[:axis], n_own_rotors, *array.shape[axis + 1 :]])
            if array.shape[axis] == 1
            else array
        )
        return np.pad(per_rotor, [(0, n_rotors - n_own_rotors if k == axis else 0) for k in range(array.ndim)], mode)

    names = ("rpm2thrust", "rpm2torque", "rotor_vel_min", "rotor_vel_max")
    curves_and_limits = {name: extend(getattr(params, name), 0) for name in names}
    inertia_and_lag = {name: extend(getattr(params, name), 0, "edge") for name in ("prop_inertia", "rotor_dyn_coef")}
    return params.replace(mixing_matrix=extend(params.mixing_matrix, 1), **curves_and_limits, **inertia_and_lag)
