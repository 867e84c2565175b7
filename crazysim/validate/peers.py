"""Flights of other simulators under the same commands."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import jax
import mujoco
import numpy as np

from crazysim import rotation
from crazysim.core.airframes import AirframeSource
from crazysim.drones import load_airframe
from crazysim.plugins.effects import Latency
from crazysim.sim.sim import Sim
from crazysim.validate.closed_forms import SPIN, free_body, state_of, with_states
from crazysim.validate.rows import Row


def mujoco_differences() -> dict[str, float]:
    """Return the largest differences of a thrown body under a constant wrench from C MuJoCo's after 0.5 s.

    Both programs use methods of Runge-Kutta of order 4 with steps of 1 ms, in float64.

    Returns:
        Differences of ``pos``, m, ``vel``, m/s, ``quat`` and ``ang_vel``, rad/s.
    """
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><option integrator="RK4" timestep="0.001" gravity="0 0 -9.81"/>
        <worldbody><body pos="0 0 100"><freejoint/>
        <inertial pos="0 0 0" mass="0.0434" diaginertia="2e-5 3e-5 5e-5"/></body></worldbody></mujoco>""")
    data, force, torque = mujoco.MjData(model), np.array([0.02, -0.05, 0.3]), np.array([3e-5, -2e-5, 1e-5])
    data.qvel[:] = [1, -2, 3, *SPIN]
    data.xfrc_applied[1] = [*force, *torque]
    for _ in range(500):
        mujoco.mj_step(model, data)
    with jax.enable_x64(True):
        sim = free_body("rk4", 1000, SPIN)
        sim.data = with_states(sim.data, force=force, torque=torque)
        sim.step(500)
        s = state_of(sim)
    quat = np.roll(s["quat"], 1)
    found = {"pos": s["pos"], "vel": s["vel"], "quat": quat * np.sign(quat @ data.qpos[3:]), "ang_vel": s["ang_vel"]}
    known = {"pos": data.qpos[:3], "vel": data.qvel[:3], "quat": data.qpos[3:], "ang_vel": data.qvel[3:]}
    return {k: float(np.max(np.abs(x - known[k]))) for k, x in found.items()}


def of_mujoco() -> Iterable[Row]:
    """Yield the differences from C MuJoCo."""
    units = {"pos": "m", "vel": "m/s", "quat": "", "ang_vel": "rad/s"}
    for name, x in mujoco_differences().items():
        bound = 1e-7 if name == "ang_vel" else 1e-8
        reference = f"`mj_step`, RK4, MuJoCo {mujoco.__version__}"
        yield Row(f"free body under a wrench, 0.5 s: {name}", reference, x, units[name], (0, bound))


def of_crazyflow() -> Iterable[Row]:
    """Yield the distance from Crazyflow's drone after 2 s under its own controllers, in float32."""
    weight = 0.0434 * 9.81
    state = np.zeros((1, 1, 16), np.float32)
    state[..., [0, 1, 2, 12]] = 0.5, -0.3, 5.2, 1.0
    commands = {"attitude": np.asarray([[[0.1, -0.15, 0.2, 1.02 * weight]]], np.float32), "state": state}
    for level, command in commands.items():
        ends = []
        for package, extra in (("crazysim", {"controller": "crazyflow"}), ("crazyflow", {})):
            sim: Any = importlib.import_module(f"{package}.sim").Sim(n_worlds=1, control=level, freq=500, **extra)
            sim.data = with_states(sim.data, pos=[0, 0, 5.0])
            getattr(sim, f"{level}_control")(command)
            sim.step(1000)
            ends.append(np.asarray(sim.data.states.pos)[0, 0])
        moved = np.linalg.norm(ends[1] - [0, 0, 5.0])
        # rounding of float32 in 1,000 steps, as between the peer's own precisions (tests/golden)
        yield Row(f"{level} commands, 2 s, {moved:.2f} m from the start: distance", "Crazyflow, `cf21B_500`",
                  float(np.linalg.norm(ends[0] - ends[1])), "m", (0, 1e-3))  # fmt: skip


RAPTOR_AIRFRAMES = ("cf21B_500", "cf2x_L250", "crazyflie", "bumblebee")
"""Airframes that RAPTOR flies."""


def raptor_held(drone: AirframeSource, delay: int, n: int = 100, seconds: int = 10) -> float:
    """Return the share of drones that RAPTOR holds within 0.3 m of a goal in the last second.

    Args:
        drone: Airframe.
        delay: Delay of the commands, steps of 2 ms.
        n: Number of drones, which start within 0.5 m of the goal along each axis.
        seconds: Duration, s.
    """
    policy = importlib.import_module("foundation_policy").Raptor()
    policy.reset()
    sim = Sim(n, drone=drone, control="rotor_vel")
    curve = np.asarray(load_airframe(drone).value("rotors.thrust_curve")).ravel()[:3]
    most = float(np.max(load_airframe(drone).value("rotors.thrust_max")))
    constant, linear, square = (float(x) for x in curve)
    top = float(np.max(np.roots([square, linear, constant - most]).real))
    start = np.random.default_rng(0).uniform(-0.5, 0.5, (n, 1, 3)) + [0, 0, 3]
    sim.data = with_states(sim.data, pos=start, rotor_vel=np.full(4, top / 2))
    sim.rotor_vel_control(np.full((n, 1, 4), top / 2, np.float32))
    sim.add(Latency(delay))
    action, away = np.zeros((n, 4)), np.zeros(n)
    for k in range(100 * seconds):
        s = sim.data.states
        pos, turn, vel, rate = (
            np.asarray(x, np.float64)[:, 0] for x in (s.pos, rotation.matrix(s.quat), s.vel, s.ang_vel)
        )
        seen = np.concatenate([pos - [0, 0, 3], turn.reshape(n, 9), vel, rate, action], axis=-1)
        action = policy.evaluate_step(seen)
        sim.rotor_vel_control(np.asarray(top * (action + 1) / 2, np.float32)[:, None])
        sim.step(5)
        if k >= 100 * (seconds - 1):
            away = np.maximum(away, np.linalg.norm(pos - [0, 0, 3], axis=-1))
    return float(np.mean(away < 0.3))


def of_raptor() -> Iterable[Row]:
    """Yield the share of drones that RAPTOR holds, with commands that arrive at once and late."""
    for drone in RAPTOR_AIRFRAMES:
        for delay in (0, 1, 3, 5):
            held = raptor_held(drone, delay)
            yield Row(
                f"`{drone}`, commands {2 * delay} ms late: drones held", "100 starts within 0.5 m", 100 * held, "%"
            )
