"""Fits of simulated flights of random airframes: errors are as large as the stated deviations say."""

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
ROTOR_NOISE = 0.003
"""Standard deviation of the noise of rotor speeds, as a share of their mean."""
N_LATE_STEPS = 3
"""Steps of 2 ms by which the state in a log is behind the rotor speeds."""


def draw_airframe(rng, folder, k):
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
    truth["motor lag"] = base.value("rotors.lag").ravel()[0]
    return path, true_airframe | {"drag": {"coefficients": drag}}, truth


def fly_airframes(airframes, seconds, rng, *, at_samples):
    """Return flights of drones that tilt, turn and climb at random, as columns at 500 Hz.

    The columns are those of ``COLUMN_NAMES`` and the commands of the rotors. Commands change at samples of a log of
    100 Hz, or, without ``at_samples``, at any step.
    """
    n, unit = len(airframes), 5 if at_samples else 1
    sim, drones = Sim(drone=airframes, control="attitude", integrator="rk4"), [load_airframe(a) for a in airframes]
    weight = np.array([float(a.value("rigid_body.mass")) * 9.81 for a in drones])
    hover = np.array([np.full(4, a.rotor_vel([w / 4]).item()) for a, w in zip(drones, weight, strict=True)])
    states = sim.data.states
    pos = np.stack([3.0 * np.arange(n), np.zeros(n), np.full(n, 100.0)], axis=-1)[None]
    sim.data = sim.data.replace(
        states=states.replace(pos=jnp.asarray(pos, states.pos.dtype), rotor_vel=states.rotor_vel + hover)
    )
    cmd, change_steps, rows = np.zeros((1, n, 4), np.float32), np.zeros(n), []
    for k in range(round(500 * seconds) + 250):
        s = sim.data.states
        if np.any(is_due := change_steps <= k):
            vel, climbed = np.asarray(s.vel)[0], np.asarray(s.pos)[0, :, 2] - 100
            tilt = rng.uniform(-0.5, 0.5, (n, 3))
            tilt[:, :2] += np.clip(0.05 * vel[:, [1, 0]], -0.3, 0.3) * [1, -1]  # against drifting away
            lift = rng.uniform(0.9, 1.15, n) * np.clip(1 - 0.02 * climbed - 0.05 * vel[:, 2], 0.8, 1.2)
            cmd[0, is_due] = np.c_[tilt, lift * weight][is_due]
            change_steps[is_due] = k + unit * rng.integers(75 // unit, 250 // unit, np.sum(is_due))
        sim.attitude_control(cmd)
        sim.step(1)
        s = sim.data.states
        columns = s.pos, s.quat, s.vel, s.ang_vel, s.rotor_vel, sim.data.controls.rotor_vel
        rows.append(np.concatenate([np.asarray(x)[0] for x in columns], -1))
    return np.stack(rows[250:], axis=1).astype(np.float64)


def normalised_errors(folder, n, seconds, seed, *, at_samples, fits_both=False):
    """Return the errors of fits in stated deviations, by parameter.

    Flights are fitted with commands and without in turn, or each of them in both ways.
    """
    rng, errors = np.random.default_rng(seed), {}
    paths, airframes, truths = zip(*(draw_airframe(rng, folder, k) for k in range(n)), strict=True)
    flights = fly_airframes(airframes, seconds, rng, at_samples=at_samples)
    for k, (path, flight, truth) in enumerate(zip(paths, flights, truths, strict=True)):
        x = flight[4::5] + 0
        x[1:, :13] = flight[9 - N_LATE_STEPS :: 5][: len(x) - 1, :13]
        x = x[1:]
        x[:, :13] += NOISE_STD * rng.normal(size=(len(x), 13))
        x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=-1, keepdims=True)
        x[:, 13:17] += ROTOR_NOISE * x[:, 13:17].mean() * rng.normal(size=(len(x), 4))
        commands = [f"command{i}" for i in range(1, 5)]
        table = {"t": 0.01 * np.arange(len(x)), **dict(zip([*COLUMN_NAMES, *commands], x.T, strict=True))}
        for has_commands in (True, False) if fits_both else (k % 2 == 0,):
            log = {name: y for name, y in table.items() if has_commands or name not in commands}
            result = identify([read_log(log)], path)
            assert abs(next(iter(result.delays.values())) - 0.002 * N_LATE_STEPS) < 5e-4
            for name, value in result.values.items():
                errors.setdefault(name, []).append((value - truth.get(name, 0.0)) / result.deviations[name])
            # A deviation as large as the parameter would contain any truth.
            for name in ("thrust factor", "inertia x", "inertia y", "inertia z", "rotor inertia"):
                assert result.deviations[name] < 0.1 * truth[name], (path.stem, name)
    return errors


def shares_within(errors):
    return np.array([np.mean(np.abs(errors) <= k) for k in (1, 2, 3)])


@pytest.mark.long("flies four airframes for 30 s and fits them")
@pytest.mark.parametrize(
    "at_samples", [False, pytest.param(True, marks=pytest.mark.slow("commands between samples are harder to fit"))]
)
def test_errors_are_as_large_as_their_deviations(tmp_path, at_samples):
    """Of four airframes, half of them with commands; a share of some 100 numbers scatters by 5% of 1."""
    errors = normalised_errors(tmp_path, 4, 30.0, 0, at_samples=at_samples)
    all_errors = np.concatenate(list(errors.values()))
    shares = shares_within(all_errors)
    assert np.all(shares >= [0.63, 0.93, 0.985]), shares
    assert 0.5 < np.sqrt(np.mean(all_errors**2)) < 1.2  # deviations that are too large are wrong, too
    assert shares[0] < 0.93, shares
    assert len(errors["motor lag"]) == 2
    assert np.all(np.abs(errors["motor lag"]) < 3), errors["motor lag"]
