"""Estimators: filters that fuse the measurements of sensors, each a plugin that ``sim.add`` adds."""

from crazysim.plugins.estimators.kalman import Kalman

__all__ = ["Kalman"]
