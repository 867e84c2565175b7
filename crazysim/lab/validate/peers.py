"""Flights of other simulators under the same commands."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import jax
import mujoco
import numpy as np

from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.lab.validate.closed_forms import TUMBLE_ANG_VEL, free_body, read_state, with_states
from crazysim.lab.validate.rows import Row


def mujoco_differences() -> dict[str, float]:
    """Return the largest differences from C MuJoCo in the state of a thrown body under a constant wrench after 0.5 s.

    Both programs use fourth-order Runge-Kutta methods with steps of 1 ms, in float64.

    Returns:
        Differences of ``pos``, m, ``vel``, m/s, ``quat`` and ``ang_vel``, rad/s.
    """
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><option integrator="RK4" timestep="0.001" gravity="0 0 -9.81"/>
        <worldbody><body pos="0 0 100"><freejoint/>
        <inertial pos="0 0 0" mass="0.0434" diaginertia="2e-5 3e-5 5e-5"/></body></worldbody></mujoco>""")
    data, force, torque = mujoco.MjData(model), np.array([0.02, -0.05, 0.3]), np.array([3e-5, -2e-5, 1e-5])
    data.qvel[:] = [1, -2, 3, *TUMBLE_ANG_VEL]
    data.xfrc_applied[1] = [*force, *torque]
    for _ in range(500):
        mujoco.mj_step(model, data)
    with jax.enable_x64(True):
        sim = free_body("rk4", 1000, TUMBLE_ANG_VEL)
        sim.data = with_states(sim.data, force=force, torque=torque)
        sim.step(500)
        s = read_state(sim)
    quat = np.roll(s["quat"], 1)
    own_state = {
        "pos": s["pos"],
        "vel": s["vel"],
        "quat": quat * np.sign(quat @ data.qpos[3:]),
        "ang_vel": s["ang_vel"],
    }
    reference = {"pos": data.qpos[:3], "vel": data.qvel[:3], "quat": data.qpos[3:], "ang_vel": data.qvel[3:]}
    return {k: float(np.max(np.abs(x - reference[k]))) for k, x in own_state.items()}


def compare_with_mujoco() -> Iterable[Row]:
    """Yield the differences from C MuJoCo."""
    names = {"pos": ("position", "m"), "vel": ("velocity", "m/s"), "quat": ("quaternion", "")}
    names["ang_vel"] = "angular velocity", "rad/s"
    for key, x in mujoco_differences().items():
        name, unit = names[key]
        reference = f"`mj_step`, RK4, MuJoCo {mujoco.__version__}"
        bound = 1e-7 if key == "ang_vel" else 1e-8
        yield Row(f"free body under a wrench, 0.5 s: {name}", reference, x, unit, (0, bound))


def compare_with_crazyflow() -> Iterable[Row]:
    """Yield the distance between crazysim's and Crazyflow's drone, in float32 and with Crazyflow's controllers."""
    weight = 0.0434 * GRAVITY_MAGNITUDE
    state = np.zeros((1, 1, 16), np.float32)
    state[..., [0, 1, 2, 12]] = 0.5, -0.3, 5.2, 1.0
    commands = {"attitude": np.asarray([[[0.1, -0.15, 0.2, 1.02 * weight]]], np.float32), "state": state}
    for level, command in commands.items():
        end_positions = []
        for package, settings in (("crazysim", {"controller": "crazyflow"}), ("crazyflow", {})):
            sim: Any = importlib.import_module(f"{package}.sim").Sim(n_worlds=1, control=level, freq=500, **settings)
            sim.data = with_states(sim.data, pos=[0, 0, 5.0])
            getattr(sim, f"{level}_control")(command)
            sim.step(1000)
            end_positions.append(np.asarray(sim.data.states.pos)[0, 0])
        distance = np.linalg.norm(end_positions[1] - [0, 0, 5.0])
        # rounding of float32 in 1,000 steps, as between the peer's own precisions (tests/golden)
        yield Row(f"{level} commands, 2 s, {distance:.2f} m from the start: distance", "Crazyflow, `cf21B_500`",
                  float(np.linalg.norm(end_positions[0] - end_positions[1])), "m", (0, 1e-3))  # fmt: skip
