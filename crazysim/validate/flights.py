"""Real flights: open-loop prediction and closed loop."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from crazysim.drones import load_airframe
from crazysim.errors import ConfigError
from crazysim.identify import Model, aligned, fast_rotation, prediction_errors, read_log
from crazysim.identify.prediction import HORIZONS
from crazysim.validate.closed_loop import compare, laboratory, read_flight
from crazysim.validate.rows import Row

PUBLISHED = "published mean after 0.5 s: rigid body 0.154, learned 0.063 m"
"""Figures of IDSIA's benchmark (arXiv 2512.14450) for melon."""


def logs(folder: Path, pattern: str) -> list[Path]:
    """Return the logs of a folder.

    Raises:
        ConfigError: If there are none.
    """
    found = sorted(folder.glob(pattern))
    if not found:
        raise ConfigError(
            f"expected logs {pattern} in {folder.name}, got none. See the page of validation for the data."
        )
    return found


def open_loop(folder: Path) -> Iterable[Row]:
    """Yield errors of predictions of melon from measured rotor speeds, without knowledge of its motion."""
    (path,) = logs(folder, "melon*.npz")
    log, naive = read_log(path), {"position": "position at constant velocity", "attitude": "attitude unchanged"}
    for name in ("cf21B_500", "cf21B_500_idsia"):
        model = Model.create(load_airframe(name), 0.045)
        errors = prediction_errors([aligned(log, fast_rotation([log], model.params).delays[0])], model)
        for k, h in enumerate(HORIZONS):
            for what, unit in (("position", "m"), ("attitude", "degrees")):
                beside = f"{naive[what].removeprefix(what).strip()}: {errors[naive[what]][k]:.3g} {unit}"
                yield Row(
                    f"`{name}` after {h:g} s: {what}, RMSE", path.stem, float(errors[what][k]), unit, None, beside
                )
        mean = float(errors["position (mean)"][-1])
        yield Row(f"`{name}` after 0.5 s: position, mean", path.stem, mean, "m", None, PUBLISHED)


def closed_loop(folder: Path) -> Iterable[Row]:
    """Yield simulated over logged tracking errors, flight by flight."""
    paths = [path for name in ("circle", "figure8", "trefoil") for path in logs(folder, f"*{name}*.npz")]
    for row in compare([read_flight(path) for path in paths], estimator=laboratory()):
        beside = f"real {row.logged:.3f} m, simulated {row.simulated:.3f} m"
        bound = None if row.failed else (0.7, 1.4)
        yield Row(
            row.name + (" (the real drone crashed)" if row.failed else ""), "its log", row.ratio, "", bound, beside
        )
