"""Fits of an airframe's parameters to logs."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.drones import Airframe, load_airframe
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import curve
from crazysim.errors import ConfigError
from crazysim.identify.logs import Log
from crazysim.identify.prediction import Extras, Model, Windows, attitude_error, predict, windows
from crazysim.rotation import rotate_inverse

SCALES = {"pos": 0.02, "attitude": 0.05, "vel": 0.1, "ang_vel": 0.5}
"""Sizes of errors that count as one: m, rad, m/s, rad/s. Larger ones count linearly (Huber)."""
DURATION = 0.5
"""Duration of the predictions that are fitted, s."""


NAMES = (
    "thrust factor", "inertia x", "inertia y", "inertia z", "torque factor", "rotor inertia",
    "centre of mass x", "centre of mass y", "drag x", "drag y", "drag z", "torque z",
    *(f"torque_per_vel {a}{b}" for a in "xyz" for b in "xyz"), "delay",
)  # fmt: skip
"""Names of the parameters. Factors are of the airframe's curves or moments; others in m, N s/m, N m, N s, and s."""
FACTORS = 6
"""Number of leading parameters that are positive factors, fitted as logarithms."""


UNITS = np.array([1.0] * FACTORS + [1e-3, 1e-3] + [1e-2] * 3 + [1e-4] + [1e-4] * 9 + [1e-2])
"""Scales of the parameters within the fit, which make them of order one."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of ``identify``."""

    base: str
    """Name or path of the airframe that the fit began with."""
    airframe: Airframe
    """Airframe with the identified numbers."""
    model: Model
    """Model with the identified numbers, and the torques and delay that have no key in an airframe."""
    values: dict[str, float]
    """Identified parameters by name, see ``NAMES``."""
    deviations: dict[str, float]
    """Standard deviations of the parameters, from the scatter between windows."""
    changes: dict[str, NDArray]
    """Numbers that differ from the base airframe, by dotted path."""

    @property
    def doubtful(self) -> list[str]:
        """Names of factors below 1/3 or above 3: the fit predicts with them, but they are hardly those of the body."""
        return [name for name in NAMES[:FACTORS] if not 1 / 3 < self.values[name] < 3]

    def toml(self, source: str) -> str:
        """Return the airframe as a TOML file that names its base.

        Args:
            source: Description of the logs, with date.
        """
        units = {
            "rigid_body.mass": "kg", "rigid_body.inertia": "kg m^2", "rotors.position": "m",
            "rotors.thrust_curve": "N, N/rpm, N/rpm^2", "rotors.torque_curve": "N m, N m/rpm, N m/rpm^2",
            "rotors.inertia": "kg m^2", "drag.coefficients": "N s/m",
        }  # fmt: skip
        lines = [f"base = {json.dumps(self.base)}", "", "[sources]", f"flights = {json.dumps(source)}"]
        if self.doubtful:
            lines.insert(0, f"# Doubtful, more than three times from the base: {', '.join(self.doubtful)}.")
        table = ""
        for path, value in self.changes.items():
            owner, _, key = path.rpartition(".")
            if owner != table:
                table = owner
                lines += ["", f"[{table}]"]
            text = [float(f"{x:.6g}") for x in value.ravel()]
            numbers = np.reshape(text, value.shape).tolist()
            lines.append(f'{key} = {{ value = {numbers}, unit = "{units[path]}", source = "flights" }}')
        lines += ["", "# Every parameter with its standard deviation; torques and delay have no key in an airframe."]
        lines += [f"# {name}: {x:.4g} +- {self.deviations[name]:.2g}" for name, x in self.values.items()]
        return "\n".join(lines) + "\n"


def identify(
    logs: Sequence[Log], airframe: str | Path = "cf21B_500", *, mass: float | None = None, iterations: int = 12
) -> Identification:
    """Fit the parameters of an airframe to logs with measured rotor speeds.

    Linear least squares on accelerations give a start. Then a damped Gauss-Newton method minimises the errors of
    open-loop predictions of 0.5 s, with Huber's loss, by gradients through crazysim's dynamics. Every prediction starts
    at a measured state. The mass is not observable from the motion, so it is a given number.

    Args:
        logs: Logs of the same sample time.
        airframe: Name or path of the airframe to start from.
        mass: Mass in the flights, kg; None for that of the airframe.
        iterations: Largest number of steps of Gauss-Newton.

    Raises:
        ConfigError: If the mass is not positive, or if sample times, lengths or rotors of the logs do not fit.
    """
    base = load_airframe(airframe)
    if mass is not None and not 0 < mass < np.inf:
        raise ConfigError(f"expected mass to be positive and finite, in kg, got {mass}")
    _check(logs, base)
    batch = windows(logs, DURATION, DURATION)
    if base.n_rotors <= 4:
        _check_order(logs, base)
    weight = float(base.value("rigid_body.mass")) if mass is None else float(mass)
    params = first_principles.Params.create(base).replace(mass=jnp.asarray([weight], jnp.float32))
    start = _least_squares(logs, params)
    dt = logs[0].dt

    def residuals(x: Array) -> Array:
        return jax.vmap(lambda w: _residuals(_model(x, params), w, dt))(batch)

    x, jacobian, rest, weights = _gauss_newton(residuals, start, iterations)
    normal = np.einsum("wri,wr,wrj->ij", jacobian, weights, jacobian)
    score = np.einsum("wri,wr,wr->wi", jacobian, weights, rest)
    inverse = np.linalg.pinv(normal, hermitian=True)
    spread = np.sqrt(np.diag(inverse @ (score.T @ score) @ inverse))
    factor = np.exp(x[:FACTORS])
    values = np.concatenate([factor, x[FACTORS:] * UNITS[FACTORS:]])
    deviations = np.concatenate([factor * spread[:FACTORS], spread[FACTORS:] * UNITS[FACTORS:]])
    changes = _changes(base, weight, values)
    try:
        identified = load_airframe(_nested(str(airframe), base.name, changes))
    except ConfigError as error:
        raise ConfigError(f"the fit is no airframe: {error} Add flights that turn and climb more.") from error
    return Identification(
        base=str(airframe),
        airframe=identified,
        model=_model(jnp.asarray(x, jnp.float32), params),
        values=dict(zip(NAMES, values.tolist(), strict=True)),
        deviations=dict(zip(NAMES, deviations.tolist(), strict=True)),
        changes=changes,
    )


def _model(x: Array, params: first_principles.Params) -> Model:
    """Return the model of scaled parameters."""
    factor, rest = jnp.exp(x[:FACTORS]), x[FACTORS:] * jnp.asarray(UNITS[FACTORS:], jnp.float32)
    mixing = params.mixing_matrix
    shift = jnp.stack([-rest[1], rest[0], jnp.zeros(())]) / params.L[0]
    root = jnp.diag(jnp.sqrt(factor[1:4]))
    inverse = jnp.diag(1 / jnp.sqrt(factor[1:4]))
    fitted = params.replace(
        J=root @ params.J @ root,
        J_inv=inverse @ params.J_inv @ inverse,
        rpm2thrust=params.rpm2thrust * factor[0],
        rpm2torque=params.rpm2torque * factor[4],
        prop_inertia=params.prop_inertia * factor[5],
        mixing_matrix=mixing + shift[:, None],
        drag_matrix=jnp.diag(rest[2:5]),
    )
    torque = jnp.stack([jnp.zeros(()), jnp.zeros(()), rest[5]])
    return Model(params=fitted, extras=Extras(torque=torque, torque_per_vel=rest[6:15].reshape(3, 3), delay=rest[15]))


def _residuals(model: Model, window: Windows, dt: float) -> Array:
    """Return the scaled errors of one window at ten times. (120,)"""
    pos, quat, vel, ang_vel = predict(model, window, dt)
    n = window.pos.shape[0]
    at = np.unique(np.linspace(0, n - 1, 11).round().astype(int))[1:]
    parts = [
        (pos - window.pos)[at] / SCALES["pos"],
        attitude_error(quat[at], window.quat[at]) / SCALES["attitude"],
        (vel - window.vel)[at] / SCALES["vel"],
        (ang_vel - window.ang_vel)[at] / SCALES["ang_vel"],
    ]
    return jnp.concatenate([x.ravel() for x in parts])


def _gauss_newton(residuals, x: NDArray, iterations: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return the parameters that minimise Huber's loss, and Jacobian, residuals and weights there.

    Logarithms of factors have a prior of standard deviation 1, so that what a log does not show stays near the base.
    """
    value, slopes = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))

    prior = np.arange(len(x)) < FACTORS

    def loss(r: NDArray, x: NDArray) -> float:
        size = np.abs(r)
        cost = np.sum(np.where(size < 1, 0.5 * size**2, size - 0.5)) + 0.5 * np.sum(prior * x**2)
        return float(cost) if np.isfinite(cost) else np.inf

    def evaluated(x: NDArray) -> NDArray:
        return np.asarray(value(jnp.asarray(x, jnp.float32)), np.float64)

    rest, damping = evaluated(x), 1e-3
    for _ in range(iterations):
        jacobian = np.asarray(slopes(jnp.asarray(x, jnp.float32)), np.float64)
        weights = 1 / np.maximum(1, np.abs(rest))
        normal = np.einsum("wri,wr,wrj->ij", jacobian, weights, jacobian)
        normal += np.diag(prior.astype(float))
        gradient = np.einsum("wri,wr,wr->i", jacobian, weights, rest) + prior * x
        before, gain = loss(rest, x), 0.0
        for _ in range(8):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -gradient)
            trial = x + np.clip(step, -1, 1)
            new = evaluated(trial)
            if loss(new, trial) < before:
                gain = 1 - loss(new, trial) / before
                x, rest, damping = trial, new, damping / 5
                break
            damping *= 5
        if gain < 1e-5:
            break
    jacobian = np.asarray(slopes(jnp.asarray(x, jnp.float32)), np.float64)
    return x, jacobian, rest, 1 / np.maximum(1, np.abs(rest))


def _smooth(x: NDArray, size: int = 9) -> NDArray:
    kernel = np.hanning(size + 2)[1:-1]
    return np.stack([np.convolve(c, kernel / kernel.sum(), "same") for c in x.T], axis=-1)


def _regressors(log: Log, params: first_principles.Params) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return smoothed accelerations without gravity, angular accelerations, body velocities, and thrusts."""
    sl = slice(10, -10)
    acc = np.gradient(_smooth(log.vel), log.t, axis=0) - np.asarray(params.gravity_vec)
    ang_acc = np.gradient(_smooth(log.ang_vel), log.t, axis=0)
    body = np.asarray(rotate_inverse(jnp.asarray(log.quat), jnp.asarray(np.stack([acc, _smooth(log.vel)]))))
    thrust = _smooth(np.asarray(curve(jnp.asarray(log.rotor_vel), params.rpm2thrust), np.float64))
    return body[0][sl], ang_acc[sl], body[1][sl], thrust[sl]


def _least_squares(logs: Sequence[Log], params: first_principles.Params) -> NDArray:
    """Return scaled parameters by linear least squares on accelerations and angular accelerations."""
    pieces = [_regressors(log, params) for log in logs]
    acc, ang_acc, vel, thrust = [np.concatenate(x) for x in zip(*pieces, strict=True)]
    mass, inertia = float(params.mass[0]), np.diag(np.asarray(params.J, np.float64))
    mixing, arm = np.asarray(params.mixing_matrix, np.float64), float(params.L[0])
    x = np.zeros(len(NAMES))
    for axis in range(3):
        terms = [vel[:, axis]] + ([thrust.sum(-1)] if axis == 2 else [])
        found = np.linalg.lstsq(np.stack(terms, -1), mass * acc[:, axis], rcond=None)[0]
        x[8 + axis] = min(found[0], 0.0) / UNITS[8 + axis]
        if axis == 2:
            x[0] = np.log(np.clip(found[1], 0.3, 3))
    factor = np.exp(x[0])
    for axis in range(2):
        torque = factor * arm * thrust @ mixing[axis]
        terms = np.c_[torque, vel, factor * thrust.sum(-1)]
        found = np.linalg.lstsq(terms, ang_acc[:, axis], rcond=None)[0]
        scale = np.clip(1 / max(found[0] * inertia[axis], 1e-3), 0.3, 3)
        x[1 + axis] = np.log(scale)
        moment = scale * inertia[axis]
        row = 12 + 3 * axis
        x[row : row + 3] = moment * found[1:4] / UNITS[row : row + 3]
        arm_shift = moment * found[4]
        x[6 if axis == 1 else 7] = (arm_shift if axis == 1 else -arm_shift) / UNITS[6]
    return x


def _check(logs: Sequence[Log], airframe: Airframe) -> None:
    """Check that logs and airframe fit: sample times, number and unit of rotors."""
    if not logs:
        raise ConfigError("expected at least one log, got none")
    params = first_principles.Params.create(airframe)
    hover = float(np.mean(np.asarray(first_principles.hover_rotor_vel(params))))
    for log in logs:
        if abs(log.dt - logs[0].dt) > 1e-4:
            raise ConfigError(
                f"{log.name}: expected samples every {logs[0].dt:.4g} s as in the first log, got {log.dt:.4g}"
            )
        if log.rotor_vel.shape[1] != airframe.n_rotors:
            raise ConfigError(f"{log.name}: expected {airframe.n_rotors} rotors, got {log.rotor_vel.shape[1]}")
        ratio = float(np.median(log.rotor_vel)) / hover
        if not 0.4 < ratio < 2.5:
            raise ConfigError(
                f"{log.name}: expected rotor speeds near {hover:.0f} rpm, as in hover, got a median of "
                f"{np.median(log.rotor_vel):.0f}. Give rpm_per_unit: {60 / (2 * np.pi):.4g} for rad/s, 1 over the pole "
                "pairs for electrical rpm."
            )


def _check_order(logs: Sequence[Log], airframe: Airframe) -> None:
    """Check that no other order of the rotors explains the angular accelerations much better."""
    params = first_principles.Params.create(airframe)
    pieces = [_regressors(log, params) for log in logs]
    _, ang_acc, vel, thrust = [np.concatenate(x) for x in zip(*pieces, strict=True)]
    mixing = airframe.mixing_matrix

    def explained(order: tuple[int, ...]) -> float:
        total = 0.0
        for axis in range(2):
            rest = np.c_[vel, np.ones(len(vel))]
            torque = thrust[:, order] @ mixing[axis]
            full = np.linalg.lstsq(np.c_[torque, rest], ang_acc[:, axis], rcond=None)[0]
            alone = np.linalg.lstsq(rest, ang_acc[:, axis], rcond=None)[0]
            gain = np.var(ang_acc[:, axis] - rest @ alone) - np.var(ang_acc[:, axis] - np.c_[torque, rest] @ full)
            total += np.sign(full[0]) * gain / np.var(ang_acc[:, axis])
        return total

    given = tuple(range(airframe.n_rotors))
    best = max(itertools.permutations(given), key=explained)
    if explained(best) > explained(given) + 0.2:
        raise ConfigError(
            f"expected rotors in the order of airframe {airframe.name!r}; the angular accelerations fit "
            f"the order {[k + 1 for k in best]} much better ({explained(best):.2f} against {explained(given):.2f}, "
            "of at most 2). Change rotor_vel in Columns."
        )


def _changes(base: Airframe, mass: float, values: NDArray) -> dict[str, NDArray]:
    """Return the numbers of the identified airframe that differ from its base."""
    root = np.sqrt(values[1:4])
    inertia = base.inertia * np.outer(root, root)
    inertia = np.diag(inertia) if np.allclose(inertia, np.diag(np.diag(inertia)), atol=0) else inertia
    shift = np.array([values[6], values[7], 0.0])
    return {
        "rigid_body.mass": np.asarray(mass),
        "rigid_body.inertia": inertia,
        "rotors.position": base.value("rotors.position") - shift,
        "rotors.thrust_curve": base.value("rotors.thrust_curve") * values[0],
        "rotors.torque_curve": base.value("rotors.torque_curve") * values[4],
        "rotors.inertia": base.value("rotors.inertia") * values[5],
        "drag.coefficients": np.minimum(values[8:11], 0.0),
    }


def _nested(base: str, name: str, changes: dict[str, NDArray]) -> dict:
    """Return the tables of an airframe with a base and changes."""
    tables: dict = {"name": f"{name}_identified", "base": base}
    for path, value in changes.items():
        table, _, key = path.rpartition(".")
        tables.setdefault(table, {})[key] = value.tolist()
    return tables
