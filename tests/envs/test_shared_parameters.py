"""Shared parameters that change after an environment was made: every path computes with the new values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import build_stagewise_step, with_params

import crazysim.envs as envs
from crazysim import ConfigError, SlungLoad
from crazysim.core.functional import stage_command
from crazysim.engine.pytree import scopes
from crazysim.envs.tasks.hover import Hover

N_WORLDS, N_DRAWS = 3, 2
TILTED = np.array([3.0, 0.0, -9.81], np.float32)
"""Gravity with a component that is zero in every airframe's parameters, m/s^2."""


@pytest.fixture(scope="module")
def env():
    """Return an environment whose drones carry loads, whose attachments have zeros, too."""
    effects = [SlungLoad(mass=0.003, length=0.3, attach=(0.0, 0.0, -0.01))]
    return envs.make("hover", N_WORLDS, control="rotor_vel", effects=effects)


CONSTANT_TERMS = {"rpm2thrust": 2e-3, "rpm2torque": 1e-5}
"""Sizes of the constant terms of polynomials in the rotor speed, N and N m."""


def with_random_parameters(data, rng):
    """Return the data with every element of all shared parameters changed, and none of them zero."""

    def change(path, scope, x):
        if scope != "shared" or not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        x = np.asarray(x)
        zero = CONSTANT_TERMS.get(path[-1].name, 0.03 * np.abs(x).max() or 1e-3)
        factor = rng.uniform(0.3, 1.0, x.shape) * rng.choice([-1, 1], x.shape)
        return jnp.asarray(np.where(x == 0, zero * factor, x * (1 + 0.03 * factor)), x.dtype)

    return jax.tree_util.tree_map_with_path(change, scopes(data), data)


def drone_states(data):
    states = data.states
    return {"pos": states.pos, "vel": states.vel, "quat": states.quat, "ang_vel": states.ang_vel}


def relative_difference(actual, expected):
    """Return the largest difference, relative to the largest number of its kind."""
    sizes = {name: max(np.abs(x).max(), 1e-3) for name, x in expected.items()}
    return max(float(np.abs(np.asarray(actual[name]) - x).max() / sizes[name]) for name, x in expected.items())


@pytest.mark.long("compiles every path")
def test_a_random_search_over_shared_parameters_finds_no_path_that_keeps_old_values(env):
    """Paths: environments with and without automatic resets, rollouts, and steps of simulations, traced and not."""
    auto, sim, n = envs.AutoReset(env), env.sim, env.n_substeps
    key = jax.random.key(0)
    start, start_state, before = jax.jit(env.reset)(key), jax.jit(auto.reset)(key), sim.data
    plain = jax.jit(build_stagewise_step(sim), static_argnums=1)
    step = sim.step_fn
    paths = {
        "env.step": jax.jit(env.step),
        "AutoReset.step": jax.jit(auto.step),
        "rollout": jax.jit(lambda s, a: envs.rollout(auto, s, lambda obs, memory, key: (a, memory, ()), key, 1)[0]),
    }
    rng = np.random.default_rng(0)
    for _ in range(N_DRAWS):
        action = jnp.asarray(rng.uniform(-0.5, 0.5, start.action.shape), start.action.dtype)
        data = with_random_parameters(start.data, rng)
        sent = stage_command(data, env.actions.command(action))
        expected = drone_states(plain(sent, n))
        assert (
            relative_difference(
                drone_states(plain(stage_command(start.data, env.actions.command(action)), n)), expected
            )
            > 1e-3
        )
        starts = {name: start if name == "env.step" else start_state for name in paths}
        actual = {name: fly(starts[name].replace(data=data), action).data for name, fly in paths.items()}
        actual["step_fn"], actual["traced"] = step(sent, jnp.int32(n)), jax.jit(step)(sent, jnp.int32(n))
        sim.data = sent
        sim.step(n)
        actual["sim.step"], sim.data = sim.data, before
        differences = {name: relative_difference(drone_states(x), expected) for name, x in actual.items()}
        assert max(differences.values()) < 2e-5, differences


def with_tilted_gravity(data):
    return with_params(data, gravity_vec=TILTED)


def test_gravity_that_is_tilted_pulls_the_drones_of_an_environment(tilted_hover):
    """Gravity is tilted in ``sim.default_data``, with which episodes begin, and vertical in the data of a state."""
    upright = tilted_hover.sim.data.params
    for env in (tilted_hover, envs.AutoReset(tilted_hover)):
        start_state = jax.jit(env.reset)(jax.random.key(0))
        np.testing.assert_array_equal(start_state.data.params.gravity_vec, TILTED)
        step, speeds = jax.jit(env.step), []
        for params in (start_state.data.params, upright):
            state = start_state.replace(data=start_state.data.replace(params=params))
            for _ in range(5):
                state = step(state, jnp.zeros_like(state.action))
            speeds.append(np.asarray(state.data.states.vel)[..., 0])
        np.testing.assert_allclose(speeds[0] - speeds[1], 0.3, rtol=0.03)  # 3 m/s^2 for 0.1 s, less the drag


@pytest.fixture(scope="module")
def tilted_hover():
    sim, task = envs.make("hover", N_WORLDS, control="rotor_vel").sim, Hover()
    sim.default_data = with_tilted_gravity(sim.default_data)
    return envs.DroneEnv(sim, task)


def test_an_environment_refuses_to_begin_episodes_after_its_default_data_was_replaced(tilted_hover):
    sim = tilted_hover.sim
    before = sim.default_data
    sim.default_data = with_params(before, mass=2 * before.params.mass)
    with pytest.raises(ConfigError, match="default data with which the environment was made, got others"):
        tilted_hover.reset(jax.random.key(0))
    sim.default_data = before
    tilted_hover.reset(jax.random.key(0))


@pytest.mark.long("compiles gradients of the stages and of environment steps")
def test_gradients_of_an_environment_step_by_parameters_that_are_zero(env):
    """Derivatives of velocities by gravity, and of rates by the inverse inertia, are those of the stages."""
    auto, stages = envs.AutoReset(env), build_stagewise_step(env.sim)
    start = jax.jit(auto.reset)(jax.random.key(0))
    action = 0.3 * jnp.ones_like(start.action).at[..., 0].set(0.2)
    parameters = {name: getattr(start.data.params, name) for name in ("gravity_vec", "J_inv")}

    def slopes(step):
        def total(values):
            states = step(start.replace(data=with_params(start.data, **values))).data.states
            return jnp.sum(states.vel) + jnp.sum(states.ang_vel)

        return jax.jit(jax.grad(total))(parameters)

    def step_by_stages(state):
        return state.replace(data=stages(stage_command(state.data, env.actions.command(action)), env.n_substeps))

    expected = slopes(step_by_stages)
    assert all(np.all(x != 0) for x in expected.values())
    actual = slopes(lambda state: auto.step(state, action))
    for name, x in expected.items():
        np.testing.assert_allclose(actual[name], x, rtol=2e-4, atol=1e-6 * np.abs(x).max(), err_msg=name)
