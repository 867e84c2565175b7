"""Fits of the models ``so_rpy`` to logs with attitude commands."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from crazysim.drones import Airframe, load_airframe
from crazysim.dynamics.utils.data_utils import derivatives_svf, preprocessing
from crazysim.dynamics.utils.identification import fit_rotation, fit_translation
from crazysim.errors import ConfigError
from crazysim.identify.logs import Log

UNITS = {
    "acc_coef": "N", "cmd_f_coef": "1", "thrust_dyn_coef": "1/s", "drag_coefficients": "N s/m",
    "rpy_coef": "1/s^2", "rpy_rates_coef": "1/s", "cmd_rpy_coef": "1/s^2",
}  # fmt: skip


def identify_attitude(
    logs: Sequence[Log], airframe: str | Path, dynamics: str, source: str, *, mass: float | None = None
) -> tuple[Airframe, str]:
    """Return an airframe with a fitted model of logs with attitude commands, and its TOML file.

    Args:
        logs: Logs with ``attitude_command`` that begin in hover, without gaps.
        airframe: Name or path of the airframe to start from.
        dynamics: ``so_rpy``, ``so_rpy_rotor`` or ``so_rpy_rotor_drag``.
        source: Description of the logs, with date.
        mass: Mass in the flights, kg; None for that of the airframe.

    Raises:
        ConfigError: If a log has no attitude commands or has gaps, or the fit is no airframe.
    """
    base = load_airframe(airframe)
    known = float(base.value("rigid_body.mass"))
    weight = known if mass is None else float(mass)
    data = []
    for log in logs:
        if log.attitude_command is None or len(log.gaps):
            raise ConfigError(
                f"{log.name}: expected attitude commands and no gaps, got "
                f"{'none' if log.attitude_command is None else f'{len(log.gaps)} gaps'}. "
                "Name roll, pitch, yaw and thrust as attitude_command, and cut the log at gaps."
            )
        cmd = log.attitude_command
        columns = {"time": log.t, "pos": log.pos, "quat": log.quat, "cmd_rpy": cmd[:, :3], "cmd_f": cmd[:, 3]}
        data.append(derivatives_svf(preprocessing(columns)))
    force, force_spread = fit_translation(dynamics, weight, data)
    turn, turn_spread = fit_rotation(data)
    table: dict[str, float | list[float]] = {"acc_coef": 0.0, "cmd_f_coef": force["cmd_f_coef"]}
    if "thrust_dyn_coef" in force:
        table["thrust_dyn_coef"] = force["thrust_dyn_coef"]
    if "drag_xy_coef" in force:
        table["drag_coefficients"] = [force["drag_xy_coef"], force["drag_xy_coef"], force["drag_z_coef"]]
    table |= {name: x.tolist() for name, x in turn.items()}
    tables: dict = {"name": f"{base.name}_identified", "base": str(airframe), "fitted": {dynamics: table}}
    lines = [f"base = {json.dumps(str(airframe))}", "", "[sources]", f"flights = {json.dumps(source)}"]
    if weight != known:
        tables["rigid_body"] = {"mass": weight}
        lines += ["", "[rigid_body]", f'mass = {{ value = {weight}, unit = "kg", source = "flights" }}']
    lines += ["", f"[fitted.{dynamics}]"]
    lines += [f'{k} = {{ value = {x}, unit = "{UNITS[k]}", source = "flights" }}' for k, x in table.items()]
    lines += ["", "# Standard deviations:"]
    lines += [f"# {name}: {x:.2g}" for name, x in force_spread.items()]
    lines += [f"# {name}: {', '.join(f'{v:.2g}' for v in x)}" for name, x in turn_spread.items()]
    return load_airframe(tables), "\n".join(lines) + "\n"
