"""ROS 2 bridge: publishes the clock, states of drones and poses of objects, and receives commands.

The package does not depend on ROS. ``RosBridge`` takes a node and the message classes that it uses; without classes it
imports them from the ROS installation in which it runs.

| Topic | Message | |
| --- | --- | --- |
| `/clock` | `rosgraph_msgs/Clock` | simulated time |
| `/NAME/pose` | `geometry_msgs/PoseStamped` | pose of a drone or object in the frame `world` |
| `/NAME/odom` | `nav_msgs/Odometry` | pose in `world`, linear and angular velocity in the body frame |
| `/NAME/imu` | `sensor_msgs/Imu` | attitude, angular velocity, specific force |
| `/NAME/cmd_vel` | `geometry_msgs/Twist` | velocity, world frame, and yaw rate |
| `/NAME/cmd_pose` | `geometry_msgs/PoseStamped` | position and yaw |
| `/NAME/cmd_thrust` | `std_msgs/Float64` | collective thrust of the next attitude commands, N |
| `/NAME/cmd_attitude` | `geometry_msgs/QuaternionStamped` | attitude, with the latest thrust |
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.control import Control
from crazysim.errors import ConfigError, require
from crazysim.lab.live.attitude import rotate, to_rpy
from crazysim.lab.live.loop import Live
from crazysim.lab.live.swarm import DroneState, Swarm

MESSAGE_MODULES = {
    "Clock": "rosgraph_msgs.msg",
    "Time": "builtin_interfaces.msg",
    "PoseStamped": "geometry_msgs.msg",
    "QuaternionStamped": "geometry_msgs.msg",
    "Twist": "geometry_msgs.msg",
    "Odometry": "nav_msgs.msg",
    "Imu": "sensor_msgs.msg",
    "Float64": "std_msgs.msg",
}
"""ROS modules that contain the message classes, by the name of the class."""
QUEUE_LENGTH = 10
"""Length of the queues of publishers and subscriptions."""


def import_message_classes() -> Any:
    try:
        messages = {name: getattr(importlib.import_module(package), name) for name, package in MESSAGE_MODULES.items()}
    except ImportError as error:
        raise ConfigError(
            f"messages need ROS 2, which is not installed ({error}). Source its setup file, or pass messages=."
        ) from error
    return SimpleNamespace(**messages)


class RosBridge:
    """Bridge between ROS topics and the drones of a swarm; it also publishes poses of objects.

        rclpy.init()
        bridge = RosBridge(swarm, rclpy.create_node("crazysim"))
        while rclpy.ok():
            rclpy.spin_once(bridge.node, timeout_sec=0)
            bridge.update()
            swarm.advance(0.01)

    Commands are carried out in the callbacks of the node.
    """

    def __init__(
        self,
        swarm: Swarm,
        node: Any,
        messages: Any = None,
        objects: Sequence[str] = (),
        freq: float = 100.0,
        frame: str = "world",
    ):
        require(0 < freq < math.inf, f"expected a positive rate of messages, got {freq} Hz")
        self.swarm, self.node, self.frame = swarm, node, frame
        self.messages = m = import_message_classes() if messages is None else messages
        names = swarm.sim.data.objects.names if swarm.sim.data.objects is not None else ()
        for name in objects:
            require(name in names, f"expected one of the movable objects {list(names)}, got {name!r}")
        self._object_rows = {name: names.index(name) for name in objects}
        self._period, self._next_time = 1 / freq, 0.0
        self._clock_publisher = node.create_publisher(m.Clock, "/clock", QUEUE_LENGTH)
        message_types = {"pose": m.PoseStamped, "odom": m.Odometry, "imu": m.Imu}
        self._publishers = [
            {
                topic: node.create_publisher(message_type, f"/{name}/{topic}", QUEUE_LENGTH)
                for topic, message_type in message_types.items()
            }
            for name in swarm.names
        ]
        self._object_publishers = {
            name: node.create_publisher(m.PoseStamped, f"/{name.replace(':', '_')}/pose", QUEUE_LENGTH)
            for name in objects
        }
        self._thrust = np.zeros(len(swarm.names))
        for k, name in enumerate(swarm.names):
            for topic, message_type, callback in (
                ("cmd_vel", m.Twist, self._command_velocity),
                ("cmd_pose", m.PoseStamped, self._command_pose),
                ("cmd_thrust", m.Float64, self._set_thrust),
                ("cmd_attitude", m.QuaternionStamped, self._command_attitude),
            ):
                node.create_subscription(
                    message_type, f"/{name}/{topic}", self._guard_callback(k, callback), QUEUE_LENGTH
                )

    def __call__(self, live: Live) -> None:
        del live
        self.update()

    def update(self) -> None:
        """Publish clock and states, if they are due."""
        now = self.swarm.time
        if now < self._next_time - 1e-9 and self._next_time - now <= self._period:
            return
        self._next_time = now + self._period
        stamp = self._make_stamp(now)
        clock = self.messages.Clock()
        clock.clock = stamp
        self._clock_publisher.publish(clock)
        for k, publishers in enumerate(self._publishers):
            state = self.swarm.state(k)
            publishers["pose"].publish(self._make_pose_message(stamp, state.pos, state.quat))
            publishers["odom"].publish(self._make_odometry_message(stamp, state, self.swarm.names[k]))
            publishers["imu"].publish(self._make_imu_message(stamp, state, self.swarm.names[k]))
        if self._object_rows:
            objects = self.swarm.sim.data.objects
            pos, quat = (np.asarray(x[0, 0], float) for x in (objects.pos, objects.quat))
            for name, row in self._object_rows.items():
                self._object_publishers[name].publish(self._make_pose_message(stamp, pos[row], quat[row]))

    # Messages -------------------------------------------------------------------------------------------------------

    def _make_stamp(self, now: float) -> Any:
        stamp = self.messages.Time()
        nanoseconds = round(now * 1e9)
        stamp.sec, stamp.nanosec = nanoseconds // 10**9, nanoseconds % 10**9
        return stamp

    def _make_pose_message(self, stamp: Any, pos: NDArray, quat: NDArray) -> Any:
        message = self.messages.PoseStamped()
        message.header.stamp, message.header.frame_id = stamp, self.frame
        _write_fields(message.pose.position, pos)
        _write_fields(message.pose.orientation, quat)
        return message

    def _make_odometry_message(self, stamp: Any, state: DroneState, name: str) -> Any:
        message = self.messages.Odometry()
        message.header.stamp, message.header.frame_id, message.child_frame_id = stamp, self.frame, name
        _write_fields(message.pose.pose.position, state.pos)
        _write_fields(message.pose.pose.orientation, state.quat)
        _write_fields(message.twist.twist.linear, rotate(state.quat * (-1, -1, -1, 1), state.vel))
        _write_fields(message.twist.twist.angular, state.ang_vel)
        return message

    def _make_imu_message(self, stamp: Any, state: DroneState, name: str) -> Any:
        message = self.messages.Imu()
        message.header.stamp, message.header.frame_id = stamp, name
        _write_fields(message.orientation, state.quat)
        _write_fields(message.angular_velocity, state.ang_vel)
        _write_fields(message.linear_acceleration, state.acc)
        return message

    # Commands -------------------------------------------------------------------------------------------------------

    def _guard_callback(self, drone: int, handler: Callable[[int, Any], None]) -> Callable[[Any], None]:
        def callback(message: Any) -> None:
            with self.swarm.lock:
                try:
                    handler(drone, message)
                except ConfigError as error:
                    self.swarm.reports.add("refused", self.swarm.names[drone], self.swarm.time, str(error))

        return callback

    def _command_velocity(self, drone: int, message: Any) -> None:
        self.swarm.commanders[drone].velocity(_read_fields(message.linear), float(message.angular.z))

    def _command_pose(self, drone: int, message: Any) -> None:
        require(
            message.header.frame_id in ("", self.frame),
            f"expected a pose in the frame {self.frame!r}, got {message.header.frame_id!r}",
        )
        quat = _read_fields(message.pose.orientation, "xyzw")
        self.swarm.commanders[drone].position(_read_fields(message.pose.position), _normalized_rpy(quat)[2])

    def _set_thrust(self, drone: int, message: Any) -> None:
        thrust = float(message.data)
        require(0 <= thrust < math.inf, f"expected a collective thrust of 0 N or more, got {thrust}")
        self._thrust[drone] = thrust

    def _command_attitude(self, drone: int, message: Any) -> None:
        rpy = _normalized_rpy(_read_fields(message.quaternion, "xyzw"))
        self.swarm.commanders[drone].command(Control.attitude, [*rpy, self._thrust[drone]])


def _write_fields(part: Any, values: NDArray) -> None:
    for name, value in zip("xyzw", values.tolist(), strict=False):
        setattr(part, name, value)


def _read_fields(part: Any, names: str = "xyz") -> NDArray:
    return np.array([getattr(part, name) for name in names], float)


def _normalized_rpy(quat: NDArray) -> NDArray:
    norm = float(np.linalg.norm(quat))
    if not 1e-3 < norm < math.inf:
        raise ConfigError(f"expected a unit quaternion, xyzw, got {quat.tolist()}")
    return to_rpy(quat / norm)
