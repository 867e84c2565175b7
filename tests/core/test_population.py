"""Populations: records with members, stages of one member, and programs of their own.

The populations are the masses on springs of ``springs.py``.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from springs import KINDS, STIFFNESS, Springs, Tied, Tying, build_springs

from crazysim import ConfigError, Sim, stage
from crazysim.core.pipeline import insert_fn_before
from crazysim.core.plugin import Param, param
from crazysim.core.population import Population
from crazysim.core.random import member_key, world_key
from crazysim.engine.pytree import check_axes, scopes
from crazysim.errors import EngineWarning

COUNTS = [(2, 2, 2), (3, 2, 4), (4, 3, 1)]
"""Numbers of worlds, drones and members."""


def keep_mass_stages(sim):
    """Return the simulation with only the stages of its masses, so that drones stand still."""
    stages = sim.step_pipeline.items()
    sim.step_pipeline = {name: fn for name, fn in stages if name.startswith("springs") or name == "increment_steps"}
    return sim


def states_by_name(data):
    result = {"drones": data.states.pos, "speeds": data.states.vel}
    for name, record in data.plugins.items():
        result |= {f"masses of {name}": record.pos, f"ticks of {name}": record.ticks}
    return {name: np.asarray(value) for name, value in result.items()}


@pytest.mark.parametrize(("n_worlds", "n_drones", "n_members"), COUNTS)
def test_law_02_axes_are_as_declared_for_any_counts(n_worlds, n_drones, n_members):
    """For equal and unequal numbers of worlds, drones and members, the first world flies like a single world."""
    sim, single_sim = (build_springs(KINDS, n, n_drones, n_members, engine="interpret") for n in (n_worlds, 1))
    for each_sim in (sim, single_sim):
        each_sim.step(7)
    expected = states_by_name(single_sim.data)
    for name, values in states_by_name(sim.data).items():
        assert np.all(np.isfinite(values)), name
        np.testing.assert_allclose(values[:1], expected[name], rtol=2e-5, atol=2e-6, err_msg=name)
        assert np.ptp(values) > 0 or name.startswith("ticks")
    for kind in ("springs", "crowd", "tied", "tying"):
        np.testing.assert_array_equal(states_by_name(sim.data)[f"ticks of {kind}"], 2)  # 100 Hz: steps 0 and 5


@pytest.mark.parametrize("integrator", ["euler", "symplectic_euler", "rk4"])
def test_integration_follows_the_scheme(integrator):
    errors, freqs = [], (50, 100, 200)
    with jax.enable_x64(True):
        for freq in freqs:
            sim = Sim(control="rotor_vel", freq=freq, integrator=integrator, engine="interpret")
            sim.add(Springs(1, rate=None))
            keep_mass_stages(sim).step(2 * freq // 5)
            exact = np.cos(np.sqrt(STIFFNESS) * 0.4)
            errors.append(abs(np.asarray(sim.data.plugins["springs"].pos)[0, 0, 0] - exact))
    slope = np.polyfit(np.log(1 / np.asarray(freqs)), np.log(errors), 1)[0]
    assert abs(slope - sim.integrator.order) < 0.35


@pytest.mark.long("compiles gradients in both directions")
def test_gradients_pass_through_populations():
    """Gradients in both modes equal central differences, which are exact, since the loss is quadratic."""
    cmd = np.ones((4, 2, 3, 3), np.float32)

    sim = build_springs(KINDS, 2, 2, 3)
    step = sim.step_fn

    def loss(cmd):
        data = sim.data
        for population, population_cmd in zip(sim.plugins.values(), cmd, strict=True):
            data = population.with_command(data, population_cmd)
        data = step(data, 5)
        return sum(jnp.sum(record.pos**2) for record in data.plugins.values()) + jnp.sum(data.states.pos)

    gradient = np.asarray(jax.jit(jax.grad(loss))(cmd))
    assert np.all(np.abs(gradient) > 0)
    direction = np.float32(np.random.default_rng(1).uniform(0.5, 1, cmd.shape))
    value_and_slope = jax.jit(lambda x: jax.jvp(loss, (x,), (direction,)))
    np.testing.assert_allclose(value_and_slope(cmd)[1], np.sum(direction * gradient), rtol=1e-4)
    for k in range(4):
        h = np.zeros(cmd.shape, np.float32)
        h[k, 1, 2, 0] = 0.5
        central = float(value_and_slope(cmd + h)[0]) - float(value_and_slope(cmd - h)[0])
        np.testing.assert_allclose(gradient[k, 1, 2, 0], central, rtol=2e-2)


def test_a_derivative_reaches_the_drones_from_a_mass():
    sim = build_springs(Tying, 2, 2, 3, engine="fused")

    def height(pos):
        record = sim.data.plugins["springs"].replace(pos=pos)
        return sim.step_fn(sim.plugins["springs"].write(sim.data, record), 5).states.pos[1, 0, 2]

    slope = np.asarray(jax.jit(jax.grad(height))(sim.data.plugins["springs"].pos))
    assert np.all(slope[1, :, 2] != 0)
    assert np.all(slope[0] == 0)


def test_random_numbers_are_those_of_world_and_member():
    @stage("springs")
    def kick(data):
        record = data.plugins["springs"]
        vel = record.vel + jax.random.normal(member_key(data, "springs", "kick"), (3,))
        return data.replace(plugins=data.plugins | {"springs": record.replace(vel=vel)})

    drawn = []
    for counts in ((3, 2, 4), (2, 1, 3)):
        sim = Sim(*counts[:2])
        sim.add(Springs(counts[2], stiffness=0.0))
        insert_fn_before(sim.step_pipeline, "integration", kick, "springs_kick")
        keep_mass_stages(sim).step(3)
        drawn.append(np.asarray(sim.data.plugins["springs"].vel))
    np.testing.assert_allclose(drawn[0][:2, :3], drawn[1], rtol=1e-6)
    assert len(np.unique(drawn[0])) == drawn[0].size
    data = sim.data
    core = jax.tree.map(lambda x: x.reshape(-1)[0], data.core)
    member_record = data.plugins["springs"].replace(member_id=np.asarray(data.plugins["springs"].member_id)[0, 0])
    member_data = data.replace(core=core, plugins={"springs": member_record})
    assert world_key(member_data, "kick") != member_key(member_data, "springs", "kick")


def test_two_populations_are_two_programs():
    sim = Sim(2, 2, engine="fused")
    sim.add(Springs(3))
    sim.add(Springs(["Mass_7", "Mass_8"], name="others", stiffness=0.0))
    assert [p.population for p in sim.step_fn.plan(sim.data).programs] == ["drone", "springs", "others"]
    assert "fused, for one member of 'springs': springs_control, springs_integration" in sim.explain()
    sim.step(50)
    springs, others = jax.device_get((sim.data.plugins["springs"], sim.data.plugins["others"]))
    assert springs.pos.shape == (2, 3, 3)
    np.testing.assert_array_equal(others.pos, np.broadcast_to(np.arange(1.0, 3)[:, None], (2, 2, 3)))
    assert np.all(np.abs(springs.pos - others.pos[:, [0, 1, 1]]) > 0.01)
    np.testing.assert_array_equal(sim.data.core.steps, 50)


def test_parameters_may_differ_between_members():
    sim = build_springs(Springs, 2, 1, 2)
    record = sim.data.plugins["springs"]
    assert jax.tree.leaves(scopes(record)) == ["springs"] * 5 + ["shared"]
    stiffness = np.float32([[[0.0], [10.0]], [[20.0], [0.0]]])
    sim.data = sim.plugins["springs"].write(sim.data, record.replace(stiffness=stiffness))
    assert jax.tree.leaves(scopes(sim.data.plugins["springs"]))[-1] == "springs"
    keep_mass_stages(sim).step(10)
    moved = np.any(np.asarray(sim.data.plugins["springs"].vel) != 0, axis=-1)
    np.testing.assert_array_equal(moved, [[False, True], [True, False]])


def test_many_members_that_read_the_drones_run_unfused_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", EngineWarning)
        sim = build_springs(Tied, 2, 2, 9)
        assert sim.step_fn.plan(sim.data).program.unfused_stages


def test_a_population_is_added_replaced_and_removed():
    sim = Sim(2, 2, engine="lanes")
    before, leaves = list(sim.step_pipeline), len(jax.tree.leaves(sim.data))
    sim.add(Springs(2))
    assert list(sim.step_pipeline) == [
        *before[:-3],
        "springs_control",
        *before[-3:-1],
        "springs_integration",
        before[-1],
    ]
    sim.step(5)
    speed = sim.data.plugins["springs"].vel
    size = sim.step_fn._cache_size()
    sim.replace(Springs(2, stiffness=0.0))
    np.testing.assert_array_equal(sim.data.plugins["springs"].vel, speed)
    sim.step(5)
    np.testing.assert_array_equal(sim.data.plugins["springs"].vel, speed)
    assert sim.step_fn._cache_size() <= size + 1  # zeros of shared parameters are folded
    sim.remove("springs")
    assert list(sim.step_pipeline) == before
    assert len(jax.tree.leaves(sim.data)) == leaves


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (lambda: Springs(0), "a positive number or a list of names, got 0"),
        (lambda: Springs(True), "a positive number or a list of names, got True"),
        (lambda: Springs("Mass_0"), "a positive number or a list of names, got 'Mass_0'"),
        (lambda: Springs(["Mass_0", 1]), "a positive number or a list of names"),
        (lambda: Springs(["Mass_0", "Mass_0"]), "distinct names of members, got 'Mass_0' twice"),
        (lambda: Springs(name="drone"), "name of a population, got 'drone'"),
        (lambda: Springs(name="shared"), "name of a population, got 'shared'"),
        (lambda: Springs(rate=300), "to divide freq = 500 Hz, got 300 Hz. Use the nearest rate below, 250 Hz"),
        (lambda: Springs(rate=-1), "control_freq of 'springs' is -1; it must be a positive whole number"),
    ],
)
def test_wrong_settings_are_refused(plugin, message):
    """Law 9; the simulation stays as it was."""
    sim = Sim(2, 2)
    pipeline = dict(sim.step_pipeline)
    with pytest.raises(ConfigError, match=message):
        sim.add(plugin())
    assert sim.step_pipeline == pipeline
    assert not sim.data.plugins


def test_a_stage_of_a_population_that_does_not_exist_is_refused():
    sim = Sim(engine="plain")

    @stage("cars")
    def drive(data):
        return data

    insert_fn_before(sim.step_pipeline, "integration", drive)
    with pytest.raises(ConfigError, match="'drive' is declared for one member of 'cars', and there is no population"):
        sim.step()
    sim.add(Springs(2))
    with pytest.raises(ConfigError, match="Use one of 'drone', 'springs' or 'world'"):
        sim.step()


def test_a_stage_may_write_its_own_population_only():
    sim = build_springs(Springs, engine="plain")

    @stage("springs")
    def greedy(data):
        return data.replace(states=data.states.replace(pos=data.states.pos + 1))

    insert_fn_before(sim.step_pipeline, "integration", greedy)
    with pytest.raises(ConfigError, match=r"'greedy' is declared for one member of 'springs' and writes states\.pos"):
        sim.step()


def test_commands_of_another_shape_are_refused():
    sim = build_springs(Springs, 2, 2, 3)
    springs = sim.plugins["springs"]
    with pytest.raises(ValueError, match=r"expected a command of shape \(2, 3, 3\) for 'springs', got \(3,\)"):
        springs.with_command(sim.data, np.zeros(3))
    with pytest.raises(ValueError, match="expected finite numbers as command of 'springs'"):
        springs.with_command(sim.data, np.full((2, 3, 3), np.nan))

    class Still(Population):
        name: str = "still"

        pos: Param = param(default=None, core=(3,), scope="member")

    for wrong in (0.0, np.zeros((2, 3)), np.zeros((3, 3, 3))):
        with pytest.raises(
            ConfigError, match=r"expected pos .* for all members, or \(2, 3, 3\) = \(n_worlds, n_members"
        ):
            sim.add(Still(3, pos=wrong))


def test_leaves_have_the_axes_of_their_population():
    sim = build_springs(Springs, 2, 2, 3)
    record = sim.data.plugins["springs"]
    few = np.asarray(record.pos)[:, :2]
    for wrong in (record.replace(pos=few), record.replace(stiffness=np.ones((2, 2, 1), np.float32))):
        with pytest.raises(ConfigError, match=r"begin with \(2, 3\).*for 2 worlds of 3 springs"):
            check_axes(sim.plugins["springs"].write(sim.data, wrong), 2, 2)


def test_a_rate_of_something_else_is_refused():
    class Wrong(Springs):
        def derivative(self, data):
            return {"mass": 1.0}

    sim = Sim(engine="plain")
    sim.add(Wrong())
    with pytest.raises(ConfigError, match="rates of states of members in its record, which are 'member_id', 'pos'"):
        sim.step()
