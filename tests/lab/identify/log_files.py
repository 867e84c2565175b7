"""Writers of log files for the tests of readers: logs of drones that swing about their x axis."""

import struct
from zlib import crc32

import numpy as np

from crazysim.lab.identify import Columns

N = 400
T = 5.0 + 0.01 * np.arange(N)
"""Times of the samples, s."""
ANGLE = 0.3 * np.sin(T)
"""Roll, rad."""
RATE = 0.3 * np.cos(T)
"""Roll rate, rad/s."""
LATERAL_POS = 9.81 * ANGLE
"""Position along y, m: its second derivative is ``-g roll``, the acceleration of a drone with this roll, m/s^2."""


def write_crazyflie(path, version=2, pause=(), damaged=False):
    """Write a log of a micro-SD card: body rates in degrees/s at 100 Hz, other variables at 50 Hz, two events.

    Samples with the numbers in ``pause`` have body rates only. A damaged log lacks its last 7 bytes.
    """
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
                + struct.pack("<14f", T[k], LATERAL_POS[k], 3, 1, 9.81 * RATE[k], 0, *quat, 1e4, 1e4, 1e4, 1e4)
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
"""Columns of the logs of ``write_crazyflie``."""


def write_ulog(path, leave_out=(), slow=(), old=False):
    """Write a ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html).

    ``leave_out`` names the messages that are missing, and ``slow`` those that come only every 0.25 s. Old logs have the
    body rates in the message of the attitude.
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
            + struct.pack("<6f", 1 + 0.1 * t, -LATERAL_POS[k], -3 - 0.3 * t, 0.1, -9.81 * RATE[k], -0.3),
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


BLACKBOX_TIMES = np.arange(5.0, 5.0 + 0.01 * N, 0.001)
"""Times of the blackbox, s."""


def swing(t):
    """Return roll, rad, and its rate, rad/s, of a swing that does not repeat itself."""
    return 0.3 * np.sin(t) + 0.1 * np.sin(2.7 * t), 0.3 * np.cos(t) + 0.27 * np.cos(2.7 * t)


def drift(t):
    """Return the position, m, and velocity, m/s, along y of a drone with the roll of ``swing``."""
    return (
        9.81 * (0.3 * np.sin(t) + 0.1 / 2.7**2 * np.sin(2.7 * t)),
        9.81 * (0.3 * np.cos(t) + 0.1 / 2.7 * np.cos(2.7 * t)),
    )


def write_blackbox(path, explorer=False, damaged=0, leave_out=()):
    """Write a log at 1 kHz as blackbox_decode or the Blackbox Explorer (12 poles, high resolution) does.

    The first ``damaged`` rows have two cells only.
    """
    names = ["loopIteration", "time", *(f"gyroADC[{k}]" for k in range(3)), *(f"motor[{k}]" for k in range(4))]
    names += [*(f"eRPM[{k}]" for k in range(4)), "vbatLatest", "flightModeFlags"]
    _, rate = swing(BLACKBOX_TIMES)
    scale = 10 if explorer else 1
    cells = [
        np.arange(len(BLACKBOX_TIMES)),
        np.round(1e6 * BLACKBOX_TIMES),
        np.degrees(rate) * scale,
        0 * BLACKBOX_TIMES,
        0 * BLACKBOX_TIMES,
    ]
    cells += [np.full(len(BLACKBOX_TIMES), 1000.0 + k) for k in range(4)] + [
        np.full(len(BLACKBOX_TIMES), 60.0 + k) for k in range(4)
    ]
    cells += [np.full(len(BLACKBOX_TIMES), 1610.0 if explorer else 16.1)]
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


def create_mocap(offset=0.0, of_other_flight=False):
    """Return motion capture of ``swing`` at 100 Hz, on a clock that is behind by an offset, s.

    Motion capture of another flight has a random roll.
    """
    angle, _ = swing(T)
    if of_other_flight:
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


def write_bag(path, leave_out=(), odometry=True, storage="sqlite3", seconds=4.0):
    """Write a bag: pose or odometry and rotor speeds at 100 Hz, gyroscope at 200 Hz, all with headers.

    The storage is ``"sqlite3"`` or ``"mcap"`` for ROS 2, or ``"bag"`` for ROS 1.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    old = storage == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
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
        return make("std_msgs/msg/Header", stamp=stamp, frame_id="world", **({"seq": 0} if old else {}))

    def vector(kind, *x):
        return make(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, x), strict=False)))

    plugin = {"sqlite3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}
    serialize = store.serialize_ros1 if old else store.serialize_cdr
    with rosbag1.Writer(path) if old else rosbag2.Writer(path, version=9, storage_plugin=plugin[storage]) as writer:
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
                # The bag's own time is late; readers use the time in the header.
                writer.write(topics[topic], round(1e9 * (t + 0.3)), serialize(message, kinds[topic]))

        for k, t in enumerate(np.arange(5.0, 5.0 + seconds, 0.005)):
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
