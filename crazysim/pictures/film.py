"""Deprecated path of ``crazysim.media.film``."""

from crazysim.deprecation import moved

__getattr__ = moved(__name__, "crazysim.media.film")
