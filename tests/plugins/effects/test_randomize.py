"""Randomisation: distributions, equality with changed parameters, and the laws of random numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_rotor_state, with_states
from sweep import RANGES

from crazysim import IMU, Battery, ConfigError, Latency, Randomize, Sim, Wind
from crazysim.core.pipeline import append_fn
from crazysim.engine.stage import stage
from crazysim.envs import make
from crazysim.plugins.effects.battery import open_circuit_voltage
from crazysim.plugins.effects.moving_air import drag_factor
from crazysim.plugins.estimators import ESKF
from crazysim.plugins.sensors import TimeOfFlight


def build(n_worlds=3, n_drones=2, engine="interpret", **settings):
    sim = Sim(n_worlds, n_drones, control="rotor_vel", rng_key=5, engine=engine)
    sim.data = with_states(sim.data, pos=[0, 0, 2.0], rotor_vel=hover_rotor_state(sim.data))
    sim.build_default_data()
    return sim, sim.add(Randomize(**settings))


@pytest.fixture(scope="module")
def thousand_worlds():
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


def test_a_fraction_draws_every_number_of_a_task_within_it():
    env = make("hover", 200, randomize=0.05, engine="interpret")
    drawn = env.reset(jax.random.key(0)).data.plugins["randomize"]
    factors = np.concatenate([np.asarray(drawn.factors)[:, 0], np.asarray(drawn.thrust_factors)[:, 0]], axis=-1)
    assert np.all(np.abs(factors - 1) <= 0.05 + 1e-6)
    assert np.all(np.ptp(factors, axis=0) > 0.09)


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


PATHS = {
    "params.J": 0.2,
    "params.rotor_vel_max": (0.8, 0.9),
    "controls.state.controller.params.kp": 0.3,
    "controls.force_torque.params.rpm2thrust": 0.1,
    "plugins.battery.resistance": (0.5, 2.0),
    "plugins.imu.accel.noise": (2.0, 3.0),
    "plugins.imu.gyro.spread": (0.0, 4.0),
    "plugins.wind.velocity": 0.5,
}


def number_at(data, path):
    for name in path.split("."):
        data = data[name] if isinstance(data, dict) else getattr(data, name)
    return data


def with_number(node, path, value):
    name, _, rest = path.partition(".")
    new = with_number(number_at(node, name), rest, value) if rest else value
    return node | {name: new} if isinstance(node, dict) else node.replace(**{name: new})


def fly(plugins, n_worlds=3, **settings):
    sim = Sim(n_worlds, 2, control="state", controller="crazyflow", rng_key=5, engine="interpret", **settings)
    sim.data = with_states(sim.data, pos=[0, 0, 2.0], rotor_vel=hover_rotor_state(sim.data))
    sim.build_default_data()
    for plugin in plugins:
        sim.add(plugin)
    sim.state_control(pos=[0.2, 0.0, 2.5])
    return sim


def physical_plugins():
    return [Battery(), IMU.bmi088(), Wind([1.0, 0.5, 0.0])]


@pytest.mark.parametrize(("drone", "position"), [("cf2x_L250", 0), (["cf2x_L250", "cf21B_500"], 3)])
def test_numbers_drawn_by_path_act_as_numbers_set_by_hand(drone, position):
    """The nominal numbers stay as they are, for numbers that drones share or not, and in any order of adding."""
    plugins = physical_plugins()
    plugins.insert(position, Randomize(PATHS))
    drawn_sim, set_sim = fly(plugins, drone=drone), fly(physical_plugins(), drone=drone)
    nominal = {path: np.asarray(number_at(drawn_sim.data, path)) for path in PATHS}
    masks = [None, np.array([True, False, True]), np.array([False, True, True])]
    last_factors = np.ones((3, 2, len(PATHS)))
    for mask in masks:
        drawn_sim.reset(mask)
        factors = np.asarray(drawn_sim.data.plugins["randomize"].path_factors)
        is_reset = np.ones(3, bool) if mask is None else mask
        np.testing.assert_allclose(factors[~is_reset], last_factors[~is_reset], rtol=1e-6)  # rounded by another engine
        assert np.all(factors[is_reset] != last_factors[is_reset])
        for k, (path, limits) in enumerate(PATHS.items()):
            low, high = limits if isinstance(limits, tuple) else (1 - limits, 1 + limits)
            assert low <= factors[..., k].min() < factors[..., k].max() <= high
            n_core = nominal[path].ndim - 2 * (nominal[path].shape[:2] == (3, 2))
            factor = factors[..., k].reshape(3, 2, *[1] * n_core)
            for owner in ("data", "default_data"):
                data = with_number(getattr(set_sim, owner), path, jnp.asarray(factor * nominal[path]))
                if path == "params.J":
                    data = with_number(data, "params.J_inv", jnp.linalg.inv(data.params.J))
                setattr(set_sim, owner, data)
        set_sim.reset(mask)
        for sim in (drawn_sim, set_sim):
            sim.state_control(pos=[2.0, -1.0, 2.0])
            sim.step(20)
        for path in ("states", "plugins.battery.voltage", "plugins.imu.samples", "plugins.imu.gyro.bias"):
            results = [jax.tree.leaves(number_at(sim.data, path)) for sim in (drawn_sim, set_sim)]
            for x, expected in zip(*results, strict=True):
                np.testing.assert_allclose(x, expected, rtol=1e-3, atol=1e-3, err_msg=path)
        for path, x in nominal.items():
            np.testing.assert_array_equal(number_at(drawn_sim.data, path), x)
        last_factors = factors


def test_factors_survive_other_numbers_and_edits_of_the_scene():
    """A replaced plugin has new nominal numbers; ranges that are replaced act from the next episode on."""
    sim = fly([Randomize(PATHS), *physical_plugins()])
    sim.step()
    factors = np.asarray(sim.data.plugins["randomize"].path_factors)
    sim.replace(Battery(resistance=0.5))
    sim.scene.add("sphere", pos=[3.0, 0.0, 0.0], radius=0.1)
    sim.replace(Randomize(PATHS | {"params.J": (3.0, 3.0)}))
    sim.step()
    np.testing.assert_array_equal(sim.data.plugins["randomize"].path_factors, factors)
    np.testing.assert_array_equal(sim.data.plugins["battery"].resistance, np.float32([0.5]))
    sim.reset()
    np.testing.assert_array_equal(sim.data.plugins["randomize"].path_factors[..., 0], 3.0)
    with pytest.raises(ConfigError, match="plugin that needs 'wind'"):
        sim.remove("wind")


def test_a_filter_assumes_nominal_numbers():
    """The variances of a filter do not depend on the noise that its sensors have."""
    covariances, accelerations = [], []
    for ranges in ({}, {"plugins.imu.accel.noise": (9.0, 9.0)}):
        imu, ranger = IMU.bmi088(), TimeOfFlight()
        sim = fly([imu, ranger, ESKF([imu, ranger], control=False), Randomize(ranges)])
        sim.step(5)
        covariances.append(np.asarray(sim.data.plugins["eskf"].estimate.cov))
        accelerations.append(np.asarray(sim.plugins.observations(sim.data)["imu.accel"]))
    np.testing.assert_allclose(*covariances, rtol=0.01, atol=1e-8)
    assert np.abs(accelerations[0] - accelerations[1]).max() > 0.01


def test_without_a_range_of_the_drag_it_stays_as_it_is():
    sim, _ = build(thrust=(0.9, 1.1))
    assert drag_factor(sim.data) == 1
