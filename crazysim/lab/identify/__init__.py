"""Identification of airframes from logs of real flights."""

from crazysim.lab.identify.attitude import FittedModel, identify_attitude
from crazysim.lab.identify.columns import Columns
from crazysim.lab.identify.fit import Identification, identify
from crazysim.lab.identify.logs import Log, read_log
from crazysim.lab.identify.motors import motor_lag, with_speeds
from crazysim.lab.identify.network import fit_residual
from crazysim.lab.identify.prediction import Model, Predictor, errors_table, plot_errors, prediction_errors
from crazysim.lab.identify.rotation import aligned, fast_rotation

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
