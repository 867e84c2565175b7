"""Fits of the ``so_rpy`` models to logs with attitude commands."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.drones import Airframe, load_airframe
from crazysim.dynamics import fitted
from crazysim.dynamics.models import Dynamics
from crazysim.engine.pytree import PyTree
from crazysim.errors import ConfigError
from crazysim.lab.identify.attitude_logs import derivatives_svf, preprocessing
from crazysim.lab.identify.checks import check_turning
from crazysim.lab.identify.fitted import fit_rotation, fit_translation
from crazysim.lab.identify.logs import Log
from crazysim.lab.identify.prediction import PADDING, State, Windows
from crazysim.lab.identify.rotation import SAMPLING_ERROR, deviation_of_sum, sum_pieces

PARAMETER_UNITS = {
    "acc_coef": "N", "cmd_f_coef": "1", "thrust_dyn_coef": "1/s", "drag_coefficients": "N s/m",
    "rpy_coef": "1/s^2", "rpy_rates_coef": "1/s", "cmd_rpy_coef": "1/s^2",
}  # fmt: skip
"""Unit of each fitted parameter."""


class FittedModel(PyTree):
    """Fitted model that predicts a flight from its attitude commands."""

    params: fitted.Params
    """Parameters of the model."""

    @staticmethod
    def create(airframe: Airframe, dynamics: str, mass: float | None = None) -> FittedModel:
        """Return the model of an airframe.

        Args:
            dynamics: ``so_rpy``, ``so_rpy_rotor`` or ``so_rpy_rotor_drag``.
            mass: Mass, kg; None for the mass of the airframe.
        """
        params = fitted.Params.create(airframe, Dynamics(dynamics))
        return FittedModel(params if mass is None else params.replace(mass=jnp.asarray([mass], jnp.float32)))

    def prepare_log(self, log: Log) -> Log:
        """Return the log with attitudes relative to the first 0.1 s, and the thrust in place of the rotor speeds.

        The thrust is lagged if the model has ``thrust_dyn_coef``.
        """
        columns = _to_crazyflow_columns(log)
        thrust = columns["cmd_f"]
        if self.params.thrust_dyn_coef is not None:
            from scipy.signal import lfilter  # takes 0.2 s to import

            decay = np.exp(-float(self.params.thrust_dyn_coef[0]) * log.dt)
            thrust, _ = lfilter([0.0, 1 - decay], [1.0, -decay], thrust, zi=thrust[:1])
        return replace(log, quat=preprocessing(columns)["quat"], rotor_vel=thrust[:, None])

    def start(self, window: Windows) -> Array:
        """Return the lagged thrust at the first sample, N. (1,)"""
        return window.rotor_vel[PADDING]

    def inputs(self, window: Windows, dt: float) -> Array:
        """Return the commands, held from sample to sample. (n - 1, 3, 4)"""
        del dt  # an argument of every predictor
        cmd = window.attitude_command
        if cmd is None:
            raise ConfigError("expected windows with attitude commands, got none. Cut them from prepared logs.")
        return jnp.repeat(cmd[:-1, None], 3, axis=1)

    def derivative(self, state: State, inputs: Array) -> State:
        """Return the time derivatives of a state under a command."""
        pos, quat, vel, ang_vel, thrust = state
        _, acc, ang_acc, thrust_rate = fitted.dynamics(pos, quat, vel, ang_vel, inputs, thrust, params=self.params)
        return vel, ang_vel, acc, ang_acc, thrust_rate


def _to_crazyflow_columns(log: Log) -> dict[str, NDArray]:
    cmd = log.attitude_command
    if cmd is None:
        raise ConfigError(
            f"{log.name}: expected attitude commands, got none. Name roll, pitch, yaw and thrust as attitude_command."
        )
    if len(log.gaps):
        ends = np.array([0, *log.gaps, len(log.t)])
        longest = int(np.argmax(log.t[ends[1:] - 1] - log.t[ends[:-1]]))
        first, last = log.t[ends[longest]], log.t[ends[longest + 1] - 1]
        raise ConfigError(
            f"{log.name}: expected no gaps, got {len(log.gaps)}. Cut the log: its longest piece without gaps is "
            f"from t = {first:.6g} to {last:.6g} s."
        )
    return {"time": log.t, "pos": log.pos, "quat": log.quat, "cmd_rpy": cmd[:, :3], "cmd_f": cmd[:, 3]}


def identify_attitude(
    logs: Sequence[Log], airframe: str | Path, dynamics: str, source: str, *, mass: float | None = None
) -> tuple[Airframe, str]:
    """Fit a model to logs with attitude commands; return the airframe, and the text of its TOML file.

    Args:
        logs: Logs with ``attitude_command`` that begin in hover, without gaps.
        airframe: Name or path of the airframe to start from.
        dynamics: ``so_rpy``, ``so_rpy_rotor`` or ``so_rpy_rotor_drag``.
        source: Description of the logs, with date.
        mass: Mass in the flights, kg; None for the mass of the airframe.

    Raises:
        ConfigError: If a log has no attitude commands or has gaps, or the fitted numbers are not valid.
    """
    base = load_airframe(airframe)
    base_mass = float(base.value("rigid_body.mass"))
    flight_mass = base_mass if mass is None else float(mass)
    check_turning(logs)
    # Translation and rotation, with standard deviations.
    data = [derivatives_svf(preprocessing(_to_crazyflow_columns(log))) for log in logs]
    force, force_influences = fit_translation(dynamics, flight_mass, data)
    rotation_params, influences = fit_rotation(data)
    force_spread = _deviations(np.array([*force.values()]), force_influences, logs)
    tilt, yaw = (
        _deviations(np.array([x[2 * k] for x in rotation_params.values()]), influences[:, k], logs) for k in (0, 1)
    )
    # Table of the model.
    table: dict[str, float | list[float]] = {"acc_coef": 0.0, "cmd_f_coef": force["cmd_f_coef"]}
    if "thrust_dyn_coef" in force:
        table["thrust_dyn_coef"] = force["thrust_dyn_coef"]
    if "drag_xy_coef" in force:
        table["drag_coefficients"] = [force["drag_xy_coef"], force["drag_xy_coef"], force["drag_z_coef"]]
    table |= {name: x.tolist() for name, x in rotation_params.items()}
    tables: dict = {"name": f"{base.name}_identified", "base": str(airframe), "fitted": {dynamics: table}}
    # Text of the file.
    lines = [f"base = {json.dumps(str(airframe))}", "", "[sources]", f"flights = {json.dumps(source)}"]
    if flight_mass != base_mass:
        tables["rigid_body"] = {"mass": flight_mass}
        lines += [
            'given = "not fitted: the mass that was passed to identify"',
            "",
            "[rigid_body]",
            f'mass = {{ value = {flight_mass}, unit = "kg", source = "given" }}',
        ]
    lines += ["", f"[fitted.{dynamics}]"]
    lines += [f'{k} = {{ value = {x}, unit = "{PARAMETER_UNITS[k]}", source = "flights" }}' for k, x in table.items()]
    lines += ["", "# Standard deviations:"]
    lines += [f"# {name}: {x:.2g}" for name, x in zip(force, force_spread, strict=True)]
    lines += [f"# {name}: {x:.2g}, {x:.2g}, {y:.2g}" for name, x, y in zip(rotation_params, tilt, yaw, strict=True)]
    return load_airframe(tables), "\n".join(lines) + "\n"


def _deviations(values: NDArray, influences: NDArray, logs: Sequence[Log]) -> NDArray:
    return np.hypot(
        deviation_of_sum(sum_pieces(influences, sum(float(log.t[-1] - log.t[0]) for log in logs))),
        SAMPLING_ERROR * values,
    )
