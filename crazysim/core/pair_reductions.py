"""The former path of ``crazysim.engine.pair_reductions``."""

from crazysim.engine.pair_reductions import *  # noqa: F403
