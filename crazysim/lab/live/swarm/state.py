"""States of drones, simulated and real, and the frame of a drone's estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.control import Control
from crazysim.lab.live.attitude import from_yaw, multiply, rotate, to_rpy


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


class EstimateFrame(NamedTuple):
    """Turn about the vertical and shift from the world to the frame of a drone's estimate.

    Without absolute positioning, as with a Flow deck, the estimate is the pose at which the estimator was started
    (``kalmanCoreInit`` in kalman_core.c of crazyflie-firmware) and the motion since then; commands are relative to it.
    """

    turn: float
    """Angle about the vertical, rad."""
    shift: NDArray
    """Position of the world's origin in the frame of the estimate, m. (3,)"""

    @staticmethod
    def from_pose(pos: NDArray, yaw: float, pose: NDArray) -> EstimateFrame:
        """Return the frame in which a drone at a position, m, and yaw, rad, of the world has a pose (4,)."""
        turn = float(pose[3]) - yaw
        return EstimateFrame(turn, pose[:3] - rotate(from_yaw(turn), pos))

    def state(self, state: DroneState) -> DroneState:
        """Return the state of a drone in this frame."""
        quat = from_yaw(self.turn)
        return state._replace(
            pos=rotate(quat, state.pos) + self.shift, quat=multiply(quat, state.quat), vel=rotate(quat, state.vel)
        )

    def motion(self, pos: NDArray, vel: NDArray, yaw: float) -> tuple[NDArray, NDArray, float]:
        """Return position, m, velocity, m/s, and yaw, rad, in this frame."""
        quat = from_yaw(self.turn)
        return rotate(quat, pos) + self.shift, rotate(quat, vel), yaw + self.turn

    def command(self, level: Control, command: NDArray) -> NDArray:
        """Return a command in the world's frame."""
        if level == Control.attitude:
            return command - [0.0, 0.0, self.turn, 0.0]
        if level != Control.state:
            return command
        inverse_turn = from_yaw(-self.turn)
        pos, vel, acc = (rotate(inverse_turn, x) for x in (command[:3] - self.shift, command[3:6], command[6:9]))
        return np.concatenate([pos, vel, acc, multiply(inverse_turn, command[9:13]), command[13:]])
