"""Identification of airframes from logs of real flights."""

from crazysim.identify.attitude import FittedModel, identify_attitude
from crazysim.identify.columns import Columns
from crazysim.identify.fit import Identification, identify
from crazysim.identify.logs import Log, read_log
from crazysim.identify.motors import motor_lag, with_speeds
from crazysim.identify.network import fit_residual
from crazysim.identify.plots import plot_errors
from crazysim.identify.prediction import Model, Predictor, errors_table, prediction_errors
from crazysim.identify.rotation import aligned, fast_rotation

__all__ = [
    "Columns",
    "FittedModel",
    "Identification",
    "Log",
    "Model",
    "Predictor",
    "aligned",
    "errors_table",
    "fast_rotation",
    "fit_residual",
    "identify",
    "identify_attitude",
    "motor_lag",
    "plot_errors",
    "prediction_errors",
    "read_log",
    "with_speeds",
]
