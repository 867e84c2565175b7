"""Deprecated path of ``crazysim.core.stages``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.core.stages")
