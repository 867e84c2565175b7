"""A linear quadratic regulator of offset and heading, with gains for each speed from the vehicle's dynamics."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from crazysim.core.settings import setting
from crazysim.engine.jaxcompat import fori_loop
from crazysim.engine.pytree import PyTree, as_parameter, leaf
from crazysim.lab.control.lqr import solve_on_host, weight_matrix
from crazysim.lab.control.riccati import gain_discrete
from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState
from crazysim.lab.vehicles.following import PathController, PathState, motor_reference
from crazysim.lab.vehicles.kinematic import kinematic
from crazysim.lab.vehicles.model import VehicleModel
from crazysim.lab.vehicles.single_track import single_track
from crazysim.rotation import clip

SPEED_STEP, N_SPEEDS = 0.25, 24
"""Interval between the speeds in the table of gains, m/s, and number of speeds: the table extends to 6 m/s."""
N_SQUARINGS = 14
"""Number of squarings in the matrix exponential."""


class PathLQRGains(PyTree):
    """Gains of ``PathLQR`` as a function of the speed."""

    table: Array = leaf("shared", 3)
    """Gains of offset, sideways velocity, heading error and yaw rate, and the steering angle per curvature, for speeds
    from ``SPEED_STEP`` in steps of ``SPEED_STEP``, forwards and backwards. (2, N_SPEEDS, 5)"""


class PathLQR(PathController):
    """Linear quadratic regulator of a vehicle about its path, forwards and backwards.

    ``steer = f curvature - K (offset, sideways velocity, heading error, yaw rate)``. At each speed the model is
    linearised about straight driving, and K minimises the weighted squares. With the feed-forward f the offset is zero
    in steady cornering.
    """

    Q: ArrayLike = (100.0, 0.1, 10.0, 0.1)
    """Weights of offset, sideways velocity, heading error and yaw rate. (4,) or (4, 4)"""
    R: float = setting(default=20.0, positive=True)
    """Weight of the steering angle."""

    def gains(self, vehicle: VehicleModel, car: CarParams, freq: int) -> PathLQRGains:
        """Return the gains, computed in float64."""
        speeds = SPEED_STEP * np.arange(1, N_SPEEDS + 1) * np.array([[1.0], [-1.0]])
        Q, R = weight_matrix("Q", self.Q, 4), weight_matrix("R", [self.R], 1)
        table = solve_on_host(GAIN_FUNCTIONS[vehicle.dynamics], car, speeds.ravel(), 1 / freq, Q, R)
        return PathLQRGains(as_parameter(table.reshape(2, N_SPEEDS, 5)))

    def steering(
        self, state: CarState, tracking: PathState, memory: Any, gains: PathLQRGains, car: CarParams
    ) -> tuple[Array, Any]:
        cell = clip(jnp.abs(state.body_vel[0]) / SPEED_STEP - 1, 0.0, N_SPEEDS - 1.001)
        k = lax.floor(cell)
        direction, node = (tracking.speed[0] < 0).astype(jnp.int32), k.astype(jnp.int32)
        table = jnp.asarray(gains.table)
        low, high = (table.at[direction, node + i].get(mode="clip") for i in range(2))
        row = low + (cell - k) * (high - low)
        x = jnp.concatenate([tracking.offset, state.body_vel[1:], tracking.heading_error, state.yaw_rate])
        return row[4:] * tracking.curvature - jnp.sum(row[:4] * x, keepdims=True), memory


def lateral_model(model: Callable[..., CarState], car: CarParams, speed: Array) -> tuple[Array, Array]:
    """Return A (4, 4) and B (4, 1) of the linear model ``x' = A x + B steer``.

    The state x is offset, sideways velocity, heading and yaw rate.

    Args:
        speed: Speed about which the dynamics are linearised, m/s. ()
    """
    reference = motor_reference(speed[None], jnp.zeros(1, speed.dtype), car)

    def rates(x: Array, steer: Array) -> Array:
        zero = jnp.zeros(1, x.dtype)
        pos, vel = jnp.stack([x[0] * 0, x[0], x[0] * 0]), jnp.stack([speed, x[1]])
        state = CarState(pos, x[2:3], vel, x[3:], steer, zero)
        rate = model(state, jnp.concatenate([reference, steer]), car)
        return jnp.concatenate([rate.pos[1:2], rate.body_vel[1:], rate.yaw, rate.yaw_rate])

    x, steer = jnp.zeros(4, speed.dtype), jnp.zeros(1, speed.dtype)
    return jax.jacfwd(rates)(x, steer), jax.jacfwd(rates, argnums=1)(x, steer)


def lateral_gains(
    model: Callable[..., CarState], car: CarParams, speed: Array, period: Array | float, Q: Array, R: Array
) -> Array:
    """Return the four gains of the regulator at a speed, followed by the feed-forward of curvature. (5,)

    See ``lateral_model`` for the arguments; ``period`` is the time between updates of the controller, s.
    """
    A, B = lateral_model(model, car, speed)
    augmented = jnp.zeros((5, 5), A.dtype).at[:4, :4].set(A).at[:4, 4:].set(B)
    discrete = matrix_exponential(augmented * period)  # the input is constant over a period
    K = gain_discrete(discrete[:4, :4], discrete[:4, 4:], Q, R)[0]
    # Steady cornering of curvature 1: the yaw rate is the speed, and sideways velocity and steering angle balance it.
    # Without slip both rates are multiples of the tangent of the steering angle, and the matrix is still regular.
    rows = jnp.array([1, 3])
    balance = jnp.stack([A[rows, 1], B[rows, 0]], axis=1)
    side_vel, steer = jnp.linalg.solve(balance, -A[rows, 3] * speed)
    steady_state = jnp.stack([jnp.zeros_like(speed), side_vel, -side_vel / speed, speed])
    return jnp.concatenate([K, (steer + K @ steady_state)[None]])


def _gain_rows(
    model: Callable[..., CarState], car: CarParams, speeds: Array, period: Array, Q: Array, R: Array
) -> Array:
    return jax.vmap(lambda speed: lateral_gains(model, car, speed, period, Q, R))(speeds)


GAIN_FUNCTIONS = {
    "kinematic": functools.partial(_gain_rows, kinematic),
    "single_track": functools.partial(_gain_rows, single_track),
}
"""``lateral_gains`` at several speeds, by the name of the dynamics. Vehicles share these functions, which JAX compiles
once."""


def matrix_exponential(matrix: Array) -> Array:
    """Return the exponential of a small matrix, by a Taylor polynomial of order 6 and squaring. (n, n)

    In float64 its relative error is below 1e-12 for norms up to 100.
    """
    eye, scaled_matrix = jnp.eye(len(matrix), dtype=matrix.dtype), matrix / 2**N_SQUARINGS
    total = eye
    for k in range(6, 0, -1):
        total = eye + scaled_matrix @ total / k
    return fori_loop(N_SQUARINGS, lambda _, x: x @ x, total)
