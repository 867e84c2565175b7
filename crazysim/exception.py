"""The errors again, where Crazyflow has them; ``crazysim.errors`` is their home."""

from crazysim.errors import ConfigError, RenderError, UnknownNameError

__all__ = ["ConfigError", "RenderError", "UnknownNameError"]
