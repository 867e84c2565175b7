"""Comparisons with closed-form motions, and of the integrators with their orders of convergence."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.lab.validate.rows import Row
from crazysim.plugins.payloads import SlungLoad
from crazysim.sim.sim import Sim

INERTIA = (2e-5, 3e-5, 5e-5)
"""Moments of inertia of a body, all different, about the size of a Crazyflie's, kg m^2."""
TUMBLE_ANG_VEL = (4.0, 1.0, 7.0)
"""Angular velocity of a tumbling body, rad/s."""


def free_body(
    integrator: str = "rk4",
    freq: int = 500,
    ang_vel: ArrayLike = (0.0, 0.0, 0.0),
    inertia: ArrayLike | None = None,
    gravity: bool = True,
    n_worlds: int = 1,
) -> Sim:
    """Return a simulation of a drone without thrust and drag, thrown from a height of 100 m.

    Args:
        freq: Steps per second, Hz.
        ang_vel: Initial angular velocity, body frame, rad/s. (3,)
        inertia: Inertia matrix, kg m^2; None for a diagonal matrix of ``INERTIA``. (3, 3)
    """
    sim = Sim(n_worlds, control="rotor_vel", integrator=integrator, freq=freq)
    inertia = np.diag(INERTIA) if inertia is None else np.asarray(inertia)
    p = sim.data.params
    params = p.replace(
        drag_matrix=np.zeros_like(p.drag_matrix),
        rpm2thrust=np.zeros_like(p.rpm2thrust) + np.array([0.0, 0.0, 1e-30], p.rpm2thrust.dtype),
        rpm2torque=np.zeros_like(p.rpm2torque),
        J=np.asarray(inertia, p.J.dtype),
        J_inv=np.asarray(np.linalg.inv(inertia), p.J.dtype),
        gravity_vec=np.asarray(p.gravity_vec) * gravity,
    )
    start = {"pos": [0.0, 0.0, 100.0], "vel": [1.0, -2.0, 3.0], "ang_vel": ang_vel}
    sim.data = with_states(sim.data.replace(params=params), **start)
    return sim


def with_states(data: SimData, **changes: Any) -> SimData:
    """Return the data with some states replaced, by values that are broadcast to all drones."""
    states = data.states
    new_values = {
        k: np.broadcast_to(v, getattr(states, k).shape).astype(getattr(states, k).dtype) for k, v in changes.items()
    }
    return data.replace(states=states.replace(**{k: jnp.asarray(v) for k, v in new_values.items()}))


def quat_from_rotvec(vector: NDArray) -> Array:
    """Return the quaternion, xyzw, of a nonzero rotation vector, rad. (4,)"""
    angle = float(np.linalg.norm(vector))
    return jnp.asarray([*(vector / angle * math.sin(angle / 2)), math.cos(angle / 2)])


def read_state(sim: Sim) -> dict[str, NDArray]:
    """Return the states of the first drone of the first world."""
    s = sim.data.states
    return {k: np.asarray(getattr(s, k))[0, 0] for k in ("pos", "vel", "quat", "ang_vel", "rotor_vel")}


def angle_between(a: ArrayLike, b: ArrayLike) -> float:
    """Return the angle between two attitudes, unit quaternions xyzw, rad."""
    relative = rotation.multiply(rotation.conjugate(jnp.asarray(a)), jnp.asarray(b))
    return 2 * math.asin(min(1.0, float(np.linalg.norm(relative[:3]))))


def free_fall_error(integrator: str) -> float:
    """Return the distance between simulated and exact position after a free fall of 1 s, m.

    The exact position is the closed form of the integration scheme itself. Under constant acceleration g the
    displacement of a scheme is a sum: ``v0 t + g t^2 / 2``, minus ``g t dt / 2`` for explicit Euler, and plus
    ``g t dt / 2`` for symplectic Euler.
    """
    sim, t, dt = free_body(integrator), 1.0, 1 / 500
    sim.step(500)
    scheme_term = {
        "euler": 0.5 * GRAVITY_MAGNITUDE * t * dt,
        "symplectic_euler": -0.5 * GRAVITY_MAGNITUDE * t * dt,
        "rk4": 0.0,
    }[integrator]
    expected = np.array([1.0, -2.0, 103.0 - 0.5 * GRAVITY_MAGNITUDE * t**2 + scheme_term])
    return float(np.linalg.norm(read_state(sim)["pos"] - expected))


def free_fall() -> Iterable[Row]:
    """Yield the error of the position in a free fall, for each integrator."""
    for name in ("euler", "symplectic_euler", "rk4"):
        with jax.enable_x64(True):
            error = free_fall_error(name)
        # bound: 500 additions of numbers near 100, each rounded to 1.4e-14
        yield Row(f"free fall, 1 s, {name}: position", "sum of the scheme", error, "m", (0, 1e-11))


def precession() -> Iterable[Row]:
    """Yield the error of the attitude of a torque-free symmetric top.

    The exact attitude is a product of two rotations at constant rates.
    """
    # moments of inertia across and along the axis of symmetry, angular velocity, duration
    a, c, w, t = 2e-5, 5e-5, np.array([4.0, 3.0, 8.0]), 0.5
    with jax.enable_x64(True):
        sim = free_body("rk4", 500, w, np.diag([a, a, c]))
        sim.step(250)
        quat = read_state(sim)["quat"]
        exact_quat = rotation.multiply(
            quat_from_rotvec(np.array([a, a, c]) * w / a * t),
            quat_from_rotvec(np.array([0, 0, w[2] * (1 - c / a) * t])),
        )
        angle = angle_between(exact_quat, quat)
    # One step turns by 0.019 rad. The bound is ten times 250 * 0.019^5 / 120, which is the error for a linear system,
    # because Euler's equations are not linear.
    yield Row("precession of a top at 9.4 rad/s, 0.5 s, RK4: attitude", "closed form", angle, "rad", (0, 5e-8))


def terminal_velocity() -> Iterable[Row]:
    """Yield the relative error of the speed of a drone that has fallen for 40 s with its rotors off."""
    with jax.enable_x64(True):
        sim = Sim(control="rotor_vel", integrator="rk4")
        p = sim.data.params
        mass, drag = float(np.ravel(p.mass)[0]), -float(np.asarray(p.drag_matrix)[..., 2, 2].ravel()[0])
        terminal_speed = mass * GRAVITY_MAGNITUDE / drag
        sim.data = with_states(sim.data, pos=[0, 0, 2000.0], rotor_vel=np.zeros(4))
        sim.rotor_vel_control(np.zeros((1, 1, 4)))
        sim.step(20_000)
        speed = -read_state(sim)["vel"][2]
    rate = GRAVITY_MAGNITUDE / terminal_speed
    # bound: twice the remainder of the transient after 40 s, to allow for rounding
    bound = (0, 2 * math.exp(-40 * rate))
    reference = f"m g / D = {terminal_speed:.3f} m/s"
    yield Row("terminal velocity, 40 s", reference, abs(speed / terminal_speed - 1), "", bound)


def motor_step() -> Iterable[Row]:
    """Yield the error of the speed of a rotor that spins up.

    The speed r for a commanded speed c follows ``r' = (c - r) (a + b (c + r))``. Its solution is a rational function of
    an exponential.
    """
    low, high, t = 10_000.0, 16_000.0, 0.05
    with jax.enable_x64(True):
        sim = Sim(control="rotor_vel", integrator="rk4")
        a, b = (float(x) for x in np.asarray(sim.data.params.rotor_dyn_coef).reshape(-1, 4)[0, :2])
        sim.data = with_states(sim.data, pos=[0, 0, 10.0], rotor_vel=np.full(4, low))
        sim.rotor_vel_control(np.full((1, 1, 4), high))
        sim.step(25)
        speed = read_state(sim)["rotor_vel"][0]
    # with e = c - r: e' = -e (a + 2 b c - b e), Bernoulli's equation
    rate, initial_error = a + 2 * b * high, high - low
    e = rate / (b + (rate / initial_error - b) * math.exp(rate * t))
    # bound: a step of 2 ms is 0.035 of the time constant, so RK4 errs by 25 * 0.035^5 / 120 of 6,000 rpm
    yield Row(
        "motor, 50 ms after a step from 10,000 to 16,000 rpm", "closed form", abs(speed - high + e), "rpm", (0, 1e-4)
    )


def pendulum() -> Iterable[Row]:
    """Yield the relative error of the period of a pendulum: a load of 0.2 kg on a rod of 0.4 m below a fixed body.

    The body has a mass of 1e9 kg, and a force carries its weight. The exact period is an elliptic integral, computed
    with the arithmetic-geometric mean.
    """
    angles, length = np.array([0.2, 0.8, 1.4]), 0.4
    with jax.enable_x64(True):
        sim = Sim(3, drone="bumblebee", control="rotor_vel", integrator="rk4")
        sim.data = sim.data.replace(params=sim.data.params.replace(mass=jnp.full(1, 1e9)))
        sim.data = with_states(sim.data, pos=[0, 0, 5.0], force=[0, 0, 1e9 * GRAVITY_MAGNITUDE])
        load = sim.add(SlungLoad(mass=0.2, length=length, in_scene=False))
        record = load.read(sim.data)
        pos = np.stack([length * np.sin(angles), 0 * angles, 5 - length * np.cos(angles)], axis=-1)[:, None]
        sim.data = load.write(sim.data, record.replace(pos=jnp.asarray(pos, record.pos.dtype)))
        offsets = []
        for _ in range(1500):
            sim.step()
            offsets.append(np.asarray(load.read(sim.data).pos - sim.data.states.pos)[:, 0, 0])
    for k, angle in enumerate(angles):
        offset = np.stack(offsets)[:, k]
        crossings = np.flatnonzero((offset[:-1] > 0) & (offset[1:] <= 0))[:2]
        times = (crossings + 1 + offset[crossings] / (offset[crossings] - offset[crossings + 1])) / sim.freq
        mean, geometric_mean = 1.0, math.cos(angle / 2)
        for _ in range(6):
            mean, geometric_mean = (mean + geometric_mean) / 2, math.sqrt(mean * geometric_mean)
        period = 2 * math.pi * math.sqrt(length / GRAVITY_MAGNITUDE) / mean
        error = abs(float(times[1] - times[0]) / period - 1)
        # bound: crossings are interpolated linearly between samples 2 ms apart, which errs by the curvature times
        # (2 ms)^3, relative to 1.3 s
        name = f"period of a load on a rod, amplitude {angle:g} rad"
        yield Row(name, f"elliptic integral, {period:.4f} s", error, "", (0, 1e-5))


def dzhanibekov() -> Iterable[Row]:
    """Yield the relative error of the growth rate of a wobble during rotation about the intermediate axis.

    The exact rate is ``w sqrt((J2 - J1) (J3 - J2) / (J1 J3))``, with moments of inertia J1 < J2 < J3, and the angular
    velocity w about the second axis.
    """
    j1, j2, j3 = INERTIA
    w, wobble, t = 10.0, 1e-7, 1.0
    rate = w * math.sqrt((j2 - j1) * (j3 - j2) / (j1 * j3))
    ang_vel = [wobble, w, rate * j1 / ((j2 - j3) * w) * wobble]
    with jax.enable_x64(True):
        sim = free_body("rk4", 500, ang_vel)
        sim.step(500)
        growth = math.log(abs(read_state(sim)["ang_vel"][0]) / wobble) / t
    # per step of 2 ms the wobble grows by exp(0.0089), which RK4 matches up to 0.0089^5 / 120: 500 times that over 4.5
    yield Row("Dzhanibekov effect: growth rate", f"{rate:.4f} 1/s", abs(growth / rate - 1), "", (0, 1e-8))


ORDER_TEST_FREQS = {"euler": (400, 800, 1600), "symplectic_euler": (400, 800, 1600), "rk4": (100, 200, 400)}
"""Steps per second of the flights from which the order of an integrator is estimated, Hz."""


def order_errors() -> dict[str, NDArray]:
    """Return the errors of position, m, and attitude of a tumbling body with drag, by integrator. (n_freqs, 2)

    The error of the attitude is the norm of the difference of quaternions. The drag depends on the attitude and the
    axis of rotation turns, so errors from rotations that do not commute are included. The reference is RK4 at 6,400 Hz.
    """

    def flight(freq: int, scheme: str) -> tuple[NDArray, NDArray]:
        sim = free_body(scheme, freq, TUMBLE_ANG_VEL)
        drag = np.diag([-0.02, -0.05, -0.2])
        sim.data = sim.data.replace(params=sim.data.params.replace(drag_matrix=drag))
        sim.step(freq // 2)
        state = read_state(sim)
        return state["pos"], state["quat"]

    with jax.enable_x64(True):
        reference = flight(6400, "rk4")
        flights = {name: [flight(f, name) for f in freqs] for name, freqs in ORDER_TEST_FREQS.items()}
    return {
        name: np.array(
            [[np.linalg.norm(x - e) for x, e in zip(state_pair, reference, strict=True)] for state_pair in state_pairs]
        )
        for name, state_pairs in flights.items()
    }


def orders() -> Iterable[Row]:
    """Yield the measured orders of the integrators: slopes of log error over log time step."""
    for name, errors in order_errors().items():
        order = 4 if name == "rk4" else 1
        for quantity, column in zip(("position", "attitude"), errors.T, strict=True):
            slope = float(np.polyfit(np.log(1 / np.array(ORDER_TEST_FREQS[name])), np.log(column), 1)[0])
            bound = (order - 0.35, order + 0.35)  # tolerance for terms of higher order
            yield Row(f"order of {name}: {quantity}", f"theory: {order}", slope, "", bound)


CHECKS = (free_fall, precession, terminal_velocity, motor_step, pendulum, dzhanibekov, orders)
"""All comparisons of this module."""
