"""Deprecated path of ``crazysim.core.settings``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.core.settings")
