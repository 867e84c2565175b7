"""Deprecated path of ``crazysim.core.stage``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.core.stage")
