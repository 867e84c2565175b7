"""Fits of an airframe's parameters to logs."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim.drones import Airframe, load_airframe
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import RPM_TO_RAD_S, quadratic_curve
from crazysim.errors import ConfigError, require
from crazysim.lab.identify.checks import check_turning
from crazysim.lab.identify.logs import Log
from crazysim.lab.identify.motion import integrate
from crazysim.lab.identify.motors import mean_motor_lag, with_speeds
from crazysim.lab.identify.prediction import Model, cut_windows
from crazysim.lab.identify.rotation import (
    PIECE_DURATION,
    SAMPLING_ERROR,
    aligned,
    deviation_of_sum,
    fast_rotation,
)
from crazysim.lab.plugins.residual import N_INPUTS, Residual
from crazysim.rotation import rotate, rotate_inverse

WINDOW_DURATION = 0.5
"""Duration of the windows over which forces and torques change the velocities, s."""
SLOW_TORQUE_DELAY_STD = 0.3
"""Standard deviation of delays for slow torques, the third regression of ``identify``, samples. Where commands change
at samples, rotor speeds have corners. In simulated flights at 100 Hz torques per velocity then had the errors of a
delay of 0.4 to 0.5 samples, and of 0.1 with integrals that keep corners. Where commands changed between samples, the
errors were those of 0 and 0.2 samples."""
MAX_FACTOR = 10.0
"""Largest factor of the airframe's curves and moments of inertia; a fit with a larger factor is an error. Rotor
speeds are checked to be near hover, so a thrust factor stays below 2.5 squared times the factor of the mass."""
MIN_FACTORS = {"rotor inertia": 0.0}
"""Least values of factors that may be below ``1 / MAX_FACTOR``: flights that hardly yaw do not show the inertia of the
rotors."""


FACTOR_NAMES = ("thrust factor", "inertia x", "inertia y", "inertia z", "torque factor", "rotor inertia")
"""Names of the factors by which the airframe's curves and moments of inertia are multiplied."""
FORCE_TERMS = (
    "thrust factor", "drag x", "drag y", "drag z", "quadratic drag x", "quadratic drag y", "quadratic drag z",
)  # fmt: skip
"""Parameters of the force: a factor, and coefficients in N s/m and N s^2/m^2."""
TORQUE_TERMS = (
    "centre of mass x", "centre of mass y", "torque z", *(f"torque {a} per velocity {b}" for a in "xyz" for b in "xyz"),
)  # fmt: skip
"""Parameters of the torque: coordinates in m, a torque in N m, and torques per velocity in N s."""
PARAMETER_UNITS = dict(
    zip(
        (*FORCE_TERMS, *TORQUE_TERMS),
        ("", *["N s/m"] * 3, *["N s^2/m^2"] * 3, "m", "m", "N m", *["N s"] * 9),
        strict=True,
    )
)
"""Units of the parameters of force and torque; empty for factors."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of ``identify``."""

    base: str
    """Name or path of the airframe that the fit started from."""
    airframe: Airframe
    """Airframe with the identified numbers."""
    model: Model
    """Model of that airframe, with its residual."""
    values: dict[str, float]
    """Identified parameters by name, see ``FACTOR_NAMES``, ``FORCE_TERMS`` and ``TORQUE_TERMS``, and ``motor lag``,
    1/s, for logs with commands and measured speeds."""
    deviations: dict[str, float]
    """Standard deviations of the parameters, with bias that the logs show; NaN for logs that are too short to tell."""
    delays: dict[str, float]
    """Delay of the state behind the rotor speeds in each log, by its name, s."""
    changes: dict[str, NDArray]
    """Numbers that differ from the base airframe, by dotted path."""

    def with_residual(self, residual: Residual) -> Identification:
        """Return the result with another residual, such as one from ``fit_residual``."""
        changes = {key: x for key, x in self.changes.items() if not key.startswith("residual.")}
        for key in ("linear", "hidden", "output"):
            if (x := getattr(residual, key)) is not None:
                changes[f"residual.{key}"] = np.asarray(x, np.float64)
        airframe = load_airframe(_nest_tables(self.base, self.airframe.name.removesuffix("_identified"), changes))
        return replace(self, airframe=airframe, model=Model.create(airframe), changes=changes)

    def describe(self) -> list[str]:
        """Return a line for each parameter: name, value, standard deviation and unit."""
        units = PARAMETER_UNITS | {"motor lag": "1/s"}
        spreads = {key: "unknown" if math.isnan(x) else f"{x:.2g}" for key, x in self.deviations.items()}
        return [f"{key:26}{x:10.4g} +- {spreads[key]} {units.get(key, '')}".rstrip() for key, x in self.values.items()]

    @property
    def doubtful(self) -> list[str]:
        """Names of factors below 1/3 or above 3: they help to predict the logs, but are hardly physical."""
        return [name for name in FACTOR_NAMES if not 1 / 3 < self.values[name] < 3]

    def toml(self, source: str) -> str:
        """Return the airframe as a TOML file that names its base.

        Args:
            source: Description of the logs, with date.
        """
        units = {
            "rigid_body.mass": "kg", "rigid_body.inertia": "kg m^2", "rotors.position": "m",
            "rotors.thrust_curve": "N, N/rpm, N/rpm^2", "rotors.torque_curve": "N m, N m/rpm, N m/rpm^2",
            "rotors.inertia": "kg m^2", "rotors.lag": "1/s, 1/(s rpm), twice",
            "drag.coefficients": "N s/m", "controller.thrust2torque": "m",
            "residual.linear": "N and N m per input", "residual.hidden": "1 per input", "residual.output": "N and N m",
        }  # fmt: skip
        lines = [
            f"base = {json.dumps(self.base)}",
            "",
            "[sources]",
            f"flights = {json.dumps(source)}",
            'given = "not fitted: the mass that was passed to identify, or else that of the base"',
        ]
        if self.doubtful:
            lines.insert(
                0, f"# Doubtful, less than 1/3 or more than 3 times the base's value: {', '.join(self.doubtful)}."
            )
        table = ""
        for path, value in sorted(self.changes.items(), key=lambda x: x[0].rpartition(".")[0]):
            owner, _, key = path.rpartition(".")
            if owner != table:
                table = owner
                lines += ["", f"[{table}]"]
            rounded_values = [float(f"{x:.6g}") for x in value.ravel()]
            numbers = np.reshape(rounded_values, value.shape).tolist()
            lines.append(
                f'{key} = {{ value = {numbers}, unit = "{units[path]}", '
                f'source = "{"given" if path == "rigid_body.mass" else "flights"}" }}'
            )
        lines += ["", "# Every parameter with its standard deviation."]
        lines += [f"# {line}" for line in self.describe()]
        return "\n".join(lines) + "\n"


def identify(logs: Sequence[Log], airframe: str | Path = "cf21B_500", *, mass: float | None = None) -> Identification:
    """Fit the parameters of an airframe to logs with rotor speeds, measured or from ``with_speeds``.

    The fit consists of three linear regressions. The first explains changes of the velocity over 0.5 s by thrust and
    drag, rotated by the measured attitude. The second explains fast rotation by the torques of the rotors
    (``fast_rotation``). The third explains the remaining changes of the angular velocity over 0.5 s by the torques in
    ``TORQUE_TERMS``. The mass is not observable from the motion, so it is not fitted.

    Args:
        logs: Logs of the same sample time.
        airframe: Name or path of the airframe to start from.
        mass: Mass in the flights, kg; None for the mass of the airframe.
    """
    base = load_airframe(airframe)
    require(mass is None or 0 < mass < np.inf, f"expected mass to be positive and finite, in kg, got {mass}")
    logs = [with_speeds(log, base) for log in logs]
    _check_logs(logs, base)
    cut_windows(logs, WINDOW_DURATION, WINDOW_DURATION)  # an error if no log is long enough
    check_turning(logs)
    if base.n_rotors <= 4:
        _check_rotor_order(logs, base)
    flight_mass = float(base.value("rigid_body.mass")) if mass is None else float(mass)
    params = Model.create(base, flight_mass).params
    aligned_logs = logs
    for _ in range(2):  # the delay changes the thrust factor, which is a factor of the moments of inertia
        thrust_factor = float(_fit_forces(aligned_logs, params)[0][0])
        rotation_fit = fast_rotation(logs, params, thrust_factor)
        aligned_logs = [aligned(log, delay) for log, delay in zip(logs, rotation_fit.delays, strict=True)]
    logs = aligned_logs
    force_values, force_spread = _fit_forces(logs, params)
    thrust_factor = float(force_values[0])
    force_spread[0] = math.hypot(force_spread[0], SAMPLING_ERROR * force_values[0])
    torque_values, torque_spread = _fit_torques(logs, params, thrust_factor, rotation_fit.values)
    # Errors of the first steps are errors of the next.
    delay = np.hypot(np.nan_to_num(rotation_fit.delay_deviation), SLOW_TORQUE_DELAY_STD * logs[0].dt)
    late_logs = [aligned(log, delay) for log in logs]
    force_spread = np.hypot(force_spread, _fit_forces(late_logs, params)[0] - force_values)
    shifts = [_fit_torques(late_logs, params, thrust_factor, rotation_fit.values)[0]]
    for k, deviation in enumerate(np.nan_to_num(rotation_fit.deviations)):
        factors = rotation_fit.values + deviation * (np.arange(5) == k)
        shifts.append(_fit_torques(logs, params, thrust_factor, factors)[0])
    torque_spread = np.sqrt(torque_spread**2 + np.sum((np.array(shifts) - torque_values) ** 2, axis=0))

    def name_parameters(force_numbers: NDArray, torque_numbers: NDArray, rotation_numbers: NDArray) -> dict[str, float]:
        numbers = [*force_numbers, *torque_numbers, *rotation_numbers]
        return dict(zip((*FORCE_TERMS, *TORQUE_TERMS, *FACTOR_NAMES[1:]), map(float, numbers), strict=True))

    values = name_parameters(force_values, torque_values, rotation_fit.values)
    deviations = name_parameters(force_spread, torque_spread, rotation_fit.deviations)
    if unphysical := [
        f"{name} {values[name]:.3g}"
        for name in FACTOR_NAMES
        if not MIN_FACTORS.get(name, 1 / MAX_FACTOR) <= values[name] <= MAX_FACTOR
    ]:
        raise ConfigError(
            f"expected factors from {1 / MAX_FACTOR:g} to {MAX_FACTOR:g}, got {', '.join(unphysical)}, which no body "
            f"that flies like {base.name!r} explains. Check its mass and the logs, add flights that turn and climb "
            "more, or start from an airframe file nearer to the drone (--airframe)."
        )
    changes = _airframe_changes(base, flight_mass, values)
    if (lag := mean_motor_lag(logs)) is not None:
        values["motor lag"], deviations["motor lag"] = lag
        changes["rotors.lag"] = np.array([values["motor lag"], 0.0, values["motor lag"], 0.0])
    try:
        new_airframe = load_airframe(_nest_tables(str(airframe), base.name, changes))
    except ConfigError as error:
        raise ConfigError(f"the fitted numbers are not valid: {error} Add flights that turn and climb more.") from error
    return Identification(
        base=str(airframe),
        airframe=new_airframe,
        model=Model.create(new_airframe),
        values=values,
        deviations=deviations,
        delays=dict(zip([log.name for log in logs], rotation_fit.delays.tolist(), strict=True)),
        changes=changes,
    )


def _fit_forces(logs: Sequence[Log], params: first_principles.Params) -> tuple[NDArray, NDArray]:
    mass, gravity = float(params.mass[0]), np.asarray(params.gravity_vec, np.float64)

    def terms(log: Log) -> tuple[NDArray, NDArray]:
        thrust = np.asarray(quadratic_curve(jnp.asarray(log.rotor_vel), params.rpm2thrust), np.float64)
        vel, speed = _to_body_frame(log, log.vel), np.linalg.norm(log.vel, axis=-1, keepdims=True)
        axes = np.eye(3)
        body_forces = [thrust.sum(-1, keepdims=True) * axes[2]]
        body_forces += [(x[:, k : k + 1] * axes[k]) for x in (vel, vel * speed) for k in range(3)]
        world_forces = np.stack(
            [np.asarray(rotate(jnp.asarray(log.quat), jnp.asarray(x))) for x in body_forces], axis=-1
        )
        return world_forces, mass * (log.vel - gravity * log.t[:, None])

    return _fit_regression(logs, terms, np.arange(7) > 0)


def _fit_torques(
    logs: Sequence[Log], params: first_principles.Params, thrust_factor: float, rotation_factors: NDArray
) -> tuple[NDArray, NDArray]:
    mixing, arm = np.asarray(params.mixing_matrix, np.float64), float(params.L[0])
    root = np.sqrt(rotation_factors[:3])
    inertia = np.asarray(params.J, np.float64) * np.outer(root, root)
    rotor_inertia = rotation_factors[4] * RPM_TO_RAD_S * np.asarray(params.prop_inertia, np.float64)

    def terms(log: Log) -> tuple[NDArray, NDArray]:
        speed = jnp.asarray(log.rotor_vel)
        thrust = thrust_factor * np.asarray(quadratic_curve(speed, params.rpm2thrust), np.float64)
        drag = rotation_factors[3] * np.asarray(quadratic_curve(speed, params.rpm2torque), np.float64)
        spin = np.zeros_like(log.ang_vel)
        spin[:, 2] = -(rotor_inertia * log.rotor_vel) @ mixing[2]
        momentum = log.ang_vel @ inertia + spin
        rotors = np.c_[arm * thrust @ mixing[:2].T, drag @ mixing[2]]
        # Integrals of the known terms move to the left side.
        impulse = integrate(rotors - np.cross(log.ang_vel, momentum), log.t)
        vel, total, axes = _to_body_frame(log, log.vel), thrust.sum(-1, keepdims=True), np.eye(3)
        columns = [total * axes[1], -total * axes[0], np.broadcast_to(axes[2], vel.shape)]
        columns += [vel[:, b : b + 1] * axes[a] for a in range(3) for b in range(3)]
        return np.stack(columns, axis=-1), momentum - impulse

    return _fit_regression(logs, terms, np.zeros(len(TORQUE_TERMS), bool))


def _to_body_frame(log: Log, vector: NDArray) -> NDArray:
    return np.asarray(rotate_inverse(jnp.asarray(log.quat), jnp.asarray(vector)), np.float64)


def _fit_regression(
    logs: Sequence[Log], terms: Callable[[Log], tuple[NDArray, NDArray]], is_nonpositive: NDArray
) -> tuple[NDArray, NDArray]:
    regressors, momentum_changes, pieces = [], [], []
    for number, log in enumerate(logs):
        x, momentum = terms(log)
        total, size = integrate(x, log.t), round(WINDOW_DURATION / log.dt)
        starts = np.arange(0, len(log.t) - size, max(1, size // 5))
        starts = starts[[not np.any((log.gaps > start) & (log.gaps <= start + size)) for start in starts]]
        regressors.append(total[starts + size] - total[starts])
        momentum_changes.append(momentum[starts + size] - momentum[starts])
        pieces.append(number * 1e6 + (log.t[starts] - log.t[0]) // PIECE_DURATION)
    x, y, piece = (np.concatenate(parts) for parts in (regressors, momentum_changes, pieces))
    k = x.shape[-1]
    weights = np.ones(y.shape)
    coefficients, is_free = np.zeros(k), np.ones(k, bool)
    for _ in range(10):
        normal = np.einsum("wri,wr,wrj->ij", x, weights, x)
        vector = np.einsum("wri,wr,wr->i", x, weights, y)
        is_free = np.ones(k, bool)
        while True:
            coefficients = np.zeros(k)
            coefficients[is_free] = np.linalg.lstsq(normal[np.ix_(is_free, is_free)], vector[is_free], rcond=None)[0]
            is_wrong_sign = is_nonpositive & (coefficients > 0)
            if not np.any(is_wrong_sign):
                break
            is_free &= ~is_wrong_sign
        residual = y - x @ coefficients
        scale = 1.4826 * np.median(np.abs(residual), axis=0)  # standard deviation, if residuals are normal
        weights = 1 / np.maximum(scale, np.abs(residual) / 2) / np.maximum(scale, 1e-30)
    # Influences by leaving out each piece (jackknife), without bounds, which would hide the scatter of coefficients.
    pieces, n_pieces = np.unique(piece, return_inverse=True)[1], len(np.unique(piece))
    normals, vectors = np.zeros((n_pieces, k, k)), np.zeros((n_pieces, k))
    np.add.at(normals, pieces, np.einsum("wri,wr,wrj->wij", x, weights, x))
    np.add.at(vectors, pieces, np.einsum("wri,wr,wr->wi", x, weights, y))
    normal, vector = normals.sum(axis=0), vectors.sum(axis=0)
    held_out_fits = [
        np.linalg.lstsq(normal - a, vector - b, rcond=None)[0] for a, b in zip(normals, vectors, strict=True)
    ]
    return coefficients, deviation_of_sum(np.array(held_out_fits))


def _smooth_columns(x: NDArray, size: int = 9) -> NDArray:
    kernel = np.hanning(size + 2)[1:-1]
    return np.stack([np.convolve(c, kernel / kernel.sum(), "same") for c in x.T], axis=-1)


def _create_regressors(log: Log, params: first_principles.Params) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    interior = slice(10, -10)
    acc = np.gradient(_smooth_columns(log.vel), log.t, axis=0) - np.asarray(params.gravity_vec)
    ang_acc = np.gradient(_smooth_columns(log.ang_vel), log.t, axis=0)
    body = np.asarray(rotate_inverse(jnp.asarray(log.quat), jnp.asarray(np.stack([acc, _smooth_columns(log.vel)]))))
    thrust = _smooth_columns(np.asarray(quadratic_curve(jnp.asarray(log.rotor_vel), params.rpm2thrust), np.float64))
    return body[0][interior], ang_acc[interior], body[1][interior], thrust[interior]


def _check_logs(logs: Sequence[Log], airframe: Airframe) -> None:
    require(logs, "expected at least one log, got none")
    params = first_principles.Params.create(airframe)
    hover = np.broadcast_to(np.asarray(first_principles.hover_rotor_vel(params)).ravel(), airframe.n_rotors)
    for log in logs:
        require(
            abs(log.dt - logs[0].dt) <= 1e-4,
            f"{log.name}: expected samples every {logs[0].dt:.4g} s as in the first log, got {log.dt:.4g}",
        )
        require(
            log.rotor_vel.shape[1] == airframe.n_rotors,
            f"{log.name}: expected measured speeds of {airframe.n_rotors} rotors, got {log.rotor_vel.shape[1]}. "
            "Name their columns as rotor_vel; or log commands, as shares of the voltage, and the voltage, for an "
            "airframe with battery.thrust_over_voltage; or fit a model of attitude commands (--dynamics so_rpy).",
        )
        medians = np.median(log.rotor_vel, axis=0)
        require(
            np.all((medians >= 0.4 * hover) & (medians <= 2.5 * hover)),
            f"{log.name}: expected each rotor near {hover.mean():.0f} rpm, as in hover, got medians of "
            f"{', '.join(f'{x:.0f}' for x in medians)}. Correct the column of a rotor that does not turn, or "
            f"give rpm_per_unit: {60 / (2 * np.pi):.4g} for rad/s, 1 over the pole pairs for electrical rpm.",
        )


def _check_rotor_order(logs: Sequence[Log], airframe: Airframe) -> None:
    params = first_principles.Params.create(airframe)
    pieces = [_create_regressors(log, params) for log in logs]
    _, ang_acc, vel, thrust = [np.concatenate(x) for x in zip(*pieces, strict=True)]
    mixing = airframe.mixing_matrix

    def explained_variance(order: tuple[int, ...]) -> float:
        total = 0.0
        for axis in range(2):
            regressors = np.c_[vel, np.ones(len(vel))]
            torque = thrust[:, order] @ mixing[axis]
            all_coefficients = np.linalg.lstsq(np.c_[torque, regressors], ang_acc[:, axis], rcond=None)[0]
            without_torque = np.linalg.lstsq(regressors, ang_acc[:, axis], rcond=None)[0]
            gain = np.var(ang_acc[:, axis] - regressors @ without_torque) - np.var(
                ang_acc[:, axis] - np.c_[torque, regressors] @ all_coefficients
            )
            total += np.sign(all_coefficients[0]) * gain / np.var(ang_acc[:, axis])
        return total

    index_order = tuple(range(airframe.n_rotors))
    best_order = max(itertools.permutations(index_order), key=explained_variance)
    if explained_variance(best_order) > explained_variance(index_order) + 0.2:
        raise ConfigError(
            f"expected rotors in the order of airframe {airframe.name!r}; the angular accelerations fit "
            f"the order {[k + 1 for k in best_order]} much better "
            f"({explained_variance(best_order):.2f} against {explained_variance(index_order):.2f}, of at most 2). Name "
            "the columns of rotor_vel, and of command, in that order."
        )


def _airframe_changes(base: Airframe, mass: float, values: dict[str, float]) -> dict[str, NDArray]:
    thrust, *moments, torque, rotor = [values[name] for name in FACTOR_NAMES]
    root = np.sqrt(moments)
    inertia = base.inertia * np.outer(root, root)
    inertia = np.diag(inertia) if np.allclose(inertia, np.diag(np.diag(inertia)), atol=0) else inertia
    x = np.array([values[name] for name in (*FORCE_TERMS, *TORQUE_TERMS)])
    linear = np.zeros((6, N_INPUTS))
    linear[range(3), range(4, 7)] = x[4:7]
    linear[5, 0], linear[3:, 1:4] = x[9], x[10:].reshape(3, 3)
    changes = {
        "rigid_body.mass": np.asarray(mass),
        "rigid_body.inertia": inertia,
        "rotors.position": base.value("rotors.position") - [x[7], x[8], 0.0],
        "rotors.thrust_curve": base.value("rotors.thrust_curve") * thrust,
        "rotors.torque_curve": base.value("rotors.torque_curve") * torque,
        "rotors.inertia": base.value("rotors.inertia") * rotor,
        "drag.coefficients": x[1:4],
        "residual.linear": linear,
    }
    if "controller.thrust2torque" in base.values:
        ratio = base.value("controller.thrust2torque") * torque / thrust
        changes["controller.thrust2torque"] = np.asarray(ratio)
    return changes


def _nest_tables(base: str, name: str, changes: dict[str, NDArray]) -> dict:
    tables: dict = {"name": f"{name}_identified", "base": base}
    for path, value in changes.items():
        table, _, key = path.rpartition(".")
        tables.setdefault(table, {})[key] = value.tolist()
    return tables
