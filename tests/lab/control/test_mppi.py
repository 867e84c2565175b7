"""Sampling model-predictive control: flights, reproducibility, and wrong settings."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import RangeFinder, Sim, Wind
from crazysim.control import Setpoint
from crazysim.errors import ConfigError
from crazysim.lab.control.mppi import MPPI, RECORD_NAME, RolloutRecord
from crazysim.trajectories import figure_eight


def setpoint(x=0.0, y=0.0, z=1.0):
    zero, none = jnp.zeros(3), jnp.zeros(1)
    return Setpoint(jnp.array([x, y, z]), zero, zero, zero, zero, none, none, none)


@pytest.fixture(scope="module")
def sim():
    return Sim(n_worlds=2, control="attitude")


@pytest.fixture(scope="module")
def mppi(sim):
    return MPPI(sim, samples=256, freq=125)


def place_drones(sim, pos, quat=(0, 0, 0, 1), vel=(0, 0, 0)):
    sim.reset()
    s = sim.data.states
    new = {"pos": pos, "quat": quat, "vel": vel}
    new = {key: np.broadcast_to(np.float32(x), getattr(s, key).shape) for key, x in new.items()}
    sim.data = sim.data.replace(states=s.replace(**new, rotor_vel=np.full_like(s.rotor_vel, 15900.0)))


def fly_and_return_errors(sim, mppi, setpoint_at, seconds):
    """Return the distance of every drone from its setpoint after each control step. (n, n_worlds)"""
    n_steps, result = round(mppi.period * sim.freq), []
    for k in range(round(seconds / mppi.period)):
        sim.attitude_control(mppi.command(sim.data, setpoint_at(jnp.float32(k * mppi.period))))
        sim.step(n_steps)
        target = setpoint_at(jnp.float32((k + 1) * mppi.period)).pos
        result.append(np.linalg.norm(np.asarray(sim.data.states.pos)[:, 0] - target, axis=-1))
    return np.array(result)


def test_it_hovers_from_a_bad_start(sim, mppi):
    """1.5 m away and rolled by 69 degrees."""
    mppi.reset()
    place_drones(sim, [1.0, -1.0, 1.5], [np.sin(0.6), 0, 0, np.cos(0.6)])
    result = fly_and_return_errors(sim, mppi, lambda t: setpoint(), 2.8)
    assert result[0].min() > 1.0
    assert result[-50:].max() < 0.3
    assert mppi._compiled_plan._cache_size() == 1


def test_it_follows_a_figure_eight(sim, mppi):
    """At 2 m/s and 2 m wide: within decimetres, though the setpoint moves by 3 m within the horizon."""
    eight = figure_eight(2.0, 1.0, speed=2.0)
    start = jax.tree.map(np.asarray, eight.evaluate(jnp.float32(0)))
    mppi.reset()
    place_drones(sim, start.pos, vel=start.vel)
    result = fly_and_return_errors(sim, mppi, jax.jit(eight.evaluate), 2.8)
    assert np.sqrt(np.mean(result**2)) < 0.25


def test_the_command_follows_from_the_cost(sim):
    """A cost of only the thrust drops the drone; the command is within the limits."""
    place_drones(sim, [0, 0, 1.0])
    mppi = MPPI(sim, samples=256, freq=125, horizon=20, cost=lambda states, setpoint, command: command[3] ** 2)
    for _ in range(20):
        command = np.asarray(mppi.command(sim.data, setpoint()))
    assert np.all(command[..., 3] < 0.15)
    assert np.all(command[..., 3] >= 4 * 0.02136 - 1e-4)


def test_commands_are_interpolated_between_the_knots_of_a_plan(mppi):
    knots = np.random.default_rng(0).normal(size=(mppi.knots, 4)).astype(np.float32)
    data = SimpleNamespace(plugins={RECORD_NAME: SimpleNamespace(knots=jnp.asarray(knots))})
    n_steps = (mppi.horizon - 1) * mppi.substeps
    at = np.linspace(0, mppi.knots - 1, n_steps + 1)
    expected = [np.interp(at, np.arange(mppi.knots), column) for column in knots.T]
    commands = jax.vmap(lambda step: mppi._command_at(data, step))(jnp.arange(n_steps + 1))
    np.testing.assert_allclose(commands, np.transpose(expected), atol=1e-5)


def test_a_sample_that_is_not_finite_has_no_weight(sim):
    """In the first world, some samples are not finite; in the second one, with another setpoint, all are not."""
    place_drones(sim, [0, 0, 1.0])

    def cost(states, setpoint, command):
        return jnp.where((command[0] > 0.1) | (setpoint.pos[0] > 0), jnp.nan, 1 + command[0] ** 2)

    per_world = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, 1, len(x))), setpoint())
    per_world = per_world.replace(pos=per_world.pos.at[1, 0, 0].set(1.0))
    partly_nan, all_nan = MPPI(sim, samples=64, freq=125, horizon=10, cost=cost).command(sim.data, per_world)
    assert np.isfinite(partly_nan).all()
    assert np.any(partly_nan != all_nan)
    np.testing.assert_allclose(all_nan, [[0, 0, 0, 0.0434 * 9.81]], rtol=1e-5)


WRONG_SETTINGS = {
    "level": (lambda sim: MPPI(Sim(control="state")), "control"),
    "knots": (lambda sim: MPPI(sim, knots=65), "knots"),
    "horizon": (lambda sim: MPPI(sim, horizon=1), "horizon"),
    "samples": (lambda sim: MPPI(sim, samples=0), "samples"),
    "temperature": (lambda sim: MPPI(sim, temperature=0.0), "temperature"),
    "endless temperature": (lambda sim: MPPI(sim, temperature=np.inf), "temperature"),
    "noise": (lambda sim: MPPI(sim, noise=[1.0, 2.0]), "noise"),
    "text as temperature": (lambda sim: MPPI(sim, temperature="a"), "temperature"),
    "text as noise": (lambda sim: MPPI(sim, noise="a"), "noise"),
    "no cost": (lambda sim: MPPI(sim, cost=None), "cost as a function"),
    "text as seed": (lambda sim: MPPI(sim, seed="a"), "as seed, got 'a'"),
    "endless noise": (lambda sim: MPPI(sim, noise=[np.inf] * 4), "noise"),
}
"""Functions that must fail, and a part of their message."""


@pytest.mark.parametrize("case", WRONG_SETTINGS)
def test_wrong_settings_are_errors(sim, case):
    make, message = WRONG_SETTINGS[case]
    with pytest.raises(ConfigError, match=message):
        make(sim)


def test_data_with_other_plugins_is_refused():
    sim = Sim(control="attitude")
    mppi = MPPI(sim, samples=2, freq=125, horizon=2)
    sim.add(Wind())
    with pytest.raises(ConfigError, match="Build MPPI after adding them"):
        mppi.command(sim.data, setpoint())


def predict(sim, mppi, n_steps):
    memory = mppi.init(sim.n_worlds, sim.n_drones)
    record = RolloutRecord(memory.plan, jax.tree.map(lambda x: jnp.broadcast_to(x, (2, 1, len(x))), setpoint()),
                           jnp.zeros((2, 1, 1)))  # fmt: skip
    return mppi._step(mppi._rollouts(sim.data, record), n_steps)


def fly(sim, mppi, n_steps):
    sim.attitude_control(mppi.init(sim.n_worlds, sim.n_drones).plan[:, :, 0])
    sim.step(n_steps)
    return sim.data


@pytest.mark.parametrize("controller", ["auto", "crazyflow"])
def test_rollouts_predict_at_the_rates_of_the_simulation(controller):
    """At the default rates, a drone that is rolled by 69 degrees would recover sooner than at 50 Hz."""
    settings = {"control": "attitude", "attitude_freq": 50, "force_torque_freq": 250, "controller": controller}
    sim = Sim(n_worlds=2, **settings)
    mppi = MPPI(sim, samples=1, horizon=10, substeps=10)
    assert mppi._sim.configuration.control_freqs == sim.configuration.control_freqs
    place_drones(sim, [0, 0, 1.0], [np.sin(0.6), 0, 0, np.cos(0.6)])
    predicted, flown = predict(sim, mppi, 60).states, fly(sim, mppi, 60).states
    for x, y in zip(jax.tree.leaves(predicted), jax.tree.leaves(flown), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)  # rounding of two kernels
    # The rates of rollouts with another physics rate are the next lower divisors.
    assert set(MPPI(sim, samples=1, freq=125)._sim.configuration.control_freqs.values()) <= {25, 125}


def test_rollouts_meet_the_objects_of_the_scene():
    """Each world has its own wall, 2 m ahead in the first, where a range finder measures it in the rollout, too."""
    sim = Sim(n_worlds=2, control="attitude")
    sim.scene.add("sphere", pos=[0, 3.0, 1], radius=0.1, mocap=False)
    wall = sim.scene.add("wall", pos=[[[2.0, 0, 0]], [[3.0, 0, 0]]], length=4.0, height=3.0, thickness=0.1)
    sim.add(RangeFinder(directions=[[1, 0, 0], [0, 1, 0]]))
    mppi = MPPI(sim, samples=1, horizon=10, substeps=10)
    place_drones(sim, [0, 0, 1.0], vel=[2.0, 0, 0])
    predicted, flown = (data.plugins["range_finder"].distance for data in (predict(sim, mppi, 50), fly(sim, mppi, 50)))
    np.testing.assert_allclose(predicted, flown, rtol=1e-5)
    np.testing.assert_allclose(predicted[1, 0, 0] - predicted[0, 0, 0], 1.0, atol=0.02)
    assert predicted[0, 0, 0] < 1.9
    sim.data = wall.set_pose(sim.data, pos=[5.0, 0, 0])
    assert np.isfinite(mppi.command(sim.data, setpoint())).all()
    sim.scene.add("pole", pos=[1, 1, 0])
    with pytest.raises(ConfigError, match=r"expected data with the objects .* Build MPPI after adding them"):
        mppi.command(sim.data, setpoint())
