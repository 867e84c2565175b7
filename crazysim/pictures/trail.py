"""Deprecated path of ``crazysim.media.trail``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.media.trail")
