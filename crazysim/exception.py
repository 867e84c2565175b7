"""Errors, under Crazyflow's import path."""

from crazysim.errors import ConfigError, RenderError, UnknownNameError
from crazysim.errors import ConfigError as CrazyflowError

__all__ = ["ConfigError", "CrazyflowError", "RenderError", "UnknownNameError"]
