"""Identification of airframes from logs of real flights."""

from crazysim.identify.fit import Identification, identify
from crazysim.identify.logs import Columns, Log, read_log
from crazysim.identify.prediction import Extras, Model, errors_table, prediction_errors

__all__ = [
    "Columns",
    "Extras",
    "Identification",
    "Log",
    "Model",
    "errors_table",
    "identify",
    "prediction_errors",
    "read_log",
]
