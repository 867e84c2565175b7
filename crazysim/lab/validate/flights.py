"""Real flights: open-loop prediction and closed loop."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from numpy.typing import NDArray

from crazysim.drones import load_airframe
from crazysim.errors import require
from crazysim.lab.identify import Model, aligned, fast_rotation, prediction_errors, read_log
from crazysim.lab.identify.prediction import HORIZONS
from crazysim.lab.validate.closed_loop import compare_tracking, laboratory_estimator, read_flight
from crazysim.lab.validate.rows import Row

PUBLISHED_ERRORS = {
    "position": {"rigid body at constant body rates": (0.0126, 0.1269), "hybrid model": (0.0166, 0.1119)},
    "attitude": {"rigid body at constant body rates": (1.175, 14.58), "hybrid model": (2.154, 13.21)},
}
"""Published mean errors over IDSIA's three flights named melon after 0.1 and 0.5 s, m and degrees, of its rigid body
and of its learned model with the least error of position. They are the rows Physics and Hybrid of the last table in
``results/model_comparison.ipynb``, repository idsia-robotics/nanodrone-sysid-benchmark at commit 2d921b5, converted
from rad."""
IDSIA_MASS = 0.045
"""Mass of IDSIA's drone, kg."""


def find_logs(folder: Path, pattern: str) -> list[Path]:
    """Return the logs of a folder, ``.npz`` and ``.csv``, sorted."""
    paths = sorted(path for ending in ("npz", "csv") for path in folder.glob(f"{pattern}.{ending}"))
    require(
        paths,
        f"expected logs {pattern}.npz or .csv in {folder.name}, got none. docs/results.md says where to get them.",
    )
    return paths


def open_loop(folder: Path) -> Iterable[Row]:
    """Yield mean errors of predictions of a flight from its rotor speeds, and published errors.

    The predictions are for ``HORIZONS``, from the first flight named melon in the folder of IDSIA's logs. The published
    errors are after 0.1 and 0.5 s.
    """
    path = find_logs(folder, "melon*")[0]
    log = read_log(path)
    series_errors: dict[str, dict[str, NDArray]] = {"position": {}, "attitude": {}}
    errors: dict[str, NDArray] = {}
    for name in ("cf21B_500", "cf21B_500_idsia"):
        model = Model.create(load_airframe(name), IDSIA_MASS)
        # Rotor speeds are shifted by the delay that explains the angular acceleration in the log.
        flight = aligned(log, fast_rotation([log], model.params).delays[0])
        errors = prediction_errors([flight], model)
        errors = {key.removesuffix(" (mean)"): x for key, x in errors.items() if key.endswith("(mean)")}
        series_errors["position"][f"`{name}`"] = errors["position"]
        series_errors["position"][f"`{name}` at constant body rates"] = errors["position at constant body rates"]
        series_errors["attitude"][f"`{name}`"] = errors["attitude"]
    series_errors["position"]["constant velocity"] = errors["position at constant velocity"]
    series_errors["attitude"]["constant body rates"] = errors["attitude at constant body rates"]
    series_errors["attitude"]["unchanged"] = errors["attitude unchanged"]
    for quantity, unit in (("position", "m"), ("attitude", "degrees")):
        published = {f"published {name}": figures for name, figures in PUBLISHED_ERRORS[quantity].items()}
        for series, figures in (series_errors[quantity] | published).items():
            horizons, flights = ((0.1, 0.5), "three melon flights") if series in published else (HORIZONS, path.stem)
            for h, figure in zip(horizons, figures, strict=True):
                label = f"{quantity}, {series}, after {h:g} s"
                yield Row(label, flights, float(figure), unit, series=series.replace("`", ""), x=h)


def closed_loop(folder: Path) -> Iterable[Row]:
    """Yield the ratio of simulated to logged tracking error of each flight in a folder with NanoBench's logs.

    Flights are circles, figure eights and trefoils. If the real drone crashed, there is no bound.
    """
    paths = [path for name in ("circle", "figure8", "trefoil") for path in find_logs(folder, f"*{name}*")]
    for row in compare_tracking([read_flight(path) for path in paths], estimator=laboratory_estimator()):
        remark = f"real {row.logged_error:.3f} m, simulated {row.simulated_error:.3f} m"
        if row.failed:
            yield Row(f"{row.name} (the real drone crashed)", "its log", row.ratio, remark=remark)
            continue
        kind = " ".join(part for part in row.name.split("_")[1:] if not part.startswith("rep"))
        yield Row(row.name, "its log", row.ratio, "", (0.7, 1.4), remark, series="one flight", x=kind)
