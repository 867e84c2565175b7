"""Linear quadratic regulator about hover, which tracks moving setpoints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.control.bandwidth import bandwidth
from crazysim.control.flatness import attitude_of_thrust
from crazysim.control.levels import Control
from crazysim.control.priority import prioritized_wrench
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.rigid_body_params import RigidBodyParams
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY
from crazysim.engine.pytree import leaf
from crazysim.errors import ConfigError
from crazysim.lab.control.linear_models import drone_derivative, linearize
from crazysim.lab.control.riccati import check_gain, gain_continuous
from crazysim.rotation import cross, dot, matvec
from crazysim.tables import read_numbers


class LQRParams(RigidBodyParams):
    """Gain and parameters of the LQR about hover, each shared or one per drone."""

    gain: Array = leaf("parameter", 2, (4, 12))
    """Gain K from the errors of position, velocity, rotation and body rates to the wrench. (4, 12)"""


def lqr_weights(
    airframe: Airframe,
    freq: int,
    Q: ArrayLike | None,
    R: ArrayLike | None,
    load_mass: float = 0.0,
    length: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights Q (n, n) and R (4, 4) as matrices; by default they suit the bandwidth of the airframe.

    The default follows Bryson's rule: each weight is one over the square of an acceptable error. The acceptable
    position error is 1 m. The acceptable velocity, tilt, body rates, thrust and torque are the responses to such an
    error with the gains of ``crazysim.control.bandwidth``: w, w^2 / g, w^3 / g, m w^2 and J k w^2 / g, with the natural
    frequency w of the position loop, the attitude stiffness k, and the mass m including the load. The acceptable yaw
    error equals the acceptable tilt. The acceptable angle of a rod is 1 / length rad, which shifts its load by 1 m; the
    acceptable rate of this angle is w times that.

    Args:
        freq: Rate of the controller, Hz.
        Q: Weights of the n = 12 states, or 16 with a load: a diagonal or a matrix; None for Bryson's rule.
        R: Weights of the inputs: a diagonal or a matrix; None for Bryson's rule.
        load_mass: Mass of the load, kg.
        length: Length of the rod of the load, m; None without a load.
    """
    bandwidths, g = bandwidth(airframe, freq), -GRAVITY[2]
    w, mass, moments = bandwidths.position, float(airframe.value("rigid_body.mass", ())), np.diag(airframe.inertia)
    tilt = w**2 / g
    angle = [] if length is None else [1 / length, 1 / length, w / length, w / length]
    acceptable_errors = np.concatenate([np.ones(3), np.full(3, w), np.full(3, tilt), np.full(3, tilt * w), angle])
    acceptable_inputs = np.array([(mass + load_mass) * w**2, *(moments * bandwidths.stiffness * tilt)])
    Q, R = acceptable_errors**-2 if Q is None else Q, acceptable_inputs**-2 if R is None else R
    return weight_matrix("Q", Q, len(acceptable_errors)), weight_matrix("R", R, 4)


def weight_matrix(name: str, weights: ArrayLike, n: int) -> np.ndarray:
    """Return weights as a matrix (n, n) of float64.

    Args:
        name: ``"Q"`` for weights of states, which may be zero, or ``"R"`` for weights of inputs, which are positive.
        weights: A diagonal (n,) or a symmetric matrix (n, n).
        n: Number of states or inputs.
    """
    array = read_numbers(f"weights {name}", weights, shapes=((n,), (n, n)), remedy=f"Give a diagonal of {n} numbers.")
    array = np.diag(array) if array.ndim == 1 else array
    is_symmetric = np.allclose(array, array.T)
    min_eigenvalue, tolerance = np.linalg.eigvalsh(array)[0], 1e-12 * np.abs(array).max()
    if not is_symmetric or (min_eigenvalue <= 0 if name == "R" else min_eigenvalue < -tolerance):
        reason = f"the eigenvalue {min_eigenvalue:.3g}" if is_symmetric else "a matrix that is not symmetric"
        kind = "definite" if name == "R" else "semidefinite"
        raise ConfigError(
            f"expected weights {name} as a symmetric, positive {kind} matrix, got {reason}. Give a diagonal of {n} "
            f"{'positive numbers' if name == 'R' else 'numbers that are at least zero'}."
        )
    return array


def solve_on_host(compute_gain: Callable[..., Array], *args: Any) -> np.ndarray:
    """Return ``compute_gain(*args)``, computed in float64 on the CPU."""
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        args = jax.tree.map(lambda x: np.asarray(x, np.float64), args, is_leaf=lambda x: isinstance(x, list))
        return check_gain(np.asarray(jax.jit(compute_gain)(*args)))


def hover_gain(mass: Array, J: Array, Q: Array, R: Array) -> Array:
    """Return the gain of the LQR about hover at yaw zero, or NaN if there is none; pure and differentiable.

    Args:
        mass: Mass, kg. () or (1,)
        J: Inertia, body frame, kg m^2. (3, 3)
        Q: Weights of position, velocity, roll, pitch, yaw and body rates. (12, 12)
        R: Weights of collective thrust and torque. (4, 4)

    Returns:
        Gain K of ``u = -K x``. (4, 12)
    """
    gravity = jnp.asarray(GRAVITY, J.dtype)
    mass = jnp.reshape(mass, (1,))

    def model(x: Array, u: Array) -> Array:
        return drone_derivative(x, u, mass, J, gravity)

    x, u = jnp.zeros(12, J.dtype), jnp.concatenate([-GRAVITY[2] * mass, jnp.zeros(3, J.dtype)])
    return gain_continuous(*linearize(model, x, u), Q, R)


class Reference(NamedTuple):
    """State and wrench of a drone that tracks a setpoint exactly."""

    pos: Array
    """Position, world frame, m. (..., 3)"""
    vel: Array
    """Velocity, world frame, m/s. (..., 3)"""
    matrix: Array
    """Rotation matrix, body to world. (..., 3, 3)"""
    ang_vel: Array
    """Angular velocity, body frame, rad/s. (..., 3)"""
    wrench: Array
    """Collective thrust, N, and body torque, N m. (..., 4)"""


def flat_reference(setpoint: Setpoint, params: RigidBodyParams) -> Reference:
    """Return the reference of a setpoint by differential flatness, with the drag of a level drone compensated.

    Args:
        params: A record with ``mass``, ``gravity_vec``, ``J`` and ``drag_matrix``.
    """
    p, sp = params, setpoint
    specific_thrust = sp.acc - p.gravity_vec - matvec(p.drag_matrix, sp.vel) / p.mass
    specific_thrust_rate = sp.jerk - matvec(p.drag_matrix, sp.acc) / p.mass
    specific_thrust_acc = sp.snap - matvec(p.drag_matrix, sp.jerk) / p.mass
    attitude = attitude_of_thrust(
        specific_thrust, specific_thrust_rate, specific_thrust_acc, sp.yaw, sp.yaw_rate, sp.yaw_acc
    )
    thrust = p.mass * rotation.safe_norm(specific_thrust)
    torque = matvec(p.J, attitude.ang_acc) + cross(attitude.ang_vel, matvec(p.J, attitude.ang_vel))
    return Reference(sp.pos, sp.vel, attitude.matrix, attitude.ang_vel, jnp.concatenate([thrust, torque], axis=-1))


def state_error(
    pos: Array, quat: Array, vel: Array, ang_vel: Array, reference: Reference, yaw: Array | None = None
) -> Array:
    """Return the errors of position, velocity, rotation and body rates. (..., 12)

    The rotation error is ``vee(R_d^T R - R^T R_d) / 2``; near hover these are the errors of roll, pitch and yaw.

    Args:
        pos: Position, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        yaw: Yaw of the frame in which errors of position and velocity are returned, rad; None for the world frame.
            (..., 1)
    """
    matrix = rotation.matrix(quat)
    relative_matrix = [
        [dot(reference.matrix[..., i], matrix[..., j])[..., 0] for j in range(3)] for i in range(3)
    ]  # R_d^T R
    rotation_error = 0.5 * jnp.stack(
        [
            relative_matrix[2][1] - relative_matrix[1][2],
            relative_matrix[0][2] - relative_matrix[2][0],
            relative_matrix[1][0] - relative_matrix[0][1],
        ],
        axis=-1,
    )
    to_body = jnp.swapaxes(matrix, -1, -2)
    rate_error = ang_vel - matvec(to_body, matvec(reference.matrix, reference.ang_vel))
    errors = [pos - reference.pos, vel - reference.vel]
    if yaw is not None:
        errors = [to_heading_frame(error, yaw) for error in errors]
    return jnp.concatenate([*errors, rotation_error, rate_error], axis=-1)


def to_heading_frame(vector: Array, yaw: Array) -> Array:
    """Return a world vector in the frame that is turned by the yaw, rad, about z. (..., 3)"""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y, z = vector[..., :1], vector[..., 1:2], vector[..., 2:]
    return jnp.concatenate([cos * x + sin * y, cos * y - sin * x, z], axis=-1)


def lqr_control(pos: Array, quat: Array, vel: Array, ang_vel: Array, setpoint: Setpoint, *, params: LQRParams) -> Array:
    """Track a setpoint by the LQR about hover, with the wrench of the setpoint's motion as feedforward.

    The law is ``u = u_ref - K e``. Errors of position and velocity are in the frame of the desired heading, so that the
    same gain is valid for every yaw. ``flat_reference`` gives the reference attitude, rates and wrench.

    Args:
        pos: Position, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        setpoint: Setpoint with the leading axes of the state.
        params: Gain, shared or with the leading axes of the state.

    Returns:
        Collective thrust, N, and body torque, N m, within the limits of the rotors. (..., 4)
    """
    reference = flat_reference(setpoint, params)
    error = state_error(pos, quat, vel, ang_vel, reference, setpoint.yaw)
    return prioritized_wrench(reference.wrench - matvec(params.gain, error), params=params.allocation)


class LQR(Controller):
    """Linear quadratic regulator about hover (``lqr_control``) for setpoints."""

    name: ClassVar[str] = "lqr"
    levels: ClassVar[tuple[Control, ...]] = (Control.state,)
    output: ClassVar[Control] = Control.force_torque
    freq: int = 500
    """Rate of the controller, Hz."""
    Q: ArrayLike | None = None
    """Weights of position, velocity, roll, pitch, yaw and body rates, a diagonal (12,) or a matrix (12, 12); None for
    ``lqr_weights``."""
    R: ArrayLike | None = None
    """Weights of collective thrust and torque, (4,) or (4, 4); None for ``lqr_weights``."""

    def params(self, airframe: Airframe) -> LQRParams:
        Q, R = lqr_weights(airframe, self.freq, self.Q, self.R)
        gain = solve_on_host(hover_gain, airframe.value("rigid_body.mass"), airframe.inertia, Q, R)
        return LQRParams.create(airframe, gain=gain)

    def update(self, data: DroneData, command: Any, memory: Any, params: LQRParams) -> tuple[Array, Any]:
        s = data.states
        return lqr_control(s.pos, s.quat, s.vel, s.ang_vel, command, params=params), memory
