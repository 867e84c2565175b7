"""Readers of logs: the files that ``log_files`` writes are read, and damaged files are repaired or refused."""

import bz2
import gzip
import lzma
from functools import partial

import numpy as np
import pytest
from log_files import (
    ANGLE,
    COLUMNS,
    LATERAL_POS,
    RATE,
    N,
    T,
    create_mocap,
    drift,
    swing,
    write_bag,
    write_blackbox,
    write_crazyflie,
    write_ulog,
)

from crazysim.errors import ConfigError
from crazysim.lab.identify import Columns, read_log
from crazysim.lab.identify.readers import Stream, resample
from crazysim.lab.live.attitude import decompress_quat


@pytest.mark.parametrize("version", [1, 2])
def test_micro_sd_logs_are_read_at_the_rate_of_the_fastest_block(tmp_path, version):
    log = read_log(write_crazyflie(tmp_path / "log00", version), COLUMNS)
    assert log.dt == pytest.approx(0.01)
    np.testing.assert_allclose(log.pos[:, 0], T[: len(log.t)], atol=2e-3)  # interpolated, from milliseconds
    np.testing.assert_allclose(log.ang_vel[:, 0], RATE[: len(log.t)], atol=1e-3)
    assert not log.repairs


def test_damaged_micro_sd_logs_are_read_up_to_the_last_record(tmp_path):
    log = read_log(write_crazyflie(tmp_path / "log00", damaged=True), COLUMNS)
    assert "checksum" in log.repairs[0]
    np.testing.assert_allclose(log.pos[:, 0], T[: len(log.t)], atol=1e-5)
    assert len(log.t) > N - 10


TABLE = b"t,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n"
BLACKBOX = b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n" + bytes(100)
ROTOR_SPEEDS = Columns(rotor_vel=("rpm2", "rpm1", "rpm3", "rpm4"))
WRONG_FILES = [
    ("LOG00001.BBL", BLACKBOX, {}, "Convert it with blackbox_decode"),
    ("log.bfl", BLACKBOX, {}, "Convert it with blackbox_decode"),
    ("a.csv.gz", gzip.compress(TABLE, mtime=0), {}, "a.csv.gz: expected a log.*Unpack it with gunzip"),
    ("a.csv", gzip.compress(TABLE, mtime=0), {}, "Unpack it with gunzip"),
    ("a.csv", bz2.compress(TABLE), {}, "Unpack it with bunzip2"),
    ("a.csv", lzma.compress(TABLE), {}, "Unpack it with unxz"),
    *[("a.csv", TABLE.decode().encode(x), {}, "Save it as UTF-8") for x in ("utf-16", "utf-16-le", "utf-16-be")],
    ("a.csv", b"\xfe\xff" + TABLE.decode().encode("utf-16-be"), {}, "Save it as UTF-8"),
    ("a.csv", b"", {}, "expected names of columns in the first line"),
    ("a.csv", b"t;x;y\n0;1;2", {}, "semicolons between them"),
    ("a.csv", b"0,1,2\n1,2,3", {}, "got numbers: 0,1,2"),
    ("a.csv", b"t,x,x\n1,2,3", {}, "got 'x' twice"),
    ("a.csv", b"t,x,y\n0,1,2\n0,1\n", {}, "got 1 such rows and 1 others, the first with 2 in line 3. Export"),
    ("a.csv", b"t,x\nnoon,1\nlater,2\n", {}, "one number a sample in column t, got noon in its first row"),
    ("log", b"text, not a log", {}, "begins with 0xBC"),
    ("log03", partial(write_crazyflie, version=3), {}, "version 1 or 2"),
    ("log04", write_crazyflie, {}, "stateEstimate"),
    ("a.ulg", partial(write_ulog, slow=["esc_status"]), {"columns": ROTOR_SPEEDS},
     r"columns rpm2, rpm1, .* a slow stream: expected esc_status"),
    ("a.ulg", partial(write_ulog, slow=["vehicle_attitude"]), {}, r"vehicle_attitude every 0\.2 s"),
    ("a.ulg", partial(write_ulog, leave_out=["vehicle_attitude"]), {}, "messages vehicle_attitude, got esc_status"),
    ("a.ulg", b"no ULog", {}, "expected a ULog"),
    ("a.csv", partial(write_blackbox, damaged=2000), {"motion": create_mocap()}, "Decode the log again"),
    ("a.csv", write_blackbox, {}, "--motion"),
    ("a.csv", write_blackbox, {"motion": create_mocap(of_other_flight=True)}, "one flight"),
    ("a.csv", partial(write_blackbox, leave_out=["gyroADC[1]"]), {"motion": create_mocap()}, r"gyroADC\[1\]"),
    ("a.csv", partial(write_blackbox, explorer=True),
     {"columns": Columns(rad_per_unit=60.0), "motion": create_mocap()}, "degrees per second"),
    ("a", partial(write_bag, leave_out=["/drone/pose"]), {}, r"expected a topic of nav_msgs.*/motors"),
    ("b", write_bag, {"columns": Columns(voltage=("/battery/voltage",))}, r"topic and a field.*/drone/pose \(nav_msgs"),
    ("b", write_bag, {"columns": Columns(voltage=("/drone/imu/voltage",))}, "ros2 interface show"),
    ("c.bag", b"no bag", {}, "expected a ROS bag"),
]  # fmt: skip
"""Name of a file, its bytes or the function that writes it, settings of ``read_log``, and words of the error."""


@pytest.mark.parametrize(("name", "content", "settings", "remedy"), WRONG_FILES)
def test_law_09_wrong_files_are_refused(tmp_path, name, content, settings, remedy):
    if content is write_bag or name in ("a", "c.bag"):
        pytest.importorskip("rosbags")
    path = tmp_path / name
    path.write_bytes(content) if isinstance(content, bytes) else content(path)
    with pytest.raises(ConfigError, match=remedy):
        read_log(path, **settings)


def test_pauses_of_a_stream_are_gaps(tmp_path):
    log = read_log(write_crazyflie(tmp_path / "log00", pause=range(150, 220)), COLUMNS)
    assert len(log.gaps) == 1
    assert np.diff(log.t)[log.gaps[0] - 1] == pytest.approx(0.72, abs=0.02)
    assert "1 gap," in log.repairs[0]


def test_angles_after_a_sample_that_is_missing_are_kept():
    angle = np.linspace(0, 300, 200)
    logged = (angle + 180) % 360 - 180
    logged[20] = 1e30
    table = {"x": angle, "y": angle, "z": angle, "roll": 0 * angle, "pitch": 0 * angle, "yaw": logged}
    columns = Columns(rpy=("roll", "pitch", "yaw"), rad_per_angle=np.pi / 180)
    result = resample("log", {"a": Stream(0.01 * np.arange(200), table)}, [], columns)["yaw"]
    is_missing = np.isnan(result)
    assert 0 < np.sum(is_missing) < 3
    np.testing.assert_allclose(result[~is_missing], angle[: len(result)][~is_missing], atol=1e-6)


def test_compressed_attitudes_are_unpacked():
    """Quaternions are packed as in quatcompress.h: index of the largest component, then sign and 9 bits of others."""
    bits = [[(2, 0), (0, 255), (1, 511), (0, 511)], [(3, 0), (0, 0), (1, 100), (0, 1)]]
    packed = [(b[0][0] << 30) | sum(((s << 9) | m) << (20 - 10 * k) for k, (s, m) in enumerate(b[1:])) for b in bits]
    unit = np.sqrt(0.5) / 511
    expected = np.array([[255, -511, 0, 511], [0, -100, 1, 0]]) * unit
    expected[0, 2], expected[1, 3] = 0.0, np.sqrt(1 - (100**2 + 1) * unit**2)
    result = decompress_quat(np.array(packed, np.uint32))
    np.testing.assert_allclose(result[1], expected[1], atol=1e-12)
    np.testing.assert_allclose(result[0, [0, 1, 3]], expected[0, [0, 1, 3]], atol=1e-12)


@pytest.mark.parametrize("old", [False, True])
def test_ulogs_are_read_with_axes_up_and_left(tmp_path, old):
    log = read_log(write_ulog(tmp_path / "flight.ulg", ["vehicle_angular_velocity"] if old else (), old=old))
    np.testing.assert_allclose(log.pos[5], [1 + 0.1 * T[5], LATERAL_POS[5], 3 + 0.3 * T[5]], rtol=1e-6)
    np.testing.assert_allclose(log.vel[5], [0.1, 9.81 * RATE[5], 0.3], rtol=1e-6)
    np.testing.assert_allclose(log.ang_vel[:, 1:], [[-0.05, -0.025]] * len(log.t), rtol=1e-6)
    np.testing.assert_allclose(log.quat[:, 0], np.sin(ANGLE / 2)[: len(log.t)], atol=1e-6)
    np.testing.assert_allclose(log.rotor_vel[5], [1000, 2000, 3000, 4000])
    np.testing.assert_allclose(log.command[5], [0.4, 0.5, 0.6, 0.7], rtol=1e-6)
    np.testing.assert_allclose(log.attitude_command[5], [ANGLE[5], 0, 0, 0.5], atol=1e-6)


def test_ulogs_lack_what_is_not_logged_or_slow(tmp_path):
    log = read_log(write_ulog(tmp_path / "a.ulg", ["vehicle_angular_velocity"], slow=["esc_status"]))
    assert log.rotor_vel.shape[1] == 0
    assert "esc_status every 0.2 s or more often, got every 0.25 s" in log.repairs[0]
    assert any("differentiated the attitude" in x for x in log.repairs)
    assert read_log((tmp_path / "a.ulg").rename(tmp_path / "A.ULG")).t.shape == log.t.shape


@pytest.mark.parametrize("explorer", [False, True])
def test_blackbox_logs_are_joined_with_motion_capture(tmp_path, explorer):
    log = read_log(write_blackbox(tmp_path / "LOG00001.csv", explorer), motion=create_mocap(offset=1234.56))
    assert log.dt == pytest.approx(0.004)
    angle, rate = swing(log.t - log.t[0] + 5.0015)  # times are means of four samples
    np.testing.assert_allclose(log.ang_vel[:, 0], rate, atol=2e-3)
    # The clocks agree to a fraction of 0.005 s, the step of their search.
    np.testing.assert_allclose(2 * np.arcsin(log.quat[:, 0]), angle, atol=3e-3)
    # Velocities are slopes of lines through 0.06 s of positions. Jerks reach 7 m/s^3, and the clocks agree to 2 ms.
    np.testing.assert_allclose(log.vel[20:-20, 1], drift(log.t - log.t[0] + 5.0015)[1][20:-20], atol=0.02)
    np.testing.assert_allclose(log.vel[20:-20, 2], log.pos[20:-20, 0], atol=5e-3)
    poles = 12 if explorer else 14
    np.testing.assert_allclose(log.rotor_vel[0], np.arange(60, 64) * 200 / poles)
    np.testing.assert_allclose(log.command[0], np.arange(1000, 1004))
    np.testing.assert_allclose(log.voltage, 16.1)
    assert any("clock" in x for x in log.repairs)


def test_rows_of_a_damaged_blackbox_log_are_dropped(tmp_path):
    log = read_log(write_blackbox(tmp_path / "LOG00001.csv", damaged=50), motion=create_mocap())
    assert "dropped 50 rows" in log.repairs[0]


@pytest.mark.parametrize("odometry", [True, False])
def test_ros_bags_are_read_by_the_types_of_their_topics(tmp_path, odometry):
    pytest.importorskip("rosbags")
    log = read_log(write_bag(tmp_path / "flight", odometry=odometry))
    assert log.dt == pytest.approx(0.005)
    angle, rate = swing(log.t + 5.0)
    np.testing.assert_allclose(2 * np.arcsin(log.quat[:, 0]) * np.sign(log.quat[0, 3]), angle, atol=1e-3)
    np.testing.assert_allclose(log.ang_vel[:, 0], rate, atol=1e-6)
    # A logged twist is interpolated linearly; a differentiated velocity lacks up to 0.06 s at both ends.
    np.testing.assert_allclose(log.vel[12:-12, 1], drift(log.t + 5.0)[1][12:-12], atol=1e-2)
    np.testing.assert_allclose(log.vel[:, ::2], 0, atol=2e-3)
    np.testing.assert_allclose(log.rotor_vel[7], np.arange(100, 500, 100) * 60 / (2 * np.pi))


def test_ros_bags_are_read_by_a_map_of_topics(tmp_path):
    pytest.importorskip("rosbags")
    columns = Columns(
        pos=tuple(f"/drone/pose/pose/position/{k}" for k in "xyz"),
        quat=tuple(f"/drone/pose/pose/orientation/{k}" for k in "xyzw"),
        ang_vel=tuple(f"/drone/imu/angular_velocity/{k}" for k in "xyz"),
        rotor_vel=("/motors/velocity[0]", "-/motors/velocity[1]", "/motors/velocity[2]", "-/motors/velocity[3]"),
        rpm_per_unit=60 / (2 * np.pi),
    )
    path = write_bag(tmp_path / "flight", odometry=False)
    log, log_by_types = read_log(path, columns), read_log(path)
    for key in ("pos", "quat", "vel", "ang_vel", "rotor_vel"):
        np.testing.assert_allclose(getattr(log, key), getattr(log_by_types, key), err_msg=key)
