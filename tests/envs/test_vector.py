"""Tasks as Gymnasium's vector environments: modes of resets, seeds, wrong input, pictures, NumPy users."""

import itertools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import trees_equal
from gymnasium.utils.env_checker import check_env
from pictures import HEIGHT, WIDTH, has_colour, read_frames

from crazysim import ConfigError
from crazysim.envs import AutoReset, DroneVectorEnv, HoopTask, flying, make
from crazysim.envs.single import DroneSingleEnv
from crazysim.envs.tasks.hover import Hover
from crazysim.envs.vector import make_vector

MODES = ("NextStep", "SameStep", "Disabled")
N_STEPS = 5
"""Length of an episode, steps."""
ID = "crazysim/Hover-v0"


@pytest.fixture(scope="module")
def envs():
    """Return vector environments of all modes, with three worlds and short episodes, over one environment."""
    short = make("hover", 3, seconds=N_STEPS / 50)
    return {mode: DroneVectorEnv(short, mode) for mode in MODES}


@pytest.fixture(scope="module", params=MODES)
def env(envs, request):
    return envs[request.param]


@pytest.fixture(scope="module")
def next_step(envs):
    return envs["NextStep"]


def zeros(env):
    return np.zeros(env.action_space.shape, np.float32)


def run(env, n):
    """Return the results of n steps from a fixed beginning."""
    env.reset(seed=1)
    return [env.step(zeros(env)) for _ in range(n)]


def test_an_episode_takes_its_time_in_every_mode(env):
    results = run(env, N_STEPS + 2)
    ends = np.stack([truncated for _, _, _, truncated, _ in results])
    expected = np.zeros((N_STEPS + 2, 3), bool)
    expected[N_STEPS - 1 :] = env.metadata["autoreset_mode"].value == "Disabled"
    expected[N_STEPS - 1] = True
    np.testing.assert_array_equal(ends, expected)
    assert not np.stack([terminated for _, _, terminated, _, _ in results]).any()


@pytest.mark.long("compiles an environment for two devices")
def test_episodes_stay_on_the_device_that_was_asked_for():
    """Compiled or not, with keys and actions on JAX's default device; the steps of a moved state stay on its device."""
    default, device = jax.devices()[:2]
    env = make("hover", 3, device="cpu:1")
    state = jax.jit(env.reset)(jax.random.key(0))
    action, mask = np.zeros(state.action.shape, np.float32), np.array([True, False, True])
    after = jax.jit(env.step)(state, jnp.asarray(action))
    vec = gymnasium.make_vec(ID, num_envs=3, device="cpu:1")
    start_state = vec.reset(seed=0)
    uncompiled = env.reset(jax.random.key(0)), env.step(state, action), env.restart(after, mask)
    for tree in (state, after, start_state, vec.step(zeros(vec)), uncompiled):
        assert {x.device for x in jax.tree.leaves(tree)} == {device}
    moved = env.step(jax.device_put(state, default), action)
    assert {x.device for x in jax.tree.leaves(moved)} == {default}
    with jax.default_device(device):
        assert trees_equal(jax.jit(env.reset)(jax.random.key(0)), state)


def test_next_step_gives_no_reward_in_the_step_that_begins_an_episode(next_step):
    results = run(next_step, N_STEPS + 2)
    rewards = np.stack([reward for _, reward, _, _, _ in results])
    np.testing.assert_array_equal(rewards[N_STEPS], np.zeros(3))
    assert (rewards[[*range(N_STEPS), N_STEPS + 1]] != 0).all()
    jumps = [np.abs(a[0]["pos"] - b[0]["pos"]).max() for a, b in itertools.pairwise(results)]
    assert np.argmax(jumps) == N_STEPS - 1
    assert jumps[N_STEPS - 1] > 10 * max(jumps[: N_STEPS - 1])
    assert "final_obs" not in results[-1][4]


def test_same_step_returns_the_last_observation_of_an_episode(envs):
    env = envs["SameStep"]
    results = run(env, N_STEPS + 1)
    disabled = run(envs["Disabled"], N_STEPS)
    obs, reward, _, _, info = results[N_STEPS - 1]
    np.testing.assert_array_equal(info["_final_obs"], np.ones(3, bool))
    assert trees_equal(info["final_obs"], disabled[-1][0])
    np.testing.assert_array_equal(reward, disabled[-1][1])
    assert not np.allclose(obs["pos"], info["final_obs"]["pos"])
    assert not results[N_STEPS][4]["_final_obs"].any()
    final = info["final_info"]
    np.testing.assert_array_equal(info["_final_info"], np.ones(3, bool))
    assert trees_equal({k: x for k, x in final.items() if k[0] != "_"}, disabled[-1][4])
    assert all(np.all(x) for k, x in final.items() if k[0] == "_")
    assert not any(np.any(x) for k, x in results[N_STEPS][4]["final_info"].items() if k[0] == "_")
    assert "final_info" not in disabled[-1][4]


def test_disabled_resets_the_worlds_of_a_mask(envs):
    env, mask = envs["Disabled"], np.array([True, False, True])
    last = run(env, N_STEPS + 1)[-1][0]
    obs, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(obs["pos"][1], last["pos"][1])
    assert (np.abs(obs["pos"] - last["pos"]).max(axis=-1)[mask] > 1e-3).all()
    _, _, _, truncated, _ = env.step(zeros(env))
    np.testing.assert_array_equal(truncated, ~mask)


def test_seeds_determine_all_episodes(next_step):
    first, _ = next_step.reset(seed=3)
    again, _ = next_step.reset(seed=3)
    second, _ = next_step.reset()
    assert trees_equal(first, again)
    assert not np.allclose(second["pos"], first["pos"])
    next_step.reset(seed=3)
    assert trees_equal(next_step.reset()[0], second), "the episodes after a seed follow from it"
    assert len(np.unique(first["pos"][:, 0])) == 3, "worlds differ"
    assert trees_equal(next_step.reset(seed=np.int64(3))[0], first)


def test_a_step_transfers_no_arrays_and_is_traced_once(next_step):
    next_step.reset(seed=0)
    action = jnp.zeros(next_step.action_space.shape)
    next_step.step(action)
    with jax.transfer_guard("disallow"):
        obs, reward, terminated, truncated, info = next_step.step(action)
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves((obs, reward, terminated, truncated, info)))
    traces = next_step._stepper.compiled._cache_size()
    for actions in (zeros(next_step), zeros(next_step).astype(np.float64), zeros(next_step).tolist()):
        next_step.step(actions)
    # NumPy arrays are converted in another way than JAX arrays, and traced once
    assert next_step._stepper.compiled._cache_size() <= traces + 1


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        (np.zeros((3, 5)), ValueError, r"\(3, 4\), got \(3, 5\)"),
        (jnp.zeros((2, 4)), ValueError, r"\(3, 4\), got \(2, 4\)"),
        (np.zeros(4), ValueError, r"\(3, 4\), got \(4,\)"),
        ("up", ConfigError, r"\(3, 4\), got 'up'"),
        ({"drone": np.zeros(4)}, ConfigError, "array of numbers"),
        (np.array([[0.0] * 4, [np.nan] * 4, [0, 0, 0, np.inf]]), ConfigError, r"finite actions, .* \[1, 2\]"),
    ],
)
def test_wrong_actions_are_errors(next_step, action, error, message):
    next_step.reset(seed=0)
    with pytest.raises(error, match=message):
        next_step.step(action)


def test_an_action_of_the_device_that_is_not_finite_ends_its_world(next_step):
    """A check on the host would stall the device; the world is terminated and reported instead."""
    next_step.reset(seed=0)
    obs, reward, terminated, _, info = next_step.step(jnp.zeros((3, 4)).at[1].set(jnp.nan))
    np.testing.assert_array_equal(terminated, [False, True, False])
    np.testing.assert_array_equal(info["nonfinite"], [False, True, False])
    assert not obs["pos"][1].any()
    assert float(reward[1]) == 0.0
    assert np.isfinite(jax.tree.leaves(next_step.step(zeros(next_step))[0])[0]).all()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        *(({"seed": seed}, "as seed of all worlds, .*got") for seed in ([1, 2, 3], 1.5, True, -1, 2**63)),
        ({"options": {"colour": 1}}, "'reset_mask', got .*colour"),
        ({"options": "all"}, "'reset_mask', got 'all'"),
        ({"options": {"reset_mask": [True]}}, r"mask of .*\(1,\)"),
        ({"options": {"reset_mask": np.ones(3)}}, r"mask of .*\(3,\) and bool"),
        ({"seed": 1, "options": {"reset_mask": np.ones(3, bool)}}, "a seed or a reset_mask, got both"),
    ],
)
def test_wrong_resets_are_errors(next_step, kwargs, message):
    next_step.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        next_step.reset(**kwargs)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"render_mode": "ascii"}, "render_mode .*'ascii'"),
        ({"autoreset_mode": "sometimes"}, "autoreset_mode .*'NextStep'"),
        ({"render_worlds": [2]}, r"render_worlds .*\[2\]"),
        ({"render_worlds": 0}, "render_worlds .*got 0"),
        ({"render_size": (0, 480)}, "image, got 0 x 480"),
        ({"render_size": 480}, "render_size as width and height"),
        ({"numpy": "no"}, "numpy .*got 'no'"),
        ({"color": "red"}, "no option 'color'.* camera, depth_image, sim_freq; the simulation has"),
        ({"n_world": 2}, "did you mean n_worlds"),
        ({"n_worlds": 4}, "num_envs, got n_worlds=4"),
        ({"freq": "fast", "max_episode_steps": 5}, "freq is 'fast'"),
        ({"seconds": 2.0, "max_episode_steps": 5}, "max_episode_steps or seconds, .*both"),
        ({"freq": 300}, "freq that divides .*500 Hz, got 300 Hz"),
    ],
)
def test_wrong_settings_are_errors(kwargs, message):
    with pytest.raises(ConfigError, match=message):
        gymnasium.make_vec(ID, num_envs=2, **kwargs)


def test_an_unknown_task_is_an_error():
    with pytest.raises(ConfigError, match="task 'hoover' does not exist; there are hover"):
        make("hoover")


def test_a_step_before_the_first_reset_is_an_error():
    env = make_vector("hover", 1)
    with pytest.raises(ConfigError, match=r"reset of all worlds before the first reset_mask, got none"):
        env.reset(options={"reset_mask": [False]})
    with pytest.raises(ConfigError, match="reset"):
        env.step(np.zeros((1, 4)))
    with pytest.raises(ConfigError, match="render_mode='rgb_array'"):
        env.render()
    with pytest.raises(ConfigError, match="adapters to other libraries add it themselves"):
        DroneVectorEnv(AutoReset(env.env.env))


@pytest.mark.usefixtures("opengl")
def test_pictures_show_the_drone_as_it_is():
    env = gymnasium.make_vec(ID, num_envs=3, render_mode="rgb_array", max_episode_steps=7, engine="interpret")
    assert env.metadata["render_fps"] == 50
    assert env.unwrapped.env.max_steps == 7
    env.reset(seed=0)
    picture, *others = env.render()
    assert len(others) == 2, "an image of each world"
    assert (picture.shape, picture.dtype) == ((480, 640, 3), np.uint8)
    assert picture.std() > 5
    for _ in range(6):
        env.step(np.ones(env.action_space.shape))
    later = env.render()[0]
    assert (later != picture).any(), "the drone has moved"
    env.close()
    two_worlds = DroneVectorEnv(
        env.unwrapped.env.env, render_mode="rgb_array", render_worlds=(2, 0), render_size=(64, 48)
    )
    two_worlds.reset(seed=0)
    pictures = two_worlds.render()
    assert [p.shape for p in pictures] == [(48, 64, 3)] * 2
    assert (pictures[0] != pictures[1]).any()
    two_worlds.close()


@pytest.mark.usefixtures("opengl")
def test_pictures_show_what_the_task_shows_in_films():
    """Its camera sees its hoops and its goal, and a drone that is small has a ring of 25 pixels."""

    class Hooped(HoopTask, Hover):
        name = "hooped"
        n_waypoints = 1

        def camera(self, n_drones):
            return {"lookat": (0.0, 0.0, 1.0), "distance": 8.0, "azimuth": 0, "elevation": 0}

        def spawn(self, data, key):
            n = data.core.n_drones
            data = flying(data, jnp.array([0.0, 1.5, 1.0]))
            return self.set_course(data, jnp.tile(jnp.array([0.0, 0.0, 1.0]), (n, 1, 1)), jnp.array([0.0, -1.5, 1.0]))

    env = DroneVectorEnv(make(Hooped()), render_mode="rgb_array", render_size=(WIDTH, HEIGHT))
    env.reset(seed=0)
    (picture,) = env.render()
    # Across the view are y, to the left, and z; the hoop faces the camera.
    scale = 0.5 * HEIGHT / np.tan(np.radians(50 / 2)) / 8.0
    hoop = np.nonzero((np.ptp(picture.astype(int), axis=-1) > 60) & has_colour(picture, [1, 1, 0]))
    goal = np.nonzero(has_colour(picture, [0, 1, 0]))
    ring = np.nonzero(has_colour(picture, [1, 0, 0]) & (np.arange(WIDTH) < WIDTH / 2 - 0.7 * scale))
    assert [np.ptp(x) for x in hoop] == pytest.approx([scale, scale], abs=2)
    np.testing.assert_allclose([x.mean() for x in goal], [HEIGHT / 2, WIDTH / 2 + 1.5 * scale], atol=2)
    np.testing.assert_allclose([x.mean() for x in ring], [HEIGHT / 2, WIDTH / 2 - 1.5 * scale], atol=2)
    assert [np.ptp(x) for x in ring] == pytest.approx([25, 25], abs=3)
    env.close()


@pytest.mark.usefixtures("opengl")
@pytest.mark.skipif(not hasattr(gymnasium.wrappers.vector, "RecordVideo"), reason="a newer Gymnasium has it")
def test_gymnasiums_recorders_film_one_world_and_all_and_render_worlds_chooses_some(tmp_path):
    pytest.importorskip("moviepy")
    options = {"render_mode": "rgb_array", "render_size": (64, 48), "engine": "interpret"}
    env = gymnasium.make_vec(ID, num_envs=4, max_episode_steps=3, numpy=True, **options)
    film = gymnasium.wrappers.vector.RecordVideo(env, str(tmp_path / "all"), episode_trigger=lambda k: k == 0)
    film.reset(seed=0)
    for _ in range(4):
        film.step(zeros(film))
    film.close()
    frames = read_frames(tmp_path / "all" / "rl-video-episode-0.mp4", 2 * 48, 2 * 64)
    assert len(frames) >= 4
    assert len(np.unique(frames[0].reshape(2, 48, 2, 64, 3).swapaxes(1, 2).reshape(4, -1), axis=0)) == 4
    film = gymnasium.wrappers.RecordVideo(gymnasium.make(ID, **options), str(tmp_path / "one"))
    film.reset(seed=0)
    film.step(np.zeros(4))
    film.close()
    assert len(read_frames(tmp_path / "one" / "rl-video-episode-0.mp4", 48, 64)) >= 2
    env = gymnasium.make_vec(ID, num_envs=4, render_worlds=[3], **options)
    env.reset(seed=0)
    (picture,) = env.render()
    assert picture.shape == (48, 64, 3)
    env.close()


def test_gymnasiums_wrappers_return_numpy_arrays(envs):
    pytest.importorskip("array_api_compat")
    wrappers = gymnasium.wrappers.vector
    env = wrappers.RecordEpisodeStatistics(wrappers.JaxToNumpy(envs["NextStep"]))
    obs, info = env.reset(seed=0)
    assert all(type(x) is np.ndarray for x in jax.tree.leaves((obs, info)))
    returns = np.zeros(3)
    for _ in range(N_STEPS):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        returns += reward
        assert obs in env.observation_space
    assert all(type(x) is np.ndarray for x in (reward, terminated, truncated))
    np.testing.assert_array_equal(info["episode"]["l"], [N_STEPS] * 3)
    np.testing.assert_allclose(info["episode"]["r"], returns, rtol=1e-5)


def test_numpy_results_may_be_written_to_as_wrappers_of_rewards_do():
    vec = gymnasium.make_vec(ID, num_envs=2, numpy=True, engine="interpret")
    env = gymnasium.wrappers.vector.ClipReward(vec, -0.01, 0.01)
    obs, info = env.reset(seed=0)
    results = env.step(env.action_space.sample())
    for x in jax.tree.leaves((obs, info, results)):
        assert type(x) is np.ndarray
        assert x.flags.writeable
    np.testing.assert_array_less(np.abs(results[1]), 0.01 + 1e-9)
    kept = obs["pos"].copy()
    obs["pos"][:] = 9.0
    np.testing.assert_array_equal(vec.unwrapped.state.obs["pos"].shape, (2, 1, 3))
    np.testing.assert_array_equal(vec.reset(seed=0)[0]["pos"], kept)


@pytest.mark.filterwarnings("ignore:.*infinity")
def test_one_world_is_an_environment_that_gymnasium_accepts():
    env = gymnasium.make(ID, seconds=1.0)
    check_env(env.unwrapped, skip_render_check=True)
    first = env.reset(seed=5)[0]
    for seed in (-1, True):
        with pytest.raises(ConfigError, match="one integer from 0"):
            env.unwrapped.reset(seed=seed)
    vec = gymnasium.make_vec(ID, num_envs=1, seconds=1.0, autoreset_mode="Disabled")
    vector_obs = vec.reset(seed=5)[0]
    truncated = False
    for steps in range(1, 51):  # noqa: B007
        for name, x in first.items():
            np.testing.assert_allclose(x, np.asarray(vector_obs[name])[0], rtol=1e-5, atol=1e-5)
        first, reward, terminated, truncated, _ = env.step(np.zeros(4, np.float32))
        vector_obs, rewards, *_ = vec.step(np.zeros((1, 4), np.float32))
        assert reward == pytest.approx(float(rewards[0]), rel=1e-5, abs=1e-5)
        if terminated or truncated:
            break
    assert truncated
    assert steps == 50
    with pytest.raises(ConfigError, match="no options of reset"):
        env.reset(options={"reset_mask": [True]})
    with pytest.raises(ConfigError, match=r"Use gymnasium\.make_vec"):
        DroneSingleEnv(make("hover", 2))
    with pytest.raises(ConfigError, match=r"Use gymnasium\.make_vec"):
        gymnasium.make(ID, n_worlds=2)


def test_several_drones_have_an_axis_and_share_their_mean_reward():
    env = make_vector("hover", 3, n_drones=2, engine="interpret")
    assert env.single_action_space.shape == (2, 4)
    assert env.single_observation_space["pos"].shape == (2, 3)
    obs, _ = env.reset(seed=0)
    assert jax.tree.map(np.asarray, obs) in env.observation_space
    _, reward, terminated, _, info = env.step(env.action_space.sample())
    assert (reward.shape, terminated.shape, info["error"].shape) == ((3,), (3,), (3, 2))
    np.testing.assert_allclose(reward, np.asarray(env.state.reward).mean(axis=1), rtol=1e-6)
    with pytest.raises(ValueError, match=r"actions of shape \(3, 2, 4\)"):
        env.step(np.zeros((3, 4)))
