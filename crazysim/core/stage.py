"""The former path of ``crazysim.engine.stage``."""

from crazysim.engine.stage import *  # noqa: F403
