"""Randomisation: distributions, equality with changed parameters, and the laws of random numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_rotor_state, with_states
from sweep import RANGES

from crazysim import Battery, ConfigError, Latency, Randomize, RotorAerodynamics, Sim, Wind
from crazysim.core.pipeline import append_fn
from crazysim.engine.stage import stage
from crazysim.envs import AutoReset, make
from crazysim.plugins.effects.battery import open_circuit_voltage


def build(n_worlds=3, n_drones=2, engine="interpret", **settings):
    sim = Sim(n_worlds, n_drones, control="rotor_vel", rng_key=5, engine=engine)
    sim.data = with_states(sim.data, pos=[0, 0, 2.0], rotor_vel=hover_rotor_state(sim.data))
    sim.build_default_data()
    return sim, sim.add(Randomize(**settings))


@pytest.fixture(scope="module")
def thousand_worlds():
    """Return a simulation of a thousand worlds after one step, and its plugin."""
    sim, plugin = build(1000, 1, **RANGES)
    sim.rotor_vel_control(sim.data.states.rotor_vel)
    sim.step()
    return sim, plugin


def test_factors_are_uniform_in_their_ranges_and_independent(thousand_worlds):
    """Means and deviations of 1000 uniform numbers agree to four standard errors."""
    sim, plugin = thousand_worlds
    record = plugin.read(sim.data)
    names = ("mass", "inertia", "torque", "lag", "drag")
    columns = [np.asarray(record.factors)[:, 0, k] for k in range(5)]
    columns.append(np.linalg.norm(record.air_vel[:, 0, :2], axis=-1))
    for name, x in zip((*names, "wind"), columns, strict=True):
        low, high = RANGES[name]
        assert low <= x.min() < x.max() <= high
        np.testing.assert_allclose(x.mean(), (low + high) / 2, atol=4 * (high - low) / np.sqrt(12 * 1000))
    thrust = np.asarray(record.thrust_factors)[:, 0]
    assert thrust.min() > 0.9 * 0.95
    assert thrust.max() < 1.05
    np.testing.assert_allclose(np.sqrt(thrust.var(axis=1, ddof=1).mean()), 0.95 * 0.1 / np.sqrt(12), rtol=0.1)
    correlation = np.corrcoef([*columns, *thrust.T])
    assert np.abs(correlation[:6, :6] - np.eye(6)).max() < 4 / np.sqrt(1000)
    angle = np.arctan2(record.air_vel[:, 0, 1], record.air_vel[:, 0, 0])
    assert np.histogram(angle, 4, (-np.pi, np.pi))[0].min() > 190
    np.testing.assert_array_equal(record.air_vel[..., 2], 0.0)


def test_factors_act_as_changed_parameters(thousand_worlds):
    """Drones fly as in a simulation whose parameters and wind are set to the drawn values."""
    sim, plugin = thousand_worlds
    record = jax.tree.map(np.asarray, plugin.read(sim.data))
    changed_sim = Sim(1000, control="rotor_vel", engine="interpret")
    p, f = changed_sim.data.params, record.factors[..., None]
    changed_sim.data = with_states(changed_sim.data, pos=[0, 0, 2.0], rotor_vel=hover_rotor_state(changed_sim.data))
    changed_sim.data = changed_sim.data.replace(
        params=p.replace(
            mass=f[..., 0, :] * p.mass,
            J=f[..., 1:2, :] * p.J,
            J_inv=p.J_inv / f[..., 1:2, :],
            rpm2torque=f[..., 2:3, :] * p.rpm2torque,
            rotor_dyn_coef=f[..., 3:4, :] * p.rotor_dyn_coef,
            drag_matrix=f[..., 4:5, :] * p.drag_matrix,
            rpm2thrust=record.thrust_factors[..., None] * p.rpm2thrust,
        )
    )
    changed_sim.add(Wind(record.air_vel))
    command = 1.05 * np.asarray(changed_sim.data.states.rotor_vel)
    random_sim, random_plugin = build(1000, 1, **RANGES)
    for s in (changed_sim, random_sim):
        s.rotor_vel_control(command)
        s.step(20)
    np.testing.assert_array_equal(random_plugin.read(random_sim.data).factors, record.factors)
    for name in ("pos", "vel", "ang_vel", "rotor_vel"):
        # float32 over 20 steps
        result, expected = (np.asarray(getattr(x.data.states, name)) for x in (random_sim, changed_sim))
        np.testing.assert_allclose(result, expected, rtol=1e-4, atol=2e-5, err_msg=name)
    assert random_sim.data.params.mass.shape == (1,)


def test_law_10_numbers_depend_on_the_episode_and_not_on_other_worlds():
    factors = []
    for n_worlds in (2, 3):
        sim, plugin = build(n_worlds, **RANGES)
        sim.step()
        factors.append(np.asarray(plugin.read(sim.data).factors))
    np.testing.assert_array_equal(factors[0], factors[1][:2])
    assert len(np.unique(factors[1][..., 0])) == 6
    sim.step()
    np.testing.assert_array_equal(plugin.read(sim.data).factors, factors[1])
    sim.reset(np.array([False, True, False]))
    sim.step()
    factors_after_reset = np.asarray(plugin.read(sim.data).factors)
    np.testing.assert_array_equal(factors_after_reset[::2], factors[1][::2])
    assert np.all(factors_after_reset[1] != factors[1][1])


def test_charges_of_batteries_and_delays_are_drawn():
    sim, _ = build(50, 2, charge=(0.2, 0.6), delay=(1, 4))
    battery = sim.add(Battery())
    latency = sim.add(Latency(delay=np.zeros((50, 2), int), max_delay=4))
    sim.step()
    charge, delay = np.asarray(battery.read(sim.data).charge), np.asarray(latency.read(sim.data).delay)
    assert 0.199 < charge.min() < 0.25 < 0.55 < charge.max() <= 0.6
    assert set(np.unique(delay)) == {1, 2, 3}
    sim.step(5)
    np.testing.assert_array_equal(latency.read(sim.data).delay, delay)


def test_presets_fly_and_accept_changes():
    for preset in (Randomize.crazyflie, Randomize.generic):
        assert preset(drag=None, mass=(1.0, 1.1)).drag is None
        sim = Sim(50, control="state", rng_key=1)
        sim.data = with_states(sim.data, pos=[0, 0, 1.0], rotor_vel=hover_rotor_state(sim.data))
        plugin = sim.add(preset(delay=None))
        sim.state_control(pos=[0.0, 0.0, 1.0])
        errors = []
        for n_steps in (100, 1900):
            sim.step(n_steps)
            errors.append(np.median(np.linalg.norm(np.asarray(sim.data.states.pos) - [0, 0, 1.0], axis=-1)))
        assert errors[0] > 3e-3 > errors[1], "the drones differ, and the controller corrects them"
        assert np.ptp(plugin.read(sim.data).factors[..., 0]) > 0.05
        assert set(sim.plugins.observations(sim.data)) >= {"randomize.factors", "randomize.thrust_factors"}
    assert Randomize.crazyflie(mass=(1.0, 1.1)).mass == (1.0, 1.1)


def test_a_task_draws_new_drones_in_every_episode():
    env = AutoReset(make("hover", 4, randomize="crazyflie", seconds=0.1))
    assert "splits the step" not in env.explain(), "draws at resets are fused too"
    assert "randomize_begin" not in [s.__name__ for s in env.step_fn.stages], "and nothing is drawn again in a step"
    state = jax.jit(env.reset)(jax.random.key(0))
    step, factors_by_step = jax.jit(env.step), [np.asarray(state.data.plugins["randomize"].factors)[:, 0, 0]]
    for _ in range(8):
        state = step(state, jnp.zeros_like(state.action))
        factors_by_step.append(np.asarray(state.data.plugins["randomize"].factors)[:, 0, 0])
    np.testing.assert_array_equal(factors_by_step[0], factors_by_step[1])
    assert len(np.unique(factors_by_step[0])) == 4
    assert np.all(factors_by_step[-1] != factors_by_step[0])


def test_law_09_wrong_ranges_and_missing_plugins_are_errors():
    with pytest.raises(ConfigError, match=r"expected mass as \(low, high\), got \(1.1, 0.9\)"):
        build(mass=(1.1, 0.9))
    with pytest.raises(ConfigError, match=r"mass as \(low, high\), got 0.1. Use \(0.1, 0.1\) for a fixed"):
        build(mass=0.1)
    with pytest.raises(ConfigError, match="mass of Randomize to be positive"):
        build(mass=(-1.0, 0.9))
    for optional in (("foo",), "wind", ("wind", 3)):
        with pytest.raises(ConfigError, match=r"expected optional as a list of mass, inertia, .*, got"):
            Randomize(optional=optional)
    with pytest.raises(ConfigError, match="mass as real numbers of shape"):
        build(mass=(0.9, 1.0, 1.1))
    with pytest.raises(ConfigError, match="first_principles"):
        Sim(dynamics="so_rpy").add(Randomize.crazyflie())
    with pytest.raises(ConfigError, match="acts through drag"):
        Sim(drone="bumblebee").add(Randomize(wind=(0.0, 1.0)))
    sim = Sim(3)
    sim.add(Latency(delay=2))
    sim.add(Randomize(delay=(0, 4)))
    with pytest.raises(ConfigError, match=r"Use Latency\(delay=np.zeros\(\(3, 1\), int\), max_delay=4\)"):
        sim.step()


def test_drones_are_drawn_before_the_steps_unless_a_stage_sets_the_clock_back():
    """Factors are constant in a call, except if a stage begins an episode within it."""

    @stage("world")
    def restart_episode(data):
        steps = data.core.steps
        return data.replace(
            core=data.core.replace(steps=jnp.where(steps == 2, 0, steps), episode=data.core.episode + 1)
        )

    def fly_with(*stages):
        sim = Sim(n_worlds=2, control="rotor_vel", engine="interpret")
        sim.add(Randomize.crazyflie())
        for fn in stages:
            append_fn(sim.step_pipeline, fn)
        sim.build_step_fn()
        sim.step(5)
        return sim

    constant_sim, restarted_sim = fly_with(), fly_with(restart_episode)
    phases = [
        [s.phase for s in sim.step_fn.plan(sim.data).program.fused_segments] for sim in (constant_sim, restarted_sim)
    ]
    assert phases[0] == ["before", "each"]
    assert "before" not in phases[1]
    assert np.any(constant_sim.data.plugins["randomize"].factors != restarted_sim.data.plugins["randomize"].factors)


@pytest.mark.parametrize("setting, remedy", [
    ({"charge": (0.1, 0.5)}, r"Use sim.add\(Battery\(\)\)"),
    ({"delay": (0, 4)}, r"Use sim.add\(Latency\(delay=np.zeros\(\(1, 1\), int\), max_delay=4\)\)"),
    ({"drag": (0.5, 1.5)}, "Use sim.add.RotorAerodynamics"),
])  # fmt: skip
def test_law_09_ranges_that_would_do_nothing_are_errors(setting, remedy):
    """In a preset such ranges are ignored; the same range as an argument is an error, before the first step."""
    sim = Sim(drone="bumblebee", control="rotor_vel", engine="interpret")
    sim.add(Randomize.generic())
    sim.step()
    sim.replace(Randomize.generic(**setting))
    with pytest.raises(ConfigError, match=remedy):
        sim.step()
    with pytest.raises(ConfigError, match=remedy):
        make("hover", drone="bumblebee", effects=[Randomize(**setting)])


def test_law_09_unknown_ranges_of_a_task_are_an_error():
    with pytest.raises(ConfigError, match=r"randomize as one of 'crazyflie', 'generic', got 'crazyfly'. Use effects="):
        make("hover", randomize="crazyfly")


@pytest.mark.parametrize("latency_first", [True, False])
def test_delays_are_drawn_in_any_order_of_adding(latency_first):
    sim = Sim(20, control="rotor_vel", engine="interpret")
    plugins = [Latency(delay=np.zeros((20, 1), int), max_delay=3), Randomize(delay=(0, 4 - 1e-3))]
    for plugin in plugins if latency_first else reversed(plugins):
        sim.add(plugin)
    sim.step()
    assert set(np.unique(sim.data.plugins["latency"].delay)) == {0, 1, 2, 3}


def test_factors_are_drawn_at_the_reset():
    """Observations after a reset are those of the new episode, in its worlds only, in any number of worlds."""
    observations_by_count = []
    for n_worlds in (2, 3):
        sim, plugin = build(n_worlds, charge=(0.2, 0.6), **RANGES)
        battery = sim.add(Battery())
        sim.reset()
        first = sim.plugins.observations(sim.data)
        assert np.ptp(first["battery.charge"]) > 0.01
        expected = open_circuit_voltage(first["battery.charge"], battery.read(sim.data).n_cells)
        np.testing.assert_allclose(first["battery.voltage"], expected, rtol=1e-6)
        observations_by_count.append({key: np.asarray(x) for key, x in first.items() if key.startswith("randomize")})
        sim.step()
        for key, x in observations_by_count[-1].items():  # rounded by another engine
            np.testing.assert_allclose(sim.plugins.observations(sim.data)[key], x, rtol=1e-6, atol=1e-6, err_msg=key)
    assert np.unique(observations_by_count[1]["randomize.factors"][..., 0]).size == 6
    for key, x in observations_by_count[0].items():
        np.testing.assert_array_equal(x, observations_by_count[1][key][:2])
    sim.reset(np.array([False, True, False]))
    again = np.asarray(plugin.read(sim.data).factors)
    np.testing.assert_allclose(again[::2], observations_by_count[1]["randomize.factors"][::2], rtol=1e-6)
    assert np.all(again[1] != observations_by_count[1]["randomize.factors"][1])
    sim.remove(plugin)
    assert list(sim.reset_pipeline) == ["reset"]


def test_a_factor_of_the_drag_acts_on_rotor_aerodynamics():
    """A factor of two acts as twice the coefficient of rotor drag, whose moment tips the drone back."""
    velocities = []
    for factor, drag in ((2.0, 1e-6), (1.0, 2e-6)):
        sim, _ = build(1, 1, drag=(factor, factor))
        sim.add(RotorAerodynamics(drag=drag, inflow=0.0))
        sim.data = with_states(sim.data, vel=[2.0, 0, 0])
        sim.rotor_vel_control(sim.data.states.rotor_vel)
        sim.step(10)
        velocities.append(np.concatenate([sim.data.states.vel[0, 0], sim.data.states.ang_vel[0, 0]]))
    assert velocities[0][0] < 2.0 - 1e-4
    np.testing.assert_allclose(velocities[0], velocities[1], rtol=1e-5, atol=1e-6)
