"""The interface of Brax's environments: fields, shapes, types, jit, scan, and entries of its training wrappers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_cases import array_types

from crazysim import ConfigError
from crazysim.envs import AutoReset, make
from crazysim.envs.brax import BraxEnv
from crazysim.envs.state import flatten

N_WORLDS, N_STEPS = 3, 5


@pytest.fixture(scope="module")
def drone_env():
    return make("hover", N_WORLDS, n_drones=2, seconds=N_STEPS / 50, engine="interpret")


@pytest.fixture(scope="module")
def env(drone_env):
    return BraxEnv(drone_env)


@pytest.fixture(scope="module")
def reset(env):
    return jax.jit(env.reset)


@pytest.fixture(scope="module")
def recorded_flight(env, reset):
    """Return the states of a scan over more than two episodes."""

    @jax.jit
    def fly(state):
        def step(state, _):
            state = env.step(state, jnp.full((N_WORLDS, env.action_size), 0.1))
            return state, state

        return jax.lax.scan(step, state, length=2 * N_STEPS + 1)[1]

    return fly(reset(jax.random.key(0)))


def test_attributes_of_an_environment(env):
    assert (env.observation_size, env.action_size) == (2 * 21, 2 * 4)
    assert env.backend == "crazysim"
    assert env.unwrapped is env
    assert env.dt == pytest.approx(0.02)


def test_a_state_has_the_fields_of_brax(env, reset):
    state = reset(jax.random.key(0))
    assert state.obs.shape == (N_WORLDS, env.observation_size)
    for x in (state.reward, state.done, state.metrics["error"], state.info["steps"], state.info["truncation"]):
        assert (x.shape, x.dtype) == ((N_WORLDS,), jnp.float32)
    assert set(state.info) == {"steps", "truncation", "episode_done", "episode_metrics"}
    assert set(state.info["episode_metrics"]) == {"sum_reward", "length", "error"}
    assert type(state.info) is type(state.metrics) is dict  # Brax's wrappers write into both
    assert state.replace(done=1).done == 1
    np.testing.assert_array_equal(state.obs, flatten(state.pipeline_state.obs).reshape(N_WORLDS, -1))


def test_keys_of_any_kind_are_the_same_seed(env, reset):
    state = reset(jax.random.key(3))
    keys = jnp.stack([jax.random.key(3), jax.random.key(8), jax.random.key(9)])
    for rng in (jax.random.PRNGKey(3), keys, jax.random.key_data(keys)):
        np.testing.assert_array_equal(reset(rng).obs, state.obs)
    assert len(np.unique(state.obs[:, 6])) == N_WORLDS
    with pytest.raises(ValueError, match=r"one key, or one for each of the 3 worlds, got keys of shape \(4,\)"):
        env.reset(jax.random.split(jax.random.key(0), 4))
    with pytest.raises(ValueError, match=r"key data of shape \(4, 2\)"):
        env.reset(jax.random.split(jax.random.PRNGKey(0), 4))


def test_steps_return_the_same_kind_of_state(env, reset, recorded_flight):
    state = reset(jax.random.key(0))
    first = jax.eval_shape(lambda states: jax.tree.map(lambda x: x[0], states), recorded_flight)
    assert array_types(first) == array_types(state)


def test_episodes_end_and_begin_as_with_the_wrappers_of_brax(recorded_flight):
    ends = np.zeros((2 * N_STEPS + 1, N_WORLDS))
    ends[[N_STEPS - 1, 2 * N_STEPS - 1]] = 1
    np.testing.assert_array_equal(recorded_flight.done, ends)
    np.testing.assert_array_equal(recorded_flight.info["episode_done"], ends)
    np.testing.assert_array_equal(recorded_flight.info["truncation"], ends)
    counts = np.array([1, 2, 3, 4, 5] * 2 + [1], float)
    np.testing.assert_array_equal(recorded_flight.info["steps"], np.tile(counts[:, None], N_WORLDS))
    np.testing.assert_array_equal(recorded_flight.info["episode_metrics"]["length"], recorded_flight.info["steps"])
    sums = np.asarray(recorded_flight.reward[:N_STEPS]).sum(axis=0)
    np.testing.assert_allclose(recorded_flight.info["episode_metrics"]["sum_reward"][N_STEPS - 1], sums, rtol=1e-5)
    np.testing.assert_allclose(
        recorded_flight.info["episode_metrics"]["sum_reward"][N_STEPS], recorded_flight.reward[N_STEPS], rtol=1e-5
    )
    jumps = np.abs(np.diff(recorded_flight.obs, axis=0)).max(axis=(1, 2))
    assert set(np.argsort(jumps)[-2:]) == {N_STEPS - 2, 2 * N_STEPS - 2}, "new episodes begin in the step that ends one"


def test_the_step_is_that_of_the_environment(env, reset, recorded_flight):
    state = reset(jax.random.key(0)).pipeline_state
    state = jax.jit(env.env.step)(state, np.full(state.action.shape, 0.1, np.float32))
    np.testing.assert_allclose(recorded_flight.obs[0], flatten(state.obs).reshape(N_WORLDS, -1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(recorded_flight.reward[0], state.reward.mean(axis=1), rtol=1e-5)
    np.testing.assert_allclose(recorded_flight.metrics["error"][0], state.info["error"].mean(axis=1), rtol=1e-5)


def test_entries_of_wrappers_are_kept(env, reset):
    """Brax's evaluation adds entries to ``metrics`` and ``info`` of a state and reads them from the next state."""
    state = reset(jax.random.key(0))
    state.metrics["reward"] = state.reward
    state.info["eval_metrics"] = {"mine": jnp.ones(N_WORLDS)}
    after = jax.jit(env.step)(state, jnp.zeros((N_WORLDS, env.action_size)))
    assert set(after.metrics) == {"error", "reward"}
    np.testing.assert_array_equal(after.info["eval_metrics"]["mine"], np.ones(N_WORLDS))


def test_wrong_input_is_an_error(drone_env, env, reset):
    with pytest.raises(ConfigError, match="random key, got 0"):
        env.reset(0)
    with pytest.raises(ConfigError, match="without AutoReset"):
        BraxEnv(AutoReset(drone_env))
    state = reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"action of shape \(3, 8\) = \(n_worlds, action_size\), got \(8,\)"):
        env.step(state, jnp.zeros(8))
