"""Gains by bandwidth: what the lag of an airframe's rotors and the rate of a controller allow.

A drone with rotors of lag rate ``a`` turns under a feedback of attitude and body rate, with gains per inertia kp and
kd, as ``s^3 / a + s^2 + kd s + kp``. The rule here is

    kd = a,   kp = 0.3 a^2,   and half of these rates about yaw, where rotors have less authority,

which puts the slowest mode of the attitude at about 0.4 a. The position loop is critically damped with a natural
frequency of 0.12 a: together the five modes then have damping ratios of 0.39 and more (``test_bandwidth.py`` computes
them). A controller that runs every 1/freq s acts half a period late, and its input is one period old at worst, which
counts as lag: ``1 / a = 1 / rotor_rate + 1.5 / freq``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from crazysim.control.allocation import hover_rotor_vel
from crazysim.drones import Airframe

ATTITUDE_STIFFNESS = 0.3
"""Attitude gain per inertia over the squared lag rate, 1."""
YAW = 0.5
"""Rate of the yaw loop over that of roll and pitch, 1."""
POSITION = 0.12
"""Natural frequency of the position loop over the lag rate, 1."""


class Bandwidth(NamedTuple):
    """Rates of the loops of an airframe."""

    position: float
    """Natural frequency of the critically damped position loop, rad/s."""
    stiffness: np.ndarray
    """Angular acceleration per rotation error, 1/s^2. (3,)"""
    damping: np.ndarray
    """Angular acceleration per body rate, 1/s. (3,)"""


def rotor_rate(airframe: Airframe) -> float:
    """Return the rate of the lag of the rotors around hover, in the slower direction, 1/s.

    The lag is ``a (cmd - r) + b (cmd^2 - r^2)``; its slope at the hover speed is ``a + 2 b r``.

    Raises:
        ConfigError: If the airframe has no rotor constants.
    """
    hover = hover_rotor_vel(airframe)
    lag = np.atleast_2d(airframe.value("rotors.lag"))
    return float(np.min([lag[:, 0] + 2 * lag[:, 1] * hover, lag[:, 2] + 2 * lag[:, 3] * hover]))


def bandwidth(airframe: Airframe, freq: int, rate: float | None = None) -> Bandwidth:
    """Return the rates of the loops of an airframe under a controller that runs at ``freq`` Hz.

    Args:
        airframe: The airframe.
        freq: Rate of the controller, Hz.
        rate: Rate of the lag of the rotors, 1/s; None for ``rotor_rate``.

    Raises:
        ConfigError: If the airframe has no rotor constants.
    """
    rate = 1 / (1 / (rotor_rate(airframe) if rate is None else rate) + 1.5 / freq)
    axes = rate * np.array([1.0, 1.0, YAW])
    return Bandwidth(POSITION * rate, ATTITUDE_STIFFNESS * axes**2, axes)
