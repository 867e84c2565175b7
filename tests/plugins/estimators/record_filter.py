"""Record ``firmware_filter.npz``: the compiled Kalman filter of the firmware in fast flights, and on the ground.

    python tests/plugins/estimators/record_filter.py PATH/OF/crazyflie-firmware

Needs gcc and a checkout of bitcraze/crazyflie-firmware; recorded at commit 2a18fc29 on 2026-11-25. The functions of
CMSIS that the filter calls are replaced by plain C. Flights last 4 s, with up to 5.4 m/s and tilts up to 62 degrees.
Loops last 1 ms; every 100th is recorded: position, velocity in the body frame, attitude error, attitude wxyz, and the
upper triangle of the covariance.
"""

import ctypes
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

FOLDER, MODULES = Path(__file__).parent, "src/modules"
FOLDERS = (
    f"{MODULES}/interface {MODULES}/interface/kalman_core {MODULES}/interface/outlierfilter src/hal/interface "
    "src/utils/interface src/utils/interface/lighthouse src/config src/drivers/interface src/platform/interface"
).split()
MODELS = "flow position pose tof distance tdoa sweep_angles".split()
HEADERS = {
    "arm_math.h": FOLDER / "record_filter.h",
    "static_mem.h": "#define NO_DMA_CCM_SAFE_ZERO_INIT",
    "log.h": "#define LOG_GROUP_START(x)\n#define LOG_GROUP_STOP(x)\n#define LOG_ADD(a, b, c)",
    "param.h": "#define PARAM_GROUP_START(x)\n#define PARAM_GROUP_STOP(x)\n#define PARAM_ADD_CORE(a, b, c)",
    "autoconf.h": "",
    "test_support.h": "",
}


def compile_filter(firmware: Path) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        for name, text in HEADERS.items():
            Path(folder, name).write_text(text.read_text() if isinstance(text, Path) else text)
        sources = [firmware / f"{MODULES}/src/kalman_core/{s}.c" for s in ("kalman_core", *(f"mm_{m}" for m in MODELS))]
        library = Path(folder, "filter.so")
        flags = ["-w", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-include", "stdint.h", "-D_GNU_SOURCE"]
        flags += ["-DUNIT_TEST_MODE", f"-I{folder}", *(f"-I{firmware / name}" for name in FOLDERS)]
        command = ["gcc", *flags, "-o", library, FOLDER / "record_filter.c", *sources, "-lm"]
        subprocess.run(command, check=True)
        return ctypes.CDLL(str(library))


c_float = ctypes.c_float


def float_array(x):
    return (c_float * len(x))(*[float(a) for a in x])


LOOPS, SAMPLE_PERIOD, GRAVITY = 4000, 100, 9.81
"""Number of loops of 1 ms, loops between recorded outputs, and gravity, m/s^2."""
PIXELS = 35 / 0.71674
"""Pixels per rad of the flow sensor (mm_flow.c)."""
ANCHORS = np.float32([[-3, -3, 0.2], [3, -3, 2.4], [3, 3, 0.2], [-3, 3, 2.4]])
STATIONS = np.float32([[-3.5, -3.0, 2.4], [3.5, 3.0, 2.4]])
DIODE = np.float32([0.015, 0.0075, 0.0])
"""Positions of UWB anchors and lighthouse stations, world frame, and of the light sensor, body frame, m."""


def station_attitude(pos):
    """Return the attitude of a station that looks at the middle of the flight, station to world. (3, 3)"""
    x = np.array([0, 0, 1.2]) - pos
    y = np.cross([0, 0, 1], x)
    return np.float32(np.stack([a / np.linalg.norm(a) for a in (x, y, np.cross(x, y))], axis=-1))


FRAMES = np.stack([station_attitude(pos) for pos in STATIONS])
"""Attitudes of the stations. (2, 3, 3)"""


def flight():
    """Return position, velocity, attitude as matrices, angular velocity and specific force in each loop.

    The path is a Lissajous figure. The drone starts at rest, turns, and points its thrust along the specific force.
    """
    t = np.arange(-5, LOOPS + 6) / 1000
    s = np.clip(t, 0, 1)
    phase = np.where(t < 1, s**3 - s**4 / 2, t - 0.5)
    pos = np.stack([a * np.sin(w * phase) for a, w in ((1.6, 2.6), (1.2, 3.1), (0.3, 2.2))], axis=-1) + [0, 0, 1.2]
    vel = np.gradient(pos, 1e-3, axis=0)
    force = np.gradient(vel, 1e-3, axis=0) + [0.0, 0.0, GRAVITY]
    z = force / np.linalg.norm(force, axis=-1, keepdims=True)
    yaw = 1.5 * phase
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=-1)
    y = np.cross(z, ahead)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    rot = np.stack([np.cross(y, z), y, z], axis=-1)
    skew = np.einsum("kji,kjl->kil", rot, np.gradient(rot, 1e-3, axis=0))
    rate = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
    return [x[5:-5] for x in (pos, vel, rot, rate, np.einsum("kji,kj->ki", rot, force))]


def quaternion(rot):
    w = 0.5 * np.sqrt(max(1 + np.trace(rot), 1e-12))
    v = [rot[2, 1] - rot[1, 2], rot[0, 2] - rot[2, 0], rot[1, 0] - rot[0, 1]]
    return np.array([*(np.array(v) / (4 * w)), w])


def inertial_measurements(flight_states, is_flying, rng):
    """Return accelerations and angular velocities in every tenth loop, and zeros in the others. (n, 6)"""
    rows = np.zeros((LOOPS + 1, 6), np.float32)
    for k in range(10, LOOPS + 1, 10):
        accel, rate = flight_states[4][k - 10 : k].mean(0), flight_states[3][k - 10 : k].mean(0)
        if not is_flying:
            accel, rate = np.array([0.3, -0.2, GRAVITY]), 0.8 * np.sin(k / 1000 * np.array([4.4, 6.9, 2.5]))
        rows[k] = *(accel + 0.3 * rng.normal(size=3)), *(rate + 0.02 * rng.normal(size=3))
    return rows


def run(lib, kind, flight_states, inertial):
    rng = np.random.default_rng(7)
    inputs, out = [], []
    lib.k_init(*[c_float(x) for x in (0.05, -0.05, 1.25, 0.0)])
    for k in range(1, LOOPS + 1):
        pos, vel, rot, rate, _ = (x[k] for x in flight_states)
        accel, gyro = inertial[k, :3], inertial[k, 3:]
        if k % 10 == 0:
            lib.k_predict(float_array(accel), float_array(gyro), k, int(kind != "ground"))
        lib.k_noise(k)
        m = np.zeros(9, np.float32)
        if (kind in ("position", "ground") and k % 10 == 5) or (kind == "sweep" and k == 2):
            m[:3] = (0 if kind == "ground" else pos) + 0.05 * rng.normal(size=3)
            lib.k_position(float_array(m[:3]), c_float(0.01))
        if kind == "pose" and k % 10 == 0:
            q = quaternion(rot) + 0.01 * rng.normal(size=4)
            m[:3] = pos + 0.02 * rng.normal(size=3)
            m[3:7] = q / np.linalg.norm(q)
            lib.k_pose(float_array(m[:3]), float_array(m[3:7]), c_float(0.01), c_float(0.05))
        if kind in ("flow", "range") and k % 10 == 0:
            flow = (rot.T @ vel)[:2] * rot[2, 2] / pos[2] + [-rate[1], rate[0]]
            m[:2] = 10 * (0.01 * PIXELS * flow + 0.2 * rng.normal(size=2))
            degrees = float_array(np.degrees(gyro.astype(np.float64)))
            lib.k_flow(c_float(m[0]), c_float(m[1]), c_float(2.0), c_float(2.0), c_float(0.01), degrees)
        if kind == "range" and k % 25 == 10:
            tilt = max(np.arccos(rot[2, 2]) - np.radians(7.5), 0)
            m[2] = pos[2] / np.cos(tilt) + 0.02 * rng.normal()
            lib.k_tof(c_float(m[2]), c_float(0.02))
        a = k // 5 % 4
        b = (a + 1) % 4
        if kind == "distance" and k % 5 == 0:
            m[0] = np.linalg.norm(pos - ANCHORS[a]) + 0.1 * rng.normal()
            lib.k_distance(c_float(m[0]), float_array(ANCHORS[a]), c_float(0.25))
        if kind == "difference" and k % 5 == 0:
            m[0] = np.linalg.norm(pos - ANCHORS[b]) - np.linalg.norm(pos - ANCHORS[a]) + 0.1 * rng.normal()
            lib.k_tdoa(c_float(m[0]), float_array(ANCHORS[a]), float_array(ANCHORS[b]), c_float(0.15), k)
        if kind == "sweep" and k % 4 == 0:
            tilt, station = math.pi / 6 * (-1) ** (k // 4), k // 8 % 2
            d = FRAMES[station].T @ (pos + rot @ DIODE - STATIONS[station])
            m[0] = math.atan2(d[1], d[0]) + math.asin(d[2] * math.tan(tilt) / math.hypot(*d[:2]))
            m[0] += 0.002 * rng.normal()
            frame = float_array(FRAMES[station].ravel())
            lib.k_sweep(
                c_float(m[0]),
                c_float(tilt),
                float_array(DIODE),
                float_array(STATIONS[station]),
                frame,
                c_float(0.001),
                k,
            )
        lib.k_finalize()
        inputs.append(m)
        if k % SAMPLE_PERIOD == 0:
            S, q, P = float_array([0] * 9), float_array([0] * 4), float_array([0] * 81)
            lib.k_get(S, q, P)
            out.append(np.concatenate([S[:], q[:], np.float32(P[:]).reshape(9, 9)[np.triu_indices(9)]]))
    return np.stack(inputs), np.float32(out)


if __name__ == "__main__":
    library, flight_states = compile_filter(Path(sys.argv[1])), flight()
    recorded = {"sweep/places": STATIONS, "sweep/frames": FRAMES}
    for name, is_flying in (("air", True), ("ground", False)):
        recorded[f"inertial/{name}"] = inertial_measurements(flight_states, is_flying, np.random.default_rng(5))
    for kind in ("position", "pose", "flow", "range", "distance", "difference", "sweep", "ground"):
        inertial = recorded["inertial/ground" if kind == "ground" else "inertial/air"]
        recorded[f"{kind}/inputs"], recorded[f"{kind}/outputs"] = run(library, kind, flight_states, inertial)
    np.savez_compressed(FOLDER / "firmware_filter.npz", **recorded)
