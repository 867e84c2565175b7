"""Fits of simulated flights of random airframes: true parameters are within three stated deviations."""

import tomllib

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.drones import estimate_airframe, load_airframe
from crazysim.lab.identify import identify, read_log
from crazysim.sim import Sim

COLUMN_NAMES = "x y z qx qy qz qw vx vy vz wx wy wz rpm1 rpm2 rpm3 rpm4".split()
NOISE_STD = np.repeat([1e-3, 1e-3, 1e-2, 1e-2], [3, 4, 3, 3])
"""Standard deviations of the noise of a log: position, m, quaternion, velocity, m/s, angular velocity, rad/s."""


def draw_airframe(rng, folder, k):
    """Return the file of an estimated airframe, a random airframe near it, and the true parameters by name."""
    mass = float(np.exp(rng.uniform(np.log(0.03), np.log(5))))
    propeller = 0.127 * (mass / 0.6) ** (1 / 3) * rng.uniform(0.85, 1.2)
    known = {"arm": propeller * rng.uniform(0.75, 1.2), "thrust_to_weight": rng.uniform(1.8, 5)}
    text = estimate_airframe(mass, propeller, time_constant=rng.uniform(0.02, 0.1), name=f"known{k}", **known)
    path = folder / f"known{k}.toml"
    path.write_text(text)
    base, moments = load_airframe(path), rng.uniform(0.7, 1.4, 2)
    inertia = np.diag(base.inertia)
    moments = np.array([*moments, moments @ inertia[:2] / np.sum(inertia[:2])])
    thrust, torque, rotor = rng.uniform(0.9, 1.2), rng.uniform(0.7, 1.4), rng.uniform(0.5, 2)
    offset = [*(0.02 * base.arm * rng.uniform(-1, 1, 2)), 0.0]
    drag = base.value("drag.coefficients") * rng.uniform(0.5, 1.6, 3)
    rotors = {
        "position": base.value("rotors.position") - offset,
        "thrust_max": tomllib.loads(text)["rotors"]["thrust_max"]["value"] * thrust,
        "thrust_curve": base.value("rotors.thrust_curve") * thrust,
        "torque_curve": base.value("rotors.torque_curve") * torque,
        "inertia": base.value("rotors.inertia") * rotor,
    }
    true_airframe = {
        "base": str(path),
        "name": f"true{k}",
        "rigid_body": {"inertia": inertia * moments},
        "rotors": rotors,
    }
    factors = ("thrust factor", "inertia x", "inertia y", "inertia z", "torque factor", "rotor inertia")
    truth = dict(zip(factors, [thrust, *moments, torque, rotor], strict=True))
    truth |= {f"drag {axis}": x for axis, x in zip("xyz", drag, strict=True)}
    truth |= {"centre of mass x": offset[0], "centre of mass y": offset[1]}
    return path, true_airframe | {"drag": {"coefficients": drag}}, truth


def fly_airframes(airframes, seconds, rng, *, at_samples):
    """Return flights of drones that tilt, turn and climb at random, as columns at 100 Hz.

    Commands change at samples of the log, or, without ``at_samples``, at random times between them.
    """
    n = len(airframes)
    sim, drones = Sim(drone=airframes, control="attitude", integrator="rk4"), [load_airframe(a) for a in airframes]
    weight = np.array([float(a.value("rigid_body.mass")) * 9.81 for a in drones])
    hover = np.array([np.full(4, a.rotor_vel([w / 4]).item()) for a, w in zip(drones, weight, strict=True)])
    states = sim.data.states
    pos = np.stack([3.0 * np.arange(n), np.zeros(n), np.full(n, 100.0)], axis=-1)[None]
    sim.data = sim.data.replace(
        states=states.replace(pos=jnp.asarray(pos, states.pos.dtype), rotor_vel=states.rotor_vel + hover)
    )
    cmd, change_samples, rows = np.zeros((1, n, 4), np.float32), np.zeros(n), []
    for k in range(round(100 * seconds) + 50):
        s = sim.data.states
        if np.any(is_due := change_samples <= k):
            vel, climbed = np.asarray(s.vel)[0], np.asarray(s.pos)[0, :, 2] - 100
            tilt = rng.uniform(-0.5, 0.5, (n, 3))
            tilt[:, :2] += np.clip(0.05 * vel[:, [1, 0]], -0.3, 0.3) * [1, -1]  # against drifting away
            lift = rng.uniform(0.9, 1.15, n) * np.clip(1 - 0.02 * climbed - 0.05 * vel[:, 2], 0.8, 1.2)
            cmd[0, is_due] = np.c_[tilt, lift * weight][is_due]
            change_samples[is_due] = k + rng.integers(15, 50, np.sum(is_due))
        n_late_steps = 0 if at_samples else int(rng.integers(1, 5))
        if n_late_steps:
            sim.step(n_late_steps)
        sim.attitude_control(cmd)
        sim.step(5 - n_late_steps)
        s = sim.data.states
        rows.append(np.concatenate([np.asarray(x)[0] for x in (s.pos, s.quat, s.vel, s.ang_vel, s.rotor_vel)], -1))
    return np.stack(rows[50:], axis=1).astype(np.float64)


def find_missed_parameters(folder, n, seconds, seed, *, at_samples):
    """Return the fitted numbers that are off by more than three deviations, and the number of all fitted numbers."""
    rng = np.random.default_rng(seed)
    paths, airframes, truths = zip(*(draw_airframe(rng, folder, k) for k in range(n)), strict=True)
    missed, total = [], 0
    for path, flight, truth in zip(
        paths, fly_airframes(airframes, seconds, rng, at_samples=at_samples), truths, strict=True
    ):
        for noise in (0, 1):
            x = flight + 0
            x[:, :13] += noise * NOISE_STD * rng.normal(size=(len(x), 13))
            x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=-1, keepdims=True)
            log = read_log({"t": 0.01 * np.arange(len(x)), **dict(zip(COLUMN_NAMES, x.T, strict=True))})
            result = identify([log], path)
            for name, value in result.values.items():
                error, total = value - truth.get(name, 0.0), total + 1
                if not abs(error) <= 3 * result.deviations[name]:
                    missed.append((path.stem, noise, name, value, truth.get(name, 0.0), result.deviations[name]))
            # A deviation as large as the parameter would contain any truth.
            for name in ("thrust factor", "inertia x", "inertia y", "inertia z", "rotor inertia"):
                assert result.deviations[name] < 0.03 * truth[name], (path.stem, noise, name)
    return missed, total


@pytest.mark.long("flies four airframes for 40 s and fits each twice")
@pytest.mark.parametrize(
    "at_samples", [False, pytest.param(True, marks=pytest.mark.slow("commands between samples are harder to fit"))]
)
def test_three_deviations_contain_the_truth(tmp_path, at_samples):
    missed, total = find_missed_parameters(tmp_path, 4, 40.0, 0, at_samples=at_samples)
    assert len(missed) <= 0.02 * total, missed


@pytest.mark.slow("50 airframes; the test above does the same with four")
@pytest.mark.parametrize("at_samples", [False, True])
def test_three_deviations_contain_the_truth_in_99_percent(tmp_path, at_samples):
    missed, total = find_missed_parameters(tmp_path, 50, 60.0, 1, at_samples=at_samples)
    assert len(missed) <= 0.01 * total, missed
