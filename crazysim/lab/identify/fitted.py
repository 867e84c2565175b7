"""Identification of the fitted dynamics from attitude commands: gain, lag and drag of the thrust, and angles."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim import rotation
from crazysim.dynamics.models import GRAVITY, Dynamics
from crazysim.errors import expect, require

logger = logging.getLogger(__name__)

RATE_RANGE = (0.5, 500.0)
"""Range in which the rate of the thrust's lag is searched, 1/s."""
EDGE_DURATION = 0.5
"""Duration at both ends of a log, s, that is omitted: the 6 Hz filters start there at rest, with a wrong velocity."""
FITTED_MODELS = (Dynamics.so_rpy, Dynamics.so_rpy_rotor, Dynamics.so_rpy_rotor_drag)
"""Models that are fitted."""


def sys_id_translation(
    dynamics: str,
    mass: float,
    data: Mapping[str, ArrayLike],
    data_validation: Mapping[str, ArrayLike] | None = None,
    gravity: ArrayLike = GRAVITY,
    verbose: int = 0,
    plot: bool = False,
) -> dict[str, float]:
    """Return the parameters of the translation of a fitted model.

    The rate of the lag is found by a search. For each rate, the other parameters follow from linear least squares on
    the filtered accelerations. The lag is simulated exactly between samples.

    Args:
        dynamics: ``so_rpy``, ``so_rpy_rotor`` or ``so_rpy_rotor_drag``.
        mass: Mass, kg.
        data: A log from ``derivatives_svf``.
        data_validation: A held-out log, to report its error; None for none.
        gravity: Gravitational acceleration, world frame, m/s^2. (3,)
        verbose: Ignored: results are logged at level INFO.
        plot: Accepted as False only; ``crazysim identify --dynamics ... --plot`` draws errors.

    Returns:
        ``cmd_f_coef``, thrust per commanded thrust; with a lag ``thrust_dyn_coef``, its rate, 1/s; with drag
        ``drag_xy_coef`` and ``drag_z_coef``, N s/m.
    """
    del verbose  # an argument of Crazyflow
    _refuse_plot(plot)
    values, _ = fit_translation(dynamics, mass, [data], gravity)
    for name, log in (("data", data), ("validation", data_validation)):
        if log is not None:
            terms, acc = _acceleration_terms(
                Dynamics(dynamics), mass, log, values.get("thrust_dyn_coef", np.inf), gravity
            )
            coefs = [values[key] for key in ("cmd_f_coef", "drag_xy_coef", "drag_z_coef") if key in values]
            logger.info("%s, %s: RMSE of the acceleration %.4g m/s^2", dynamics, name, _rms(acc - terms @ coefs))
    return values


def sys_id_rotation(
    data: Mapping[str, ArrayLike],
    data_validation: Mapping[str, ArrayLike] | None = None,
    verbose: int = 0,
    plot: bool = False,
) -> dict[str, NDArray]:
    """Return the parameters of the rotation of the fitted models; roll and pitch have the same values.

    Simulated angles are fitted to the filtered ones by the Levenberg-Marquardt method.

    Args:
        data: A log from ``derivatives_svf``.
        data_validation: A held-out log, to report its error; None for none.
        verbose: Ignored: results are logged at level INFO.
        plot: Accepted as False only; ``crazysim identify --dynamics ... --plot`` draws errors.

    Returns:
        ``rpy_coef``, 1/s^2, ``rpy_rates_coef``, 1/s, and ``cmd_rpy_coef``, 1/s^2. (3,) each
    """
    del verbose  # an argument of Crazyflow
    _refuse_plot(plot)
    values, _ = fit_rotation([data])
    for name, log in (("data", data), ("validation", data_validation)):
        if log is not None:
            axis_errors = [
                _rotation_error(np.array([x[k] for x in values.values()]), *_angle_samples(log, [k])) for k in range(3)
            ]
            logger.info("rotation, %s: RMSE of roll, pitch, yaw %s rad", name, [f"{_rms(x):.4g}" for x in axis_errors])
    return values


def fit_translation(
    dynamics: str, mass: float, logs: Sequence[Mapping[str, ArrayLike]], gravity: ArrayLike = GRAVITY
) -> tuple[dict[str, float], NDArray]:
    """Return the parameters of ``sys_id_translation`` for several logs, and influences of samples, (n, k)."""
    expect(
        dynamics in list(FITTED_MODELS),
        f"dynamics as one of {', '.join(FITTED_MODELS)}",
        dynamics,
        "Choose one of them.",
    )
    expect(0 < mass < np.inf, "mass to be positive and finite, in kg", mass, "Weigh the drone.")
    from scipy.optimize import minimize_scalar  # a fifth of a second to import

    model = Dynamics(dynamics)

    def solve_for_rate(rate: float) -> tuple[float, NDArray, NDArray, NDArray]:
        parts = [_acceleration_terms(model, mass, log, rate, gravity) for log in logs]
        terms, acc = (np.concatenate(x) for x in zip(*parts, strict=True))
        coefs = np.linalg.lstsq(terms.reshape(-1, terms.shape[-1]), acc.ravel(), rcond=None)[0]
        residuals = acc - terms @ coefs
        return float(np.sum(residuals**2)), coefs, terms, residuals

    rate = np.inf
    if model != Dynamics.so_rpy:
        rates = np.geomspace(*RATE_RANGE, 31)
        k = int(np.argmin([solve_for_rate(x)[0] for x in rates]))
        bounds = np.log(rates[[max(0, k - 1), min(len(rates) - 1, k + 1)]])
        result = minimize_scalar(
            lambda x: solve_for_rate(np.exp(x))[0], bounds=bounds, method="bounded", options={"xatol": 1e-7}
        )
        rate = float(np.exp(result.x))
    _, coefs, terms, residuals = solve_for_rate(rate)
    names, values, jacobian = ["cmd_f_coef"], [coefs[0]], terms
    if model != Dynamics.so_rpy:
        names, values = [*names, "thrust_dyn_coef"], [*values, rate]
        rate_slopes = (solve_for_rate(1.001 * rate)[2] - solve_for_rate(rate / 1.001)[2]) @ coefs / (rate * 0.002)
        jacobian = np.insert(jacobian, 1, rate_slopes, axis=-1)
    if model == Dynamics.so_rpy_rotor_drag:
        names, values = [*names, "drag_xy_coef", "drag_z_coef"], [*values, *coefs[1:]]
    return dict(zip(names, map(float, values), strict=True)), _influences(jacobian, residuals)


def fit_rotation(logs: Sequence[Mapping[str, ArrayLike]]) -> tuple[dict[str, NDArray], NDArray]:
    """Return the parameters of ``sys_id_rotation`` for several logs, and influences of samples.

    The influences are those on the parameters of roll and pitch, then on those of yaw. (n, 2, 3)
    """
    from scipy.optimize import least_squares  # a fifth of a second to import

    results = []  # values and influences, of roll and pitch, then of yaw
    for axes in ([0, 1], [2]):
        data = [_angle_samples(log, axes) for log in logs]

        def residuals(x: NDArray, data: list = data) -> NDArray:
            return np.concatenate([_rotation_error(x, *log) for log in data])

        def slopes(x: NDArray, data: list = data) -> NDArray:
            return np.concatenate([np.asarray(_rotation_slope(jnp.asarray(x), *log), np.float64) for log in data])

        # Angles, rates and accelerations satisfy the equation up to noise, so least squares give the first guess.
        columns = [
            np.concatenate([np.asarray(log[key], np.float64)[:, axes].ravel() for log in logs])
            for key in ("SVF_rpy", "SVF_drpy", "SVF_cmd_rpy", "SVF_ddrpy")
        ]
        guess = np.linalg.lstsq(np.stack(columns[:3], -1), columns[3], rcond=None)[0]
        initial_values = np.where(np.sign(guess) == [-1, -1, 1], guess, [-100.0, -20.0, 100.0])
        error = lambda x, residuals=residuals: residuals(x).ravel()  # noqa: E731
        jacobian: Any = lambda x, slopes=slopes: -slopes(x).reshape(-1, 3)  # noqa: E731
        x = least_squares(error, initial_values, jacobian, method="lm").x
        results.append((x, _influences(slopes(x), residuals(x))))
    (tilt_values, tilt_influences), (yaw_values, yaw_influences) = results
    names = ("rpy_coef", "rpy_rates_coef", "cmd_rpy_coef")
    values = {name: np.array([tilt_values[k], tilt_values[k], yaw_values[k]]) for k, name in enumerate(names)}
    return values, np.stack([tilt_influences, yaw_influences], axis=1)


def _acceleration_terms(
    model: Dynamics, mass: float, log: Mapping[str, ArrayLike], rate: float, gravity: ArrayLike
) -> tuple[NDArray, NDArray]:
    time, vel, acc, quat, cmd = (
        np.asarray(log[key], np.float64) for key in ("time", "SVF_vel", "SVF_acc", "SVF_quat", "SVF_cmd_f")
    )
    thrust = cmd if model == Dynamics.so_rpy else lag_signal(cmd, float(time[-1] - time[0]) / (len(time) - 1), rate)
    matrix = np.asarray(rotation.matrix(jnp.asarray(quat)), np.float64)
    terms = [matrix[..., 2] * thrust[:, None]]
    if model == Dynamics.so_rpy_rotor_drag:
        axial_vel = matrix[..., 2] * np.sum(matrix[..., 2] * vel, axis=-1, keepdims=True)
        terms += [vel - axial_vel, axial_vel]
    is_inner = (time >= time[0] + EDGE_DURATION) & (time <= time[-1] - EDGE_DURATION)
    is_inner = is_inner if np.any(is_inner) else np.ones(len(time), bool)
    return (np.stack(terms, axis=-1) / mass)[is_inner], (acc - np.asarray(gravity, np.float64))[is_inner]


def lag_signal(x: NDArray, dt: float, rate: float | NDArray) -> NDArray:
    """Return a signal, linear between samples, after a first-order lag that starts in equilibrium. (n, ...)

    Args:
        x: Samples. (n, ...)
        dt: Time between two samples, s.
        rate: Rate of the lag, 1/s. (...)
    """
    decay = np.exp(-rate * dt)
    later_weight = 1 - (1 - decay) / (rate * dt)  # weight of the later sample
    inputs = (1 - decay - later_weight) * x[:-1] + later_weight * x[1:]
    lagged_signal = np.empty((len(x), *inputs.shape[1:]))
    lagged_signal[0] = x[0]
    for k, u in enumerate(inputs):
        lagged_signal[k + 1] = decay * lagged_signal[k] + u
    return lagged_signal


def _angle_samples(log: Mapping[str, ArrayLike], axes: Sequence[int]) -> tuple[float, Array, Array, Array]:
    time = np.asarray(log["time"], np.float64)
    cmd, rpy, rates = (jnp.asarray(log[key])[:, jnp.asarray(axes)] for key in ("SVF_cmd_rpy", "SVF_rpy", "SVF_drpy"))
    return float(time[-1] - time[0]) / (len(time) - 1), cmd, rpy, jnp.stack([rpy[0], rates[0]])


def _simulate(x: Array, dt: float, cmd: Array, start: Array) -> Array:
    # ``x`` is stiffness, damping and gain; ``start`` has the first angles and their rates.
    stiffness, damping, gain = x
    zero = jnp.zeros_like(gain)
    system = jnp.array([
        [zero, 1.0, zero, zero],
        [stiffness, damping, gain, zero],
        [zero, zero, zero, 1 / dt],
        [zero, zero, zero, zero],
    ])  # fmt: skip
    transition = jax.scipy.linalg.expm(system * dt)[:2]

    def step(state: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        u, change = inputs
        new_state = transition[:, :2] @ state + transition[:, 2:3] * u + transition[:, 3:4] * change
        return new_state, new_state[0]

    _, angles = jax.lax.scan(step, start, (cmd[:-1], jnp.diff(cmd, axis=0)))
    return jnp.concatenate([start[:1], angles])


@jax.jit
def _residual(x: Array, dt: float, cmd: Array, rpy: Array, start: Array) -> Array:
    return rpy - _simulate(x, dt, cmd, start)


_rotation_slope = jax.jit(lambda x, *log: -jax.jacfwd(_residual)(x, *log))
"""Derivative of the simulated angles with respect to the parameters. (n, k, 3)"""


def _rotation_error(x: NDArray, *log: Array | float) -> NDArray:
    return np.asarray(_residual(jnp.asarray(x), *log), np.float64)


def _influences(jacobian: NDArray, residuals: NDArray) -> NDArray:
    inverse = np.linalg.pinv(np.einsum("nri,nrj->ij", jacobian, jacobian), hermitian=True)
    return np.einsum("nri,nr->ni", jacobian, residuals) @ inverse


def _refuse_plot(plot: bool) -> None:
    require(not plot, "expected plot=False, got True. Plot errors with crazysim identify --plot.")


def _rms(x: NDArray) -> float:
    return float(np.sqrt(np.mean(np.asarray(x) ** 2)))
