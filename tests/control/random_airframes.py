"""Random airframes that can fly, and flights of many of them at once, as the drones of one simulation."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from crazysim import Sim, load_airframe
from crazysim.commands.airframe_check import MAX_PRECESSION_RATIO
from crazysim.control import Auto
from crazysim.control.allocation import allocation_matrix
from crazysim.control.bandwidth import max_ang_acc, precession_rate
from crazysim.core.pipeline import remove_fn
from crazysim.errors import ConfigError

GRAVITY = 9.81
MIN_AUTHORITY = np.array([4.0, 4.0, 0.2])
"""Least ``max_ang_acc`` of drawn airframes about x, y, z, rad/s^2; ``airframe check`` warns of smaller ones. (3,)"""

MAX_TIME_CONSTANT = 0.2
"""Maximum time constant of drawn rotors, s; ``airframe check`` warns of longer ones."""

MAX_BODY_RATE = 2.0
"""Body rate, rad/s, at which the gyroscopic torque of rotors is at most half of the largest roll or pitch torque."""


def log_uniform(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_airframe(rng, n, name):
    """Return an airframe of n rotors: 20 g to 20 kg, thrust over weight 1.3 to 10, rotors of 2 to 200 ms.

    Half of the bodies are asymmetric: the angles and radii of the rotors vary, and the centre of mass is not in their
    middle. Rotors have a third to three times the usual inertia. Their rate of slowing down is half to twice the rate
    of speeding up.
    """
    while True:
        mass, ratio, tau = log_uniform(rng, 0.02, 20), log_uniform(rng, 1.3, 10), log_uniform(rng, 0.002, 0.2)
        arm, asymmetry = 0.17 * (mass / 0.5) ** 0.4 * rng.uniform(0.6, 1.4), rng.choice([0.0, 1.0])
        angles = 2 * np.pi * (np.arange(n) + rng.choice([0.0, 0.5]) + asymmetry * rng.uniform(-0.15, 0.15, n)) / n
        aspect, radii = rng.uniform(0.84, 1.18), arm * (1 + asymmetry * rng.uniform(-0.15, 0.15, n))
        x, y = aspect * radii * np.cos(angles), radii * np.sin(angles) / aspect
        x, y = (p - np.mean(p) + asymmetry * rng.uniform(-0.08, 0.08) * arm for p in (x, y))
        signs = np.array([1, -1] * (n // 2) + [1] * (n % 2))
        effective_mass = rng.uniform(0.3, 1.0) * mass  # the mass that would have this inertia at the rotors
        inertia = effective_mass * np.array([np.mean(y**2), np.mean(x**2), 0]) * rng.uniform(0.8, 1.25, 3)
        inertia[2] = (inertia[0] + inertia[1]) * rng.uniform(0.65, 0.98)
        # Propellers: thrust coefficient, and inertia of a rod of 15 g at 0.279 m, see airframe_estimate.
        diameter = 2 * arm * np.sin(np.pi / n) * rng.uniform(0.6, 1.0)
        curve = rng.uniform(0.09, 0.15) * 1.225 * diameter**4 / 3600
        rod = 0.015 * (diameter / 0.279) ** 2 * diameter**2 / 12
        lift_shares = np.linalg.pinv(np.stack([np.ones(n), y, -x, signs]))[:, 0]
        max_thrust = ratio * mass * GRAVITY * np.max(lift_shares)
        hover = np.sqrt(mass * GRAVITY / n / curve)
        rise_rate, fall_rate = 1 / tau, 1 / tau * rng.uniform(0.5, 1.0) ** rng.choice([-1, 1])
        quadratic = rng.uniform(0.0, 0.8) * rng.choice([0, 1])  # share of the quadratic lag in the rate in hover
        # Linear and quadratic coefficient of spinning up, then of spinning down.
        lag = [rate * part for rate in (rise_rate, fall_rate) for part in (1 - quadratic, quadratic / 2 / hover)]
        if min(rise_rate, fall_rate) < 1 / MAX_TIME_CONSTANT:
            continue
        if max(rise_rate, fall_rate) * (1 - quadratic + quadratic * np.sqrt(ratio * n * np.max(lift_shares))) > 600:
            continue  # too quick for steps of 2 ms
        try:
            airframe = load_airframe(
                {
                    "name": name,
                    "rigid_body": {"mass": mass, "inertia": inertia.tolist()},
                    "rotors": {
                        "position": np.stack([x, y, 0 * x], axis=-1).tolist(),
                        "yaw_torque_sign": signs.tolist(),
                        "thrust_min": max_thrust * rng.uniform(0.01, 0.06),
                        "thrust_max": max_thrust,
                        "inertia": rod * log_uniform(rng, 1 / 3, 3),
                        "thrust_curve": [0.0, 0.0, curve],
                        "torque_curve": [0.0, 0.0, curve * log_uniform(rng, 0.002, 0.03) * max(1.0, arm / 0.2)],
                        "lag": lag,
                    },
                    "drag": {"coefficients": (-mass * rng.uniform(0.05, 0.5, 3)).tolist()},
                }
            )
        except ConfigError:
            continue
        acc = max_ang_acc(airframe)
        if not np.all(acc > MIN_AUTHORITY) or 2 * MAX_BODY_RATE * precession_rate(airframe) > np.min(acc[:2]):
            continue
        if precession_rate(airframe) < MAX_PRECESSION_RATIO * np.sqrt(Auto().params(airframe).stiffness[0]):
            return airframe


def draw_airframes(n, count, seed=0):
    rng = np.random.default_rng([seed, n])
    return [draw_airframe(rng, n, f"{n} rotors, number {k} of seed {seed}") for k in range(count)]


def set_flying_states(sim, pos=0.0, vel=0.0, quat=(0.0, 0.0, 0.0, 1.0), ang_vel=0.0):
    if "clip_floor_pos" in sim.step_pipeline:
        remove_fn(sim.step_pipeline, "clip_floor_pos")
        sim.build_step_fn()
    s = sim.data.states
    broadcast = lambda x, template: jnp.broadcast_to(jnp.asarray(x, template.dtype), template.shape)  # noqa: E731
    weights = [GRAVITY * a.value("rigid_body.mass") for a in sim.airframes]
    rotor_vel = [a.rotor_vel(w * allocation_matrix(a)[:, 0]) for a, w in zip(sim.airframes, weights, strict=True)]
    states = s.replace(
        pos=broadcast(pos, s.pos),
        vel=broadcast(vel, s.vel),
        quat=broadcast(quat, s.quat),
        ang_vel=broadcast(ang_vel, s.ang_vel),
        rotor_vel=broadcast(np.stack(rotor_vel), s.rotor_vel),
    )
    sim.data = sim.data.replace(states=states)


def random_directions(rng, *shape):
    """Return random unit vectors. (..., 3)"""
    vectors = rng.normal(size=(*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def throw_drones(sim, seed, tilt=np.pi / 4, rate=2.0, speed=2.0, away=2.0, heading=np.pi):
    """Start all drones in flight, with random directions of all motions."""
    rng, shape = np.random.default_rng(seed), (sim.n_worlds, sim.n_drones)
    axes = random_directions(rng, *shape) * [1, 1, 0]
    axes *= tilt / np.linalg.norm(axes, axis=-1, keepdims=True)
    yaws = Rotation.from_rotvec(rng.uniform(-heading, heading, (np.prod(shape), 1)) * [0, 0, 1])
    quat = (Rotation.from_rotvec(axes.reshape(-1, 3)) * yaws).as_quat().reshape(*shape, 4)
    pos = away * random_directions(rng, *shape) * rng.uniform(0, 1, (*shape, 1))
    set_flying_states(sim, pos, speed * random_directions(rng, *shape), quat, rate * random_directions(rng, *shape))


def alternation(sim):
    """Return the largest second difference of a rotor's commands at 12 ticks, over its speed in hover. (n_drones,)"""
    commands = []
    for _ in range(12):
        sim.step()
        commands.append(np.asarray(sim.data.controls.rotor_vel))
    hover = [np.max(a.rotor_vel(GRAVITY * a.value("rigid_body.mass") / a.n_rotors)) for a in sim.airframes]
    return np.abs(np.diff(commands, 2, axis=0)).max((0, 1, 3)) / hover


def fly_airframes(airframes, controller, n_worlds, seconds, seed, **start):
    """Return the distances from the setpoint and heights after each 0.1 s, m, and the alternation of rotors at the end.

    (n_times, n_worlds, n_drones), the same, (n_drones,)
    """
    sim = Sim(n_worlds, drone=airframes, control="state", controller=controller)
    throw_drones(sim, seed, **start)
    sim.state_control(pos=[0.0, 0.0, 0.0])
    positions = []
    for _ in range(round(10 * seconds)):
        sim.step(50)
        positions.append(np.asarray(sim.data.states.pos))
    positions = np.array(positions)
    return np.linalg.norm(positions, axis=-1), positions[..., 2], alternation(sim)


def settling_time(distances, limit):
    """Return the time after which a distance stays below a limit, s; infinite if it does not. (n_worlds, n_drones)"""
    is_far = distances > limit
    last_index = len(is_far) - np.argmax(is_far[::-1], axis=0)
    return np.where(is_far[-1], np.inf, np.where(is_far.any(0), 0.1 * last_index, 0.0))
