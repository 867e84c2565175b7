"""The former path of ``crazysim.engine.cache``."""

from crazysim.engine.cache import *  # noqa: F403
