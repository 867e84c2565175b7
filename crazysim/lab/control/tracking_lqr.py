"""Time-varying linear quadratic regulator along a trajectory, with gains from a backward Riccati recursion."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.control.levels import Control
from crazysim.control.priority import prioritized_wrench
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.rigid_body_params import RigidBodyParams
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY
from crazysim.engine.pytree import leaf
from crazysim.errors import require
from crazysim.lab.control.lqr import (
    Reference,
    flat_reference,
    lqr_weights,
    solve_on_host,
    state_error,
)
from crazysim.lab.control.riccati import gain_continuous, solve_lyapunov
from crazysim.rotation import cross, matvec

MAX_KNOTS = 60
"""Largest number of knots, which are the times with a gain."""


class TrackingLQRParams(RigidBodyParams):
    """Gains and parameters of the LQR along a trajectory, each shared or one per drone."""

    gains: Array = leaf("parameter", 3)
    """Gains at the knots. (n_knots, 4, 12)"""
    dt: Array = leaf("parameter", 1, (1,))
    """Time from one knot to the next, s. (1,)"""
    start: Array = leaf("parameter", 1, (1,))
    """Time of the first knot, s since the reset. (1,)"""


def error_derivative(error: Array, wrench: Array, reference: Reference, ang_acc: Array, mass: Array, J: Array) -> Array:
    """Return the derivative of the errors about a reference, for an error of the wrench, per second. (12,)

    To first order, the errors are the same as in ``state_error``: position, velocity, a small rotation vector e_R with
    ``R = R_d exp(e_R^)``, and ``e_w = w - R^T R_d w_d``, so that ``e_R' = e_w``.

    Args:
        error: Errors. (12,)
        wrench: Error of collective thrust, N, and torque, N m. (4,)
        ang_acc: Angular acceleration of the reference, body frame, rad/s^2. (3,)
        mass: Mass, kg. (1,)
        J: Inertia, body frame, kg m^2. (3, 3)
    """
    vel_error, rot_error, rate_error = error[3:6], error[6:9], error[9:12]
    w_d = reference.ang_vel
    w = w_d + rate_error - cross(rot_error, w_d)
    z = reference.matrix[..., 2]
    thrust_axis = z + matvec(reference.matrix, cross(rot_error, jnp.asarray([0.0, 0.0, 1.0], rot_error.dtype)))
    acc = ((reference.wrench[:1] + wrench[:1]) * thrust_axis - reference.wrench[:1] * z) / mass
    w_rate = jnp.linalg.solve(J, reference.wrench[1:] + wrench[1:] - cross(w, matvec(J, w)))
    return jnp.concatenate(
        [vel_error, acc, rate_error, w_rate - ang_acc + cross(rate_error, w_d) + cross(rot_error, ang_acc)]
    )


def tracking_gains(
    setpoints: Setpoint, dt: Array, mass: Array, J: Array, drag_matrix: Array, Q: Array, R: Array, n_steps: int = 1
) -> Array:
    """Return the gains of the LQR about the references of successive setpoints, or NaN; pure and differentiable.

    The error dynamics are linearised at every setpoint, and constant until the next setpoint. A backward scan runs the
    Riccati recursion in steps of ``dt / n_steps``, discretised to second order. It starts from the solution of the
    algebraic equation at the last setpoint, as if that setpoint were held forever.

    Args:
        setpoints: Setpoints ``dt`` apart. (n, ...)
        dt: Time from one setpoint to the next, s. ()
        mass: Mass, kg. () or (1,)
        J: Inertia, body frame, kg m^2. (3, 3)
        drag_matrix: Linear drag coefficients, body frame, N s/m. (3, 3)
        Q: Weights of the errors, per second. (12, 12)
        R: Weights of the wrench, per second. (4, 4)
        n_steps: Steps of the recursion from one setpoint to the next. A step should be a few milliseconds at most.

    Returns:
        (n, 4, 12)
    """
    mass = jnp.reshape(mass, (1,))
    # ``flat_reference`` does not read the allocation.
    params = RigidBodyParams(mass, jnp.asarray(GRAVITY, J.dtype), J, drag_matrix, None)  # type: ignore[arg-type]

    def linearize_errors(setpoint: Setpoint) -> tuple[Array, Array]:
        reference = flat_reference(setpoint, params)
        w = reference.ang_vel
        ang_acc = jnp.linalg.solve(J, reference.wrench[1:] - cross(w, matvec(J, w)))

        def derivative(error: Array, wrench: Array) -> Array:
            return error_derivative(error, wrench, reference, ang_acc, mass, J)

        zero, no_wrench = jnp.zeros(12, J.dtype), jnp.zeros(4, J.dtype)
        return jax.jacfwd(derivative, 0)(zero, no_wrench), jax.jacfwd(derivative, 1)(zero, no_wrench)

    A, B = jax.vmap(linearize_errors)(setpoints)
    eye, h = jnp.eye(12, dtype=J.dtype), dt / n_steps
    transition, input_matrix = eye + h * A + h * h / 2 * A @ A, h * B + h * h / 2 * A @ B
    end_gain = gain_continuous(A[-1], B[-1], Q, R)
    P = solve_lyapunov(A[-1] - B[-1] @ end_gain, Q + end_gain.T @ R @ end_gain)

    def step_backward(P: Array, matrices: tuple[Array, Array]) -> tuple[Array, Array]:
        F, G = matrices

        def riccati_step(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], None]:
            P, _ = carry
            K = jnp.linalg.solve(h * R + G.T @ P @ G, G.T @ P @ F)
            closed_loop = F - G @ K
            P = closed_loop.T @ P @ closed_loop + h * (Q + K.T @ R @ K)
            return ((P + P.T) / 2, K), None

        (P, K), _ = jax.lax.scan(riccati_step, (P, end_gain), length=n_steps)
        return P, K

    _, gains = jax.lax.scan(step_backward, P, (transition, input_matrix), reverse=True)
    return gains


def interpolate_gain(time: Array, gains: Array, dt: Array) -> Array:
    """Return the gain at a time, s, interpolated linearly between knots ``dt`` apart. (4, 12)

    Before the first knot and after the last knot, the gain is constant.
    """
    last_index = gains.shape[-3] - 1
    knot = rotation.clip(time / dt, 0.0, float(last_index))
    gains, index = jnp.asarray(gains), jnp.minimum(jnp.floor(knot).astype(jnp.int32), last_index - 1)
    weight = knot - index
    return (1 - weight) * gains[index] + weight * gains[index + 1]


def tracking_lqr_control(
    pos: Array, quat: Array, vel: Array, ang_vel: Array, setpoint: Setpoint, time: Array, *, params: TrackingLQRParams
) -> Array:
    """Track a trajectory by its LQR, ``u = u_ref - K(t) e``.

    Args:
        pos: Position, world frame, m. (3,)
        quat: Attitude, body to world, unit, xyzw. (4,)
        vel: Velocity, world frame, m/s. (3,)
        ang_vel: Angular velocity, body frame, rad/s. (3,)
        setpoint: Setpoint of one drone at this time.
        time: Time since the reset, s. ()

    Returns:
        Collective thrust, N, and body torque, N m, within the limits of the rotors. (4,)
    """
    p = params
    reference = flat_reference(setpoint, p)
    error = state_error(pos, quat, vel, ang_vel, reference)
    gain = interpolate_gain(time - p.start[0], p.gains, p.dt[0])
    return prioritized_wrench(reference.wrench - matvec(gain, error), params=p.allocation)


class TrackingLQR(Controller):
    """Time-varying LQR (``tracking_lqr_control``) along a trajectory that is known in advance.

    The gains depend on the time since the reset of a world, so the commanded setpoints must follow the same trajectory
    at the same times. ``Follow`` with the same start commands such setpoints. AIMotionLab-Virtual's LTV-LQR is the
    corresponding controller of a drone with a load.
    """

    name: ClassVar[str] = "tracking_lqr"
    levels: ClassVar[tuple[Control, ...]] = (Control.state,)
    output: ClassVar[Control] = Control.force_torque
    setpoints: Setpoint | None = None
    """Setpoints of the trajectory, ``dt`` apart: a ``Setpoint`` with one leading axis, 2 to ``MAX_KNOTS`` long."""
    dt: float = 0.1
    """Time from one setpoint to the next, s."""
    start: float = 0.0
    """Time of the first setpoint, s since the reset."""
    freq: int = 500
    """Rate of the controller, Hz."""
    Q: ArrayLike | None = None
    """Weights of the states, as for ``LQR``."""
    R: ArrayLike | None = None
    """Weights of the inputs, as for ``LQR``."""

    def params(self, airframe: Airframe) -> TrackingLQRParams:
        shape = np.shape(self.setpoints.pos) if isinstance(self.setpoints, Setpoint) else ()
        n = shape[0] if len(shape) == 2 else 0
        require(
            2 <= n <= MAX_KNOTS and 0 < self.dt < math.inf,
            f"expected setpoints of one drone with a leading axis of 2 to {MAX_KNOTS}, and a positive dt, got "
            f"positions of shape {shape} and {self.dt}. Use jax.vmap(trajectory.evaluate)(times) with a larger dt.",
        )
        invalid = [name for name, x in vars(self.setpoints).items() if not np.all(np.isfinite(x))]
        require(
            not invalid,
            f"expected finite setpoints, got NaN or infinity in {', '.join(invalid)}. Evaluate the trajectory at "
            f"times that it covers, and check its limits.",
        )
        Q, R = lqr_weights(airframe, self.freq, self.Q, self.R)
        mass, drag = airframe.value("rigid_body.mass"), airframe.matrix("drag.coefficients")
        compute_gains = functools.partial(tracking_gains, n_steps=math.ceil(self.dt * self.freq))
        gains = solve_on_host(compute_gains, self.setpoints, self.dt, mass, airframe.inertia, drag, Q, R)
        return TrackingLQRParams.create(airframe, gains=gains, dt=self.dt, start=self.start)

    def update(self, data: DroneData, command: Any, memory: Any, params: TrackingLQRParams) -> tuple[Array, Any]:
        s, core = data.states, data.core
        time = core.steps.astype(s.pos.dtype) / core.freq
        return tracking_lqr_control(s.pos, s.quat, s.vel, s.ang_vel, command, time, params=params), memory
