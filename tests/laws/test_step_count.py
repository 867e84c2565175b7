"""Law 4 for long flights: the number of steps never wraps silently."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, Sim
from crazysim.engine.record import MAX_STEPS
from crazysim.envs import AutoReset, DroneEnv, rollout
from crazysim.envs.tasks.hover import Hover
from crazysim.envs.vector import make_vector


def with_step_counts(data, steps):
    return data.replace(core=data.core.replace(steps=np.array(steps, np.int32)[:, None]))


@pytest.fixture(scope="module")
def sim():
    return Sim(2, control="rotor_vel", freq=1000, engine="interpret")


def test_a_simulation_refuses_the_step_that_would_pass_the_largest_count(sim):
    sim.data = with_step_counts(sim.data, [0, MAX_STEPS - 3])
    sim.step(2)
    sim.step()
    before = sim.data
    for n_steps in (1, 2**31, 2**40):
        with pytest.raises(ConfigError, match=r"at most 2147483647 steps.*24\.9 days at 1000 Hz.*sim\.reset\(\)"):
            sim.step(n_steps)
    with pytest.raises(ConfigError, match="at most 2147483647 steps"):
        sim.rollout(lambda params, data: data.controls.rotor_vel, None, 5)
    assert sim.data is before
    assert sim.data.core.steps.tolist() == [[3], [MAX_STEPS]]
    np.testing.assert_allclose(sim.time[1], 2147483.647)
    sim.reset([False, True])
    sim.step(5)
    assert sim.data.core.steps.tolist() == [[8], [5]]
    sim.data = with_step_counts(sim.data, [MAX_STEPS, 0])
    with pytest.raises(ConfigError, match="at most 2147483647 steps"):
        sim.step()
    sim.reset()
    sim.step()


def test_the_functional_api_flags_worlds_whose_count_has_wrapped():
    sim = Sim(3, control="rotor_vel")
    data = with_step_counts(sim.data, [MAX_STEPS - 2, MAX_STEPS - 1, 0])
    after = sim.step_fn(sim.step_fn(data, jnp.int32(2)), jnp.int32(1))
    np.testing.assert_array_equal(after.core.nonfinite[:, 0], [True, True, False])
    assert not np.any(sim.step_fn(data, jnp.int32(1)).core.nonfinite)


def test_an_environment_that_never_resets_ends_where_its_count_wraps():
    sim, task = Sim(3, control="attitude", engine="interpret"), Hover()
    task.install(sim)
    env = AutoReset(DroneEnv(sim, task), "Disabled")
    state = env.reset(jax.random.key(0))
    state = state.replace(data=with_step_counts(state.data, [MAX_STEPS - 5, MAX_STEPS - 10, 0]))
    after = jax.jit(env.step)(state, jnp.zeros_like(state.action))
    np.testing.assert_array_equal(after.info["nonfinite"], [True, False, False])
    np.testing.assert_array_equal(after.terminated, [True, False, False])


def test_a_call_of_more_steps_than_can_be_counted_is_refused(sim):
    for n_steps in (2**31, np.int64(2**31)):
        with pytest.raises(ConfigError, match="at most 2147483647 steps in a call, got 2147483648"):
            sim.step_fn(sim.data, n_steps)


WRONG_COUNTS = (2.5, 2.0, True, np.bool_(True), np.float32(2), jnp.float32(2), "2", None, [2], np.array([2]))


def test_law_09_a_number_of_steps_is_one_integer_of_at_least_zero(sim):
    for call in (sim.step_fn, sim.step_fn.lower):
        for n_steps in WRONG_COUNTS:
            with pytest.raises(ConfigError, match="expected a number of steps as one integer, got"):
                call(sim.data, n_steps)
        for n_steps in (-5, np.int64(-5), jnp.int32(-5)):
            with pytest.raises(ConfigError, match="expected a number of steps of at least 0, got -5"):
                call(sim.data, n_steps)


def test_law_09_lengths_of_episodes_and_rollouts_are_positive_integers(sim):
    task = Hover()
    task.install(sim)
    env = AutoReset(DroneEnv(sim, task))
    state = jax.eval_shape(env.reset, jax.random.key(0))
    for n_steps in (0, -1, 2.0, True):
        with pytest.raises(ConfigError, match=rf"n_steps (is|as a whole number, got) {n_steps}"):
            rollout(env, state, lambda obs, memory, key: (state.action, memory, ()), jax.random.key(0), n_steps)
        with pytest.raises(ConfigError, match=f"max_episode_steps is {n_steps}; it must be a positive whole number"):
            make_vector("hover", max_episode_steps=n_steps)
