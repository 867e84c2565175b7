"""Files of flight controllers and robots, written here, are read; damaged ones are repaired or refused."""

import struct
from zlib import crc32

import numpy as np
import pytest

from crazysim.errors import ConfigError
from crazysim.identify import Columns, read_log
from crazysim.identify.readers import decompressed

N = 400
T = 5.0 + 0.01 * np.arange(N)
ANGLE = 0.3 * np.sin(T)
"""Roll, rad: the drones of these logs swing about their first axis."""
RATE = 0.3 * np.cos(T)
SIDE = 9.81 * ANGLE
"""Position along y, m: roll accelerates a drone by ``-g roll``, which this is twice the integral of."""


def crazyflie(path, version=2, pause=(), damaged=False):
    """Write a log of a micro-SD card: body rates in degrees/s at 100 Hz, all others at 50 Hz, and two rare events."""
    kinds = {
        1: ("start", ["x", "y"]),
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
        if k in (200, 210):
            body.append(struct.pack("<HI" if version == 1 else "<HQ", 1, round(t * (1e3 if version == 1 else 1e6))))
            body.append(struct.pack("<2f", 0, 0))
        time = struct.pack("<I", round(1e3 * t)) if version == 1 else struct.pack("<Q", round(1e6 * t))
        body.append(struct.pack("<H", 3) + time + struct.pack("<3f", np.degrees(RATE[k]), 0, 0))
        if k % 2 == 0 and k not in pause:
            quat = np.sin(ANGLE[k] / 2), 0, 0, np.cos(ANGLE[k] / 2)
            body.append(
                struct.pack("<H", 7)
                + time
                + struct.pack("<14f", T[k], SIDE[k], 3, 1, 9.81 * RATE[k], 0, *quat, 1e4, 1e4, 1e4, 1e4)
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
    assert "1 gap," in log.repairs[0]


def test_compressed_attitudes_are_unpacked():
    """The components below, packed by the definition of quatcompress.h: three of ten bits after the largest's index."""
    bits = {1: [(2, 0), (0, 255), (1, 511), (0, 511)], 2: [(3, 0), (0, 0), (1, 100), (0, 1)]}
    packed = [
        (b[0][0] << 30) | sum(((s << 9) | m) << (20 - 10 * k) for k, (s, m) in enumerate(b[1:])) for b in bits.values()
    ]
    unit = np.sqrt(0.5) / 511
    expected = np.array([[255, -511, 0, 511], [0, -100, 1, 0]]) * unit
    expected[0, 2], expected[1, 3] = 0.0, np.sqrt(1 - (100**2 + 1) * unit**2)
    found = decompressed(np.array(packed, np.uint32))
    np.testing.assert_allclose(found[1], expected[1], atol=1e-12)
    np.testing.assert_allclose(found[0, [0, 1, 3]], expected[0, [0, 1, 3]], atol=1e-12)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "log").write_bytes(b"text, not a log")
    with pytest.raises(ConfigError, match="begins with 0xBC"):
        read_log(tmp_path / "log")
    with pytest.raises(ConfigError, match="version 1 or 2"):
        read_log(crazyflie(tmp_path / "log03", version=3))
    with pytest.raises(ConfigError, match="stateEstimate"):
        read_log(crazyflie(tmp_path / "log04"))


def ulog(path, leave_out=(), slow=(), old=False):
    """Write a ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html); slow messages come every 0.25 s.

    Old ones have the body rates in the message of the attitude.
    """
    formats = {
        "esc_report": "uint64_t timestamp;int32_t esc_rpm;",
        "esc_status": "uint64_t timestamp;esc_report[4] esc;uint8_t esc_count;",
        "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;",
        "vehicle_attitude": "uint64_t timestamp;"
        + ("float rollspeed;float pitchspeed;float yawspeed;" if old else "")
        + "float[4] q;",
        "vehicle_attitude_setpoint": "uint64_t timestamp;float[4] q_d;float[3] thrust_body;",
        "actuator_motors": "uint64_t timestamp;float[12] control;",
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
        rates = struct.pack("<3f", RATE[k], 0.05, 0.025)
        content = {
            "esc_status": stamp + b"".join(stamp + struct.pack("<i", 1000 * (i + 1)) for i in range(4)) + b"\x04",
            "vehicle_local_position": stamp
            + struct.pack("<6f", 1 + 0.1 * t, -SIDE[k], -3 - 0.3 * t, 0.1, -9.81 * RATE[k], -0.3),
            "vehicle_attitude": stamp + (rates if old else b"") + struct.pack("<4f", *quat),
            "vehicle_attitude_setpoint": stamp + struct.pack("<7f", *quat, 0, 0, -0.5),
            "actuator_motors": stamp + struct.pack("<12f", 0.4, 0.5, 0.6, 0.7, *[np.nan] * 8),
            "vehicle_angular_velocity": stamp + rates,
        }
        data += b"".join(
            message("D", struct.pack("<H", i) + content[name])
            for i, name in enumerate(names)
            if name not in slow or k % 25 == 0
        )
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("old", [False, True])
def test_ulogs_are_read_with_axes_up_and_left(tmp_path, old):
    pytest.importorskip("pyulog")
    log = read_log(ulog(tmp_path / "flight.ulg", ["vehicle_angular_velocity"] if old else (), old=old))
    np.testing.assert_allclose(log.pos[5], [1 + 0.1 * T[5], SIDE[5], 3 + 0.3 * T[5]], rtol=1e-6)
    np.testing.assert_allclose(log.vel[5], [0.1, 9.81 * RATE[5], 0.3], rtol=1e-6)
    np.testing.assert_allclose(log.ang_vel[:, 1:], [[-0.05, -0.025]] * len(log.t), rtol=1e-6)
    np.testing.assert_allclose(log.quat[:, 0], np.sin(ANGLE / 2)[: len(log.t)], atol=1e-6)
    np.testing.assert_allclose(log.rotor_vel[5], [1000, 2000, 3000, 4000])
    np.testing.assert_allclose(log.command[5], [0.4, 0.5, 0.6, 0.7], rtol=1e-6)
    np.testing.assert_allclose(log.attitude_command[5], [ANGLE[5], 0, 0, 0.5], atol=1e-6)


def test_ulogs_lack_what_is_not_logged_or_slow(tmp_path):
    pytest.importorskip("pyulog")
    log = read_log(ulog(tmp_path / "a.ulg", ["vehicle_angular_velocity"], slow=["esc_status"]))
    assert log.rotor_vel.shape[1] == 0
    assert "esc_status every 0.2 s or more often, got every 0.25 s" in log.repairs[0]
    assert any("differentiated the attitude" in x for x in log.repairs)
    with pytest.raises(ConfigError, match=r"columns rpm2, rpm1, .* a slow stream: expected esc_status"):
        read_log(tmp_path / "a.ulg", Columns(rotor_vel=("rpm2", "rpm1", "rpm3", "rpm4")))
    with pytest.raises(ConfigError, match=r"vehicle_attitude every 0\.2 s"):
        read_log(ulog(tmp_path / "b.ulg", slow=["vehicle_attitude"]))
    with pytest.raises(ConfigError, match="expected messages vehicle_attitude, got 5 others"):
        read_log(ulog(tmp_path / "c.ulg", ["vehicle_attitude"]))
    (tmp_path / "d.ulg").write_bytes(b"no ULog")
    with pytest.raises(ConfigError, match="expected a ULog"):
        read_log(tmp_path / "d.ulg")


FAST = np.arange(5.0, 5.0 + 0.01 * N, 0.001)
"""Times of the blackbox, s."""


def swing(t):
    """Return roll, rad, and its rate, rad/s, of a swing that does not repeat itself."""
    return 0.3 * np.sin(t) + 0.1 * np.sin(2.7 * t), 0.3 * np.cos(t) + 0.27 * np.cos(2.7 * t)


def drift(t):
    """Return position, m, and velocity, m/s, along y that follow from that roll."""
    return (
        9.81 * (0.3 * np.sin(t) + 0.1 / 2.7**2 * np.sin(2.7 * t)),
        9.81 * (0.3 * np.cos(t) + 0.1 / 2.7 * np.cos(2.7 * t)),
    )


def blackbox(path, explorer=False, damaged=0, leave_out=()):
    """Write a log at 1 kHz as blackbox_decode or the Blackbox Explorer (12 poles, high resolution) does."""
    names = ["loopIteration", "time", *(f"gyroADC[{k}]" for k in range(3)), *(f"motor[{k}]" for k in range(4))]
    names += [*(f"eRPM[{k}]" for k in range(4)), "vbatLatest", "flightModeFlags"]
    _, rate = swing(FAST)
    scale = 10 if explorer else 1
    cells = [np.arange(len(FAST)), np.round(1e6 * FAST), np.degrees(rate) * scale, 0 * FAST, 0 * FAST]
    cells += [np.full(len(FAST), 1000.0 + k) for k in range(4)] + [np.full(len(FAST), 60.0 + k) for k in range(4)]
    cells += [np.full(len(FAST), 1610.0 if explorer else 16.1)]
    keep = [k for k, name in enumerate(names) if name not in leave_out]
    unit = {} if explorer else {"time": " (us)", "vbatLatest": " (V)", "flightModeFlags": " (flags)"}
    header = [names[k] + unit.get(names[k], "") for k in keep]
    lines = ['"Product","Blackbox flight data recorder"', '"motor_poles",12', '"blackbox_high_resolution","1"']
    lines = [*lines, ",".join(f'"{x}"' for x in header)] if explorer else [", ".join(header)]
    rows = [
        [*(f"{c:.6g}" if k > 1 else f"{c:.0f}" for k, c in enumerate(row)), "ANGLE_MODE|ARM"]
        for row in zip(*cells, strict=True)
    ]
    lines += [",".join(row[k] for k in keep) if i >= damaged else "1,2" for i, row in enumerate(rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def mocap(offset=0.0, reverse=False):
    """Return motion capture of the same swing at 100 Hz, on a clock that is behind by an offset, s."""
    angle, _ = swing(T)
    if reverse:
        angle = np.cumsum(np.random.default_rng(0).normal(size=N)) * 0.03
    columns = {
        "x": T,
        "y": drift(T)[0],
        "z": T**2 / 2,
        "qx": np.sin(angle / 2),
        "qy": 0 * T,
        "qz": 0 * T,
        "qw": np.cos(angle / 2),
    }
    return columns | {"t": T - offset}


@pytest.mark.parametrize("explorer", [False, True])
def test_blackbox_logs_are_joined_with_motion_capture(tmp_path, explorer):
    log = read_log(blackbox(tmp_path / "LOG00001.csv", explorer), motion=mocap(offset=1234.56))
    assert log.dt == pytest.approx(0.004)
    angle, rate = swing(log.t - log.t[0] + 5.0015)  # times are means of four samples
    np.testing.assert_allclose(log.ang_vel[:, 0], rate, atol=2e-3)
    # The clocks agree to a fraction of the 0.005 s of the search.
    np.testing.assert_allclose(2 * np.arcsin(log.quat[:, 0]), angle, atol=3e-3)
    # Differentiated: lines through 0.06 s at jerks of up to 7 m/s^3, with clocks that agree to 2 ms.
    np.testing.assert_allclose(log.vel[20:-20, 1], drift(log.t - log.t[0] + 5.0015)[1][20:-20], atol=0.02)
    np.testing.assert_allclose(log.vel[20:-20, 2], log.pos[20:-20, 0], atol=5e-3)
    poles = 12 if explorer else 14
    np.testing.assert_allclose(log.rotor_vel[0], np.arange(60, 64) * 200 / poles)
    np.testing.assert_allclose(log.command[0], np.arange(1000, 1004))
    np.testing.assert_allclose(log.voltage, 16.1)
    assert any("clock" in x for x in log.repairs)


def test_bad_blackbox_logs_are_repaired_or_refused(tmp_path):
    path = tmp_path / "LOG00001.csv"
    assert "dropped 50 rows" in read_log(blackbox(path, damaged=50), motion=mocap()).repairs[0]
    with pytest.raises(ConfigError, match="Decode the log again"):
        read_log(blackbox(path, damaged=2000), motion=mocap())
    with pytest.raises(ConfigError, match="--motion"):
        read_log(blackbox(path))
    with pytest.raises(ConfigError, match="one flight"):
        read_log(blackbox(path), motion=mocap(reverse=True))
    with pytest.raises(ConfigError, match=r"gyroADC\[1\]"):
        read_log(blackbox(path, leave_out=["gyroADC[1]"]), motion=mocap())
    with pytest.raises(ConfigError, match="degrees per second"):
        read_log(blackbox(path, explorer=True), Columns(rad_per_unit=60.0), motion=mocap())


def bag(path, leave_out=(), odometry=True):
    """Write a bag of ROS 2: pose or odometry and rotor speeds at 100 Hz, gyroscope at 200 Hz, all with headers."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(
        get_types_from_msg(
            "std_msgs/Header header\nfloat64[] position\nfloat64[] velocity\nfloat64[] normalized",
            "actuator_msgs/msg/Actuators",
        )
    )
    m = store.types

    def make(kind, **fields):
        return m[kind](**fields)

    def header(t):
        stamp = make("builtin_interfaces/msg/Time", sec=int(t), nanosec=round(t % 1 * 1e9))
        return make("std_msgs/msg/Header", stamp=stamp, frame_id="world")

    def vector(kind, *x):
        return make(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, x), strict=False)))

    with Writer(path, version=9) as writer:
        pose_kind = "nav_msgs/msg/Odometry" if odometry else "geometry_msgs/msg/PoseStamped"
        kinds = {
            "/drone/pose": pose_kind,
            "/drone/imu": "sensor_msgs/msg/Imu",
            "/motors": "actuator_msgs/msg/Actuators",
        }
        kinds = {topic: kind for topic, kind in kinds.items() if topic not in leave_out}
        topics = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}

        def write(topic, t, message):
            if topic in topics:
                # The bag's own time is late; that of the header counts.
                writer.write(topics[topic], round(1e9 * (t + 0.3)), store.serialize_cdr(message, kinds[topic]))

        for k, t in enumerate(np.arange(5.0, 9.0, 0.005)):
            angle, rate = swing(t)
            quat = np.array([np.sin(angle / 2), 0, 0, np.cos(angle / 2)]) * (-1 if k % 4 else 1)
            gyro = make(
                "sensor_msgs/msg/Imu", header=header(t), orientation=vector("Quaternion", 0, 0, 0, 1),
                orientation_covariance=np.zeros(9), angular_velocity=vector("Vector3", rate, 0, 0),
                angular_velocity_covariance=np.zeros(9), linear_acceleration=vector("Vector3", 0, 0, 0),
                linear_acceleration_covariance=np.zeros(9),
            )  # fmt: skip
            write("/drone/imu", t, gyro)
            if k % 2:
                continue
            pose = make(
                "geometry_msgs/msg/Pose",
                position=vector("Point", 1, drift(t)[0], 3),
                orientation=vector("Quaternion", *quat),
            )
            if odometry:
                # The velocity along world y, in the frame of the body.
                speed = drift(t)[1]
                twist = make(
                    "geometry_msgs/msg/Twist",
                    linear=vector("Vector3", 0, speed * np.cos(angle), -speed * np.sin(angle)),
                    angular=vector("Vector3", 9, 9, 9),
                )  # fmt: skip
                message = make(
                    pose_kind, header=header(t), child_frame_id="body",
                    pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
                    twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
                )  # fmt: skip
            else:
                message = make(pose_kind, header=header(t), pose=pose)
            write("/drone/pose", t, message)
            speeds = np.array([100.0, -200.0, 300.0, -400.0])
            empty = np.zeros(0)
            write(
                "/motors",
                t,
                make(
                    kinds.get("/motors", "actuator_msgs/msg/Actuators"),
                    header=header(t),
                    position=empty,
                    velocity=speeds,
                    normalized=empty,
                ),
            )
    return path


@pytest.mark.parametrize("odometry", [True, False])
def test_ros_bags_are_read_by_the_types_of_their_topics(tmp_path, odometry):
    pytest.importorskip("rosbags")
    log = read_log(bag(tmp_path / "flight", odometry=odometry))
    assert log.dt == pytest.approx(0.005)
    angle, rate = swing(log.t + 5.0)
    np.testing.assert_allclose(2 * np.arcsin(log.quat[:, 0]) * np.sign(log.quat[0, 3]), angle, atol=1e-3)
    np.testing.assert_allclose(log.ang_vel[:, 0], rate, atol=1e-6)
    # Linear interpolation of the twist; the velocity that is differentiated lacks up to 0.06 s at both ends.
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
    path = bag(tmp_path / "flight", odometry=False)
    log, same = read_log(path, columns), read_log(path)
    for key in ("pos", "quat", "vel", "ang_vel", "rotor_vel"):
        np.testing.assert_allclose(getattr(log, key), getattr(same, key), err_msg=key)


def test_ros_bags_without_a_topic_or_a_field_are_refused(tmp_path):
    pytest.importorskip("rosbags")
    with pytest.raises(ConfigError, match=r"expected a topic of nav_msgs.*/motors"):
        read_log(bag(tmp_path / "a", leave_out=["/drone/pose"]))
    with pytest.raises(ConfigError, match=r"expected a topic and a field.*/drone/pose \(nav_msgs"):
        read_log(bag(tmp_path / "b"), Columns(voltage=("/battery/voltage",)))
    with pytest.raises(ConfigError, match="ros2 interface show"):
        read_log(tmp_path / "b", Columns(voltage=("/drone/imu/voltage",)))
    (tmp_path / "c.bag").write_bytes(b"no bag")
    with pytest.raises(ConfigError, match="expected a bag"):
        read_log(tmp_path / "c.bag")
