"""Open-loop prediction of logged flights from rotor speeds or attitude commands."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.drones import Airframe
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import reaction_torque
from crazysim.engine.pytree import PyTree
from crazysim.errors import optional_import, require
from crazysim.lab.identify.logs import Log
from crazysim.lab.plugins.residual import N_INPUTS, Residual, residual_inputs, residual_wrench
from crazysim.storage import write_figure

HORIZONS = (0.1, 0.25, 0.5)
"""Horizons of the tables of errors, s."""


class Windows(PyTree):
    """Pieces of logs, all of the same length. A prediction starts at the first sample of each window."""

    pos: Array
    """Position, world frame, m. (n_windows, n, 3)"""
    quat: Array
    """Attitude, body to world, unit, xyzw. (n_windows, n, 4)"""
    vel: Array
    """Velocity, world frame, m/s. (n_windows, n, 3)"""
    ang_vel: Array
    """Angular velocity, body frame, rad/s. (n_windows, n, 3)"""
    rotor_vel: Array
    """Rotor speeds, rpm, with ``PADDING`` samples before and after. (n_windows, n + 2 PADDING, n_rotors)

    A ``FittedModel`` of ``crazysim.lab.identify.attitude`` stores its collective thrust, N, here."""
    attitude_command: Array | None = None
    """Commanded roll, pitch, yaw, rad, and collective thrust, N; None if a log has none. (n_windows, n, 4)"""


PADDING = 1
"""Number of samples of rotor speeds before and after a window, for the rotor accelerations at its ends."""


State = tuple[Array, Array, Array, Array, Array]
"""Position, attitude, velocity and angular velocity as in ``Windows``, and the further states of a model."""


class Predictor(Protocol):
    """Model that predicts logged flights: ``Model`` or ``FittedModel``."""

    def prepare_log(self, log: Log) -> Log:
        """Return the log with its columns converted to the variables of the model."""
        ...

    def start(self, window: Windows) -> Array:
        """Return the further states of the model at the first sample of a window. (k,)"""
        ...

    def inputs(self, window: Windows, dt: float) -> Array:
        """Return the inputs at start, middle and end of each interval between samples. (n - 1, 3, ...)"""
        ...

    def derivative(self, state: State, inputs: Array) -> State:
        """Return the time derivatives of a state under inputs; in place of the attitude's, its angular velocity."""
        ...


class Model(PyTree):
    """Model that predicts a flight from its rotor speeds."""

    params: first_principles.Params
    """Parameters of the first-principles model."""
    residual: Residual
    """Forces and torques that are added to the first-principles model."""

    @staticmethod
    def create(airframe: Airframe, mass: float | None = None) -> Model:
        """Return the model of an airframe, with its table ``[residual]`` if it has one.

        Args:
            mass: Mass, kg; None for the mass of the airframe.
        """
        params = first_principles.Params.create(airframe)
        if mass is not None:
            params = params.replace(mass=jnp.asarray([mass], jnp.float32))
        has_residual = "residual.linear" in airframe.values
        residual = Residual.create(airframe) if has_residual else Residual(jnp.zeros((6, N_INPUTS)), is_bound=True)
        return Model(params=params, residual=residual)

    def prepare_log(self, log: Log) -> Log:
        """Return the log unchanged."""
        return log

    def start(self, window: Windows) -> Array:
        """Return no further states. (0,)"""
        return window.pos[0, :0]

    def inputs(self, window: Windows, dt: float) -> Array:
        """Return rotor speeds, interpolated linearly, rpm, and accelerations, rpm/s. (n - 1, 3, 2, n_rotors)"""
        n = window.pos.shape[0]
        sample = jnp.arange(2 * n - 1) / 2 + PADDING
        index = jnp.arange(n + 2 * PADDING, dtype=sample.dtype)
        speeds = jax.vmap(lambda x: jnp.interp(sample, index, x), 1, 1)(window.rotor_vel)
        accelerations = jnp.asarray(jnp.gradient(speeds, axis=0)) / (dt / 2)
        speed_and_acceleration = jnp.stack([speeds, accelerations], axis=1)
        return jnp.stack(
            [speed_and_acceleration[:-1:2], speed_and_acceleration[1::2], speed_and_acceleration[2::2]], axis=1
        )

    def derivative(self, state: State, inputs: Array) -> State:
        """Return the time derivatives of a state under rotor speeds and their accelerations."""
        (pos, quat, vel, ang_vel, no_states), (speed, acceleration), p = state, inputs, self.params
        force, torque = residual_wrench(residual_inputs(quat, vel, ang_vel, speed, p), self.residual)
        torque = torque + reaction_torque(acceleration, p.mixing_matrix[..., 2, :], p.prop_inertia)
        force, torque = rotation.rotate(quat, force), rotation.rotate(quat, torque)
        _, acc, ang_acc, _ = first_principles.dynamics(pos, quat, vel, ang_vel, speed, speed, force, torque, params=p)
        return vel, ang_vel, acc, ang_acc, no_states


def cut_windows(logs: Sequence[Log], duration: float, stride: float) -> Windows:
    """Return the windows of logs of equal sample times that do not cross a gap.

    Args:
        duration: Duration of a window, s.
        stride: Time between the starts of two windows, s.

    Raises:
        ConfigError: If no log is long enough for a window.
    """
    names = ["pos", "quat", "vel", "ang_vel", "rotor_vel"]
    if all(log.attitude_command is not None for log in logs):
        names.append("attitude_command")
    pieces: dict[str, list[NDArray]] = {key: [] for key in names}
    for log in logs:
        n, step = round(duration / log.dt) + 1, max(1, round(stride / log.dt))
        for start in range(PADDING, len(log.t) - n - PADDING, step):
            if np.any((log.gaps > start - PADDING) & (log.gaps < start + n + PADDING)):
                continue
            for key, values in pieces.items():
                padding = PADDING if key == "rotor_vel" else 0
                values.append(getattr(log, key)[start - padding : start + n + padding])
    require(
        pieces["pos"],
        f"expected a log longer than {duration:g} s plus {2 * PADDING + 1} samples without a gap, got none. "
        "Use longer logs.",
    )
    return Windows(**{key: jnp.asarray(np.stack(x), jnp.float32) for key, x in pieces.items()})


def predict(
    model: Predictor, window: Windows, dt: float, constant_rates: bool = False
) -> tuple[Array, Array, Array, Array]:
    """Return the states of one window, predicted from its first sample: pos, quat, vel, ang_vel. (n, ...) each

    Each sample is one Runge-Kutta step of order 4.

    Args:
        dt: Time between two samples, s.
        constant_rates: Whether to keep the angular velocity of the first sample, so that only forces are modelled.
    """

    def derivative(state: State, inputs: Array) -> State:
        vel, ang_vel, acc, ang_acc, more_derivatives = model.derivative(state, inputs)
        return vel, ang_vel, acc, jnp.zeros_like(ang_acc) if constant_rates else ang_acc, more_derivatives

    def advance_state(state: State, derivatives: State, duration: float) -> State:
        pos, quat, vel, ang_vel, more_states = state
        return (
            pos + duration * derivatives[0],
            rotation.integrate_attitude(quat, derivatives[1], duration, normalize=True),
            vel + duration * derivatives[2],
            ang_vel + duration * derivatives[3],
            more_states + duration * derivatives[4],
        )

    def step(state: State, inputs: Array) -> tuple[State, State]:
        k1 = derivative(state, inputs[0])
        k2 = derivative(advance_state(state, k1, dt / 2), inputs[1])
        k3 = derivative(advance_state(state, k2, dt / 2), inputs[1])
        k4 = derivative(advance_state(state, k3, dt), inputs[2])
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
        next_state = advance_state(state, mean, dt)
        return next_state, next_state

    start = (window.pos[0], window.quat[0], window.vel[0], window.ang_vel[0], model.start(window))
    _, path = jax.lax.scan(step, start, model.inputs(window, dt))
    pos, quat, vel, ang_vel, _ = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, path)
    return pos, quat, vel, ang_vel


@functools.partial(jax.jit, static_argnames=("dt", "constant_rates"))
def _predict_all(model: Predictor, batch: Windows, dt: float, constant_rates: bool = False) -> tuple[Array, Array]:
    return jax.vmap(lambda window: predict(model, window, dt, constant_rates)[:2])(batch)


def attitude_error(quat: Array, reference: Array) -> Array:
    """Return the rotation from a reference attitude to another, body frame. (..., 3)

    Its length is ``2 sin(angle / 2)``: for small angles the angle in rad, and at most 2.
    """
    error = rotation.multiply(reference * jnp.array([-1.0, -1.0, -1.0, 1.0]), quat)
    return 2 * jnp.where(error[..., 3:] < 0, -error[..., :3], error[..., :3])


def prediction_errors(
    logs: Sequence[Log], model: Predictor, horizons: Sequence[float] = HORIZONS
) -> dict[str, NDArray]:
    """Measure the errors of open-loop predictions that start every 0.05 s.

    Args:
        logs: Logs of the same sample time.
        horizons: Horizons, s.

    Returns:
        Errors at each horizon, by name. (len(horizons),) each

        - ``position`` and ``attitude``: predicted by the model.
        - ``position at constant body rates`` and ``attitude at constant body rates``: only the forces are modelled.
        - ``position at constant velocity`` and ``attitude unchanged``: without a model.

        These names have the RMSE: of the position, m, and of ``2 sin(angle / 2)`` of the attitude error, degrees. The
        names with `` (mean)`` appended have the mean distance, m, or the mean angle, degrees.
    """
    batch, dt = cut_windows([model.prepare_log(log) for log in logs], max(horizons), 0.05), logs[0].dt
    pos, quat = _predict_all(model, batch, dt)
    constant_rate_pos, constant_rate_quat = _predict_all(model, batch, dt, constant_rates=True)
    samples = np.asarray([round(h / dt) for h in horizons])
    times = jnp.asarray(samples * dt, jnp.float32)[:, None]
    true_pos, true_quat = batch.pos[:, samples], batch.quat[:, samples]
    positions = {
        "position": pos[:, samples],
        "position at constant body rates": constant_rate_pos[:, samples],
        "position at constant velocity": batch.pos[:, :1] + times * batch.vel[:, :1],
    }
    attitudes = {
        "attitude": quat[:, samples],
        "attitude at constant body rates": constant_rate_quat[:, samples],
        "attitude unchanged": jnp.broadcast_to(batch.quat[:, :1], true_quat.shape),
    }
    errors: dict[str, NDArray] = {}
    for name, x in positions.items():
        size = np.linalg.norm(np.asarray(x - true_pos, np.float64), axis=-1)
        errors |= {name: np.sqrt(np.mean(size**2, axis=0)), f"{name} (mean)": np.mean(size, axis=0)}
    for name, x in attitudes.items():
        size = np.linalg.norm(np.asarray(attitude_error(x, true_quat), np.float64), axis=-1)
        angle = 2 * np.arcsin(np.minimum(size / 2, 1.0))
        rmse, mean = np.sqrt(np.mean(size**2, axis=0)), np.mean(angle, axis=0)
        errors |= {name: np.degrees(rmse), f"{name} (mean)": np.degrees(mean)}
    return errors


def errors_table(errors: dict[str, NDArray], horizons: Sequence[float] = HORIZONS) -> str:
    """Return errors from ``prediction_errors`` as a table of text."""
    head = f"{'RMSE, or mean error, after':48}" + "".join(f"{f'{h:g} s':>10}" for h in horizons)
    unit_by_letter = {"p": "m", "a": "degrees"}  # position, attitude
    return "\n".join(
        [head, *(f"{f'{k}, {unit_by_letter[k[0]]}':48}" + "".join(f"{x:10.4g}" for x in v) for k, v in errors.items())]
    )


def plot_errors(logs: Sequence[Log], models: Mapping[str, Predictor], path: str | Path) -> None:
    """Write a picture of the errors of position and attitude over the horizon.

    Args:
        logs: Logs of the same sample time, whose delays were removed with ``aligned``.
        path: File to write, such as ``errors.png``.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    with optional_import("plots need", "matplotlib", "demo"):
        from matplotlib.figure import Figure
    horizons = np.linspace(0, max(HORIZONS), 11)[1:].tolist()
    errors = {name: prediction_errors(logs, model, horizons) for name, model in models.items()}
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots(1, 2)
    baselines = {"position": "at constant velocity", "attitude": "unchanged"}
    for ax, (key, baseline), unit in zip(axes, baselines.items(), ("m", "degrees"), strict=True):
        for name, values in errors.items():
            ax.plot(horizons, values[key], label=name)
        for kind, style in ((baseline, "k:"), ("at constant body rates", "k--")):
            ax.plot(horizons, values[f"{key} {kind}"], style, label=kind)
        ax.set(xlabel="horizon, s", ylabel=f"RMSE of {key}, {unit}", xlim=(0, None), ylim=(0, None))
        ax.grid(alpha=0.3)
        ax.legend()
    write_figure(figure, path, dpi=120)
