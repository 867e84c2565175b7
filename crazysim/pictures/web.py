"""Deprecated path of ``crazysim.media.web``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.media.web")
