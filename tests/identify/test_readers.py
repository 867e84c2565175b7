"""Files of flight controllers, written here byte by byte, are read; damaged ones are repaired or refused."""

import struct
from zlib import crc32

import numpy as np
import pytest

from crazysim.errors import ConfigError
from crazysim.identify import Columns, read_log

N = 400
T = 5.0 + 0.01 * np.arange(N)
ANGLE = 0.3 * np.sin(T)
"""Roll, rad: the drones of these logs swing about their first axis."""
RATE = 0.3 * np.cos(T)


def crazyflie(path, version=2, pause=(), damaged=False):
    """Write a log of a micro-SD card: body rates in degrees/s at 100 Hz, all others at 50 Hz."""
    kinds = {
        3: ("fast", ["gyro.x", "gyro.y", "gyro.z"]),
        7: (
            "slow",
            [
                *(f"stateEstimate.{k}" for k in ("x", "y", "z", "vx", "vy", "vz", "qx", "qy", "qz", "qw")),
                "m1",
                "m2",
                "m3",
                "m4",
            ],
        ),
    }
    head = b"\xbc" + struct.pack("<HH", version, len(kinds))
    for key, (name, variables) in kinds.items():
        head += struct.pack("<H", key) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        head += b"".join(f"{v}(f)".encode() + b"\0" for v in variables)
    body = []
    for k, t in enumerate(T):
        time = struct.pack("<I", round(1e3 * t)) if version == 1 else struct.pack("<Q", round(1e6 * t))
        body.append(struct.pack("<H", 3) + time + struct.pack("<3f", np.degrees(RATE[k]), 0, 0))
        if k % 2 == 0 and k not in pause:
            quat = np.sin(ANGLE[k] / 2), 0, 0, np.cos(ANGLE[k] / 2)
            body.append(
                struct.pack("<H", 7) + time + struct.pack("<14f", T[k], 2, 3, 1, 0, 0, *quat, 1e4, 1e4, 1e4, 1e4)
            )
    data = head + b"".join(body)
    path.write_bytes((data + struct.pack("<I", crc32(data)))[: -7 if damaged else None])
    return path


COLUMNS = Columns(
    pos=("stateEstimate.x", "stateEstimate.y", "stateEstimate.z"),
    vel=("stateEstimate.vx", "stateEstimate.vy", "stateEstimate.vz"),
    quat=("stateEstimate.qx", "stateEstimate.qy", "stateEstimate.qz", "stateEstimate.qw"),
    ang_vel=("gyro.x", "gyro.y", "gyro.z"),
    rotor_vel=("m1", "m2", "m3", "m4"),
    rad_per_unit=np.pi / 180,
)


@pytest.mark.parametrize("version", [1, 2])
def test_micro_sd_logs_are_read_at_the_rate_of_the_fastest(tmp_path, version):
    log = read_log(crazyflie(tmp_path / "log00", version), COLUMNS)
    assert log.dt == pytest.approx(0.01)
    np.testing.assert_allclose(log.pos[:, 0], T[: len(log.t)], atol=2e-3)  # interpolated, from milliseconds
    np.testing.assert_allclose(log.ang_vel[:, 0], RATE[: len(log.t)], atol=1e-3)
    assert not log.repairs


def test_damaged_micro_sd_logs_are_read_up_to_the_last_record(tmp_path):
    log = read_log(crazyflie(tmp_path / "log00", damaged=True), COLUMNS)
    assert "checksum" in log.repairs[0]
    np.testing.assert_allclose(log.pos[:, 0], T[: len(log.t)], atol=1e-5)
    assert len(log.t) > N - 10


def test_pauses_of_a_stream_are_gaps(tmp_path):
    log = read_log(crazyflie(tmp_path / "log00", pause=range(150, 220)), COLUMNS)
    assert len(log.gaps) == 1
    assert np.diff(log.t)[log.gaps[0] - 1] == pytest.approx(0.72, abs=0.02)
    assert "gaps" in log.repairs[0]


def test_other_files_are_refused(tmp_path):
    (tmp_path / "log").write_bytes(b"text, not a log")
    with pytest.raises(ConfigError, match="begins with 0xBC"):
        read_log(tmp_path / "log")
    with pytest.raises(ConfigError, match="version 1 or 2"):
        read_log(crazyflie(tmp_path / "log03", version=3))
    with pytest.raises(ConfigError, match="stateEstimate"):
        read_log(crazyflie(tmp_path / "log04"))


def ulog(path, leave_out=()):
    """Write a ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html) of four messages."""
    formats = {
        "esc_report": "uint64_t timestamp;int32_t esc_rpm;",
        "esc_status": "uint64_t timestamp;esc_report[4] esc;uint8_t esc_count;",
        "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;",
        "vehicle_attitude": "uint64_t timestamp;float[4] q;",
        "vehicle_angular_velocity": "uint64_t timestamp;float[3] xyz;",
    }

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    data += b"".join(message("F", f"{name}:{fields}".encode()) for name, fields in formats.items())
    names = [name for name in formats if name not in ("esc_report", *leave_out)]
    data += b"".join(message("A", struct.pack("<BH", 0, k) + name.encode()) for k, name in enumerate(names))
    for k, t in enumerate(T):
        stamp = struct.pack("<Q", round(1e6 * t))
        quat = np.array([np.cos(ANGLE[k] / 2), np.sin(ANGLE[k] / 2), 0, 0]) * (-1 if k > N // 2 else 1)
        content = {
            "esc_status": stamp + b"".join(stamp + struct.pack("<i", 1000 * (i + 1)) for i in range(4)) + b"\x04",
            "vehicle_local_position": stamp + struct.pack("<6f", 1, 2, -3, 0.1, 0.2, -0.3),
            "vehicle_attitude": stamp + struct.pack("<4f", *quat),
            "vehicle_angular_velocity": stamp + struct.pack("<3f", RATE[k], 0.5, 0.25),
        }
        data += b"".join(message("D", struct.pack("<H", i) + content[name]) for i, name in enumerate(names))
    path.write_bytes(data)
    return path


def test_ulogs_are_read_with_axes_up_and_left(tmp_path):
    pytest.importorskip("pyulog")
    log = read_log(ulog(tmp_path / "flight.ulg"))
    np.testing.assert_allclose(log.pos[5], [1, -2, 3])
    np.testing.assert_allclose(log.vel[5], [0.1, -0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(log.ang_vel[:, 1:], [[-0.5, -0.25]] * len(log.t))
    np.testing.assert_allclose(log.quat[:, 0], np.sin(ANGLE / 2)[: len(log.t)], atol=1e-6)
    np.testing.assert_allclose(log.rotor_vel[5], [1000, 2000, 3000, 4000])


def test_ulogs_without_rotor_speeds_are_refused(tmp_path):
    pytest.importorskip("pyulog")
    with pytest.raises(ConfigError, match="esc_status"):
        read_log(ulog(tmp_path / "flight.ulg", leave_out=["esc_status"]))
