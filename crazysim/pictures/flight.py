"""Deprecated path of ``crazysim.media.flight``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.media.flight")
