"""The former path of ``crazysim.engine.pytree``."""

from crazysim.engine.pytree import *  # noqa: F403
