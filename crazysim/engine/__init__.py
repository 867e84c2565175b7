"""How a step is executed."""

from crazysim.engine.plain import build_reset, build_step

__all__ = ["build_reset", "build_step"]
