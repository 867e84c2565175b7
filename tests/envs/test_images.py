"""Depth images among the observations: of the state after the step, of new episodes, and in Gymnasium."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_cases import random_action

from crazysim import ConfigError
from crazysim.envs import (
    AutoReset,
    DepthImages,
    DroneVectorEnv,
    FrameStack,
    Normalize,
    ObservationNoise,
    Observe,
    make,
)
from crazysim.envs.state import EnvState

SIZE = {"width": 8, "height": 6}


@pytest.fixture(scope="module")
def pair():
    """Return environments with and without images whose episodes end after two steps, automatic resets around them."""
    base = make("avoid", 3, seconds=0.04, n_boxes=1, n_poles=3)
    return AutoReset(DepthImages(base, **SIZE, max_depth=5.0)), AutoReset(base)


@pytest.fixture(scope="module")
def flown(pair):
    """Return the states of both environments after a reset and three random steps; the second one ends the episodes."""
    states = [[jax.jit(env.reset)(jax.random.key(3))] for env in pair]
    for env, reached in zip(pair, states, strict=True):
        step = jax.jit(env.step)
        for seed in range(3):
            reached.append(step(reached[-1], random_action(reached[-1], seed)))
    return states


def test_images_are_those_of_the_state_after_the_step_and_after_new_episodes(pair, flown):
    look = jax.jit(pair[0].sim.scene.depth_fn("fpv_cam", 8, 6))
    for state in flown[0]:
        seen = np.minimum(look(state.data).distance, 5.0).reshape(3, 1, -1)
        np.testing.assert_allclose(state.obs["depth"], seen, rtol=1e-6)
    assert flown[0][2].done.all()
    assert np.asarray(flown[0][2].obs["depth"]).std() > 0.1, "nothing is in view"


def test_final_observations_of_episodes_have_the_images_of_the_step_before(flown):
    for before, after in zip(flown[0], flown[0][1:], strict=False):
        expected = (before if after.done.all() else after).obs["depth"]
        np.testing.assert_array_equal(after.final_obs["depth"], expected)
        assert after.final_obs.keys() == after.obs.keys()


def test_restarted_worlds_have_images_of_their_new_episodes(pair, flown):
    restarted = pair[0].restart(flown[0][1], np.array([True, False, False]))
    assert jax.tree.structure(restarted) == jax.tree.structure(flown[0][1])
    for obs in (restarted.obs, restarted.final_obs):
        np.testing.assert_array_equal(obs["depth"][1:], flown[0][1].obs["depth"][1:])
    np.testing.assert_array_equal(restarted.final_obs["depth"], restarted.obs["depth"])
    assert not np.array_equal(restarted.obs["depth"][0], flown[0][1].obs["depth"][0])


def test_nothing_else_depends_on_images(flown):
    for with_images, without in zip(*flown, strict=True):
        record = with_images.record
        info = {k: x for k, x in record.drone_info["final_obs"].items() if k != "depth"}
        record = record.replace(images={}, drone_info=record.drone_info | {"final_obs": info})
        data = with_images.full_data
        plain = EnvState(data.replace(plugins=data.plugins | {"environment": record}))
        assert jax.tree.structure(plain) == jax.tree.structure(without)
        jax.tree.map(lambda x, y: np.testing.assert_array_equal(*map(_as_numbers, (x, y))), plain, without)


def _as_numbers(x):
    return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x)


def test_adapters_have_the_images_in_their_spaces():
    env = DroneVectorEnv(make("hover", 2, depth_image=(4, 3), engine="interpret"))
    obs, _ = env.reset(seed=0)
    assert env.single_observation_space["depth"].shape == (12,)
    obs, *_ = env.step(env.action_space.sample())
    assert obs["depth"].shape == (2, 12)
    assert env.observation_space.contains(jax.device_get(obs))
    again, _ = env.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(again["depth"][1], obs["depth"][1])
    env.reset()


def test_wrappers_around_images_leave_them_as_they_are():
    env = DepthImages(make("hover", 2, engine="interpret"), **SIZE)
    for around in (lambda env: FrameStack(env, 2), Normalize, lambda env: ObservationNoise(env, {"pos": 0.1})):
        state = around(env).reset(jax.random.key(0))
        state = around(env).step(state, jnp.zeros((2, 1, 4)))
        assert state.obs["depth"].shape == (2, 1, 48)


def test_law_09_wrong_images_are_refused():
    base = make("hover", 2, engine="interpret")
    with pytest.raises(ConfigError, match=r"expected depth_image as width and height in pixels, got '16x12'"):
        make("hover", 2, depth_image="16x12")
    with pytest.raises(ConfigError, match="expected an image of positive integer width, got 0 x 12 pixels"):
        DepthImages(base, width=0)
    for around, message in [
        (lambda env: DepthImages(env, key="pos"), "expected other names of images than those of obs.*, got 'pos'"),
        (lambda env: Observe(DepthImages(env, **SIZE), lambda obs, _: {k: 2 * x for k, x in obs.items()}),
         "expected images unchanged in functions of one world, got a new 'depth'"),
    ]:  # fmt: skip
        env = around(base)
        with pytest.raises(ConfigError, match=message):
            env.step(env.reset(jax.random.key(0)), jnp.zeros((2, 1, 4)))
