"""Firmware in the loop: stand-ins for firmware speak its protocols and fly a drone with the data that they receive."""

import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from cases import with_states
from pymavlink.dialects.v20 import common
from waiting import Clock, wait_for

from crazysim import IMU, ConfigError, Sim
from crazysim.drones import load_airframe
from crazysim.lab.live.sitl import ArduPilot, Betaflight, Measurements, Origin, Px4, SoftwareInTheLoop
from crazysim.lab.live.sitl.loop import MAGNETIC_FIELD, motor_order
from crazysim.lab.live.sitl.measured import to_ned_quat
from crazysim.plugins.sensors import GPS, Barometer, Magnetometer, Triad

TO_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Axes east, north, up to north, east, down, and back."""
TO_FRD = np.diag([1.0, -1, -1])
"""Axes forward, left, up to forward, right, down, and back."""
HOVER_COMMAND = 0.733
"""Fraction of the largest rotor speed at which a cf21B_500 hovers (15,864 of 21,661 rpm)."""


def rotation_matrix(quat):
    """Return the rotation matrix of a quaternion, xyzw."""
    x, y, z, w = quat
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def autopilot_commands(link, pos, vel, rotation, gyro):
    """Return the motor commands of a simple autopilot that holds 1 m above the origin and heads east.

    World axes are east, north, up; body axes are forward, left, up. The link has the position and yaw torque of each
    motor of its firmware.
    """
    target_acc = -1.0 * pos - 1.0 * vel
    thrust = HOVER_COMMAND + 0.15 * (target_acc[2] + 1.0)
    tilt = np.cross([0, 0, 1.0], rotation[2])  # from the body's z to the world's z, in the body
    target_tilt = rotation.T @ np.array([-target_acc[1], target_acc[0], 0.0]) * 0.1
    heading = np.arctan2(rotation[1, 0], rotation[0, 0])
    roll, pitch = (0.3 * (tilt + target_tilt) - 0.03 * gyro)[:2]
    yaw = -0.1 * heading - 0.05 * gyro[2]
    x, y = np.array(link.positions).T
    return np.clip(thrust + y * roll - x * pitch + np.array(link.yaw_torque_signs) * yaw, 0, 1)


class StandInThread(threading.Thread):
    """Thread of a stand-in. It ends with its socket or after an empty packet; ``end`` raises an error of the thread."""

    def __init__(self, serve):
        super().__init__(daemon=True)
        self.serve, self.error = serve, None
        self.start()

    def run(self):
        try:
            self.serve()
        except OSError:
            pass
        except Exception as error:
            self.error = error

    def end(self):
        self.join(300.0)
        if self.error:
            raise self.error


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def create_disturbed_sim(**settings):
    """Return a simulation whose drone starts in the air, turned and away from its goal."""
    sim = Sim(control="rotor_vel", **settings)
    states = sim.data.states
    pos, quat = np.array(states.pos), np.array(states.quat)
    pos[..., :] = [0.3, -0.2, 1.2]
    quat[..., :] = np.array([0.05, -0.08, 0.25, 1.0]) / np.linalg.norm([0.05, -0.08, 0.25, 1.0])
    rotor_vel = np.full_like(states.rotor_vel, 15864.0)
    sim.data = sim.data.replace(states=states.replace(pos=pos, quat=quat, rotor_vel=rotor_vel))
    return sim


def assert_at_goal(sim):
    """Check that the drone is at its goal, level, and heads east."""
    states = sim.data.states
    np.testing.assert_allclose(states.pos[0, 0], [0, 0, 1.0], atol=0.1)  # the autopilot has no integral
    np.testing.assert_allclose(rotation_matrix(states.quat[0, 0]), np.eye(3), atol=0.05)


def test_betaflight_receives_the_state_and_flies():
    ports = tuple(free_port(socket.SOCK_DGRAM) for _ in range(3))
    state, rc = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    state.bind(("127.0.0.1", ports[1]))
    rc.bind(("127.0.0.1", ports[2]))
    state.settimeout(60.0)
    rc.settimeout(0.0)
    received, origin = [], Origin(10.0, 20.0, 100.0)

    def serve():
        while content := state.recv(200):
            packet = np.frombuffer(content, "<f8")
            received.append(packet)
            gyro, quat, vel, place = packet[1:4], packet[7:11], packet[11:14], packet[14:17]
            w, x, y, z = quat * [1, 1, -1, -1]
            degrees = 2 * received[0][14:16] - place[:2]  # the bridge mirrors positions at the first one
            east, north = (degrees - [20.0, 10.0]) * 111194.93 * np.array([np.cos(np.radians(10.0)), 1])
            pos = np.array([east, north, place[2] - 100.0])
            motors = autopilot_commands(Betaflight, pos, vel, rotation_matrix([x, y, z, w]), gyro * [1, -1, 1])
            state.sendto(np.asarray(motors, "<f4").tobytes(), ("127.0.0.1", ports[0]))

    sim = create_disturbed_sim(freq=250)
    data = sim.data
    sim.step()  # compiles before the stand-in waits
    sim.data = data
    link = Betaflight(ports=ports, origin=origin, rc_freq=5.0)
    link.lockstep = True  # the flight does not depend on the speed of the machine
    with state, rc, SoftwareInTheLoop(sim, link) as loop:
        thread = StandInThread(serve)
        loop.links[0].channels[:] = np.arange(1000, 1016)
        loop.run(12.0)
        controls = [rc.recv(100) for _ in range(12 * 5)]
        rc.sendto(b"", ("127.0.0.1", ports[1]))
        thread.end()
    assert_at_goal(sim)
    times = np.array([packet[0] for packet in received])
    np.testing.assert_allclose(times, np.arange(len(times)) / 250, atol=1e-9)
    # Hovering: the specific force points up, which is minus 9.81 in the axes forward, right, down.
    np.testing.assert_allclose(received[-1][4:7], [0, 0, -9.81], atol=0.3)
    assert received[-1][17] == pytest.approx(101325 * (1 - 0.0065 / 288.15 * 101.0) ** 5.2559, rel=1e-4)
    assert struct.unpack("<d16H", controls[3])[1:] == tuple(range(1000, 1016))


def test_ardupilot_steps_with_the_simulation_and_flies():
    port, n_steps = free_port(socket.SOCK_DGRAM), 2000
    lines = []

    def serve():
        peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        peer.settimeout(60.0)
        motors = np.zeros(4)
        for count in range(n_steps):
            pulses = np.full(16, 1500)
            pulses[:4] = np.round(1000 + 1000 * motors)
            peer.sendto(struct.pack("<HHI16H", 18458, 400, count, *pulses.astype(int)), ("127.0.0.1", port))
            if count == n_steps - 1:
                break
            line = json.loads(peer.recv(2000))
            lines.append(line)
            w, x, y, z = line["quaternion"]
            rotation = TO_NED @ rotation_matrix([x, y, z, w]) @ TO_FRD
            pos, vel, gyro = TO_NED @ line["position"], TO_NED @ line["velocity"], TO_FRD @ line["imu"]["gyro"]
            motors = autopilot_commands(ArduPilot, pos, vel, rotation, gyro)
        peer.close()

    sim = create_disturbed_sim()
    with SoftwareInTheLoop(sim, ArduPilot(port=port), freq=250) as loop:
        thread = StandInThread(serve)
        loop.run(n_steps / 250)
    thread.end()
    assert_at_goal(sim)
    assert len(lines) == n_steps - 1
    np.testing.assert_allclose([line["timestamp"] for line in lines], np.arange(1, n_steps) / 250, atol=1e-9)


def test_px4_starts_slowly_and_flies_on_mounted_sensors_with_rates_of_their_own(monkeypatch):
    """The stand-in ignores fields whose bits are not set. It answers gyroscope messages, after ``n_boot`` messages."""
    # The link waits at the start for a clock that does not lag behind.
    monkeypatch.setattr("crazysim.lab.live.sitl.px4.time", Clock())
    n_steps, n_boot, sensors, gps_messages, truths = 2000, 20, [], [], []
    link = Px4(port=0, origin=Origin(10.0, 20.0, 100.0))

    def serve():
        client = socket.create_connection(link.address)
        client.settimeout(60.0)
        mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
        while len(truths) < n_steps:
            for message in mav.parse_buffer(client.recv(4096)) or []:
                kind = message.get_type()
                {"HIL_SENSOR": sensors, "HIL_GPS": gps_messages, "HIL_STATE_QUATERNION": truths}[kind].append(message)
                if kind != "HIL_SENSOR" or message.fields_updated & 0x38 != 0x38 or len(sensors) < n_boot:
                    continue
                # PX4 estimates the state; the stand-in reads it from the simulation.
                m = loop.measure()[0]
                gyro = np.array([message.xgyro, -message.ygyro, -message.zgyro])
                motors = autopilot_commands(Px4, m.pos, m.vel, rotation_matrix(m.quat), gyro)
                mode = common.MAV_MODE_FLAG_SAFETY_ARMED
                answer = common.MAVLink_hil_actuator_controls_message(message.time_usec, [*motors, *[0] * 12], mode, 1)
                client.sendall(answer.pack(mav))
        client.close()

    sim = create_disturbed_sim(freq=250)
    sim.add(IMU(gyro=Triad(bias=[0.03, 0.0, 0.03]), rpy=(np.pi, 0.0, 0.3), freq=125))
    sim.add(Barometer(altitude=100.0, freq=50))
    sim.add(Magnetometer(MAGNETIC_FIELD, rpy=(0.0, 0.0, np.pi / 2), freq=25))
    sim.add(GPS(freq=10))
    loop = SoftwareInTheLoop(sim, link)
    with loop:
        thread = StandInThread(serve)
        loop.run(n_steps / 250)
    thread.end()
    assert_at_goal(sim)
    assert link.armed
    assert [message.time_usec for message in sensors[:3]] == [0, 4000, 8000]
    last, truth = sensors[-1], truths[-1]
    np.testing.assert_allclose([last.xacc, last.yacc, last.zacc], [0, 0, -9.81], atol=0.3)
    # About the field of central Europe, in the body's axes of a drone that heads east: right is south.
    np.testing.assert_allclose([last.xmag, last.ymag, last.zmag], [0, -0.2, 0.45], atol=0.02)
    assert last.abs_pressure == pytest.approx(1013.25 * (1 - 0.0065 / 288.15 * 101.0) ** 5.2559, rel=1e-4)
    # The measured rates have the bias of the gyroscope; the true rates are zero.
    assert np.linalg.norm([last.xgyro, last.ygyro, last.zgyro]) > 0.03
    np.testing.assert_allclose([truth.rollspeed, truth.pitchspeed, truth.yawspeed], 0, atol=0.01)
    # Bits of accelerometer and gyroscope, magnetometer, barometer: all in the first message, then at their own rates.
    masks = np.array([message.fields_updated for message in sensors])
    for mask, freq in ((0x003F, 125), (0x01C0, 25), (0x1A00, 50)):
        has = masks & mask == mask
        assert has.sum() == 1 + n_steps * freq // 250
        assert not np.any(masks[~has] & mask)
    assert not np.any(masks & ~0x1BFF)  # nothing else: bit 10 would be an airspeed
    assert len(gps_messages) == 1 + n_steps * 10 // 250
    assert (gps_messages[-1].lat, gps_messages[-1].lon) == (pytest.approx(10e7, abs=20), pytest.approx(20e7, abs=20))


def test_px4_turns_no_motor_while_it_is_disarmed_and_is_given_time_to_start():
    link = Px4(port=0)
    loop = SoftwareInTheLoop(Sim(control="rotor_vel"), link, timeout=0.2)
    with link, socket.create_connection(link.address) as client:
        mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
        loop.exchange()  # without an answer
        client.sendall(common.MAVLink_hil_actuator_controls_message(0, [0.5] * 16, 0, 0).pack(mav))
        wait_for(lambda: np.array_equal(link.receive(0.2), np.zeros(4)) and link._has_answered)
        assert not link.armed
        loop.sim.step(1)
        with pytest.raises(ConfigError, match=r"expected motor commands of Px4 within 0\.2 s, got none"):
            loop.exchange()
    with Px4(port=0) as silent, socket.create_connection(silent.address):
        loop = SoftwareInTheLoop(Sim(control="rotor_vel"), silent, timeout=0.2)
        with pytest.raises(ConfigError, match=r"expected motor commands of Px4 within 0\.2 s, got none"):
            loop.run(100.0)


def test_betaflight_in_real_time_and_one_that_does_not_answer(monkeypatch):
    clock, answered = Clock(), threading.Semaphore(0)
    monkeypatch.setattr("crazysim.lab.live.sitl.loop.time", clock)
    ports = tuple(free_port(socket.SOCK_DGRAM) for _ in range(3))
    sent, sim = [], create_disturbed_sim(freq=250)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer, Betaflight(ports=ports) as link:
        loop = SoftwareInTheLoop(sim, link)
        with pytest.raises(ConfigError, match=r"expected motor commands of Betaflight within 1\.1 s, got none"):
            loop.run(1.1)
        peer.bind(("127.0.0.1", ports[1]))
        peer.settimeout(60.0)

        def serve():
            while peer.recv(200):
                sent.append(np.float32([0.5, 0.6, 0.7, 0.8]) + np.float32(1e-4) * len(sent))
                peer.sendto(sent[-1].astype("<f4").tobytes(), ("127.0.0.1", ports[0]))
                answered.release()

        def sleep(seconds):
            clock.now += seconds
            assert answered.acquire(timeout=60.0)

        monkeypatch.setattr(clock, "sleep", sleep)
        thread, start_time = StandInThread(serve), clock.now
        loop.run(0.5)
        assert clock.now - start_time == pytest.approx(0.496)  # the last step begins 4 ms before the end
        peer.sendto(b"", ("127.0.0.1", ports[1]))
        thread.end()
    command = np.asarray(sim.data.controls.rotor_vel[0, 0] / loop._max_rotor_vel[0])[loop._orders[0]]
    assert len(sent) in (124, 125)  # the last answer may come after the end
    assert min(np.abs(command - motors).max() for motors in sent[123:]) < 1e-6


STAND_IN = """
#include <arpa/inet.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

static double state[18];
static struct { double time; unsigned short channels[16]; } rc;
static int sockets[2];

static void *receive(void *data)
{
    const int i = data == &rc, size = i ? 40 : sizeof(state);
    char packet[sizeof(state)];
    for (;;) {
        fd_set set;
        FD_ZERO(&set);
        FD_SET(sockets[i], &set);
        struct timeval wait = {0, 100000};
        if (select(sockets[i] + 1, &set, NULL, NULL, &wait) != 1) continue;
        if (recvfrom(sockets[i], packet, size, 0, NULL, NULL) != size) continue;
        usleep(rand() % 300); /* the threads take different times in every run */
        memcpy(data, packet, size);
    }
    return NULL;
}

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

int main(void)
{
    const double start = seconds();
    struct sockaddr_in at = {.sin_family = AF_INET};
    pthread_t threads[2];
    srand(getpid());
    for (int i = 0; i < 2; ++i) {
        sockets[i] = socket(AF_INET, SOCK_DGRAM, 0);
        at.sin_port = htons(9003 + i);
        if (bind(sockets[i], (struct sockaddr *)&at, sizeof(at))) return 1;
        pthread_create(&threads[i], NULL, receive, i ? (void *)&rc : (void *)state);
    }
    at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    at.sin_port = htons(9002);
    for (unsigned loops = 0;; ++loops) {
        const struct timespec pause = {0, 50000};
        const float motors[4] = {(seconds() - start) / 100, state[0] / 100, rc.channels[2] / 1e4, loops / 1e6};
        sendto(sockets[0], motors, sizeof(motors), 0, (struct sockaddr *)&at, sizeof(at));
        nanosleep(&pause, NULL);
    }
}
"""
"""Program with the threads, sockets and clock of Betaflight's simulator target, whose motor commands show them."""

linux_only = pytest.mark.skipif(sys.platform != "linux" or shutil.which("gcc") is None, reason="for Linux, with gcc")


class RecordingBetaflight(Betaflight):
    """Link that keeps the commands, the first of which it receives when the program has started."""

    def receive(self, timeout):
        command = super().receive(timeout)
        self.__dict__.setdefault("received", []).append(command)
        return command


def start_betaflight(program, folder, **settings):
    ports = tuple(free_port(socket.SOCK_DGRAM) for _ in range(3))
    return RecordingBetaflight(ports=ports, program=program, folder=folder, **settings)


def compile_stand_in(folder):
    (folder / "stand_in.c").write_text(STAND_IN)
    subprocess.run(["gcc", "-pthread", folder / "stand_in.c", "-o", folder / "stand_in"], check=True)
    return folder / "stand_in"


@linux_only
def test_betaflight_in_lockstep_depends_on_the_packets_only(tmp_path):
    program = compile_stand_in(tmp_path)

    def fly():
        sim = Sim(control="rotor_vel", freq=250)
        with SoftwareInTheLoop(sim, start_betaflight(program, tmp_path, rc_freq=125.0)) as loop:
            for k in range(50):
                loop.links[0].channels[2] = 1000 + k
                loop.run(1 / 250)
        return np.array(loop.links[0].received[1:], float)

    first, second = fly(), fly()
    np.testing.assert_array_equal(first, second)
    clock, state_time, throttle, loops = (first * [100, 100, 1e4, 1e6]).T
    times = np.arange(50) / 250
    # The last command of an exchange is younger than a turn of the loop, about 53 us; numbers are in float32.
    np.testing.assert_allclose(clock, 2 + times - 30e-6, atol=60e-6)
    np.testing.assert_allclose(state_time[1:], times[1:], atol=1e-7)  # the first answer is from before
    np.testing.assert_allclose(throttle[1:], 1000 + np.arange(1, 50) // 2 * 2, atol=1e-3)
    assert np.all(np.diff(loops) > 70)  # 4 ms in turns of about 53 us


@linux_only
def test_betaflight_in_lockstep_ends_with_a_simulation_that_is_killed(tmp_path):
    program = compile_stand_in(tmp_path)
    ports = tuple(free_port(socket.SOCK_DGRAM) for _ in range(3))
    code = (
        "import os; from crazysim.lab.live.sitl import Betaflight\n"
        f"link = Betaflight(ports={ports}, program={str(program)!r}, folder={str(tmp_path)!r})\n"
        "print(link._process.pid, flush=True)\n"
        "os._exit(0)"
    )
    pid = int(subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE).stdout)
    wait_for(lambda: not Path(f"/proc/{pid}/cmdline").exists() or not Path(f"/proc/{pid}/cmdline").read_bytes())


@linux_only
def test_betaflight_that_does_not_start_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("crazysim.lab.live.sitl.betaflight.START_TIMEOUT", 0.2)
    with pytest.raises(ConfigError, match=r"no file .*missing\. Build it with make TARGET=SITL"):
        start_betaflight(tmp_path / "missing", tmp_path)
    with pytest.raises(ConfigError, match=r"to start, got no packet in 0\.2 s\. Read .*betaflight\.log"):
        start_betaflight(shutil.which("true"), tmp_path)


@pytest.mark.slow
@pytest.mark.skipif("CRAZYSIM_BETAFLIGHT" not in os.environ, reason="needs the path of betaflight_SITL")
def test_betaflight_itself_arms_flies_and_repeats_its_flight(tmp_path):
    program = os.environ["CRAZYSIM_BETAFLIGHT"]
    (tmp_path / "settings.txt").write_text("aux 0 0 0 1700 2100 0 0\naux 1 1 1 1700 2100 0 0\nsave\n")
    subprocess.run([program, "--config", "settings.txt"], cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)

    def fly():
        sim, states = Sim(control="rotor_vel"), []
        sim.add(IMU())
        link = start_betaflight(program, tmp_path)
        with SoftwareInTheLoop(sim, link) as loop:
            loop.run(4.0)
            link.channels[[4, 5]] = 1900
            loop.run(1.0)
            for roll, yaw in ((1500, 1500), (1600, 1500), (1500, 1550), (1500, 1500)):
                link.channels[[0, 2, 3]] = roll, 1800, yaw
                loop.run(1.0)
                s = sim.data.states
                states.append(np.concatenate([np.array(x)[0, 0] for x in (s.pos, s.quat, s.ang_vel)]))
        return np.array(states)

    first, second = fly(), fly()
    np.testing.assert_array_equal(first, second)
    pos, quat, ang_vel = first[:, :3], first[:, 3:7], first[:, 7:]
    assert pos[-1, 2] > 1.0
    assert pos[-1, 1] < -0.3  # it rolled to the right, which is south
    assert ang_vel[2, 2] < -0.1  # it turns to the right
    assert abs(ang_vel[3, 2]) < 0.1 * abs(ang_vel[2, 2])  # and stops
    assert rotation_matrix(quat[-1])[2, 2] > 0.99


def test_attitudes_in_the_axes_of_aviation():
    rng = np.random.default_rng(2)
    for quat in rng.normal(size=(20, 4)):
        quat /= np.linalg.norm(quat)
        w, x, y, z = to_ned_quat(quat)
        np.testing.assert_allclose(rotation_matrix([x, y, z, w]), TO_NED @ rotation_matrix(quat) @ TO_FRD, atol=1e-12)


@pytest.mark.parametrize("link", [Betaflight, ArduPilot, Px4])
def test_each_motor_drives_the_rotor_at_its_place(link):
    airframe = Sim(control="rotor_vel").airframe
    link = object.__new__(link)  # no ports
    order = motor_order(airframe, link)
    assert [tuple(np.sign(p[:2])) for p in airframe.value("rotors.position")[order]] == list(link.positions)
    with pytest.raises(ConfigError, match=rf"motors 1 to 4 of {type(link).__name__}.*Pass reversed=False, with the"):
        motor_order(airframe, link, reversed=True)
    signs = {"yaw_torque_sign": (-airframe.value("rotors.yaw_torque_sign")).tolist()}
    turned = load_airframe({"name": "turned", "base": airframe.name, "rotors": signs})
    with pytest.raises(ConfigError, match=f"Pass reversed=True, and {link.remedy}"):
        motor_order(turned, link)
    np.testing.assert_array_equal(motor_order(turned, link, reversed=True), order)


def test_wrong_settings_are_refused():
    link = ArduPilot(port=free_port(socket.SOCK_DGRAM))
    with link:
        for message, sim, settings in (
            ("expected control='rotor_vel', got 'attitude'", Sim(control="attitude"), {}),
            ("expected a link for each of 2 drones, got 1", Sim(n_drones=2, control="rotor_vel"), {}),
            ("expected freq to divide freq = 500 Hz, got 300 Hz", Sim(control="rotor_vel"), {"freq": 300}),
            ("timeout to be positive, at most 1e[+]06, got nan", Sim(control="rotor_vel"), {"timeout": np.nan}),
            ("timeout to be positive, at most 1e[+]06, got -1", Sim(control="rotor_vel"), {"timeout": -1.0}),
            ("expected motors as 'speed' or 'thrust', got 'volt'", Sim(control="rotor_vel"), {"motors": "volt"}),
        ):
            with pytest.raises(ConfigError, match=message):
                SoftwareInTheLoop(sim, link, **settings)
        with pytest.raises(ConfigError, match=r"expected motor commands of ArduPilot within 0\.1 s, got none"):
            SoftwareInTheLoop(Sim(control="rotor_vel"), link, timeout=0.1).exchange()
        with pytest.raises(ConfigError, match="expected a free port"):
            ArduPilot(port=link._link._socket.getsockname()[1])
    with Px4(port=0, connect_timeout=0.1) as px4, pytest.raises(ConfigError, match=r"within 0\.1 s, got no connection"):
        px4.send(SoftwareInTheLoop(Sim(control="rotor_vel"), px4).measure()[0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ArduPilot(port=-1), "port to be from 0 to 6.*, got -1"),
        (lambda: ArduPilot(port=70000), "port to be from 0 to 6.*, got 70000"),
        (lambda: ArduPilot(port=9002.5), "port as a whole number, got 9002.5"),
        (lambda: ArduPilot(host=5), "host as text, got 5"),
        (lambda: Px4(port=99999), "port to be from 0 to 6.*, got 99999"),
        (lambda: Px4(port=0, connect_timeout=np.inf), "connect_timeout to be positive, .*got inf"),
        (lambda: Px4(port=0, origin=(47.0, 8.0, 500.0)), r"expected an Origin, got \(47.0"),
        (lambda: Betaflight(ports=(0, 9003)), "expected ports of the motors, the state and the remote control"),
        (lambda: Betaflight(ports=(0, 0, 9004)), "port to be from 1 to"),
        (lambda: Betaflight(ports=(0, 9003, 9004), rc_freq=-5.0), "rc_freq to be positive, got -5"),
        (lambda: Betaflight(ports=(0, 9003, 9004), rc_freq=np.nan), "rc_freq to be positive, got nan"),
        (lambda: Origin(500.0, 0.0, 0.0), "latitude of Origin to be from -89 to 89, got 500"),
        (lambda: Origin(47.0, 8.0, np.nan), "altitude of Origin to be from -1000 to 11000, got nan"),
    ],
)
def test_law_09_arguments_of_links_are_checked(call, message):
    with pytest.raises(ConfigError, match=message):
        call()


def test_law_09_channels_times_and_links_are_checked():
    with Betaflight(ports=(0, 9003, 9004)) as link:
        link.channels = [1500] * 15 + [2000]
        assert link.channels[15] == 2000
        for values, message in (
            ([1500.5] * 16, "channels as whole numbers, us, got"),
            ([1500] * 3, r"channels of shape \(16,\), got \(3,\)"),
            ([-1] * 16, "channels to be from 0 to 65535"),
        ):
            with pytest.raises(ConfigError, match=message):
                link.channels = values
        link.channels[4] = 70000
        with pytest.raises(ConfigError, match="channels to be from 0 to 65535"):
            link.send(SoftwareInTheLoop(Sim(control="rotor_vel"), link).measure()[0])
        with pytest.raises(ConfigError, match="one link for each of 2 drones, got one twice"):
            SoftwareInTheLoop(Sim(n_drones=2, control="rotor_vel"), [link, link])
        with pytest.raises(ConfigError, match="a link to firmware or a list of them, got 'ardupilot'"):
            SoftwareInTheLoop(Sim(control="rotor_vel"), "ardupilot")
        loop = SoftwareInTheLoop(Sim(control="rotor_vel"), link)
        for seconds in (-1.0, np.inf, np.nan, "1"):
            with pytest.raises(ConfigError, match="expected seconds"):
                loop.run(seconds)


INVALID_PACKETS = [b"", b"\x01", b"\xff" * 15, b"\x00" * 17, np.float32([np.nan, 0, 0, 0]).tobytes(), bytes(range(200))]
"""Packets of a format that no firmware sends."""


@pytest.mark.parametrize("kind", [ArduPilot, Betaflight])
def test_packets_of_another_format_are_skipped_and_extend_no_deadline(kind):
    """The sender stops long after the deadline, and not before ``receive`` has returned."""
    has_returned = threading.Event()
    settings = {"port": 0} if kind is ArduPilot else {"ports": (0, 9003, 9004)}
    with kind(**settings) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        address = link._link._socket.getsockname()

        def serve():
            for k in range(6000):
                peer.sendto(INVALID_PACKETS[k % len(INVALID_PACKETS)], address)
                if has_returned.wait(0.005):
                    return
            raise AssertionError("receive did not return while garbage arrived")

        thread = StandInThread(serve)
        assert link.receive(0.1) is None
        has_returned.set()
        thread.end()
        good = (
            struct.pack("<HHI16H", 18458, 400, 0, *[1250] * 16)
            if kind is ArduPilot
            else struct.pack("<4f", *[0.25] * 4)
        )
        for packet in [good, *INVALID_PACKETS]:
            peer.sendto(packet, address)
        np.testing.assert_allclose(link.receive(2.0), 0.25)


def test_px4_skips_bytes_that_are_no_message():
    mav, mode = common.MAVLink(None, srcSystem=1, srcComponent=1), common.MAV_MODE_FLAG_SAFETY_ARMED
    with Px4(port=0) as link, socket.create_connection(link.address) as client:
        controls = [0.5, 0.25, np.nan, 1.0, *[0.0] * 12]
        message = common.MAVLink_hil_actuator_controls_message(0, controls, mode, 1).pack(mav)
        damaged = message[:20] + bytes([message[20] ^ 0xFF]) + message[21:]
        # after the false start of a message, the parser skips some of the messages
        client.sendall(b"".join(INVALID_PACKETS) + damaged + b"\xfd\xfe" + 20 * message)
        wait_for(lambda: np.array_equal(link.receive(0.1), [0.5, 0.25, 0.0, 1.0]))


def test_measurements_are_those_of_the_plugins_in_the_axes_of_the_body():
    sim = Sim(2, control="rotor_vel")
    quat = np.array([[[0.0, 0.0, 0.0, 1.0]], [[0.1, -0.3, 0.6, 0.5]]])
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    sim.data = with_states(sim.data, pos=[0.0, 0.0, 50.0], quat=quat, ang_vel=[0.5, -1.0, 2.0])
    sim.add(IMU(rpy=(0.4, -0.2, 1.0), pos=(0.0, 0.0, 0.02)))
    aligned = sim.add(IMU(pos=(0.0, 0.0, 0.02), name="aligned"))
    sim.add(Magnetometer(MAGNETIC_FIELD, rpy=(np.pi / 2, 0.0, np.pi), freq=None))
    sim.add(GPS(pos=(0.1, 0.0, -0.2), freq=None))
    with SoftwareInTheLoop(sim, [ArduPilot(port=free_port(socket.SOCK_DGRAM)) for _ in range(2)]) as loop:
        for has_measured in (False, True):
            if has_measured:
                sim.rotor_vel_control(np.full((2, 1, 4), 18000.0))
                sim.step(50)
            states = sim.data.states
            for k, measured in enumerate(loop.measure()):
                assert isinstance(measured, Measurements)
                pos, rotation = np.asarray(states.pos[k, 0]), rotation_matrix(states.quat[k, 0])
                assert measured.height == pytest.approx(pos[2])
                # In float32, with positions of 50 m.
                np.testing.assert_allclose(measured.gps_pos, pos + rotation @ [0.1, 0, -0.2], atol=1e-5)
                np.testing.assert_allclose(measured.field, rotation.T @ MAGNETIC_FIELD, atol=1e-10)
                np.testing.assert_allclose(measured.ang_vel, states.ang_vel[k, 0])
                if has_measured:
                    result = np.concatenate([measured.gyro, measured.accel])
                    value = np.asarray(aligned.read(sim.data).samples.value)[k, 0]
                    np.testing.assert_allclose(result, value, atol=1e-5)
