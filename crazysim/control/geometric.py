"""Geometric tracking control on SE(3), from a setpoint to a wrench. It has no singularities of Euler angles."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.control.bandwidth import Bandwidth, bandwidth
from crazysim.control.flatness import Attitude, attitude_of_thrust
from crazysim.control.levels import Control
from crazysim.control.priority import prioritized_wrench
from crazysim.control.protocol import Controller, DroneData, zeros
from crazysim.control.rigid_body_params import RigidBodyParams
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY
from crazysim.engine.pytree import PyTree, leaf
from crazysim.errors import expect
from crazysim.rotation import clip, cross, dot, matvec

MAX_INTEGRAL_RATIO = 0.5
"""Largest acceleration along an axis by the integral of the position error, over gravity, 1."""


class GeometricMemory(PyTree):
    """Memory of geometric control with an integral."""

    acc: Array = leaf("drone", 1, (3,))
    """Acceleration by the integral of the position error, world frame, m/s^2. (n_worlds, n_drones, 3)"""


class GeometricParams(RigidBodyParams):
    """Gains and parameters of geometric control, each shared or one per drone."""

    kr: Array = leaf("parameter", 1, (3,), airframe=lambda airframe: airframe.value("geometric.kr", ()))
    """Gain on the position error, N/m. (3,)"""
    kv: Array = leaf("parameter", 1, (3,), airframe=lambda airframe: airframe.value("geometric.kv", ()))
    """Gain on the velocity error, N s/m. (3,)"""
    kR: Array = leaf("parameter", 1, (3,), airframe=lambda airframe: airframe.value("geometric.kR", ()))
    """Gain on the rotation error, N m. (3,)"""
    kw: Array = leaf("parameter", 1, (3,), airframe=lambda airframe: airframe.value("geometric.kw", ()))
    """Gain on the error of the body rates, N m s. (3,)"""


def bandwidth_gains(airframe: Airframe, bandwidths: Bandwidth) -> dict[str, Any]:
    """Return the gains ``kr``, ``kv``, ``kR`` and ``kw`` that give an airframe a bandwidth, by name."""
    mass, moments = airframe.value("rigid_body.mass", ()), np.diag(airframe.inertia)
    return {
        "kr": mass * bandwidths.position**2,
        "kv": mass * 2 * bandwidths.position,
        "kR": moments * bandwidths.stiffness,
        "kw": moments * bandwidths.damping,
    }


def geometric_control(
    pos: Array,
    quat: Array,
    vel: Array,
    ang_vel: Array,
    setpoint: Setpoint,
    *,
    params: GeometricParams,
    feedforward: bool = True,
    integral: Array | None = None,
) -> Array:
    """Track a setpoint; return collective thrust, N, and body torque, N m. (..., 4)

    This is the controller of Lee, Leok and McClamroch (2010). A force follows from the errors of position and velocity.
    The z axis of the desired attitude is along that force. Desired body rates and angular acceleration follow from the
    force and from jerk and snap of the setpoint (``attitude_of_thrust``). A torque follows from the errors of rotation
    and body rates. The drag of the setpoint's velocity, with its derivatives, is compensated at the current attitude
    (Faessler, Franchi and Scaramuzza 2018). The wrench is limited by priority (``prioritized_wrench``), so that a
    drone with saturated rotors keeps its attitude and the motors stay on.

    Args:
        pos: Position, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        setpoint: Setpoint with the leading axes of the state.
        params: Gains, shared or with the leading axes of the state.
        feedforward: False for the law of AIMotionLab-Virtual, in which acceleration, jerk, snap, yaw rates and drag
            are not fed forward.
        integral: Acceleration that is added to the feedback, world frame, m/s^2; None for none. (..., 3)
    """
    p, sp = params, setpoint
    # The law of AIMotionLab-Virtual feeds nothing forward.
    if not feedforward:
        zero, zero_yaw_rate = jnp.zeros_like(pos), jnp.zeros_like(sp.yaw)
        sp = sp.replace(acc=zero, jerk=zero, snap=zero, yaw_rate=zero_yaw_rate, yaw_acc=zero_yaw_rate)
    matrix = rotation.matrix(quat)
    feedback = -(p.kr * (pos - sp.pos) + p.kv * (vel - sp.vel)) / p.mass
    if integral is not None:
        feedback = feedback + integral

    def subtract_drag(motion: Array, derivative: Array) -> Array:
        if not feedforward:
            return derivative
        return derivative - matvec(matrix, matvec(p.drag_matrix, matvec(jnp.swapaxes(matrix, -1, -2), motion))) / p.mass

    # Thrust vector with its derivatives, and the attitude along it.
    specific_thrust = subtract_drag(sp.vel, sp.acc) - p.gravity_vec + feedback
    desired = attitude_of_thrust(
        specific_thrust,
        subtract_drag(sp.acc, sp.jerk),
        subtract_drag(sp.jerk, sp.snap),
        sp.yaw,
        sp.yaw_rate,
        sp.yaw_acc,
    )
    # Thrust along the present z axis, torque to the desired attitude.
    thrust = p.mass * dot(specific_thrust, matrix[..., 2])
    torque = attitude_torque(matrix, ang_vel, desired, params=p)
    return prioritized_wrench(jnp.concatenate([thrust, torque], axis=-1), params=p.allocation)


def attitude_torque(matrix: Array, ang_vel: Array, desired: Attitude, *, params: GeometricParams) -> Array:
    """Track an attitude and its rates (Lee, Leok and McClamroch 2010); return the torque, body frame, N m. (..., 3)

    Args:
        matrix: Rotation matrix, body to world. (..., 3, 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
    """
    p = params
    rotation_error, rate_error, ang_acc = attitude_errors(matrix, ang_vel, desired)
    inertial_torque = cross(ang_vel, matvec(p.J, ang_vel)) + matvec(p.J, ang_acc)
    return inertial_torque - p.kR * rotation_error - p.kw * rate_error


def attitude_errors(matrix: Array, ang_vel: Array, desired: Attitude) -> tuple[Array, Array, Array]:
    """Return rotation error, error of the body rates, and the desired angular acceleration, all in the body frame.

    The rotation error is ``vee(R_d^T R - R^T R_d) / 2``, rad for small errors. The desired rates are rotated from the
    desired frame into the body frame before they are compared.

    Args:
        matrix: Rotation matrix R, body to world. (..., 3, 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        desired: Attitude R_d to track, with its derivatives.

    Returns:
        Rotation error, rad; rate error, rad/s; angular acceleration of a body that tracks, rad/s^2. (..., 3) each
    """
    columns = [(matrix[..., i], desired.matrix[..., i]) for i in range(3)]
    # With the axes x_d of R_d and x of R, vee(R_d^T R - R^T R_d) is R^T times the sum of x_d cross x over three axes.
    to_body = jnp.swapaxes(matrix, -1, -2)
    cross_products = [cross(axis_d, axis) for axis, axis_d in columns]
    rotation_error = 0.5 * matvec(to_body, cross_products[0] + cross_products[1] + cross_products[2])
    ang_vel_des = matvec(to_body, matvec(desired.matrix, desired.ang_vel))
    ang_acc_des = matvec(to_body, matvec(desired.matrix, desired.ang_acc))
    return rotation_error, ang_vel - ang_vel_des, ang_acc_des - cross(ang_vel, ang_vel_des)


class Geometric(Controller):
    """Geometric tracking control (``geometric_control``) of setpoints."""

    name: ClassVar[str] = "geometric"
    levels: ClassVar[tuple[Control, ...]] = (Control.state,)
    output: ClassVar[Control] = Control.force_torque
    freq: int = 500
    """Rate of the controller, Hz."""
    gains: Literal["bandwidth", "airframe"] = "bandwidth"
    """``"bandwidth"`` for the rule of ``crazysim.control.bandwidth``, times mass and inertia; ``"airframe"`` for the
    airframe's table ``[geometric]``. Airframes of AIMotionLab have its gains in this table."""
    feedforward: bool = True
    """True to feed the derivatives of the setpoint forward; False for the law of AIMotionLab-Virtual."""
    integral: float = 0.0
    """Rate at which the integral of the position error compensates a constant force, 1/s: the ratio of the integral
    gain to the position gain on each axis. 0 for no integral and no memory. Without delays, the loop is stable below
    the ratio of ``kv`` to the mass. An error is not integrated if the position gain alone demands more than
    ``MAX_INTEGRAL_RATIO`` times gravity for it."""

    def params(self, airframe: Airframe) -> GeometricParams:
        expect(
            np.isfinite(self.integral) and self.integral >= 0,
            "a finite integral of at least 0, 1/s",
            self.integral,
            "Use 0 for none.",
        )
        is_tuned = self.gains == "airframe"
        gains = {} if is_tuned else bandwidth_gains(airframe, bandwidth(airframe, self.freq))
        return GeometricParams.create(airframe, **gains)

    def memory(self, airframe: Airframe) -> GeometricMemory | None:
        return zeros(GeometricMemory) if self.integral else None

    def update(self, data: DroneData, command: Any, memory: Any, params: GeometricParams) -> tuple[Array, Any]:
        s = data.states
        if self.integral:
            limit = -MAX_INTEGRAL_RATIO * GRAVITY[2]
            error_acc = params.kr * (command.pos - s.pos) / params.mass
            error_acc = jnp.where(
                jnp.abs(error_acc) < limit, error_acc, 0.0
            )  # Larger errors are transients, not disturbances.
            memory = GeometricMemory(clip(memory.acc + self.integral / self.freq * error_acc, -limit, limit))
        state = (s.pos, s.quat, s.vel, s.ang_vel)
        acc = memory.acc if self.integral else None
        return geometric_control(*state, command, params=params, feedforward=self.feedforward, integral=acc), memory
