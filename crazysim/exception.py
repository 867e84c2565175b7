"""Errors, under the path of Crazyflow; they are defined in ``crazysim.errors``."""

from crazysim.errors import ConfigError, RenderError, UnknownNameError

CrazyflowError = ConfigError
"""Crazyflow's base class: ``except CrazyflowError`` catches what is wrong with a configuration."""

__all__ = ["ConfigError", "CrazyflowError", "RenderError", "UnknownNameError"]
