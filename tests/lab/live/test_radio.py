"""Links to real drones: the simulator's commands over cflib, and no packet without arm=True."""

import socket

import jax
import numpy as np
import pytest

from crazysim import Sim
from crazysim.envs import make
from crazysim.errors import ConfigError
from crazysim.lab.live.crtp import add_cflib_driver, remove_cflib_driver
from crazysim.lab.live.link import SimLink, TrainedPolicy, fly_policy
from crazysim.lab.live.mocap import Frame
from crazysim.lab.live.radio import Radio
from crazysim.lab.live.swarm import DroneState, Swarm
from crazysim.train.export import describe

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:cflib", "ignore::DeprecationWarning:usb")


def create_swarm(control, **settings):
    sim = Sim(control=control, drone="cf21B_500", **settings)
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos + np.array([0.0, 0.0, 1.0])))
    return Swarm(sim, ["cf1"])


class RecordedRadio:
    """A swarm that cflib reaches through a driver that records the packets."""

    def __init__(self, control):
        self.swarm = create_swarm(control)
        self.uri = add_cflib_driver(self.swarm)[0]
        self.packets = []

    def __enter__(self):
        from cflib.crazyflie import Crazyflie

        self.swarm.start(speed=2.0)
        self.crazyflie = Crazyflie()
        self.crazyflie.packet_sent.add_callback(lambda pk: self.packets.append((pk.port, pk.channel, bytes(pk.data))))
        return self

    def __exit__(self, *_):
        remove_cflib_driver(self.swarm)
        self.swarm.close()

    def commands(self):
        """Packets that move the drone: setpoints, high-level commands, arming, positions, parameters."""
        return [p for p in self.packets if p[0] in (3, 6, 7, 8, 9) or (p[0], p[1]) in ((13, 0), (2, 2))]


def test_nothing_is_sent_without_arming(monkeypatch):
    def refuse(*args):
        raise AssertionError("a connection was opened")

    with RecordedRadio("attitude") as radio:
        import cflib.crtp

        monkeypatch.setattr(cflib.crtp, "get_link_driver", refuse)
        monkeypatch.setattr(socket.socket, "connect", refuse)
        with Radio(radio.uri, crazyflie=radio.crazyflie) as link:
            for level, size in (("state", 16), ("attitude", 4), ("body_rate", 4)):
                with pytest.raises(ConfigError, match="arm=True"):
                    link.command(level, np.ones(size) * 0.1)
            with pytest.raises(ConfigError, match="arm=True"):
                link.state()
            with pytest.raises(ConfigError, match="arm=True"):
                link.send_pose(Frame.of(0.0, {"cf1": ((0, 0, 1), (0, 0, 0, 1))}), "cf1")
            with pytest.raises(ConfigError, match="arm=True"):
                fly_policy(link, lambda state: np.zeros(4), 1.0, 50)
            link.stop()
    assert radio.packets == []


@pytest.mark.parametrize(
    "level, values, error",
    [
        ("state", np.zeros(4), "16 finite numbers"),
        ("state", np.full(16, np.nan), "16 finite numbers"),
        ("state", [0, 0, 9.0] + [0] * 9 + [1, 0, 0, 0], "setpoint below 2.0 m"),
        ("state", [0, 0, 1.0] + [0] * 13, "unit quaternion"),
        ("rotor_vel", np.zeros(4), "level state, attitude or body_rate"),
        ("attitude", [0, 0, np.inf, 0], "4 finite numbers"),
    ],
)
def test_wrong_commands_are_refused_before_they_are_sent(level, values, error):
    with pytest.raises(ConfigError, match=error):
        Radio("radio://0/80/2M").command(level, values)


def test_state_commands_arrive_as_they_were_sent():
    with RecordedRadio("state") as radio, Radio(radio.uri, arm=True, crazyflie=radio.crazyflie) as link:
        command = np.zeros(16)
        command[:9] = [-0.5, 0.123, 1.0, 0.4, -0.3, 0.2, 0.1, 0.0, -0.1]
        command[9:13], command[13:] = [0.0, 0.0, np.sin(0.4), np.cos(0.4)], [0.1, -0.2, 0.3]
        link.command("state", command)
        kind, values = radio.swarm["cf1"]._stream
        assert kind == "command"
        np.testing.assert_allclose(values[:9], command[:9], atol=1e-3)
        np.testing.assert_allclose(values[9:13], command[9:13], atol=2e-3)
        np.testing.assert_allclose(values[13:], command[13:], atol=1e-3)
        link.send_pose(Frame.of(0.0, {"cf1": ((0, 0, 1), (0, 0, 0, 1))}), "cf1")
        with pytest.raises(ConfigError, match="expected one of the bodies"):
            link.send_pose(Frame.of(0.0, {"cf1": ((0, 0, 1), (0, 0, 0, 1))}), "cf2")
    assert (9, 1, b"\x01\x01") in radio.commands()  # armed
    assert not radio.swarm["cf1"].motors_on  # stopped at the end


@pytest.mark.parametrize("level, values", [("attitude", [0.2, -0.1, 0.3, 0.4]), ("body_rate", [0.5, -0.4, 0.3, 0.4])])
def test_signs_and_units_of_attitudes_and_rates(level, values):
    with RecordedRadio(level) as radio, Radio(radio.uri, arm=True, crazyflie=radio.crazyflie) as link:
        for _ in range(200):  # until the modes have been set
            link.command(level, values)
            stream = radio.swarm["cf1"]._stream
            if stream is not None and stream[0] == "command":
                break
            link.sleep(0.01)
        np.testing.assert_allclose(stream[1], values, atol=2e-5)
    first = next(data for port, _, data in radio.packets if port == 3)
    assert first == bytes(14)  # unlocks the thrust


def hover(state):
    """Hover at (0, 0, 1) by roll, pitch and thrust."""
    error = np.array([0.0, 0.0, 1.0]) - state.pos
    acc = 4.0 * error - 3.0 * state.vel
    thrust = 0.0434 * (9.81 + acc[2])
    return [-acc[1] / 9.81, acc[0] / 9.81, 0.0, thrust]


def test_a_policy_flies_a_simulated_and_a_radio_link():
    simulated = SimLink(create_swarm("attitude"))
    states = fly_policy(simulated, hover, 2.0, 100)
    np.testing.assert_allclose(states[-1].pos, [0, 0, 1], atol=0.05)
    with RecordedRadio("attitude") as radio:
        radio.swarm.close()  # started again below, in real time
        radio.swarm.start(1.0)
        with Radio(radio.uri, arm=True, crazyflie=radio.crazyflie) as link:
            radio.swarm.sim.reset()
            fly_policy(link, hover, 1.5, 100)
            state = link.state()
    np.testing.assert_allclose(state.pos, [0, 0, 1], atol=0.3)


def test_a_failing_policy_stops_the_motors():
    link = SimLink(create_swarm("attitude"))

    def policy(state):
        if state.time > 0.1:
            raise RuntimeError("lost")
        return hover(state)

    with pytest.raises(RuntimeError, match="lost"):
        fly_policy(link, policy, 1.0, 100)
    assert not link.swarm["cf1"].motors_on


def test_trained_policies_get_their_observations():
    received = {}

    def policy(observations):
        received.update(observations)
        return np.array([2.0, 0.0, -0.5, 0.5])

    meta = {
        "observations": {"ang_vel": 3, "difference_to_goal": 3, "pos": 3, "rot": 9, "vel": 3},
        "actions": {"level": "attitude", "centre": [0, 0, 0, 0.4], "scale": [0.5, 0.5, 0.1, 0.2]},
    }
    link = SimLink(create_swarm("attitude"))
    command = TrainedPolicy(policy, meta, goal=[1, 2, 3])(link.state())
    np.testing.assert_allclose(command, [0.5, 0.0, -0.05, 0.5])
    np.testing.assert_allclose(received["difference_to_goal"], [1, 2, 2])
    np.testing.assert_allclose(received["rot"], np.eye(3).reshape(9))
    with pytest.raises(ConfigError, match="got gates"):
        TrainedPolicy(policy, meta | {"observations": {"gates": 3}})


def test_observations_over_a_link_equal_those_of_the_task():
    env = make("hover", 1)
    step = jax.jit(env.reset)(jax.random.key(3))
    states, received = step.data.states, {}
    values = [np.asarray(x[0, 0], float) for x in (states.pos, states.quat, states.vel, states.ang_vel)]
    goal = values[0] + np.asarray(step.obs["difference_to_goal"])[0, 0]

    def policy(observations):
        received.update(observations)
        return np.zeros(4)

    TrainedPolicy(policy, describe(env), goal)(DroneState(0.0, *values, np.zeros(3)))
    assert sorted(received) == sorted(step.obs)
    for name, value in received.items():
        np.testing.assert_allclose(value, np.asarray(step.obs[name])[0, 0], atol=1e-5)
