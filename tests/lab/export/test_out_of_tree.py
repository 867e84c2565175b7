"""Policies as out of tree controllers of the Crazyflie's firmware, compiled against stubs of its headers."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import ConfigError, Sim, rotation
from crazysim.control import CFirmware
from crazysim.drones import load_airframe
from crazysim.engine.backends import native
from crazysim.envs import make
from crazysim.envs.actions import hover_rotor_states
from crazysim.envs.statistics import RunningStats
from crazysim.lab.export.betaflight import to_betaflight
from crazysim.lab.export.out_of_tree import to_out_of_tree
from crazysim.lab.export.rl_tools import SHAPES, evaluate
from crazysim.train.export import describe
from crazysim.train.networks import Policy, init_mlp

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="no C++ compiler here")
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")
CONTROLLER = """
#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef struct { float x, y, z; } axes, point_t, velocity_t;
typedef struct { float x, y, z, w; } quaternion_t;
typedef struct { float roll, pitch, yaw; } attitude_t;
typedef enum { modeDisable, modeAbs, modeVelocity } stab_mode_t;
typedef enum { controlModeLegacy, controlModeForceTorque, controlModeForce } control_mode_t;
typedef struct {
  float thrust, thrustSi, torqueX, torqueY, torqueZ, normalizedForces[4];
  control_mode_t controlMode;
} control_t;
typedef struct {
  struct { stab_mode_t x, y, z, roll, pitch, yaw; } mode;
  attitude_t attitude, attitudeRate;
  axes position;
  float thrust;
} setpoint_t;
typedef struct { quaternion_t attitudeQuaternion; axes position, velocity; attitude_t attitude; } state_t;
typedef struct { axes gyro; } sensorData_t;
typedef uint32_t stabilizerStep_t;
void controllerOutOfTreeInit(void);
void controllerOutOfTree(control_t *, const setpoint_t *, const sensorData_t *, const state_t *, stabilizerStep_t);
"""
POWER_DISTRIBUTION = """
#include "controller.h"
typedef struct { int32_t list[4]; } motors_thrust_uncapped_t;
typedef struct { uint16_t list[4]; } motors_thrust_pwm_t;
void powerDistribution(const control_t *, motors_thrust_uncapped_t *);
bool powerDistributionCap(const motors_thrust_uncapped_t *, motors_thrust_pwm_t *);
"""
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "out_of_tree.c"
CONTROLLER_PID = """
#include "controller.h"
static setpoint_t below;
static int started;
static void controllerPidInit(void) { started = 1; }
static bool controllerPidTest(void) { return started; }
static void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                          const state_t *state, const stabilizerStep_t step) {
  (void)sensors; (void)state; (void)step;
  below = *setpoint;
  control->controlMode = controlModeLegacy;
  control->thrust = setpoint->thrust;
}
"""
DRIVER = """
#include "controller.c"
void drive(int mode, unsigned step, const float *x, float *out) {
  setpoint_t setpoint = {.mode = {mode, mode, mode, 0, 0, 0}, .position = {x[0], x[1], x[2]}};
  state_t state = {.attitudeQuaternion = {x[6], x[7], x[8], x[9]}, .position = {x[3], x[4], x[5]},
                   .velocity = {x[10], x[11], x[12]}};
  sensorData_t sensors = {{x[13], x[14], x[15]}};
  control_t control;
  memset(&control, 1, sizeof control);
  if (!controllerOutOfTreeTest()) controllerOutOfTreeInit();
  controllerOutOfTree(&control, &setpoint, &sensors, &state, step);
  const float results[] = {RESULTS};
  memcpy(out, results, sizeof results);
}
"""
RESULTS = {
    "attitude": "below.attitude.roll, below.attitude.pitch, below.attitude.yaw, control.thrust, below.mode.roll, "
                "below.mode.pitch, below.mode.yaw, below.mode.z, control.controlMode",
    "body_rate": "below.attitudeRate.roll, below.attitudeRate.pitch, below.attitudeRate.yaw, control.thrust, "
                 "below.mode.roll, below.mode.pitch, below.mode.yaw, below.mode.z, control.controlMode",
    "force_torque": "control.thrustSi, control.torqueX, control.torqueY, control.torqueZ, control.controlMode",
    "rotor_vel": "control.normalizedForces[0], control.normalizedForces[1], control.normalizedForces[2], "
                 "control.normalizedForces[3], control.controlMode",
}  # fmt: skip
AIRFRAME = load_airframe("cf21B_500")
MAX_THRUST = 4 * float(AIRFRAME.value("rotors.thrust_max"))
"""Thrust of all rotors at full speed, N."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    exports = {}

    def export(level):
        if level not in exports:
            meta = describe(make("hover", 1, control=level))
            n = sum(meta["observations"].values())
            stats = RunningStats(jnp.zeros(n), jnp.ones(n), jnp.asarray(1e4))
            policy, folder = Policy(stats, init_mlp(jax.random.key(0), (n, 16, 4), 0.3)), tmp_path_factory.mktemp(level)
            to_out_of_tree(policy, folder, meta, AIRFRAME, 50)
            exports[level] = policy, meta["actions"], folder
        return exports[level]

    return export


def command_of(policy, actions, x):
    """Return the command of a policy for a goal, position, attitude, velocity and body rates in degrees. (16,)"""
    goal, pos, quat, vel, ang_vel = np.split(x, [3, 6, 10, 13])
    obs = {"pos": pos, "rot": np.ravel(rotation.matrix(jnp.asarray(quat))), "vel": vel,
           "ang_vel": np.radians(ang_vel), "difference_to_goal": goal - pos}  # fmt: skip
    action = np.asarray(policy({name: jnp.asarray(value, jnp.float32) for name, value in obs.items()}))
    return np.asarray(actions["centre"]) + np.asarray(actions["scale"]) * action


def compile_driver(folder, level):
    """Return the function of mode, step and inputs, (16,), that returns what the controller gives the firmware."""
    (folder / "controller.h").write_text(CONTROLLER)
    (folder / "controller_pid.h").write_text(CONTROLLER_PID)
    (folder / "driver.c").write_text(DRIVER.replace("RESULTS", RESULTS[level]))
    cc = shutil.which("cc") or shutil.which("gcc") or "cc"
    subprocess.run([cc, *FLAGS, folder / "driver.c", "-o", folder / "driver.so", "-lm"], check=True)
    drive = ctypes.CDLL(str(folder / "driver.so")).drive

    def call(mode, step, x):
        out = np.empty(9, np.float32)
        drive(mode, step, *(a.ctypes.data_as(ctypes.POINTER(ctypes.c_float)) for a in (x, out)))
        return out[: RESULTS[level].count(",") + 1]

    return call


@pytest.mark.parametrize("level", RESULTS)
def test_the_controller_gives_the_commands_of_the_policy_in_units_of_the_firmware(exported, level):
    """Angles are in degrees, pitch positive with the nose up, and thrusts relative to the largest.

    The motors are off if the setpoint has no position.
    """
    policy, actions, folder = exported(level)
    call = compile_driver(folder, level)
    x = np.array([0.3, -0.2, 1.0, 0.1, 0.2, 0.9, 0.1, -0.2, 0.3, 0.0, 0.4, -0.5, 0.2, 20.0, -30.0, 40.0], np.float32)
    x[9] = np.sqrt(1 - np.sum(x[6:9] ** 2))
    flying = call(1, 40, x)
    command = command_of(policy, actions, x)
    if level in ("attitude", "body_rate"):
        mode = 1 if level == "attitude" else 2
        expected = [*np.degrees(command[:3]) * [1, -1, 1], 65535 * command[3] / MAX_THRUST, mode, mode, mode, 0, 0]
    elif level == "force_torque":
        expected = [*command, 1]
    else:
        thrust = np.polynomial.polynomial.polyval(command, AIRFRAME.value("rotors.thrust_curve"))
        expected = [*4 * thrust / MAX_THRUST, 2]
    np.testing.assert_allclose(flying[: len(expected)], expected, rtol=3e-5, atol=1e-6)
    later = call(1, 41, x + np.float32(0.1))  # between two ticks of the policy
    moved = call(1, 60, x + np.float32(0.1))
    np.testing.assert_array_equal(later[:4], flying[:4])
    assert not np.allclose(moved[:4], flying[:4], rtol=1e-3)
    off = call(0, 60, x)
    assert off[3] == 0
    assert off[len(expected) - 1] == expected[-1]
    later = call(1, 61, x)  # switched on between two ticks, it does not fly the last command from before
    np.testing.assert_array_equal(later[:4], flying[:4])


@pytest.mark.parametrize("level", RESULTS)
def test_the_motors_are_off_without_a_finite_state_and_stay_within_limits(exported, level):
    """With NaN or infinity in any input, at any tick; and within the limits for any state that is finite."""
    x = np.array([0.3, -0.2, 1.0, 0.1, 0.2, 0.9, 0.0, 0.0, 0.0, 1.0, 0.4, -0.5, 0.2, 20.0, -30.0, 40.0], np.float32)
    call, rng = compile_driver(exported(level)[2], level), np.random.default_rng(0)
    off = call(0, 0, x)
    motors = slice(0, 4) if level in ("rotor_vel", "force_torque") else slice(3, 4)  # thrust of the firmware's PID
    np.testing.assert_array_equal(off[motors], 0)
    for value in (np.nan, np.inf, -np.inf):
        for i in range(16):
            broken = x.copy()
            broken[i] = value
            assert np.abs(call(1, 1, x)[motors]).max() > 0
            np.testing.assert_array_equal(call(1, 20, broken)[motors], 0, err_msg=f"{value} as input {i}")
            np.testing.assert_array_equal(call(1, 21, broken)[motors], 0)
    high = {"rotor_vel": 1.0, "force_torque": np.inf}.get(level, 65535.0)
    for step in range(300):
        states = np.float32(10.0 ** rng.uniform(-3, 37.5) * rng.normal(size=16)) + x
        out = call(1, 20 * step, states)[motors]
        assert np.isfinite(out).all()
        assert (out <= high).all()
        assert (out[:1] >= 0).all()


def test_the_c_controller_flies_the_flight_of_the_policy_in_python(exported):
    """In the firmware's place, at 50 Hz: the same flight within rounding of float32."""
    policy, actions, folder = exported("rotor_vel")
    library, n = folder / "policy.so", 3
    arguments = ["-DCRAZYSIM", f"-I{CFirmware.include}", folder / "controller.c", "-o", library, "-lm"]
    subprocess.run([shutil.which("cc") or "gcc", *FLAGS, *arguments], check=True)
    inputs, motors = np.zeros(39, np.float32), np.ones((2, 4), np.float32)  # struct crazysim_input
    inputs[[4, 8]] = 1.0
    for i in range(2):
        pointers = (ctypes.c_void_p(x.ctypes.data) for x in (inputs, motors[i]))
        ctypes.CDLL(str(library)).crazysim_update(None, 0, *pointers)
        inputs[9] = np.nan  # a velocity
    assert motors[0].min() > 1000.0
    assert not motors[1].any(), "rpm without a finite state"
    start = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.2], [-0.4, 0.1, 0.9]])[:, None]
    goal = np.array([0.1, 0.2, 1.1])
    in_c = Sim(n, control="state", controller=CFirmware(library, motors="rpm", freq=50))
    in_python = Sim(n, control="rotor_vel")
    for sim in (in_c, in_python):
        sim.data = with_states(sim.data, pos=start, rotor_vel=np.asarray(hover_rotor_states(sim.data.params)))
    in_c.state_control(pos=goal)
    act = jax.jit(policy)
    for _ in range(50):
        s = in_python.data.states
        obs = {"pos": s.pos, "rot": rotation.matrix(s.quat).reshape(n, 1, 9), "vel": s.vel, "ang_vel": s.ang_vel,
               "difference_to_goal": jnp.asarray(goal, s.pos.dtype) - s.pos}  # fmt: skip
        in_python.rotor_vel_control(np.asarray(actions["centre"]) + np.asarray(actions["scale"]) * act(obs))
        in_python.step(10)
        in_c.step(10)
    a, b = in_c.data.states, in_python.data.states
    assert np.abs(np.asarray(b.pos) - start).max() > 0.05  # it went somewhere
    for name in ("pos", "quat", "vel", "ang_vel"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=1e-4)


@pytest.fixture(scope="module")
def weights():
    rng = np.random.default_rng(5)
    return {name: rng.normal(scale=0.3, size=shape).astype(np.float32) for name, shape in SHAPES.items()}


def raptor_speeds(weights, airframe, states):
    """Return the speeds of the airframe's rotors after consecutive states, with the quaternion as xyzw. (n, 4)

    The states are position from the goal, quaternion, velocity and body rates in rad/s. (n, 13)
    """
    previous, inputs, actions = np.zeros(4), [], []
    for pos, quat, vel, ang_vel in (np.split(x, [3, 7, 10]) for x in states):
        rot = np.ravel(rotation.matrix(jnp.asarray(quat)))
        inputs.append(np.concatenate([pos.clip(-0.5, 0.5), rot, vel.clip(-1, 1), ang_vel, previous]))
        previous = evaluate(weights, np.array(inputs)[:, None])[-1, 0].clip(-1, 1)
        actions.append(previous)
    front, left = (airframe.value("rotors.position")[:, i] > 0 for i in range(2))
    order = [np.flatnonzero((front == x) & (left == y))[0] for x, y in ((1, 0), (0, 0), (0, 1), (1, 1))]
    speeds = np.empty((len(states), 4))
    speeds[:, order] = (1 + np.array(actions)) / 2 * airframe.rotor_vel_limits[1].max()
    return speeds


def random_states(n):
    rng = np.random.default_rng(6)
    states = rng.normal(scale=0.6, size=(n, 13))
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=-1, keepdims=True)
    return states.astype(np.float32)


def test_a_policy_of_raptors_shape_remembers_in_each_drone(tmp_path, weights):
    to_out_of_tree(weights, tmp_path, None, AIRFRAME)
    library = tmp_path / "policy.so"
    arguments = ["-DCRAZYSIM", f"-I{CFirmware.include}", tmp_path / "controller.c", "-o", library, "-lm"]
    subprocess.run([shutil.which("cc") or "gcc", *FLAGS, *arguments], check=True)
    code = ctypes.CDLL(str(library))
    code.crazysim_memory_size.restype = ctypes.c_size_t
    memories = np.full((2, code.crazysim_memory_size()), 255, np.uint8)
    assert memories.shape[1] == 4 * (16 + 4)
    states, motors, goal = random_states(20).reshape(2, 10, 13), np.empty((2, 10, 4), np.float32), [0.2, -0.1, 1.0]
    inputs = np.zeros(39, np.float32)  # struct crazysim_input
    inputs[15:18] = goal
    for drone in range(2):
        code.crazysim_init(ctypes.c_void_p(memories[drone].ctypes.data))
    for step, drone in np.ndindex(10, 2):  # both drones in turn
        inputs[2:15], inputs[2:5] = states[drone, step], states[drone, step, :3] + goal
        pointers = (ctypes.c_void_p(x.ctypes.data) for x in (inputs, motors[drone, step]))
        code.crazysim_update(ctypes.c_void_p(memories[drone].ctypes.data), 0, *pointers)
    for drone in range(2):
        np.testing.assert_allclose(motors[drone], raptor_speeds(weights, AIRFRAME, states[drone]), rtol=1e-4, atol=0.5)


def test_betaflight_gets_its_motors_in_its_order_and_range(tmp_path, weights):
    """Quaternion as wxyz, gyroscope in deg/s; commands at the rate of the policy, from any rate of the loop."""
    to_betaflight(weights, tmp_path, None, AIRFRAME)
    source, library = tmp_path / "mixer.c", tmp_path / "mixer.so"
    source.write_text(
        '#include "betaflight.h"\n'
        "bool mix(unsigned now, const float *x, float *motor);\nvoid stop(void);\n"
        "bool mix(unsigned now, const float *x, float *motor)\n"
        "{ return policy_motors(now, x, x + 7, x + 13, x + 3, x + 10, 100.0f, 2000.0f, motor); }\n"
        "void stop(void) { policy_stop(); }\n"
    )
    subprocess.run([shutil.which("cc") or "gcc", *FLAGS, source, "-o", library, "-lm"], check=True)
    code, states, goal = ctypes.CDLL(str(library)), random_states(8), np.array([0.3, 0.1, 0.9], np.float32)
    code.mix.restype = ctypes.c_bool

    def mix(now, state):
        w_first = state[[0, 1, 2, 6, 3, 4, 5, *range(7, 13)]]
        x = np.concatenate([w_first[:3] + goal, w_first[3:10], np.degrees(w_first[10:]), goal]).astype(np.float32)
        out = np.full(4, -1, np.float32)
        pointers = (a.ctypes.data_as(ctypes.POINTER(ctypes.c_float)) for a in (x, out))
        return code.mix(ctypes.c_uint(now & 0xFFFFFFFF), *pointers), out

    start = 2**32 - 30_000  # the microseconds overflow in flight
    speeds = raptor_speeds(weights, AIRFRAME, states) / AIRFRAME.rotor_vel_limits[1].max()
    quadrants = [tuple(x > 0) for x in AIRFRAME.value("rotors.position")[:, :2]]
    order = [quadrants.index(x) for x in ((False, False), (True, False), (False, True), (True, True))]
    for flight in range(2):
        for k, state in enumerate(states):
            for microseconds in range(0, 10_000, 1_250):  # a loop of 800 Hz
                flying, out = mix(start + 10_000 * k + microseconds, state if microseconds == 0 else states[0])
                assert flying
                np.testing.assert_allclose(out, 100 + 1900 * speeds[k, order], atol=0.1, err_msg=f"{flight}, {k}")
        code.stop()
    for i, value in ((7, np.nan), (0, np.inf), (8, -np.inf)):
        lost = states[0].copy()
        lost[i] = value
        flying, out = mix(start, lost)
        assert not flying
        np.testing.assert_array_equal(out, -1)


def test_betaflight_flies_a_run_that_commands_rotors(exported, tmp_path):
    policy, _, _ = exported("rotor_vel")
    meta = describe(make("hover", 1, control="rotor_vel"))
    header, source = to_betaflight(policy, tmp_path, meta, AIRFRAME, 50)
    assert "20000u" in source.read_text()
    assert header.name == "policy.h"
    with pytest.raises(ConfigError, match="level attitude"):
        to_betaflight(exported("attitude")[0], tmp_path, describe(make("hover", 1)), AIRFRAME, 50)


def test_rotors_that_turn_the_other_way_are_refused(tmp_path, weights):
    signs = AIRFRAME.value("rotors.yaw_torque_sign")
    reversed_airframe = load_airframe({"base": "cf21B_500", "rotors": {"yaw_torque_sign": (-signs).tolist()}})
    with pytest.raises(ConfigError, match="Swap the propellers"):
        to_betaflight(weights, tmp_path, None, reversed_airframe)


def test_the_example_compiles_against_the_headers(tmp_path):
    (tmp_path / "controller.h").write_text(CONTROLLER)
    (tmp_path / "power_distribution.h").write_text(POWER_DISTRIBUTION)
    folders = [f"-I{tmp_path}", f"-I{CFirmware.include}"]
    subprocess.run([shutil.which("cc") or "gcc", *FLAGS, *folders, "-fsyntax-only", EXAMPLE], check=True)


def test_policies_that_the_firmware_cannot_fly_are_errors(exported, tmp_path):
    policy, *_ = exported("attitude")
    meta = describe(make("hover", 1))
    with pytest.raises(ConfigError, match="rate that divides the firmware's 1000 Hz, got 60 Hz"):
        to_out_of_tree(policy, tmp_path, meta, AIRFRAME, 60)
    track = describe(make("track", 1))
    with pytest.raises(ConfigError, match="got difference_to_target_vel, local_samples"):
        to_out_of_tree(policy, tmp_path, track, AIRFRAME, 50)
    positions = meta | {"actions": meta["actions"] | {"level": "state"}}
    with pytest.raises(ConfigError, match="got one of positions"):
        to_out_of_tree(policy, tmp_path, positions, AIRFRAME, 50)
    assert not list(tmp_path.iterdir())
