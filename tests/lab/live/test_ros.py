"""The ROS 2 bridge, with a stand-in for its message classes and its node."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from crazysim import Sim, rotation
from crazysim.errors import ConfigError
from crazysim.lab.live.attitude import from_rpy
from crazysim.lab.live.ros import MESSAGE_MODULES, RosBridge, import_message_classes
from crazysim.lab.live.swarm import Swarm


class Part:
    """A part of a message: only existing fields can be set, with values of their type."""

    def __init__(self, **fields):
        object.__setattr__(self, "fields", fields)

    def __getattr__(self, name):
        try:
            return self.fields[name]
        except KeyError:
            raise AttributeError(name) from None

    def __setattr__(self, name, value):
        if name not in self.fields:
            raise AttributeError(name)
        assert type(value) is type(self.fields[name]) or isinstance(value, Part), (name, value)
        self.fields[name] = value


def make_vector():
    return Part(x=0.0, y=0.0, z=0.0)


def make_quaternion():
    return Part(x=0.0, y=0.0, z=0.0, w=1.0)


def make_stamp():
    return Part(sec=0, nanosec=0)


def make_header():
    return Part(stamp=make_stamp(), frame_id="")


def make_pose():
    return Part(position=make_vector(), orientation=make_quaternion())


def make_twist():
    return Part(linear=make_vector(), angular=make_vector())


STAND_IN = SimpleNamespace(
    Time=make_stamp,
    Clock=lambda: Part(clock=make_stamp()),
    PoseStamped=lambda: Part(header=make_header(), pose=make_pose()),
    QuaternionStamped=lambda: Part(header=make_header(), quaternion=make_quaternion()),
    Twist=make_twist,
    Odometry=lambda: Part(
        header=make_header(), child_frame_id="", pose=Part(pose=make_pose()), twist=Part(twist=make_twist())
    ),
    Imu=lambda: Part(
        header=make_header(),
        orientation=make_quaternion(),
        angular_velocity=make_vector(),
        linear_acceleration=make_vector(),
    ),
    Float64=lambda: Part(data=0.0),
)


class Node:
    """A node that records published messages, and passes messages to subscriptions."""

    def __init__(self):
        self.sent, self.callbacks = {}, {}

    def create_publisher(self, kind, topic, depth):
        self.sent[topic] = []
        return SimpleNamespace(publish=self.sent[topic].append)

    def create_subscription(self, kind, topic, callback, depth):
        self.callbacks[topic] = lambda fill: callback(fill(kind()))


def make_message_filler(fill):
    def call(message):
        fill(message)
        return message

    return call


@pytest.fixture(scope="module")
def swarm():
    sim = Sim(n_drones=2, control="state")
    sim.scene.add("box", "car", pos=[1.0, 2.0, 0.1])
    return Swarm(sim)


@pytest.fixture
def bridge(swarm):
    swarm.sim.reset()
    swarm.advance(0.02)
    swarm.reports.latest.clear()
    return RosBridge(swarm, Node(), STAND_IN, objects=["car:0"], freq=50.0)


def test_the_stand_in_has_the_classes_of_ros():
    assert set(vars(STAND_IN)) == set(MESSAGE_MODULES)
    with pytest.raises(ConfigError, match="need ROS 2, which is not installed"):
        import_message_classes()


def test_poses_speeds_and_clock(swarm, bridge):
    swarm["cf2"].take_off(0.5, 1.0)
    swarm["cf2"].go_to([0.5, 0.5, 0.5], 1.0, 1.0)
    for _ in range(50):
        bridge.update()
        swarm.advance(0.01)
    bridge.update()
    sent, state = bridge.node.sent, swarm.state("cf2")
    assert len(sent["/clock"]) == 26
    assert (sent["/clock"][-1].clock.sec, sent["/clock"][-1].clock.nanosec) == (0, 520_000_000)
    last = sent["/cf2/pose"][-1]
    assert last.header.frame_id == "world"
    np.testing.assert_allclose([last.pose.position.x, last.pose.position.y, last.pose.position.z], state.pos)
    np.testing.assert_allclose(last.pose.orientation.w, state.quat[3])
    odometry = sent["/cf2/odom"][-1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("world", "cf2")
    linear_vel = odometry.twist.twist.linear
    assert state.rpy[2] > 0.05
    body_vel = np.asarray(rotation.matrix(state.quat)).T @ state.vel
    np.testing.assert_allclose([linear_vel.x, linear_vel.y, linear_vel.z], body_vel, atol=1e-4)
    assert abs(linear_vel.y - state.vel[1]) > 0.01
    assert odometry.twist.twist.angular.z == state.ang_vel[2]
    accel = sent["/cf1/imu"][-1].linear_acceleration
    np.testing.assert_allclose([accel.x, accel.y, accel.z], [0, 0, 9.81], atol=0.1)
    assert sent["/cf1/imu"][-1].header.frame_id == "cf1"
    car = sent["/car_0/pose"][-1].pose.position
    np.testing.assert_allclose([car.x, car.y, car.z], [1, 2, 0.1], atol=1e-6)


def test_messages_command_the_drones(swarm, bridge):
    def climb(message):
        message.linear.z, message.angular.z = 0.5, 0.3

    def hold_position(message):
        message.header.frame_id = "world"
        message.pose.position.z = 0.8
        message.pose.position.x = -0.5
        message.pose.position.y = -0.5
        message.pose.orientation.z, message.pose.orientation.w = 2 * math.sin(0.4), 2 * math.cos(0.4)

    for _ in range(100):
        bridge.node.callbacks["/cf2/cmd_vel"](make_message_filler(climb))
        bridge.node.callbacks["/cf1/cmd_pose"](make_message_filler(hold_position))
        swarm.advance(0.02)
    assert swarm.state("cf2").pos[2] > 0.7
    assert swarm.state("cf2").rpy[2] == pytest.approx(0.6, abs=0.1)
    np.testing.assert_allclose(swarm.state("cf1").pos[2], 0.8, atol=0.12)
    assert swarm.state("cf1").rpy[2] == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize(
    "topic, fill, reason",
    [
        ("cmd_vel", lambda m: setattr(m.linear, "x", math.nan), "finite"),
        ("cmd_pose", lambda m: setattr(m.pose.orientation, "w", 0.0), "unit quaternion"),
        ("cmd_pose", lambda m: setattr(m.header, "frame_id", "map"), "frame 'world'"),
        ("cmd_thrust", lambda m: setattr(m, "data", -1.0), "0 N or more"),
        ("cmd_attitude", lambda m: None, "of level 'attitude'"),
    ],
)
def test_wrong_commands_are_reported(swarm, bridge, topic, fill, reason):
    bridge.node.callbacks[f"/cf1/{topic}"](make_message_filler(fill))
    (report,) = swarm.reports.latest
    assert (report.kind, report.name) == ("refused", "cf1")
    assert reason in report.text


def test_attitudes_and_thrust():
    swarm = Swarm(Sim(control="attitude"))
    bridge = RosBridge(swarm, Node(), STAND_IN)

    def tilt(message):
        for name, value in zip("xyzw", from_rpy([0.1, -0.2, 0.3]), strict=True):
            setattr(message.quaternion, name, float(value))

    bridge.node.callbacks["/cf1/cmd_thrust"](make_message_filler(lambda m: setattr(m, "data", 0.4)))
    bridge.node.callbacks["/cf1/cmd_attitude"](make_message_filler(tilt))
    command = swarm["cf1"].tick(0.0, np.zeros(3), np.zeros(3), 0.0)
    np.testing.assert_allclose(command, [0.1, -0.2, 0.3, 0.4], atol=1e-9)


def test_wrong_arguments_of_a_bridge_are_refused(swarm):
    with pytest.raises(ConfigError, match="movable objects"):
        RosBridge(swarm, Node(), STAND_IN, objects=["bus"])
    with pytest.raises(ConfigError, match="positive rate"):
        RosBridge(swarm, Node(), STAND_IN, freq=0.0)
