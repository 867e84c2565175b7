"""Images among the observations: after a step, in new episodes, with a rate and a latency, and in Gymnasium."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_cases import random_action, set_last_step

from crazysim import Camera, ConfigError
from crazysim.envs import (
    AutoReset,
    CameraImages,
    DroneVectorEnv,
    FrameStack,
    Normalize,
    ObservationNoise,
    Observe,
    make,
)
from crazysim.envs.state import EnvState
from crazysim.train.convolution import find_images

SIZE = {"width": 8, "height": 6}
DEPTH = {"depth": "depth"}


@pytest.fixture(scope="module")
def base():
    """Return an environment with obstacles, whose episodes end after ten steps."""
    return make("avoid", 3, seconds=0.2, n_boxes=1, n_poles=3, engine="interpret")


@pytest.fixture(scope="module")
def measure_depth(base):
    return jax.jit(base.sim.scene.depth_fn("fpv_cam", **SIZE))


@pytest.fixture(scope="module")
def envs_with_and_without_images(base):
    return AutoReset(CameraImages(base, Camera(**SIZE, max_depth=5.0), DEPTH)), AutoReset(base)


@pytest.fixture(scope="module")
def recorded_flight(envs_with_and_without_images):
    """Return the states of both environments after a reset and three random steps; the second one ends episodes."""
    states = [[jax.jit(env.reset)(jax.random.key(3))] for env in envs_with_and_without_images]
    for env, visited in zip(envs_with_and_without_images, states, strict=True):
        step = jax.jit(env.step)
        for seed in range(3):
            before = set_last_step(env, visited[-1], np.ones(3, bool)) if seed == 1 else visited[-1]
            visited.append(step(before, random_action(before, seed)))
    return states


def test_images_are_those_of_the_state_after_the_step_and_after_new_episodes(measure_depth, recorded_flight):
    for state in recorded_flight[0]:
        expected = np.minimum(measure_depth(state.data).distance, 5.0).reshape(3, 1, -1)
        np.testing.assert_allclose(state.obs["depth"], expected, rtol=1e-6)
    assert recorded_flight[0][2].done.all()
    assert np.asarray(recorded_flight[0][2].obs["depth"]).std() > 0.1, "nothing is in view"


def test_final_observations_of_episodes_have_the_images_of_the_step_before(recorded_flight):
    for before, after in zip(recorded_flight[0], recorded_flight[0][1:], strict=False):
        expected = (before if after.done.all() else after).obs["depth"]
        np.testing.assert_array_equal(after.final_obs["depth"], expected)
        assert after.final_obs.keys() == after.obs.keys()


def test_restarted_worlds_have_images_of_their_new_episodes(envs_with_and_without_images, recorded_flight):
    restart = jax.jit(envs_with_and_without_images[0].restart)
    restarted = restart(recorded_flight[0][1], np.array([True, False, False]))
    assert jax.tree.structure(restarted) == jax.tree.structure(recorded_flight[0][1])
    for obs in (restarted.obs, restarted.final_obs):
        np.testing.assert_array_equal(obs["depth"][1:], recorded_flight[0][1].obs["depth"][1:])
    np.testing.assert_array_equal(restarted.final_obs["depth"], restarted.obs["depth"])
    assert not np.array_equal(restarted.obs["depth"][0], recorded_flight[0][1].obs["depth"][0])


def test_nothing_else_depends_on_images(recorded_flight):
    for with_images, without in zip(*recorded_flight, strict=True):
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
    obs_after_reset, _ = env.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(obs_after_reset["depth"][1], obs["depth"][1])
    env.reset()


def test_colors_are_observed_as_numbers_from_0_to_1(base):
    camera = Camera(**SIZE, outputs=("rgb", "gray", "depth"))
    env = CameraImages(base, camera)
    state = jax.jit(env.reset)(jax.random.key(3))
    images = jax.jit(camera.image_fn(base.sim))(state.data)
    assert images["gray"].dtype == images["rgb"].dtype == np.uint8
    for name in ("rgb", "gray"):
        expected = np.asarray(images[name], np.float32).reshape(3, 1, -1) / 255
        # The two programs may round to neighbouring steps.
        np.testing.assert_allclose(state.obs[f"camera.{name}"], expected, atol=1.01 / 255)
        assert 0.05 < expected.std() < 0.5
    brightness = np.asarray(images["rgb"]) @ np.array([0.299, 0.587, 0.114])
    np.testing.assert_allclose(images["gray"], brightness, atol=0.51)
    image = next(
        x for x in find_images({k: x.shape[-1] for k, x in state.obs.items()}, env.image_formats()) if x.channels > 1
    )
    assert (image.shape, image.is_depth) == ((6, 8, 3), False)


def test_wrappers_around_images_leave_them_as_they_are():
    env = CameraImages(make("hover", 2, engine="interpret"), Camera(**SIZE, outputs=("depth", "normal")))
    env = ObservationNoise(Normalize(FrameStack(env, 2)), {"pos": 0.1})
    state = jax.eval_shape(env.reset, jax.random.key(0))
    state = jax.eval_shape(env.step, state, jnp.zeros((2, 1, 4)))
    images = {name: x.shape for name, x in state.obs.items() if "camera" in name}
    assert images == {"camera.depth": (2, 1, 48), "camera.normal": (2, 1, 144)}


def test_a_slow_and_late_camera_shows_old_images_and_a_new_one_in_a_new_episode(base, measure_depth):
    """25 images/s in an environment of 50 steps/s, delivered 30 ms later, between two of its steps."""
    env = AutoReset(CameraImages(base, Camera(**SIZE, freq=25, latency=0.03)))
    step, restart, state = jax.jit(env.step), jax.jit(env.restart), jax.jit(env.reset)(jax.random.key(3))
    images = []
    for k in range(13):
        if k:
            state = step(state, random_action(state, k))
        if k == 5:  # one world begins an episode on its own
            state = restart(state, np.array([True, False, False]))
        images.append(np.minimum(measure_depth(state.data).distance, 10.0).reshape(3, 1, -1))
        steps = np.asarray(state.full_data.core.steps)[:, 0] // env.n_substeps
        # The images of steps 0, 2, 4 ... of an episode arrive 1.5 steps later, the first one at once.
        taken_steps = np.maximum((2 * steps - 3) // 4 * 2, 0)
        expected = np.stack(
            [images[k - now + taken][world] for world, (now, taken) in enumerate(zip(steps, taken_steps, strict=True))]
        )
        np.testing.assert_allclose(state.obs["camera.depth"], expected, rtol=1e-6)
    assert steps.tolist() != [12] * 3
    assert np.ptp(images, axis=0).max() > 1e-3


def scale_all(obs, _):
    return {name: 2 * x for name, x in obs.items()}


def trace_step(make_env):
    env = make_env()
    jax.eval_shape(env.step, jax.eval_shape(env.reset, jax.random.key(0)), jnp.zeros((2, 1, 4)))


def test_law_09_wrong_images_are_refused():
    base = make("hover", 2, engine="interpret")
    for call, message in [
        (lambda: make("hover", 2, depth_image="16x12"), "depth_image as width and height .*'16x12'"),
        (lambda: make("hover", 2, depth_image=(0, 12), engine="interpret"), "width of Camera"),
        (lambda: CameraImages(base, "fpv_cam"), "camera or lidar, got 'fpv_cam'"),
        (lambda: make("hover", camera=["fpv_cam"], engine="interpret"), "camera as a list of plugins"),
        (lambda: CameraImages(base, Camera(freq=20)), "freq of 'camera' to divide .* 50 Hz, got 20 Hz"),
        (lambda: CameraImages(CameraImages(base, Camera()), Camera(9, 7)), "'camera.depth' twice"),
        (lambda: CameraImages(base, Camera(200_000, 200_000)), "2 images of 200000 x 200000 pixels"),
        (lambda: CameraImages(base, Camera(), {"depth": "pos"}), "different names for images .*'pos'"),
        (lambda: Observe(CameraImages(base, Camera(), DEPTH), scale_all), "images unchanged .*'depth'"),
    ]:
        with pytest.raises(ConfigError, match=message):
            trace_step(call)
