"""Controllers in C: their inputs, their commands, and their memory of each drone."""

import os
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import ConfigError, Sim
from crazysim.control import AllocationParams, CFirmware, Control, Controller
from crazysim.dynamics.rotor import quadratic_curve, rotor_vel_of_thrust
from crazysim.engine.backends import native
from crazysim.engine.pytree import PyTree, leaf
from crazysim.lab.control import firmware

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="no C++ compiler here")
WORLDS, DRONES = 3, 2
HOVER = """
#include "firmware.h"
struct memory { float throttle; int ticks; };
size_t crazysim_memory_size(void) { return sizeof(struct memory); }
void crazysim_init(void *memory) { ((struct memory *)memory)->throttle = 0.5f; }
void crazysim_update(void *memory, enum crazysim_level level, const struct crazysim_input *in, float *motors) {
  struct memory *own = (struct memory *)memory;
  float error = in->command[2] - in->pos[2];
  own->throttle += 0.2f * error * in->dt;
  own->ticks += 1;
  for (int i = 0; i < 4; ++i) motors[i] = own->throttle + 0.3f * error - 0.25f * in->vel[2];
}
"""
ECHO = """
#include <string.h>
#include "firmware.h"
struct memory { struct crazysim_input input; int level; };
size_t crazysim_memory_size(void) { return sizeof(struct memory); }
void crazysim_init(void *memory) { (void)memory; }
void crazysim_update(void *memory, enum crazysim_level level, const struct crazysim_input *in, float *motors) {
  memcpy(memory, in, sizeof *in);
  ((struct memory *)memory)->level = level;
  for (int i = 0; i < 4; ++i) motors[i] = 0.1f * i;
}
"""
CONSTANT = """
#include "firmware.h"
size_t crazysim_memory_size(void) { return 0; }
void crazysim_init(void *memory) { (void)memory; }
void crazysim_update(void *memory, enum crazysim_level level, const struct crazysim_input *in, float *motors) {
  for (int i = 0; i < 4; ++i) motors[i] = RPM;
}
"""
"""Controllers in C: one that climbs to a height, one that stores its input, and one with constant motor commands."""
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "crazyflie.c"
STAND_IN_HEADER = """
#pragma once
#include <stdint.h>
struct vec { float x, y, z; };
typedef struct { float x, y, z; } point_t, velocity_t, acc_t, gyro_t;
typedef struct { float x, y, z, w; } quaternion_t;
typedef struct { float roll, pitch, yaw; } attitude_t;
enum mode { modeDisable, modeAbs, modeVelocity };
typedef struct {
  struct { enum mode x, y, z, quat; } mode;
  point_t position; velocity_t velocity; acc_t acceleration; quaternion_t attitudeQuaternion; attitude_t attitudeRate;
} setpoint_t;
typedef struct { point_t position; velocity_t velocity; quaternion_t attitudeQuaternion; attitude_t attitude; } state_t;
typedef struct { gyro_t gyro; acc_t acc; } sensorData_t;
typedef struct { float sums[4]; } control_t;
typedef struct { int32_t list[4]; } motors_thrust_uncapped_t;
typedef struct { uint16_t list[4]; } motors_thrust_pwm_t;
typedef struct { int calls; } controllerMellinger_t, controllerLee_t;
static inline void controllerLeeInit(controllerLee_t *self) { self->calls = 100; }
static inline void controllerLee(controllerLee_t *self, control_t *control, const setpoint_t *s, const sensorData_t *d,
                                 const state_t *x, uint32_t tick) {
  const setpoint_t *p = s;
  self->calls += 1 + tick;
  control->sums[0] = p->position.x + 2 * p->velocity.y + 4 * p->acceleration.z + 8 * p->attitudeQuaternion.w;
  control->sums[1] = p->attitudeRate.roll + 2 * p->attitudeRate.pitch + 4 * p->attitudeRate.yaw + p->mode.z;
  control->sums[2] = x->position.x + 2 * x->velocity.y + 4 * x->attitudeQuaternion.z + 8 * x->attitudeQuaternion.w;
  control->sums[3] = d->gyro.x + 2 * d->gyro.y + 4 * d->gyro.z + self->calls;
}
static inline void powerDistribution(const control_t *control, motors_thrust_uncapped_t *thrusts) {
  for (int i = 0; i < 4; ++i) thrusts->list[i] = 20 * control->sums[i];
}
static inline int powerDistributionCap(const motors_thrust_uncapped_t *thrusts, motors_thrust_pwm_t *limited) {
  for (int i = 0; i < 4; ++i) limited->list[i] = thrusts->list[i];
  return 0;
}
"""
"""Header in place of the headers of the Crazyflie's firmware."""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("c")

    def compile_library(name, source):
        path = folder / f"{name}.so"
        if not path.exists():
            (folder / f"{name}.c").write_text(source)
            command = ["g++", "-O2", "-shared", "-fPIC", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror"]
            subprocess.run([*command, f"-I{CFirmware.include}", folder / f"{name}.c", "-o", path], check=True)
        return path

    return compile_library


class HeightMemory(PyTree):
    throttle: jax.Array = leaf("drone", 1)


class Height(Controller):
    """The law of ``HOVER`` in JAX."""

    name = "height"
    levels = (Control.state,)
    output = Control.rotor_vel
    freq: int = 500

    def params(self, airframe):
        return AllocationParams.create(airframe)

    def memory(self, airframe):
        return HeightMemory(np.full(1, 0.5))

    def update(self, data, command, memory, params):
        error = (command.pos - data.states.pos)[2:]
        throttle = memory.throttle + 0.2 * error / self.freq
        thrust = params.thrust_max * (throttle + 0.3 * error - 0.25 * data.states.vel[2:])
        speed = rotor_vel_of_thrust(jnp.clip(thrust, params.thrust_min, params.thrust_max), params.rpm2thrust)
        return jnp.broadcast_to(jnp.where(thrust > 0, speed, 0.0), (4,)), HeightMemory(throttle)


def fly_to_heights(controller, n_steps=1000):
    """Return a simulation after some steps in which each drone rises to its own height."""
    sim = Sim(WORLDS, DRONES, control="state", controller=controller)
    pos = np.array(sim.data.states.pos)
    pos[..., 2] = np.linspace(0.5, 2.0, WORLDS * DRONES).reshape(WORLDS, DRONES)
    sim.state_control(pos=pos)
    sim.step(n_steps)
    return sim


def test_a_law_in_c_flies_like_the_same_law_in_jax(library):
    result = fly_to_heights(CFirmware(library("hover", HOVER)))
    expected = fly_to_heights(Height())
    assert np.ptp(expected.data.states.pos[..., 2]) > 1.0
    # Both laws round differently, by 1e-7 in each of 1,000 steps.
    np.testing.assert_allclose(result.data.states.pos, expected.data.states.pos, atol=1e-5)


@pytest.mark.parametrize("level", ["state", "attitude", "body_rate"])
def test_a_library_receives_state_command_and_time(library, level):
    sim = Sim(2, 1, control=level, controller=CFirmware(library("echo", ECHO), motors="thrust", freq=250))
    rng = np.random.default_rng(1)
    quat = rng.normal(size=(2, 1, 4))
    sim.data = with_states(
        sim.data,
        pos=rng.normal(size=(2, 1, 3)) + 9,
        quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
        vel=rng.normal(size=(2, 1, 3)),
        ang_vel=rng.normal(size=(2, 1, 3)),
    )
    sim.step(2)
    states = sim.data.states
    command = rng.normal(size=(2, 1, 16 if level == "state" else 4)).astype(np.float32)
    getattr(sim, f"{level}_control")(command)
    sim.step(1)
    memory = np.asarray(sim.data.controls.controller.memory.words)
    received, clock = memory[..., :-1].view(np.float32), np.float32([2 / 500, 1 / 250])
    expected_command = np.zeros((2, 1, 24), np.float32)
    expected_command[..., : command.shape[-1]] = command
    if level == "state":
        expected_command[..., 16:] = sim.data.controls.state.feedforward
        assert expected_command[0, 0, 22] == command[0, 0, 15]  # the yaw rate
    rows = [states.pos, states.quat, states.vel, states.ang_vel, expected_command]
    expected = np.concatenate([np.broadcast_to(clock, (2, 1, 2)), *map(np.asarray, rows)], axis=-1)
    np.testing.assert_array_equal(received, expected)
    assert np.all(memory[..., -1] == ["state", "attitude", "body_rate"].index(level))


@pytest.mark.parametrize("motors", ["throttle", "thrust", "rpm"])
def test_motor_commands_have_the_unit_of_the_setting_motors(library, motors):
    sim = Sim(1, 1, drone="bumblebee", control="attitude", controller=CFirmware(library("echo", ECHO), motors=motors))
    sim.step(1)
    commanded, params = np.asarray(sim.data.controls.rotor_vel[0, 0]), sim.data.controls.controller.params
    motor_commands = np.array([0.0, 0.1, 0.2, 0.3])
    if motors == "rpm":
        idle = float(sim.data.params.rotor_vel_min[0])  # the lowest speed of a rotor that turns
        np.testing.assert_allclose(
            commanded, np.where(motor_commands > 0, np.maximum(motor_commands, idle), 0), rtol=1e-6
        )
        return
    min_thrust, max_thrust = float(params.thrust_min[0]), float(params.thrust_max[0])
    thrust = np.clip(motor_commands * (max_thrust if motors == "throttle" else 1.0), min_thrust, max_thrust)
    assert commanded[0] == 0
    # The inverse of the curve is a square root in float32.
    np.testing.assert_allclose(quadratic_curve(commanded, params.rpm2thrust)[1:], thrust[1:], rtol=1e-4)


def test_the_step_is_split_without_a_warning_and_explained(library):
    sim = fly_to_heights(CFirmware(library("hover", HOVER)), n_steps=1)
    assert "'state_controller' is not fused" in sim.explain()
    assert "it calls a function on the host" in sim.explain()


def test_a_new_controller_loads_a_library_that_was_compiled_again(tmp_path):
    sims = []
    for rpm in (9000, 12000):
        (tmp_path / "constant.c").write_text(CONSTANT.replace("RPM", f"{rpm}"))
        command = ["cc", "-shared", "-fPIC", f"-I{CFirmware.include}", "constant.c", "-o", "constant.so"]
        subprocess.run(command, cwd=tmp_path, check=True)
        controller = CFirmware(tmp_path / "constant.so", motors="rpm")
        sims.append(Sim(control="attitude", controller=controller, engine="plain"))
    for sim, rpm in zip(sims, (9000, 12000), strict=True):
        sim.step(1)
        np.testing.assert_array_equal(sim.data.controls.rotor_vel, np.full((1, 1, 4), rpm))


def test_the_example_gives_the_firmware_its_inputs(tmp_path):
    for name in ("math3d", "controller_lee", "controller_mellinger", "power_distribution"):
        (tmp_path / f"{name}.h").write_text(STAND_IN_HEADER if name == "math3d" else '#include "math3d.h"')
    command_line = [
        "cc",
        "-shared",
        "-fPIC",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-DCONTROLLER=Lee",
        f"-I{CFirmware.include}",
        "-I.",
    ]
    subprocess.run([*command_line, EXAMPLE, "-o", "lee.so"], cwd=tmp_path, check=True)
    controller = CFirmware(tmp_path / "lee.so")
    memory = np.asarray(controller.memory(None).words)
    x = np.arange(1.0, 40.0, dtype=np.float32) / 8  # time, dt, pos, quat, vel, ang_vel, command
    pos, quat, vel, gyro, command = x[2:5], x[5:9], x[9:12], x[12:15], x[15:31]
    words, motors = firmware._call_library(controller._copy_path, 0, 4, memory[None], x[None])
    degrees = np.rad2deg(1.0)
    sums = [
        command[0] + 2 * command[4] + 4 * command[8] + 8 * command[12],
        degrees * (command[13] + 2 * command[14] + 4 * command[15]) + 1,
        pos[0] + 2 * vel[1] + 4 * quat[2] + 8 * quat[3],
        degrees * (gyro[0] + 2 * gyro[1] + 4 * gyro[2]) + 101,
    ]
    np.testing.assert_allclose(65535 * motors[0], 20 * np.array(sums), atol=1.1)  # whole numbers, rounded down
    assert words.tolist() == [[101]]


def test_a_derivative_is_an_error_that_names_the_library(library):
    sim = Sim(control="state", controller=CFirmware(library("hover", HOVER)))
    data, step = sim.data, sim.step_fn

    def height(z):
        return step(data.replace(states=data.states.replace(pos=data.states.pos + z)), 2).states.pos[0, 0, 2]

    for derivative in (jax.grad, jax.jacfwd):
        with pytest.raises(ConfigError, match=r"for the derivative of a step, got CFirmware\('.*hover\.so'\)"):
            derivative(height)(0.1)


def test_wrong_libraries_and_units_are_refused(library, tmp_path):
    with pytest.raises(ConfigError, match=r"expected a shared library at .*nothing\.so.*firmware\.h"):
        CFirmware(tmp_path / "nothing.so")
    with pytest.raises(ConfigError, match=r"expected the functions .*, got no crazysim_memory_size"):
        CFirmware(library("empty", 'extern "C" int nothing(void) { return 0; }'))
    (tmp_path / "firmware.h").write_text(
        (CFirmware.include / "firmware.h").read_text().replace("VERSION 1", "VERSION 2")
    )
    with pytest.raises(ConfigError, match=r"expected version 1 of firmware\.h in .*, got 2"):
        CFirmware(library("newer", HOVER.replace("firmware.h", f"{tmp_path}/firmware.h")))
    with pytest.raises(ConfigError, match=r"expected motors as one of throttle, thrust, rpm, got 'volt'"):
        CFirmware(library("hover", HOVER), motors="volt")


def test_incomplete_libraries_pipes_and_devices_are_refused(library, tmp_path):
    """Reading a pipe or a device would never end, and half a library would end this process."""
    pipe, half = tmp_path / "pipe.so", tmp_path / "half.so"
    os.mkfifo(pipe)
    whole = library("hover", HOVER).read_bytes()
    half.write_bytes(whole[: len(whole) // 2])
    for path, reason in (
        (pipe, "got the device or pipe"),
        ("/dev/zero", "got the device or pipe"),
        (tmp_path, "expected an existing file"),
        (half, "got one that cannot be loaded: "),
    ):
        with pytest.raises(ConfigError, match=rf"expected a shared library at .*{reason}.*firmware\.h says\."):
            CFirmware(path)
    huge = HOVER.replace("return sizeof(struct memory)", "return 1000000000000000ul")
    with pytest.raises(ConfigError, match=r"a memory of at most 16777216 bytes a drone, got 1000000000000000 from"):
        CFirmware(library("huge", huge))
