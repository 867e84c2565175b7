"""Laws for all effects at once; an effect that is off adds nothing to the step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    count_documented_arrays,
    hover_command,
    make_hovering_sim,
    repeat_command,
    trees_equal,
    with_states,
)
from sweep import EFFECTS

from crazysim import (
    Battery,
    ConfigError,
    Latency,
    MotorFailure,
    Sim,
    Wind,
)
from crazysim.core.pipeline import replace_fn
from crazysim.engine.pytree import scopes

IDLE = {Battery: {"capacity": 1e6, "resistance": 1e-6}, Latency: {"delay": 0}, MotorFailure: {}, Wind: {}}
"""Effects with settings that have no effect."""


def add_effects(sim, settings=EFFECTS):
    for effect, kwargs in settings.items():
        n = sim.airframe.n_rotors
        if "fail_step" in kwargs:
            kwargs = kwargs | {"fail_step": [-1] * (n - 1) + [30]}
        sim.add(effect(**kwargs))


@pytest.fixture(scope="module")
def sim_with_effects():
    sim = make_hovering_sim()
    add_effects(sim)
    return sim


@pytest.fixture(autouse=True)
def restore(request):
    if "sim_with_effects" not in request.fixturenames:
        yield
        return
    sim = request.getfixturevalue("sim_with_effects")
    data = sim.data
    yield
    sim.data = data


def test_effects_without_strength_change_nothing():
    """The flight is that without effects, except for rounding, as the step is fused differently."""
    plain, idle = make_hovering_sim(engine="interpret"), make_hovering_sim(engine="interpret")
    stages = list(plain.step_pipeline)
    add_effects(idle, IDLE)
    assert set(idle.step_pipeline) - set(stages) == {"battery", "latency"}, (
        "stages that have nothing to do are left out"
    )
    assert [s for s in idle.step_pipeline if s in stages] == stages
    assert not plain.data.plugins
    for sim in (plain, idle):
        sim.attitude_control(repeat_command(sim.data, hover_command(sim.data) + [0.1, -0.1, 0.2, 0.05]))
        sim.step(50)
    for name in ("pos", "quat", "vel", "ang_vel"):
        a, b = getattr(plain.data.states, name), getattr(idle.data.states, name)
        np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-5)  # float32 over 50 steps


def test_docstrings_of_records_give_the_shapes(sim_with_effects):
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
    for record in sim_with_effects.data.plugins.values():
        assert count_documented_arrays(record, **sizes) == len(jax.tree.leaves(record))


def test_force_parameters_and_commands_of_the_user_stay(sim_with_effects):
    sim = sim_with_effects
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


def test_a_reset_restores_the_records_of_its_worlds_only(sim_with_effects):
    sim = sim_with_effects
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
    sim.step(40)
    before_reset, mask = sim.data.plugins, np.array([False, True, True])
    sim.reset(mask)
    drawn, default = sim.data.plugins, dict(sim.default_data.plugins)
    for name, fields in (("randomize", ("factors", "thrust_factors", "air_vel")), ("wind_field", ("shift",))):
        result = {field: getattr(drawn[name], field) for field in fields}
        changed = np.asarray(result[fields[0]]) != np.asarray(getattr(before_reset[name], fields[0]))
        np.testing.assert_array_equal(
            changed[..., 0], np.broadcast_to(mask[:, None], (3, 2)), f"{name}: drawn at resets"
        )
        default[name] = default[name].replace(**result)
    pairs = zip(*map(jax.tree.leaves, (scopes(before_reset), before_reset, sim.data.plugins, default)), strict=True)
    for scope, before, after, default in pairs:
        if scope == "drone":
            np.testing.assert_array_equal(np.asarray(after)[mask], np.asarray(default)[mask])
            np.testing.assert_array_equal(np.asarray(after)[~mask], np.asarray(before)[~mask])


@pytest.mark.long("compiles the gradient of a step with all effects")
def test_law_07_values_and_gradients_are_finite(sim_with_effects):
    """Drones on the floor, at one place, upside down, nose up and at rest, with saturated commands and a failure.

    Gradients are those of the first step and of one after 40.
    """
    sim = sim_with_effects
    s = np.sqrt(0.5)
    quat = np.array([[[0, 0, 0, 1], [0, 0, 0, 1]], [[1, 0, 0, 0], [0, s, 0, s]], [[0, 0, 0, 1], [0, 0, 0, 1]]])
    pos = np.array([[[0, 0, 0], [0, 0, -0.001]], [[0, 0, 1], [0, 0, 2]], [[0, 0, 3], [0, 0, 3]]])
    data = with_states(sim.data, pos=pos, quat=quat, rotor_vel=0.0)
    command = np.stack(
        [0 * repeat_command(data, hover_command(data))[0], 100 + repeat_command(data, hover_command(data))[0]] * 2
    )[:3]
    sim.data = data
    sim.attitude_control(command)

    @jax.jit
    @functools.partial(jax.grad, allow_int=True)
    def slopes(data):
        data = sim.step_fn(data, 1)
        return sum(getattr(data.states, name).sum() for name in ("pos", "quat", "vel", "ang_vel"))

    end = sim.step_fn(sim.data, jnp.int32(40))
    for gradient in (slopes(sim.data), slopes(end)):
        assert np.any(gradient.states.pos)
        for x in jax.tree.leaves((gradient.states, gradient.controls, gradient.params, gradient.plugins)):
            assert x.dtype == jax.dtypes.float0 or np.isfinite(x).all()
    assert np.any(gradient.plugins["motors"].effectiveness)
    for x in jax.tree.leaves((end.states, end.controls, end.plugins)):
        assert np.isfinite(np.asarray(x, np.float64)).all()


def test_law_08_an_integrator_keeps_its_order_in_wind(x64):
    """RK4 evaluates the wind at every substep; with a force that is constant over a step its order would be 1."""
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
