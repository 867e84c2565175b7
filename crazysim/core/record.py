"""The former path of ``crazysim.engine.record``."""

from crazysim.engine.record import *  # noqa: F403
