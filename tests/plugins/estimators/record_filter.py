"""Record ``firmware_filter.npz``: the compiled Kalman filter of the firmware on random inputs.

    python tests/plugins/estimators/record_filter.py PATH/OF/crazyflie-firmware

Needs gcc and a checkout of bitcraze/crazyflie-firmware; recorded at commit 2a18fc29 on 2026-11-24. The functions of
CMSIS that the filter calls are replaced by plain C. Loops last 1 ms; every 20th is kept: position, velocity in the body
frame, attitude error, attitude wxyz, and the upper triangle of the covariance.
"""

import ctypes
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE, MODULES = Path(__file__).parent, "src/modules"
FOLDERS = (
    f"{MODULES}/interface {MODULES}/interface/kalman_core {MODULES}/interface/outlierfilter src/hal/interface "
    "src/utils/interface src/utils/interface/lighthouse src/config src/drivers/interface src/platform/interface"
).split()
MODELS = "flow position pose tof distance tdoa sweep_angles".split()
HEADERS = {
    "arm_math.h": HERE / "record_filter.h",
    "static_mem.h": "#define NO_DMA_CCM_SAFE_ZERO_INIT",
    "log.h": "#define LOG_GROUP_START(x)\n#define LOG_GROUP_STOP(x)\n#define LOG_ADD(a, b, c)",
    "param.h": "#define PARAM_GROUP_START(x)\n#define PARAM_GROUP_STOP(x)\n#define PARAM_ADD_CORE(a, b, c)",
    "autoconf.h": "",
    "test_support.h": "",
}


def compiled(firmware: Path) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        for name, text in HEADERS.items():
            Path(folder, name).write_text(text.read_text() if isinstance(text, Path) else text)
        sources = [firmware / f"{MODULES}/src/kalman_core/{s}.c" for s in ("kalman_core", *(f"mm_{m}" for m in MODELS))]
        library = Path(folder, "filter.so")
        flags = ["-w", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-include", "stdint.h", "-D_GNU_SOURCE"]
        flags += ["-DUNIT_TEST_MODE", f"-I{folder}", *(f"-I{firmware / name}" for name in FOLDERS)]
        command = ["gcc", *flags, "-o", library, HERE / "record_filter.c", *sources, "-lm"]
        subprocess.run(command, check=True)
        return ctypes.CDLL(str(library))


f = ctypes.c_float


def v(x):
    return (f * len(x))(*[float(a) for a in x])


rng = np.random.default_rng(5)
ANCHORS = np.float32([[-3, -3, 0.2], [3, -3, 2.4], [3, 3, 0.2], [-3, 3, 2.4]])


def rotation(rng):
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    x, y, z, w = q
    return np.float32(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def run(lib, kind, loops=400, every=20):
    inputs, out = [], []
    start = [0.3, -0.2, 1.0, 0.0]
    lib.k_init(*[f(x) for x in start])
    pos = np.array(start[:3])
    g0 = rng.normal(size=3) * 0.5
    rotation(rng)  # one draw, to keep the numbers that are recorded
    for k in range(1, loops + 1):
        t = k / 1000
        gyro = 0.8 * np.sin(2 * np.pi * t * np.array([0.7, 1.1, 0.4]) + g0)
        accel = np.array([0.3, -0.2, 9.81]) + 0.5 * rng.normal(size=3)
        flying = int(kind != "ground")
        values = np.zeros(20, np.float32)
        values[:3], values[3:6] = accel, gyro
        if k % 10 == 0:
            lib.k_predict(v(values[:3]), v(values[3:6]), k, flying)
        lib.k_noise(k)
        m = values[6:]
        if (kind in ("position", "ground") and k % 10 == 5) or (kind == "sweep" and k == 2):
            m[:3] = pos + 0.05 * rng.normal(size=3)
            lib.k_position(v(m[:3]), f(0.01))
        if kind == "pose" and k % 10 == 0:
            q = np.array([0.02, -0.03, 0.02, 1.0]) + 0.01 * rng.normal(size=4)
            q /= np.linalg.norm(q)
            m[:3] = pos + 0.02 * rng.normal(size=3)
            m[3:7] = q
            lib.k_pose(v(m[:3]), v(m[3:7]), f(0.01), f(0.05))
        if kind == "flow":
            if k % 10 == 3:
                m[:2] = rng.normal(size=2) * 3
                lib.k_flow(f(m[0]), f(m[1]), f(2.0), f(2.0), f(0.01), v(np.degrees(values[3:6].astype(np.float64))))
            if k % 25 == 10:
                m[2] = 1.0 + 0.02 * rng.normal()
                lib.k_tof(f(m[2]), f(0.02))
        if kind == "distance" and k % 5 == 0:
            a = k // 5 % 4
            m[0] = np.linalg.norm(pos - ANCHORS[a]) + 0.1 * rng.normal()
            m[1] = a
            lib.k_distance(f(m[0]), v(ANCHORS[a]), f(0.25))
        if kind == "difference" and k % 5 == 0:
            a = k // 5 % 4
            b = (a + 1) % 4
            m[0] = np.linalg.norm(pos - ANCHORS[b]) - np.linalg.norm(pos - ANCHORS[a]) + 0.1 * rng.normal()
            m[1] = a
            lib.k_tdoa(f(m[0]), v(ANCHORS[a]), v(ANCHORS[b]), f(0.15), k)
        if kind == "sweep" and k % 4 == 0:
            tilt = math.pi / 6 * (-1) ** (k // 4)
            place = np.float32([-2, 1, 2.2])
            M = rotation(np.random.default_rng(2))
            s = np.float32([0.015, 0.0075, 0.0])
            d = M.T @ (pos + s - place)
            r = math.hypot(d[0], d[1])
            m[0] = math.atan2(d[1], d[0]) + math.asin(d[2] * math.tan(tilt) / r) + 0.002 * rng.normal()
            lib.k_sweep(f(m[0]), f(tilt), v(s), v(place), v(M.ravel()), f(0.001), k)
        lib.k_finalize()
        inputs.append(values)
        if k % every == 0:
            S, q, P = v([0] * 9), v([0] * 4), v([0] * 81)
            lib.k_get(S, q, P)
            out.append(np.concatenate([S[:], q[:], np.float32(P[:]).reshape(9, 9)[np.triu_indices(9)]]))
    return np.stack(inputs), np.float32(out)


if __name__ == "__main__":
    library, recorded = compiled(Path(sys.argv[1])), {}
    for kind in ("position", "pose", "flow", "distance", "difference", "sweep", "ground"):
        recorded[f"{kind}/inputs"], recorded[f"{kind}/outputs"] = run(library, kind)
    recorded["sweep/frame"] = rotation(np.random.default_rng(2))
    np.savez_compressed(HERE / "firmware_filter.npz", **recorded)
