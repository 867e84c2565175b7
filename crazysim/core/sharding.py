"""The former path of ``crazysim.engine.sharding``."""

from crazysim.engine.sharding import *  # noqa: F403
