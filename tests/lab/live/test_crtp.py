"""Simulated Crazyflies that speak CRTP: scripts of cflib, and packets of any content."""

import errno
import math
import socket
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import wait_for

from crazysim import Sim
from crazysim.core.pipeline import append_fn
from crazysim.errors import ConfigError
from crazysim.lab.live.attitude import decompress_quat
from crazysim.lab.live.crtp import CrtpDevice, CrtpServer, add_cflib_driver, remove_cflib_driver
from crazysim.lab.live.crtp.tables import LOG_TYPES, LOG_VARIABLES, Table, Variable, pack_number
from crazysim.lab.live.swarm import DroneState, Swarm
from crazysim.plugins.estimators import Kalman
from crazysim.plugins.sensors import IMU, MotionCapture, MultiRanger, Triad
from crazysim.plugins.sensors.range_finder import RangeFinder

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:cflib", "ignore::DeprecationWarning:usb")

MAX_DISTANCE = 0.02
"""Largest distance of a drone from its setpoint a second after a move, m."""


@pytest.fixture(scope="module")
def swarm():
    return Swarm(Sim(n_drones=2, control="state"))


@pytest.fixture
def running_swarm(swarm, request):
    """Return the swarm on the floor, advanced by a thread at a multiple of real time."""
    swarm.sim.reset()
    swarm.advance(0.02)
    swarm.reports.latest.clear()
    with swarm.start(speed=getattr(request, "param", 8.0)):
        yield swarm


@pytest.fixture
def uri(running_swarm):
    yield add_cflib_driver(running_swarm)[0]
    remove_cflib_driver(running_swarm)


def test_the_high_level_commander(running_swarm, uri):
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    with SyncCrazyflie(uri) as scf:
        commander = scf.cf.high_level_commander
        commander.takeoff(0.8, 1.5)
        running_swarm.sleep(2.5)
        assert running_swarm.state(0).pos[2] == pytest.approx(0.8, abs=MAX_DISTANCE)
        commander.go_to(0.4, 0.0, 0.0, np.pi / 2, 1.5, relative=True)
        running_swarm.sleep(2.5)
        np.testing.assert_allclose(running_swarm.state(0).pos[:2], [-0.1, -0.5], atol=0.05)
        assert running_swarm.state(0).rpy[2] == pytest.approx(np.pi / 2, abs=0.05)
        assert scf.cf.supervisor.hl_traj_finished
        commander.land(0.0, 1.5)
        running_swarm.sleep(2.5)
        assert running_swarm.state(0).pos[2] < 0.02
        assert not scf.cf.supervisor.is_flying


def test_accelerations_are_logged_in_the_frames_of_the_firmware():
    """A drone that pitches by 90 degrees, with its thrust along x of the world, falls: -1 g along z."""
    sqrt_half = math.sqrt(0.5)
    state = DroneState(
        0.0, np.zeros(3), np.array([0, sqrt_half, 0, sqrt_half]), np.zeros(3), np.zeros(3), np.array([0, 0, 9.81])
    )
    logged = {
        name: LOG_VARIABLES[name][1](state, None)
        for name in LOG_VARIABLES
        if name.startswith(("stateEstimate.a", "acc."))
    }
    assert list(logged.values()) == pytest.approx([1, 0, -1, 0, 0, 1], abs=1e-3)
    assert list(logged) == [f"stateEstimate.a{axis}" for axis in "xyz"] + [f"acc.{axis}" for axis in "xyz"]


def test_log_configurations_and_the_synchronous_logger(running_swarm, uri):
    from cflib.crazyflie.log import LogConfig
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
    from cflib.crazyflie.syncLogger import SyncLogger

    config = LogConfig(name="position", period_in_ms=50)
    config.add_variable("stateEstimate.x", "float")
    config.add_variable("stateEstimate.z")
    config.add_variable("stabilizer.yaw", "FP16")
    config.add_variable("pm.batteryLevel", "uint8_t")
    other, received = LogConfig(name="other", period_in_ms=100), []
    other.add_variable("kalman.varPX", "float")
    other.data_received_cb.add_callback(lambda stamp, data, block: received.append((stamp, data, block.name)))
    with SyncCrazyflie(uri) as scf:
        scf.cf.log.add_config(other)
        other.start()
        with SyncLogger(scf, config) as logger:
            entries = [next(logger) for _ in range(6)]
        other.stop()
        wrong = LogConfig(name="wrong", period_in_ms=50)
        wrong.add_variable("no.thing", "float")
        with pytest.raises(KeyError, match=r"no\.thing"):
            scf.cf.log.add_config(wrong)
    stamps, data, _ = zip(*entries, strict=True)
    np.testing.assert_array_equal(np.diff(stamps), 50)
    expected = {"stateEstimate.x": -0.5, "stateEstimate.z": -0.001, "stabilizer.yaw": 0.0, "pm.batteryLevel": 100}
    assert data[0] == pytest.approx(expected, abs=1e-3)
    assert len(received) >= 2
    assert received[0][2] == "other"


def test_parameters_are_set_and_read(running_swarm, uri):
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    with SyncCrazyflie(uri) as scf:
        scf.wait_for_params()
        param, called = scf.cf.param, []
        param.add_update_callback("ring", "solidRed", lambda name, value: called.append((name, value)))
        assert param.get_value("stabilizer.estimator") == "2"
        param.set_value("ring.effect", 7)
        param.set_value("ring.solidBlue", 0)
        param.set_value_raw("ring.solidGreen", 0x08, 255)
        param.set_value("ring.solidRed", 51)
        with pytest.raises(AttributeError, match="read-only"):
            param.set_value("deck.bcFlow2", 0)
        wait_for(lambda: called)
    assert called == [("ring.solidRed", "51")]
    np.testing.assert_allclose(running_swarm.colors[0], [0.2, 1.0, 0.0])


def test_a_parameter_that_is_not_simulated_keeps_its_value_and_is_reported(running_swarm, uri):
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    with SyncCrazyflie(uri) as scf:
        scf.wait_for_params()
        read_back, lines = [], []
        scf.cf.console.receivedChar.add_callback(lines.append)
        scf.cf.param.add_update_callback("pid_attitude", "pitch_kd", lambda name, value: read_back.append(value))
        scf.cf.param.set_value("pid_attitude.pitch_kd", 0.1234)
        wait_for(lambda: read_back and "\n" in "".join(lines))
        with pytest.raises(KeyError, match=r"no\.thing"):
            scf.cf.param.set_value("no.thing", 1)
    assert [float(value) for value in read_back] == [0.0]
    assert "pid_attitude.pitch_kd = 0.1234; it stays 0. The guide" in "".join(lines)


def test_a_reset_of_the_estimator_sets_the_initial_pose(running_swarm, uri):
    """A drone at (-0.5, -0.5), yaw 0, whose estimate is reset to (1, 1), yaw 90 degrees: its x is the world's -y."""
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
    from cflib.utils.reset_estimator import reset_estimator

    with SyncCrazyflie(uri) as scf:
        for name, value in {"X": 1.0, "Y": 1.0, "Z": 0.0, "Yaw": np.pi / 2}.items():
            scf.cf.param.set_value(f"kalman.initial{name}", value)
        reset_estimator(scf)
        commander = scf.cf.high_level_commander
        commander.takeoff(0.6, 1.5, yaw=None)
        running_swarm.sleep(2.0)
        commander.go_to(0.6, 1.0, 0.6, np.pi / 2, 1.5)
        running_swarm.sleep(2.5)
        np.testing.assert_allclose(running_swarm.state(0).pos[:2], [-0.5, -0.1], atol=0.05)
        assert running_swarm.state(0).rpy[2] == pytest.approx(0.0, abs=0.05)
        estimate = running_swarm["cf1"].estimate(running_swarm.state(0))
        np.testing.assert_allclose(estimate.pos[:2], [0.6, 1.0], atol=0.05)
        commander.stop()


def test_clients_read_decks_and_memories(running_swarm, uri):
    from cflib.crazyflie.mem import MemoryElement
    from cflib.crazyflie.mem.deck_memory import SyncDeckMemoryManager
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    with SyncCrazyflie(uri) as scf:
        scf.wait_for_params()
        assert scf.cf.param.get_value("deck.bcColorLedBot") == "1"
        assert scf.cf.param.get_value("deck.bcMultiranger") == "0"
        (decks,) = scf.cf.mem.get_mems(MemoryElement.TYPE_DECK_MEMORY)
        assert SyncDeckMemoryManager(decks).query_decks() == {}
        (leds,) = scf.cf.mem.get_mems(MemoryElement.TYPE_DRIVER_LED)
        scf.cf.param.set_value("ring.effect", 13)
        for led in leds.leds:
            led.set(255, 0, 255)
        leds.write_data(None)
        wait_for(lambda: running_swarm.colors[0, 0] == 1)
    np.testing.assert_allclose(running_swarm.colors[0], [1, 0, 1])


@pytest.mark.parametrize("compressed", [False, True])
def test_uploaded_trajectories(running_swarm, uri, compressed):
    from cflib.crazyflie.mem import CompressedSegment, CompressedStart, MemoryElement, Poly4D
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    if compressed:
        pieces = [CompressedStart(0, 0, 0, 0), CompressedSegment(1.5, [0, 0.6, 0.6], [], [], []),
                  CompressedSegment(0, [], [], [], [])]  # fmt: skip
    else:
        x = Poly4D.Poly(np.array([0, 0, 0, 0, 35, -84, 70, -20]) * 0.6 / 1.5 ** np.arange(8))
        pieces = [Poly4D(1.5, x)]
    with SyncCrazyflie(uri) as scf:
        memory = scf.cf.mem.get_mems(MemoryElement.TYPE_TRAJ)[0]
        memory.trajectory = pieces
        assert memory.write_data_sync(start_addr=0x40)
        commander = scf.cf.high_level_commander
        commander.define_trajectory(1, 0x40, len(pieces), type=int(compressed))
        commander.takeoff(0.6, 1.5)
        running_swarm.sleep(2.0)
        commander.start_trajectory(1, 1.0, relative_position=True)
        running_swarm.sleep(2.5)
        np.testing.assert_allclose(running_swarm.state(0).pos[:2], [0.1, -0.5], atol=0.05)
        assert not running_swarm.reports.latest
        commander.start_trajectory(1, 2.0, relative_position=True)
        running_swarm.sleep(1.0)
        commander.stop()
    # As in the firmware, which does not stretch compressed trajectories.
    assert ["timescale 2" in report.text for report in running_swarm.reports.latest] == [True] * compressed


@pytest.mark.parametrize("running_swarm", [4.0], indirect=True)  # a stream must not be late
def test_motion_commander_and_streamed_setpoints(running_swarm, uri):
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    with SyncCrazyflie(uri) as scf:
        commander = scf.cf.commander
        for _ in range(20):
            commander.send_position_setpoint(-0.5, -0.5, 0.7, 0.0)
            running_swarm.sleep(0.1)
        assert running_swarm.state(0).pos[2] == pytest.approx(0.7, abs=MAX_DISTANCE)
        for _ in range(10):
            commander.send_hover_setpoint(0.3, 0.0, 0.0, 0.7)
            running_swarm.sleep(0.1)
        assert running_swarm.state(0).pos[0] > -0.45
        yaw = running_swarm.state(0).rpy[2]
        for _ in range(10):
            commander.send_velocity_world_setpoint(0.0, 0.0, 0.0, 45.0)
            running_swarm.sleep(0.1)
        assert running_swarm.state(0).rpy[2] > yaw + 0.2  # positive turns to the left
        commander.send_stop_setpoint()
        running_swarm.sleep(0.5)
        assert not running_swarm["cf1"].motors_on


def test_scripts_use_udp_with_a_changed_uri(running_swarm):
    import cflib.crtp
    from cflib.crazyflie.swarm import CachedCfFactory
    from cflib.crazyflie.swarm import Swarm as CfSwarm

    cflib.crtp.CLASSES.clear()
    cflib.crtp.init_drivers()
    try:
        with CrtpServer(running_swarm, port=0) as server:
            assert all(address.startswith("udp://127.0.0.1:") for address in server.uris)
            with CfSwarm(set(server.uris), factory=CachedCfFactory(rw_cache=None)) as drones:
                drones.parallel_safe(lambda scf: scf.cf.high_level_commander.takeoff(0.6, 1.5))
                running_swarm.sleep(2.5)
                positions = drones.get_estimated_positions()
                for k, address in enumerate(server.uris):
                    np.testing.assert_allclose(positions[address], running_swarm.state(k).pos, atol=0.1)
                    assert running_swarm.state(k).pos[2] > 0.4
            running_swarm.sleep(2.0)
            assert running_swarm.state(0).pos[2] < 0.1  # cflib stops the motors when it disconnects
    finally:
        cflib.crtp.CLASSES.clear()


def test_scanning_lists_the_drones(running_swarm, uri):
    import cflib.crtp

    assert cflib.crtp.CLASSES[0]().scan_interface() == [["sim://cf1", ""], ["sim://cf2", ""]]
    with pytest.raises(cflib.crtp.WrongUriType):
        cflib.crtp.CLASSES[0]().connect("sim://cf9", None, None)
    with pytest.raises(cflib.crtp.WrongUriType):
        cflib.crtp.CLASSES[0]().connect("radio://0/80", None, None)


def test_the_range_finder_is_a_multi_ranger():
    sim = Sim(control="state")
    sim.add(RangeFinder(directions=[[0, 0, -2.0], [1, 0, 0], [1, 1, 0]], max_range=2.0))
    sim.build_default_data()
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(1.25)))
    swarm = Swarm(sim)
    device = CrtpDevice(swarm, 0)
    swarm.advance(0.02)
    assert device.param_values["deck.bcMultiranger"] == 1
    assert sorted(name for name in device.log.ids if name.startswith("range.")) == ["range.front", "range.zrange"]
    state = swarm.state(0)
    assert device.readings["range.zrange"][1](state, swarm["cf1"]) == pytest.approx(1250, abs=5)
    assert device.readings["range.front"][1](state, swarm["cf1"]) == 32767


def test_drones_fly_and_log_what_their_sensors_and_filter_measure():
    imu, tracked = IMU(gyro=Triad(bias=0.1)), MotionCapture(noise=0.002, freq=100)
    sim = Sim(control="state", estimator=Kalman([imu, tracked]))
    sim.add(RangeFinder(directions=[[0, 0, -2.0], [1, 0, 0], [1, 1, 0]], max_range=2.0))
    ranger = sim.add(MultiRanger(noise=0.05, n_rays=3, freq=10))
    sim.build_default_data()
    swarm = Swarm(sim)
    device = CrtpDevice(swarm, 0)

    def logged(*names):
        state = device.commander.estimate(swarm.state(0))
        return [device.readings[name][1](state, swarm["cf1"]) for name in names]

    swarm["cf1"].take_off(0.5, 0.8)
    swarm.advance(1.2)
    observations, states = sim.plugins.observations(sim.data), sim.data.states
    pos = [float(x) for x in observations["kalman.pos"][0, 0]]
    assert logged("stateEstimate.x", "stateEstimate.y", "kalman.stateZ") == pytest.approx(pos, abs=1e-6)
    assert 1e-5 < np.abs(states.pos[0, 0] - np.array(pos)).max() < 0.02  # the estimate has noise
    assert float(states.pos[0, 0, 2]) == pytest.approx(0.5, abs=0.1)
    gyro, accel = (np.asarray(observations[f"imu.{name}"][0, 0]) for name in ("gyro", "accel"))
    assert logged("gyro.x", "gyro.y", "gyro.z") == pytest.approx(np.rad2deg(gyro).tolist(), rel=1e-4)
    assert logged("acc.x", "acc.y", "acc.z") == pytest.approx((accel / 9.81).tolist(), abs=1e-5)
    measured = float(ranger.read(sim.data).samples.value[0, 0, 0])
    assert logged("range.zrange") == pytest.approx([1000 * measured], abs=0.1)
    assert abs(measured - float(states.pos[0, 0, 2])) > 1e-3
    assert logged("range.front") == [32767]


# Servers ------------------------------------------------------------------------------------------------------------


def test_a_server_answers_scans_and_warns_if_a_network_can_reach_it(swarm, caplog):
    with CrtpServer(swarm, port=0) as server:
        assert not caplog.records
        peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        peer.settimeout(60)
        peer.sendto(b"\xff", ("127.0.0.1", int(server.uris[0].rpartition(":")[2])))
        assert peer.recv(100) == b"\xff"
        with pytest.raises(ConfigError, match="expected a free address"):
            CrtpServer(swarm, port=int(server.uris[0].rpartition(":")[2]))
        peer.close()
    with CrtpServer(swarm, host="0.0.0.0", port=0):
        assert "every machine of that network can fly the drones" in caplog.text


@pytest.mark.parametrize("starter", ["server", "thread"])
def test_a_step_is_compiled_before_clients_wait(starter):
    """``aiocflib`` gives up after 0.6 s without an answer; compilation of a step takes longer."""
    sim, traces = Sim(control="state", engine="interpret"), []
    append_fn(sim.step_pipeline, lambda data: (traces.append(1), data)[1], "traced")
    swarm = Swarm(sim)
    service = CrtpServer(swarm, port=0) if starter == "server" else swarm.start(speed=1e-6)
    n = len(traces)
    service.close()
    assert n > 0
    assert float(sim.time[0, 0]) <= (0.0 if starter == "server" else 0.011)  # the thread may have taken one step
    swarm.advance(0.02)
    assert len(traces) == n


# Packets ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def device(swarm):
    swarm.sim.reset()
    swarm.advance(0.02)
    swarm.reports.latest.clear()
    return CrtpDevice(swarm, "cf1")


def send(device, port, channel, data):
    return [bytes(answer) for answer in device.handle(bytes([port << 4 | 0x0C | channel]) + bytes(data))]


def test_log_blocks_have_limits(device):
    x = device.log.ids["stateEstimate.x"]
    variable = struct.pack("<BH", 7, x)
    assert send(device, 5, 1, b"\x06\x01" + variable * 6) == [bytes([0x5D, 6, 1, 0])]
    assert send(device, 5, 1, b"\x06\x01" + variable) == [bytes([0x5D, 6, 1, errno.EEXIST])]
    assert send(device, 5, 1, b"\x07\x01" + variable) == [bytes([0x5D, 7, 1, errno.E2BIG])]
    assert send(device, 5, 1, b"\x06\x02" + struct.pack("<BH", 7, 999)) == [bytes([0x5D, 6, 2, errno.ENOENT])]
    assert send(device, 5, 1, b"\x03\x09\x01") == [bytes([0x5D, 3, 9, errno.ENOENT])]
    for k in range(2, 17):
        assert send(device, 5, 1, bytes([6, k]) + variable) == [bytes([0x5D, 6, k, 0])]
    assert send(device, 5, 1, bytes([6, 17]) + variable) == [bytes([0x5D, 6, 17, errno.ENOMEM])]


def test_the_answer_to_setting_a_parameter_by_name_repeats_the_name(device):
    head = b"\x00no\x00thing\x00"
    for rest in (b"", b"\x08\x01"):
        assert send(device, 2, 3, head + rest) == [bytes([0x2F]) + head + bytes([errno.ENOENT])]


def test_refused_commands_have_a_code_and_a_report(device):
    wrong = struct.pack("<BBff?f", 7, 0, float("nan"), 0.0, False, 1.0)
    assert send(device, 8, 0, wrong)[0][-1] == errno.ENOEXEC
    (report,) = device.swarm.reports.latest
    assert (report.kind, report.name) == ("refused", "cf1")
    assert "finite" in report.text
    assert send(device, 7, 0, struct.pack("<Bffff", 9, 0, 0, 0, 1)) == []
    assert "type 0, 1, 5" in device.swarm.reports.latest[-1].text


def test_quaternions_are_unpacked_as_cflib_packs_them():
    from cflib.utils.encoding import compress_quaternion

    rng = np.random.default_rng(0)
    for quat in rng.normal(size=(50, 4)):
        quat = quat / np.linalg.norm(quat)
        unpacked = decompress_quat(np.array([compress_quaternion(quat)]))[0]
        assert abs(unpacked @ quat) > 1 - 1e-5


def test_numbers_are_clipped_to_the_range_of_their_type():
    assert pack_number("<B", 300.0) == b"\xff"
    assert pack_number("<b", -300.0) == b"\x80"
    assert pack_number("<H", float("nan")) == b"\0\0"
    assert struct.unpack("<e", pack_number("<e", 1e9))[0] == 65504
    assert np.isfinite(struct.unpack("<f", pack_number("<f", 1e300))[0])
    with pytest.raises(ConfigError, match=r"group\.name"):
        Table([Variable("name", "float")], LOG_TYPES)
    with pytest.raises(ConfigError, match="one twice"):
        Table([Variable("a.b", "float")] * 2, LOG_TYPES)


def test_log_variables_of_a_user(swarm):
    device = CrtpDevice(swarm, 1, log={"range.front": ("uint16_t", lambda state, commander: 1234.0)})
    variable = device.log.ids["range.front"]
    send(device, 5, 1, b"\x06\x01" + struct.pack("<BH", 2, variable))
    send(device, 5, 1, b"\x03\x01\x01")
    swarm.advance(0.05)
    (packet,) = device.due_packets()
    assert struct.unpack("<H", packet[5:]) == (1234,)


def test_a_failing_log_variable_is_nan_and_reported(swarm):
    def broken(state, commander):
        raise RuntimeError("no sensor")

    swarm.reports.latest.clear()
    device = CrtpDevice(swarm, 1, log={"range.front": ("float", broken)})
    send(device, 5, 1, b"\x06\x01" + struct.pack("<BH", 7, device.log.ids["range.front"]))
    send(device, 5, 1, b"\x03\x01\x01")
    swarm.advance(0.05)
    (packet,) = device.due_packets()
    assert np.isnan(struct.unpack("<f", packet[5:])[0])
    assert "no sensor" in swarm.reports.latest[-1].text


def test_a_server_continues_after_a_packet_that_fails(swarm, caplog):
    with CrtpServer(swarm, port=0) as server:
        peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        peer.settimeout(60)
        address = ("127.0.0.1", int(server.uris[0].rpartition(":")[2]))
        handle = server.devices[0].handle
        server.devices[0].handle = lambda packet: 1 / 0
        peer.sendto(b"\xfd\x00", address)
        wait_for(lambda: "was not answered" in caplog.text)
        server.devices[0].handle = handle
        peer.sendto(b"\xfd\x00", address)
        assert peer.recv(100).startswith(b"\xfdBitcraze")
        peer.close()
    assert "cf1: a packet was not answered" in caplog.text


ports = st.sampled_from([0, 2, 3, 4, 5, 6, 7, 8, 9, 13, 15])
packets = st.one_of(
    st.binary(max_size=64),
    st.builds(
        lambda port, channel, kind, tail: bytes([port << 4 | 0x0C | channel, kind]) + tail,
        ports, st.integers(0, 3), st.integers(0, 14), st.binary(max_size=30),
    ),
)  # fmt: skip


@settings(max_examples=400, deadline=None)
@given(sequence=st.lists(packets, max_size=6))
def test_any_packet_is_answered_or_reported_and_the_setpoint_stays_finite(swarm, sequence):
    for commander in swarm.commanders:
        commander.reset()
    device = CrtpDevice(swarm, "cf1")
    for packet in sequence:
        for answer in device.handle(packet):
            assert 1 <= len(answer) <= 31
        command = device.commander.tick(device.commander.now + 0.01, np.zeros(3), np.zeros(3), 0.0)
        assert command is None or np.isfinite(command.astype(np.float32)).all()
        for packet in device.due_packets():
            assert len(packet) <= 31


@settings(max_examples=50, deadline=None)
@given(content=st.binary(min_size=160, max_size=400), kind=st.integers(0, 1), n=st.integers(0, 4))
def test_any_memory_is_a_trajectory_or_refused(swarm, content, kind, n):
    for commander in swarm.commanders:
        commander.reset()
        commander.trajectories.clear()
    device = CrtpDevice(swarm, "cf1")
    device.memory[: len(content)] = content
    send(device, 8, 0, struct.pack("<BBBBIB", 6, 1, 1, kind, 0, n))
    send(device, 8, 0, struct.pack("<BB???Bf", 13, 0, True, False, False, 1, 1.0))
    for now in np.linspace(0.01, 3.0, 5):
        command = device.commander.tick(now, np.zeros(3), np.zeros(3), 0.0)
        assert command is None or np.isfinite(command.astype(np.float32)).all()
