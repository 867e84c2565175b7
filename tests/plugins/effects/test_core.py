"""What holds for every effect: off it is not there, on it keeps to the laws, and all of them go together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import by_stages, hover_command, hovering, n_documented, repeat_command, trees_equal, with_states
from sweep import EFFECTS

from crazysim import (
    Battery,
    ConfigError,
    Latency,
    MotorFailure,
    Plugin,
    Sim,
    Wind,
    load_airframe,
)
from crazysim.core.pipeline import replace_fn
from crazysim.core.stage import vmap_drones
from crazysim.plugins import effects
from crazysim.pytree import scopes

IDLE = {Battery: {"capacity": 1e6, "resistance": 1e-6}, Latency: {"delay": 0}, MotorFailure: {}, Wind: {}}
"""Effects at settings at which they do nothing."""


def switch_on(sim, settings=EFFECTS):
    for effect, kwargs in settings.items():
        n = sim.airframe.n_rotors
        if "fail_step" in kwargs:
            kwargs = kwargs | {"fail_step": [-1] * (n - 1) + [30]}
        sim.add(effect(**kwargs))


@pytest.fixture(scope="module")
def every():
    sim = hovering()
    switch_on(sim)
    return sim


@pytest.fixture(autouse=True)
def restore(request):
    if "every" not in request.fixturenames:
        yield
        return
    sim = request.getfixturevalue("every")
    data = sim.data
    yield
    sim.data = data


def test_every_effect_is_here_and_sorted():
    assert effects.__all__ == sorted(effects.__all__)
    kinds = [name for name in effects.__all__ if isinstance(getattr(effects, name), type)]
    plugins = [name for name in kinds if issubclass(getattr(effects, name), Plugin)]
    assert plugins == sorted(effect.__name__ for effect in EFFECTS)


def test_off_nothing_is_there_and_without_strength_nothing_changes():
    """At settings that do nothing a flight is the plain one, but for the rounding of what is fused differently."""
    plain, idle = hovering(engine="interpret"), hovering(engine="interpret")
    stages = list(plain.step_pipeline)
    switch_on(idle, IDLE)
    assert set(idle.step_pipeline) - set(stages) == {"battery", "latency"}, "nothing runs that has nothing to do"
    assert [s for s in idle.step_pipeline if s in stages] == stages
    assert not plain.data.plugins
    for sim in (plain, idle):
        sim.attitude_control(repeat_command(sim.data, hover_command(sim.data) + [0.1, -0.1, 0.2, 0.05]))
        sim.step(50)
    for name in ("pos", "quat", "vel", "ang_vel"):
        a, b = getattr(plain.data.states, name), getattr(idle.data.states, name)
        np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-5)  # float32 over 50 steps


def signature(tree):
    """Return structure, shapes and types of a tree."""
    return jax.tree.structure(tree), [(x.shape, x.dtype) for x in jax.tree.leaves(tree)]


@pytest.mark.long("traces all effects for four sizes")
def test_law_02_shapes_and_types_stay_for_any_number_of_worlds_drones_and_rotors():
    tables = dict(load_airframe("cf21B_500").tables)
    angle = np.arange(6) * np.pi / 3
    rotors = {
        "position": 0.05 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1),
        "yaw_torque_sign": [1, -1, 1, -1, 1, -1],
    }
    hexacopter = tables | {"rotors": dict(tables["rotors"]) | rotors}
    for i, (n_worlds, n_drones) in enumerate([(2, 2), (1, 4), (3, 1), (4, 3)]):
        control = ("attitude", "rotor_vel")[i % 2]
        drone = ("cf21B_500", hexacopter)[i // 2 % 2]
        sim = Sim(n_worlds, n_drones, drone=drone, control=control, engine="lanes")
        switch_on(sim)
        after = jax.eval_shape(lambda d, sim=sim: sim.step_fn(d, 1), sim.data)
        assert signature(after) == signature(sim.data)
        for scope, x in zip(*map(jax.tree.leaves, (scopes(sim.data.plugins), sim.data.plugins)), strict=True):
            assert scope in ("drone", "shared")
            assert scope == "shared" or x.shape[:2] == (n_worlds, n_drones)


def test_float64_stays_float64(x64):
    sim = Sim(2, 2, engine="lanes")  # random numbers in float64 come from integers of 64 bits, which kernels lack
    switch_on(sim)
    assert all(x.dtype != jnp.float32 for x in jax.tree.leaves(sim.data.plugins))
    after = jax.eval_shape(lambda d: sim.step_fn(d, 1), sim.data)
    assert signature(after) == signature(sim.data)


STAGES = (
    "battery", "downwash", "latency", "motors", "randomize_begin", "wind", "wind_field_begin", "wind_field",
    "integration",
)  # fmt: skip


@pytest.fixture(scope="module")
def flown(every):
    """Data in flight, with everything at work."""
    before = every.data
    every.attitude_control(repeat_command(before, hover_command(before) + [0.1, -0.2, 0.0, 0.1]))
    every.step(20)
    data, every.data = on_host(every.data), before
    return data


def on_host(tree):
    """Return a tree with its numbers in NumPy's arrays, whose parts are taken without compiling anything."""
    return jax.tree.map(lambda x: x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x), tree)


def at_world(scope, x, world):
    """Return the part of a leaf that belongs to a world."""
    return x[world, 0] if scope == "world" else x[world] if scope == "drone" else x


@pytest.mark.parametrize("name", STAGES)
def test_law_01_what_a_stage_does_to_all_it_does_to_one(every, flown, name):
    """A stage on the data of one drone, or one world, gives what it gives on all data at that place."""
    stage = every.step_pipeline[name]
    all_at_once, of_one = on_host(jax.jit(stage)(flown)), jax.jit(stage.apply_unbatched)
    blown = jax.jit(vmap_drones(stage.apply_unbatched))
    for index in [(0, 0), (1, 1), (2, 0)]:

        def at(scope, x, index=index):
            if scope == "world":
                return x[index[0], 0]
            return x[index if stage.scope == "drone" else index[0]] if scope == "drone" else x

        expected = jax.tree.map(at, scopes(flown), all_at_once)
        if name == "downwash":  # a drone alone has no others
            world = jax.tree.map(lambda scope, x, w=index[0]: at_world(scope, x, w), scopes(flown), flown)
            one = jax.tree.map(lambda x, k=index[1]: x[k], on_host(blown(world)))
        else:
            one = of_one(jax.tree.map(at, scopes(flown), flown))
        for x, y in zip(*map(jax.tree.leaves, (expected, one)), strict=True):
            if jnp.issubdtype(y.dtype, jnp.floating):
                # float32: one drone's arithmetic is fused in another way
                np.testing.assert_allclose(y, x, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", STAGES)
def test_stages_are_straight_line(every, flown, name):
    """Nothing of a stage loops or branches, or engines could not turn it into scalar code."""
    jaxpr = str(jax.make_jaxpr(every.step_pipeline[name])(flown))
    for word in ("while[", "scan[", "cond[", "sort[", "dot_general["):
        assert word not in jaxpr, word


def test_docstrings_give_the_shapes(every):
    sizes = {
        "n_worlds": 3,
        "n_drones": 2,
        "n_rotors": 4,
        "n_rows": 3,
        "k": 4,
        "n_x": 3,
        "n_y": 3,
        "n_z": 2,
        "n_hidden": 2,
    }
    for record in every.data.plugins.values():
        assert n_documented(record, **sizes) == len(jax.tree.leaves(record))


def test_every_effect_is_fused(every):
    program = every.step_fn.plan(every.data).program
    assert program.unfused_stages == ()
    fused = {name for s in program.fused_segments for name in s.stages}
    assert {*STAGES} <= fused
    own = set(every.step_pipeline) - set(hovering(engine="interpret").step_pipeline)
    assert own == {*STAGES} - {"integration"}, "an effect's stages are listed in STAGES"
    assert [(s.scope, s.phase) for s in program.fused_segments] == [("drone", "before"), ("drone", "each")]


def test_law_06_one_trace_whatever_is_reset_and_changed(every):
    sim = every
    for i in range(4):
        sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
        sim.step(i + 1)
        sim.reset(np.array([True, False, i % 2 == 0]))
    sim.reset()
    sim.step()
    assert sim.step_fn._cache_size() == 1


def test_the_users_wrench_parameters_and_commands_stay(every):
    sim = every
    sim.data = with_states(sim.data, force=[0.01, 0.02, 0.03], torque=[1e-5, 0, 0])
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
    before = sim.data
    sim.step(35)
    after = sim.data
    assert trees_equal(before.params, after.params)
    assert trees_equal((before.states.force, before.states.torque), (after.states.force, after.states.torque))
    assert trees_equal(before.controls.attitude.staged_cmd, after.controls.attitude.staged_cmd)
    for record in ("battery", "downwash", "latency", "motors", "wind"):
        assert not trees_equal(before.plugins[record], after.plugins[record]), record


def test_a_reset_brings_every_record_back_in_its_worlds_alone(every):
    sim = every
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
    sim.step(40)
    flown, mask = sim.data.plugins, np.array([False, True, True])
    sim.reset(mask)
    drawn, default = sim.data.plugins, dict(sim.default_data.plugins)
    for name, fields in (("randomize", ("factors", "thrust_factors", "air_vel")), ("wind_field", ("shift",))):
        found = {field: getattr(drawn[name], field) for field in fields}
        changed = np.asarray(found[fields[0]]) != np.asarray(getattr(flown[name], fields[0]))
        np.testing.assert_array_equal(
            changed[..., 0], np.broadcast_to(mask[:, None], (3, 2)), f"{name}: drawn at resets"
        )
        default[name] = default[name].replace(**found)
    pairs = zip(*map(jax.tree.leaves, (scopes(flown), flown, sim.data.plugins, default)), strict=True)
    for scope, before, after, default in pairs:
        if scope == "drone":
            np.testing.assert_array_equal(np.asarray(after)[mask], np.asarray(default)[mask])
            np.testing.assert_array_equal(np.asarray(after)[~mask], np.asarray(before)[~mask])


def test_law_07_values_and_gradients_are_finite(every):
    """On the floor, coincident, upside down, nose up, at rest, with saturated commands, through a rotor's failure."""
    sim = every
    half = np.sqrt(0.5)
    quat = np.array([[[0, 0, 0, 1], [0, 0, 0, 1]], [[1, 0, 0, 0], [0, half, 0, half]], [[0, 0, 0, 1], [0, 0, 0, 1]]])
    pos = np.array([[[0, 0, 0], [0, 0, -0.001]], [[0, 0, 1], [0, 0, 2]], [[0, 0, 3], [0, 0, 3]]])
    data = with_states(sim.data, pos=pos, quat=quat, rotor_vel=0.0)
    command = np.stack(
        [0 * repeat_command(data, hover_command(data))[0], 100 + repeat_command(data, hover_command(data))[0]] * 2
    )[:3]
    sim.data = data
    sim.attitude_control(command)
    step = by_stages(sim)

    def sum_of_states(data):
        end = step(data, 40)
        return sum(getattr(end.states, name).sum() for name in ("pos", "quat", "vel", "ang_vel")), end

    gradient, end = jax.jit(jax.grad(sum_of_states, has_aux=True, allow_int=True))(sim.data)
    np.testing.assert_array_equal(end.core.steps, 40)
    assert np.any(gradient.states.pos)
    assert np.any(gradient.plugins["motors"].effectiveness)
    for x in jax.tree.leaves((gradient.states, gradient.controls, gradient.params, gradient.plugins)):
        assert x.dtype == jax.dtypes.float0 or np.isfinite(x).all()
    for x in jax.tree.leaves((end.states, end.controls, end.plugins)):
        assert np.isfinite(np.asarray(x, np.float64)).all()


def test_law_08_an_integrator_keeps_its_order_in_wind(x64):
    """RK4 feels the wind at every substep: a force held over the step would leave order 1."""
    ends = []
    for freq in (20, 40, 320):
        sim = Sim(control="rotor_vel", integrator="rk4", freq=freq, engine="interpret")
        p = sim.data.params
        sim.data = sim.data.replace(params=p.replace(drag_matrix=np.diag([-0.01, -0.02, -0.1])))
        sim.data = with_states(sim.data, pos=[0, 0, 50.0], ang_vel=[3.0, -2.0, 4.0])
        sim.add(Wind((5.0, -3.0, 2.0)))
        sim.step(freq // 2)
        ends.append(np.asarray(sim.data.states.vel))
    errors = [np.abs(x - ends[-1]).max() for x in ends[:-1]]
    slope = -np.polyfit(np.log([20, 40]), np.log(errors), 1)[0]
    assert abs(slope - 4) < 0.3


def test_law_09_effects_need_the_built_in_integration():
    sim = Sim()
    replace_fn(sim.step_pipeline, lambda data: data, "integration")
    with pytest.raises(ConfigError, match="before you replace or remove that stage"):
        sim.add(Wind((1.0, 0, 0)))
    assert not sim.data.plugins
    assert not sim.plugins


def test_default_data_get_the_record_and_nothing_else():
    """An effect that is added in flight does not make the present state the one that resets return to."""
    sim = hovering()
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
    sim.step(3)
    default = sim.default_data
    switch_on(sim)
    assert trees_equal(sim.default_data.replace(plugins={}), default)
    assert (
        set(sim.default_data.plugins)
        == set(sim.plugins)
        == {effect(**kwargs).name for effect, kwargs in EFFECTS.items()}
    )
    sent = np.asarray(sim.data.controls.attitude.staged_cmd)
    np.testing.assert_array_equal(sim.data.plugins["latency"].arrived, sent)
    np.testing.assert_array_equal(sim.default_data.plugins["latency"].arrived, 0 * sent)
