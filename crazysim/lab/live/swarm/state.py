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
    """Frame of a drone's estimate: the world's frame, turned about the vertical and shifted.

    Without absolute positioning, as with a Flow deck, the estimate starts at an initial pose (``kalmanCoreInit`` in
    kalman_core.c of crazyflie-firmware) and adds the motion since then. Commands are in the frame of the estimate.
    """

    yaw_offset: float
    """Yaw in this frame minus yaw in the world, rad."""
    origin: NDArray
    """Position of the world's origin in this frame, m. (3,)"""

    @staticmethod
    def from_pose(pos: NDArray, yaw: float, pose: NDArray) -> EstimateFrame:
        """Return the frame in which a drone has a pose.

        Args:
            pos: Position, world frame, m. (3,)
            yaw: Yaw, world frame, rad.
            pose: Position, m, and yaw, rad, in the new frame. (4,)
        """
        yaw_offset = float(pose[3]) - yaw
        return EstimateFrame(yaw_offset, pose[:3] - rotate(from_yaw(yaw_offset), pos))

    def state_to_estimate(self, state: DroneState) -> DroneState:
        """Return a drone's state in this frame, from its state in the world's frame."""
        quat = from_yaw(self.yaw_offset)
        return state._replace(
            pos=rotate(quat, state.pos) + self.origin, quat=multiply(quat, state.quat), vel=rotate(quat, state.vel)
        )

    def motion_to_estimate(self, pos: NDArray, vel: NDArray, yaw: float) -> tuple[NDArray, NDArray, float]:
        """Return position, m, velocity, m/s, and yaw, rad, in this frame, from values in the world's frame."""
        quat = from_yaw(self.yaw_offset)
        return rotate(quat, pos) + self.origin, rotate(quat, vel), yaw + self.yaw_offset

    def command_to_world(self, level: Control, command: NDArray) -> NDArray:
        """Return a command in the world's frame, from a command in this frame."""
        if level == Control.attitude:
            return command - [0.0, 0.0, self.yaw_offset, 0.0]
        if level != Control.state:
            return command
        inverse_quat = from_yaw(-self.yaw_offset)
        pos, vel, acc = (rotate(inverse_quat, x) for x in (command[:3] - self.origin, command[3:6], command[6:9]))
        return np.concatenate([pos, vel, acc, multiply(inverse_quat, command[9:13]), command[13:]])
