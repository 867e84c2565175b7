"""Gains of controllers: the highest bandwidth that the rotors and the rate of a controller allow.

Let a be the rate at which the rotors follow their command (the lag rate), and kp and kd the gains per inertia on
attitude and body rate (``stiffness`` and ``damping``). The characteristic polynomial is ``s^3 / a + s^2 + kd s + kp``.
The rule here is

    kd = a,   kp = 0.3 a^2,   about yaw with a / 2 or less in place of a, since rotors have less authority there,

which puts the poles of the attitude at -0.39 a and (-0.30 +- 0.82i) a. The position loop is critically damped with a
natural frequency of 0.12 a. Together, the five modes then have damping ratios of 0.39 and more (``test_geometric.py``
computes them). A controller that runs every 1/freq s acts half a period late, and its input is up to one period old.
Both delays are added to the lag: ``1 / a = 1 / rotor_rate + 1.5 / freq``.

Two limits lower these rates. The first limit is the authority of the rotors. A large error e turns the drone along the
line kp e + kd e' = 0, on which the rotors must brake with the angular acceleration (kp / kd)^2 e. If they cannot give
it (``max_ang_acc``), the drone turns faster than it can stop. Therefore ``max_gain_ratios`` bounds kp / kd.

The second limit is the reaction to accelerating rotors: a rotor that speeds up turns the body the other way at once.
Let r be the ``rotor_rate``, and z the ratio of the changes of a rotor's angular momentum and drag torque
(``momentum_per_torque``). In the first tick, the yaw torque is then up to 1 + r z times the demanded torque. A
controller that does not model this may remove at most ``MAX_YAW_CORRECTION`` of an error of the yaw rate in a tick.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from crazysim.control.allocation import hover_rotor_vel, hover_torque_arms
from crazysim.control.levels import allocation_matrix
from crazysim.drones import Airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.dynamics.rotor import RPM_TO_RAD_S

ATTITUDE_STIFFNESS = 0.3
"""Stiffness over the squared damping of an axis, 1."""
MAX_YAW_CORRECTION = 1 / 3
"""Largest fraction of an error of the yaw rate that one tick removes, by the demanded torque and by the reaction to
accelerating rotors, 1."""
YAW_RATE_RATIO = 0.5
"""Largest damping about yaw over the lag rate, 1."""
STOPPABLE_ERRORS = np.array([2.0, 2.0, 1.0])
"""Largest rotation errors about x, y and z, 2 sin(angle / 2), from which the rotors can stop a turn: 180 degrees about
x and y, and 60 degrees about z."""
POSITION_RATE_RATIO = 0.12
"""Natural frequency of the position loop over the smaller damping of roll and pitch, 1."""


class Bandwidth(NamedTuple):
    """Bandwidth of position and attitude loop: a natural frequency, and gains per inertia."""

    position: float
    """Natural frequency of the critically damped position loop, rad/s."""
    stiffness: np.ndarray
    """Angular acceleration per rotation error, 1/s^2. (3,)"""
    damping: np.ndarray
    """Angular acceleration per body rate, 1/s. (3,)"""


def rotor_rate(airframe: Airframe) -> float:
    """Return the rate of the lag of the rotors around hover, on spin-up or spin-down, whichever is slower, 1/s.

    The lag is ``c1 (cmd - n) + c2 (cmd^2 - n^2)`` at the speed n; its slope at the hover speed is ``c1 + 2 c2 n``.
    """
    return float(np.min(_lag_rates(airframe, hover_rotor_vel(airframe))))


def fastest_rotor_rate(airframe: Airframe) -> float:
    """Return the rate of the lag of the rotors at top speed, on spin-up or spin-down, whichever is faster, 1/s."""
    return float(np.max(_lag_rates(airframe, airframe.rotor_vel_limits[1])))


def _lag_rates(airframe: Airframe, rotor_vel: np.ndarray) -> np.ndarray:
    lag = np.atleast_2d(airframe.value("rotors.lag"))
    return lag[:, 0::2] + 2 * lag[:, 1::2] * rotor_vel[:, None]


def momentum_per_torque(airframe: Airframe) -> float:
    """Return the ratio of the changes of a rotor's angular momentum and drag torque around hover, s."""
    hover = hover_rotor_vel(airframe)
    _, k1, k2 = np.atleast_2d(airframe.value("rotors.torque_curve")).T
    return float(np.mean(airframe.value("rotors.inertia") * RPM_TO_RAD_S / (k1 + 2 * k2 * hover)))


def precession_rate(airframe: Airframe) -> float:
    """Return the angular acceleration about x or y that rotors cause in hover per body rate about the other axis, 1/s.

    It is the net angular momentum of the rotors over the smaller moment of inertia.
    """
    signs, hover = airframe.value("rotors.yaw_torque_sign"), RPM_TO_RAD_S * hover_rotor_vel(airframe)
    momentum = np.sum(signs * airframe.value("rotors.inertia") * hover)
    return float(abs(momentum) / np.min(np.diag(airframe.inertia)[:2]))


def max_ang_acc(airframe: Airframe) -> np.ndarray:
    """Return the angular acceleration that the rotors can give about each axis in both directions, rad/s^2. (3,)

    Roll and pitch may lower the collective thrust below hover, as in ``prioritized_thrusts``; yaw may not.
    """
    thrusts_per_wrench = allocation_matrix(airframe) / np.concatenate([[1.0], hover_torque_arms(airframe)])
    low, high = (float(airframe.value(f"rotors.thrust_{end}", ())) for end in ("min", "max"))
    weight = GRAVITY_MAGNITUDE * float(airframe.value("rigid_body.mass", ()))
    lift_shares, yaw_shares = thrusts_per_wrench[:, 0], thrusts_per_wrench[:, 3]
    torques = []
    for axis in (1, 2):
        ratio = thrusts_per_wrench[:, axis] / lift_shares
        # At a torque t, rotor i needs a collective thrust of at least low / lift_shares_i - t ratio_i. Rotor k allows
        # at most high / lift_shares_k - t ratio_k. The weight is another upper limit.
        thrust_margins = np.append(high / lift_shares, weight)[None] - (low / lift_shares)[:, None]
        margin_rates = np.abs(np.append(ratio, 0.0)[None] - ratio[:, None])
        torques.append(np.min(thrust_margins[margin_rates > 0] / margin_rates[margin_rates > 0]))
    torques.append(
        min(np.min(high / lift_shares) - weight, weight - np.max(low / lift_shares))
        / np.max(np.abs(yaw_shares / lift_shares))
    )
    return np.array(torques) / np.diag(airframe.inertia)


def max_gain_ratios(airframe: Airframe) -> np.ndarray:
    """Return the largest ratio of stiffness to damping at which the rotors can stop turns, by axis, 1/s. (3,)"""
    return np.sqrt(max_ang_acc(airframe) / STOPPABLE_ERRORS)


def bandwidth(airframe: Airframe, freq: int, lag_rate: float | None = None, limits_reaction: bool = True) -> Bandwidth:
    """Return the bandwidth of position and attitude loop of an airframe.

    Args:
        freq: Rate of the controller, Hz.
        lag_rate: Rate of the lag of the rotors, 1/s; None for ``rotor_rate``.
        limits_reaction: Whether the reaction to accelerating rotors is a limit, unless the controller compensates it.
    """
    loop_rate = 1 / (1 / (rotor_rate(airframe) if lag_rate is None else lag_rate) + 1.5 / freq)
    axis_rates = np.minimum(
        loop_rate * np.array([1.0, 1.0, YAW_RATE_RATIO]), max_gain_ratios(airframe) / ATTITUDE_STIFFNESS
    )
    if limits_reaction:
        axis_rates[2] = min(
            axis_rates[2], MAX_YAW_CORRECTION * freq / (1 + rotor_rate(airframe) * momentum_per_torque(airframe))
        )
    return Bandwidth(
        float(POSITION_RATE_RATIO * np.min(axis_rates[:2])), ATTITUDE_STIFFNESS * axis_rates**2, axis_rates
    )
