"""Deprecated path of ``crazysim.core.random``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.core.random")
