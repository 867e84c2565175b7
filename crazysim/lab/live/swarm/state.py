"""States of drones, simulated and real."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import NDArray

from crazysim.lab.live.attitude import to_rpy


class DroneState(NamedTuple):
    """State of one drone, simulated or real."""

    time: float
    """Time, s."""
    pos: NDArray
    """Position, world frame, m. (3,)"""
    quat: NDArray
    """Attitude, body to world, xyzw. (4,)"""
    vel: NDArray
    """Velocity, world frame, m/s. (3,)"""
    ang_vel: NDArray
    """Angular velocity, body frame, rad/s. (3,)"""
    acc: NDArray
    """Reading of the accelerometer, body frame, m/s^2: at rest it points up. (3,)"""

    @property
    def rpy(self) -> NDArray:
        """Roll, pitch and yaw, rad. (3,)"""
        return to_rpy(self.quat)
