"""Record ``firmware_complementary.npz``: the compiled complementary filter of the firmware on random inputs.

    python tests/plugins/estimators/record_complementary.py PATH/OF/crazyflie-firmware

Needs gcc and a checkout of bitcraze/crazyflie-firmware; recorded at commit 2a18fc29 on 2026-11-24. The fast inverse
square root of sensfusion6.c, which is off by up to 0.2%, is replaced by an exact one. Attitudes are updated every 4 ms,
heights every 10 ms; outputs are recorded every 20 ms.
"""

import ctypes
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

DRIVER = """
#include <stdint.h>
#include "stabilizer_types.h"
#include "sensfusion6.h"
#include "position_estimator.h"
uint32_t now;
uint32_t xTaskGetTickCount(void) { return now; }
static state_t state;
static baro_t baro;
static tofMeasurement_t tof = {.timestamp = -1000000};
void update_attitude(float *g, float *a) {
  sensfusion6UpdateQ(g[0], g[1], g[2], a[0], a[1], a[2], 0.004f);
  positionUpdateVelocity(sensfusion6GetAccZWithoutGravity(a[0], a[1], a[2]), 0.004f);
}
void update_height(float asl, float distance, uint32_t measured_at, uint32_t tick) {
  now = tick; baro.asl = asl; tof.distance = distance; tof.timestamp = measured_at;
  positionEstimate(&state, &baro, &tof, 0.01f, 0);
}
void get(float *out) {
  sensfusion6GetQuaternion(out, out + 1, out + 2, out + 3);
  out[4] = state.position.z; out[5] = state.velocity.z;
}
"""
HEADERS = {
    "stm32f4xx.h": "",
    "FreeRTOS.h": "#include <stdint.h>\n#define M2T(x) (x)\nuint32_t xTaskGetTickCount(void);",
    "task.h": "",
    "log.h": "#define LOG_GROUP_START(x)\n#define LOG_GROUP_STOP(x)\n#define LOG_ADD(a, b, c)",
    "param.h": "#define PARAM_GROUP_START(x)\n#define PARAM_GROUP_STOP(x)\n#define PARAM_ADD_CORE(a, b, c)\n"
    "#define PARAM_ADD(a, b, c)",
    "autoconf.h": "",
}


FOLDERS = (
    "src/modules/interface src/modules/interface/estimator src/hal/interface src/utils/interface "
    "src/utils/interface/lighthouse src/config"
).split()


def compile_filter(firmware: Path) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        for name, text in HEADERS.items():
            Path(folder, name).write_text(text)
        fusion = (firmware / "src/modules/src/sensfusion6.c").read_text()
        root = "\nfloat invSqrt(float x) { return 1 / sqrtf(x); }"
        exact_fusion = re.sub(r"\nfloat invSqrt\(float x\)\n\{.*?\n\}", root, fusion, flags=re.DOTALL)
        assert exact_fusion != fusion
        Path(folder, "fusion.c").write_text(exact_fusion)
        Path(folder, "driver.c").write_text(DRIVER)
        sources = [f"{folder}/driver.c", f"{folder}/fusion.c"]
        sources += [
            firmware / f"src/{name}.c"
            for name in ("modules/src/estimator/position_estimator_altitude", "utils/src/num")
        ]
        flags = ["-w", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-include", "stdint.h", f"-I{folder}"]
        flags += [f"-I{firmware / name}" for name in FOLDERS]
        subprocess.run(["gcc", *flags, "-o", f"{folder}/filter.so", *sources, "-lm"], check=True)
        return ctypes.CDLL(f"{folder}/filter.so")


def float_array(x):
    return (ctypes.c_float * len(x))(*[float(a) for a in x])


def run(lib, measures_distance: bool, ticks=2000):
    """Return inputs of each millisecond (gyro, degrees/s, accel, g, height, distance, age, ms) and outputs."""
    rng, inputs, outputs = np.random.default_rng(7), [], []
    phase, measured_at = rng.normal(size=3), -1000
    for k in range(ticks):
        t = k / 1000
        gyro = 30 * np.sin(2 * np.pi * t * np.array([0.7, 1.1, 0.4]) + phase)
        accel = np.array([0.0, 0.0, 1.0]) + (k > 0) * 0.1 * rng.normal(size=3)
        height = 1.0 + 0.3 * np.sin(t) + 0.05 * rng.normal()
        distance = 1.1 + 0.3 * np.sin(t) + 0.01 * rng.normal()
        if measures_distance and k >= 500 and k % 25 == 0 and not 1000 < k < 1300:
            measured_at = k
        row = np.float32([*gyro, *accel, height, distance, k - measured_at])
        if k % 4 == 0:
            lib.update_attitude(float_array(row[:3]), float_array(row[3:6]))
        if k % 10 == 0:
            lib.update_height(ctypes.c_float(row[6]), ctypes.c_float(row[7]), measured_at & 0xFFFFFFFF, k)
        inputs.append(row)
        if k % 20 == 19:
            out = float_array([0] * 6)
            lib.get(out)
            outputs.append(np.float32(out[:]))
    return np.stack(inputs), np.stack(outputs)


if __name__ == "__main__":
    recorded = {}
    for name, measures_distance in (("pressure", False), ("ground", True)):
        recorded[f"{name}/inputs"], recorded[f"{name}/outputs"] = run(
            compile_filter(Path(sys.argv[1])), measures_distance
        )
    np.savez_compressed(Path(__file__).parent / "firmware_complementary.npz", **recorded)
