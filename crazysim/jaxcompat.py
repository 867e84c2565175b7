"""The former path of ``crazysim.engine.jaxcompat``."""

from crazysim.engine.jaxcompat import *  # noqa: F403
