"""Plots of prediction errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from crazysim.errors import not_installed
from crazysim.lab.identify.logs import Log
from crazysim.lab.identify.prediction import HORIZONS, Predictor, prediction_errors
from crazysim.storage import write_figure


def plot_errors(logs: Sequence[Log], models: Mapping[str, Predictor], path: str | Path) -> None:
    """Write a picture of the errors of position and attitude over the horizon.

    Args:
        logs: Logs of the same sample time, aligned.
        models: Models by name.
        path: File to write, such as ``errors.png``.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(not_installed("plots need", "matplotlib", "demo")) from error
    horizons = np.linspace(0, max(HORIZONS), 11)[1:].tolist()
    errors = {name: prediction_errors(logs, model, horizons) for name, model in models.items()}
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots(1, 2)
    naive = {"position": "at constant velocity", "attitude": "unchanged"}
    for ax, (key, other), unit in zip(axes, naive.items(), ("m", "degrees"), strict=True):
        for name, values in errors.items():
            ax.plot(horizons, values[key], label=name)
        for kind, style in ((other, "k:"), ("at constant body rates", "k--")):
            ax.plot(horizons, values[f"{key} {kind}"], style, label=kind)
        ax.set(xlabel="horizon, s", ylabel=f"RMSE of {key}, {unit}", xlim=(0, None), ylim=(0, None))
        ax.grid(alpha=0.3)
        ax.legend()
    write_figure(figure, path, dpi=120)
