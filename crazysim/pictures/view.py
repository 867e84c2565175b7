"""Deprecated path of ``crazysim.media.view``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.media.view")
