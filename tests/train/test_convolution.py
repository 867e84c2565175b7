"""Convolutions over images: features, statistics, trainings, students, and exports."""

import ctypes
import functools
import json
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import read_frames

from crazysim import Camera, ConfigError
from crazysim.envs import AutoReset, CameraImages, make
from crazysim.envs.statistics import RunningStats
from crazysim.train import Network, apg, dagger, ppo
from crazysim.train.config import ALGORITHMS, TrainConfig
from crazysim.train.convolution import Image, convolve, find_images, scale_depth
from crazysim.train.evaluation import evaluate
from crazysim.train.export import describe, to_c, to_onnx
from crazysim.train.networks import Policies, Policy, choose_network, init_mlp, init_weights, unroll
from crazysim.train.seeds import take_seed
from crazysim.train.show import color_depth, film
from crazysim.train.training import load_policy, train

SMALL_CONFIG = {"n_steps": 8, "minibatches": 2, "epochs": 1, "hidden": (8,), "convolution": (2, 3)}
OPTIONS = {"seconds": 0.1, "depth_image": (5, 4)}
pytestmark = pytest.mark.usefixtures("shared_environments")


@pytest.fixture(scope="module")
def env():
    return make("hover", 4, engine="interpret", **OPTIONS)


@pytest.fixture(scope="module")
def meta(env):
    return describe(env)


def make_policy(meta, memory, channels=(2, 3), seed=0):
    """Return a policy with random weights and statistics for the observations of ``meta``."""
    rng, n_obs = np.random.default_rng(seed), sum(meta["observations"].values())
    network = choose_network(memory, None, channels, find_images(meta["observations"], meta["images"]))
    weights = init_weights(network, jax.random.key(1), n_obs, (16, 4), 1.0)
    weights = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(scale=0.1, size=x.shape), x.dtype), weights)
    stats = RunningStats.create(n_obs, network.pixels).update(jnp.asarray(rng.normal(1, 2, size=(9, n_obs))))
    return Policy(stats, weights.layers, weights.body, network)


@pytest.mark.parametrize("shape", [(12, 16), (5, 7), (1, 2)])
def test_a_convolution_is_that_of_xla(rng, shape):
    layers = [
        (jnp.asarray(rng.normal(size=(9 * n, m)), jnp.float32), jnp.asarray(rng.normal(size=m), jnp.float32))
        for n, m in ((1, 3), (3, 2))
    ]
    image = jnp.asarray(rng.uniform(size=(*shape, 1)), jnp.float32)
    x = image[None]
    for weight, bias in layers:
        kernel = weight.reshape(3, 3, -1, weight.shape[-1])
        dimensions = ("NHWC", "HWIO", "NHWC")
        sums = jax.lax.conv_general_dilated(x, kernel, (2, 2), ((1, 1), (1, 1)), dimension_numbers=dimensions)
        x = jnp.maximum(sums + bias, 0)
    features = convolve(layers, image)
    np.testing.assert_allclose(features, x.ravel(), atol=1e-5)
    assert features.shape == (np.prod(list(Image(0, *shape).shapes((3, 2)))[-1]),)


def test_pixels_are_scaled_distances_and_not_normalised(rng):
    images = find_images({"z": 2, "depth": 6, "a": 3}, {"depth": {"height": 2, "width": 3, "unit": "m"}})
    assert images == (Image(3, 2, 3),)
    x = jnp.asarray(rng.normal(5, 3, size=(50, 11)), jnp.float32)
    stats = RunningStats.create(11, (images[0].pixels,)).update(x)
    expected = RunningStats.create(11).update(x)
    np.testing.assert_array_equal(stats.mean[3:9], 0)
    np.testing.assert_array_equal(stats.normalize(x)[:, 3:9], x[:, 3:9])
    for part in (slice(3), slice(9, 11)):
        np.testing.assert_array_equal(stats.normalize(x)[:, part], expected.normalize(x)[:, part])
    np.testing.assert_allclose(scale_depth(jnp.array([0.0, 1.0, 9.0])), [1, 0.5, 0.1])


def test_a_pixel_of_each_image_moves_the_outputs_and_gradients_reach_all_weights(rng):
    images = (Image(0, 4, 5), Image(21, 1, 3, 3, is_depth=False))
    network = choose_network(2, None, (6,), images)
    assert choose_network(2, None, (6,), images) is network, "so that compiled functions are found again"
    weights = init_weights(network, jax.random.key(0), 31, (8, 1), 1.0)
    obs, done = jnp.asarray(rng.uniform(size=(3, 6, 31)), jnp.float32), jnp.zeros((3, 6), bool)

    def loss(weights, obs):
        return jnp.sum(unroll(network, weights, obs, network.make_memory(6), done) ** 2)

    grads, slopes = jax.grad(loss, argnums=(0, 1))(weights, obs)
    assert all(np.any(x) for x in jax.tree.leaves(grads))
    assert (np.abs(slopes).max(axis=(0, 1)) > 0).all()


@pytest.fixture(scope="module")
def episode(meta):
    """Return a policy with memory, observations of five steps of three drones, and actions."""
    policy = make_policy(meta, memory=4)
    rng = np.random.default_rng(2)
    obs = {name: np.asarray(rng.normal(size=(5, 3, n)), np.float32) for name, n in meta["observations"].items()}
    obs["depth"] = np.abs(3 * obs["depth"])
    memory, actions = policy.initial_memory(3), []
    for t in range(5):
        action, memory = jax.jit(policy.act)({name: x[t] for name, x in obs.items()}, memory)
        actions.append(np.asarray(action))
    return policy, np.concatenate([obs[name] for name in sorted(obs)], axis=-1), np.stack(actions)


def break_numbers(obs, seed):
    """Return observations of which a third are what a broken sensor may report."""
    rng = np.random.default_rng(seed)
    values = rng.choice(np.array([np.nan, np.inf, -np.inf, 3e38, -1.0], np.float32), obs.shape)
    return np.where(rng.uniform(size=obs.shape) < 0.3, values, obs).astype(np.float32)


def test_onnx_gives_the_actions_of_jax_and_holds_the_model_of_the_camera(tmp_path, meta, episode):
    runtime = pytest.importorskip("onnxruntime")
    policy, obs, actions = episode
    session = runtime.InferenceSession(to_onnx(policy, tmp_path / "policy.onnx", meta))
    memory = np.zeros((3, 4), np.float32)
    for t in range(5):
        action, memory = session.run(None, {"observation": obs[t], "memory": memory})
        np.testing.assert_allclose(action, actions[t], atol=1e-5)
    for t in range(5):  # actions and memory stay finite, whatever is observed
        action, memory = session.run(None, {"observation": break_numbers(obs[t], t), "memory": memory})
        assert (np.abs(action) <= 1).all()
        assert (np.abs(memory) <= 1).all()
    camera = json.loads(session.get_modelmeta().custom_metadata_map["images"])["depth"]
    assert (camera["width"], camera["height"], camera["unit"], camera["far"]) == (5, 4, "m", 10.0)
    assert camera["pos"] == [0.03, 0, 0]
    assert 60 < camera["fovy"] < 90
    np.testing.assert_allclose(camera["rot"], [[0, 0, -1], [-1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_c_gives_the_actions_of_jax(tmp_path, meta, episode):
    policy, obs, actions = episode
    path = to_c(policy, tmp_path / "policy.h", meta)
    text = path.read_text()
    assert 'depth: image, row by row: {"height": 4, "width": 5, "unit": "m", "far": 10.0' in text
    source, library = tmp_path / "use.c", tmp_path / "use.so"
    source.write_text(
        f'#include "{path}"\nvoid step(policy_state *s, const float *x, float *a);\n'
        "void step(policy_state *s, const float *x, float *a) { policy(s, x, a); }\n"
    )
    cc = shutil.which("cc") or shutil.which("gcc") or "cc"
    flags = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-shared", "-fPIC")
    subprocess.run([cc, *flags, source, "-o", library, "-lm"], check=True)
    step = ctypes.CDLL(str(library)).step
    state, action = np.zeros((3, 4), np.float32), np.zeros(4, np.float32)
    for t, drone in np.ndindex(5, 3):
        step(*(np.ascontiguousarray(x).ctypes.data_as(ctypes.c_void_p) for x in (state[drone], obs[t, drone], action)))
        np.testing.assert_allclose(action, actions[t, drone], atol=1e-5)
    for t in range(5):  # actions and memory stay finite, whatever is observed
        numbers = break_numbers(obs[t, 0], t)
        step(*(x.ctypes.data_as(ctypes.c_void_p) for x in (state[0], numbers, action)))
        assert (np.abs(action) <= 1).all()
        assert (np.abs(state[0]) <= 1).all()


@pytest.mark.long("renders a film")
def test_a_film_shows_what_the_drone_sees(tmp_path, env, meta, opengl):
    """Each pixel of the depth image is a block of pixels of the film; near ones are brighter."""
    options = OPTIONS | {"seconds": 0.04, "engine": "interpret"}
    short_env = make("hover", 1, **options)
    film(short_env, make_policy(meta, memory=0, channels=(2,)), tmp_path / "film.gif", worlds=1)
    short_env.sim.close()  # a renderer that is collected on a thread of a later training cannot be freed there
    frame = read_frames(tmp_path / "film.gif", 360, 480, "-vf", "scale=480:360").astype(int)[0]
    depth = np.asarray(jax.jit(short_env.reset)(jax.random.key(1)).obs["depth"]).reshape(4, 5)
    assert np.ptp(depth) > 3
    expected = color_depth(depth, 10.0)
    assert expected.sum(axis=-1)[depth.argmin() // 5, depth.argmin() % 5] == expected.sum(axis=-1).max()
    scale = 480 // 20
    rows, columns = 360 - scale * (4 - np.arange(4)) + scale // 2, 480 - scale * (5 - np.arange(5)) + scale // 2
    np.testing.assert_allclose(frame[np.ix_(rows, columns)], expected, atol=40)


@pytest.mark.long("renders a film")
def test_a_film_shows_the_colors_that_the_drone_sees(tmp_path, opengl):
    short_env = make("hover", 1, camera=Camera(5, 4, outputs=("rgb",)), seconds=0.04, engine="interpret")
    film(short_env, lambda obs: jnp.zeros((1, 1, 4)), tmp_path / "film.gif", worlds=1)
    short_env.sim.close()
    frame = read_frames(tmp_path / "film.gif", 360, 480, "-vf", "scale=480:360").astype(int)[0]
    colors = np.asarray(jax.jit(short_env.reset)(jax.random.key(1)).obs["camera.rgb"]).reshape(4, 5, 3)
    assert np.ptp(colors) > 0.2
    rows, columns = 360 - 24 * (4 - np.arange(4)) + 12, 480 - 24 * (5 - np.arange(5)) + 12
    np.testing.assert_allclose(frame[np.ix_(rows, columns)], 255 * colors, atol=40)  # a GIF has 256 colours


@pytest.mark.long("compiles a training")
@pytest.mark.parametrize("algorithm", ["ppo", "apg"])
def test_the_policy_of_a_run_with_a_convolution_comes_back(tmp_path, algorithm):
    config = SMALL_CONFIG | {
        "critic_epochs": 1,
        "image_gradients": False,
        "critic": "privileged",
        "rewards": {"proximity": 2.0},
    }
    config = {k: x for k, x in config.items() if k in ALGORITHMS[algorithm].Config.__annotations__}
    options = OPTIONS | {"engine": "interpret" if algorithm == "ppo" else "auto"}
    config = TrainConfig.create("hover", algorithm, n_worlds=8, options=options, config=config | {"iterations": 2})
    result = train(config, tmp_path, evaluation_worlds=8, log=lambda line: None, progress=False)
    policy, config, meta = load_policy(tmp_path)
    assert config.config["convolution"] == [2, 3]
    assert meta["images"]["depth"]["width"] == 5
    assert evaluate(result.env, policy)["reward"] == evaluate(result.env, result.policy)["reward"]
    start = policy.stats.is_scaled().argmin()
    np.testing.assert_array_equal(policy.stats.mean[start : start + 20], 0)
    assert np.all(policy.stats.mean[:start] != 0)


def test_policies_of_several_seeds_have_convolutions_of_their_own(rng, meta):
    policies_of_seeds = [make_policy(meta, memory=0, channels=(2,), seed=seed) for seed in (0, 1)]
    policies = Policies(jax.tree.map(lambda *x: jnp.stack(x), *policies_of_seeds))
    obs = {name: jnp.asarray(rng.uniform(size=(4, 1, n)), jnp.float32) for name, n in meta["observations"].items()}
    actions = policies(obs)
    for policy, worlds in zip(policies_of_seeds, (slice(2), slice(2, 4)), strict=True):
        np.testing.assert_allclose(actions[worlds], policy({k: x[worlds] for k, x in obs.items()}), atol=1e-6)
    assert np.abs(actions[:2] - policies_of_seeds[1]({k: x[:2] for k, x in obs.items()})).max() > 0.01


def test_a_student_learns_from_images(env, rng):
    """Its labels depend on one pixel only."""
    config = dagger.Config(iterations=30, minibatches=1, epochs=4, hidden=(8,), convolution=(4,), learning_rate=0.01)
    teacher_env = AutoReset(dagger.TeacherObservation(env, lambda data: {"pos": data.states.pos}))
    teacher = lambda obs: jnp.zeros((4, 1, 4))  # noqa: E731
    init = jax.jit(functools.partial(dagger.init, teacher_env, (config,), teacher=teacher))
    learner = init(jax.random.key(0)[None])
    agent, obs = take_seed(learner.agents, 0), jnp.asarray(rng.uniform(0, 2, size=(4, 64, 1, 41)), jnp.float32)
    (image,) = agent.network.images
    assert image.shape == (4, 5, 1)
    labels = jnp.broadcast_to(0.5 * jnp.tanh(obs[..., image.start : image.start + 1] - 1), (4, 64, 1, 4))
    outcome = (jnp.ones(4),) * 4  # of which only metrics are made
    learn = jax.jit(lambda agent, key: dagger.learn(agent, config, ((obs, labels, jnp.ones(4)), outcome), key))
    measure = jax.jit(lambda agent: jnp.square(agent.act(agent.stats.normalize(obs)) - labels).mean())
    before = measure(agent)
    for i in range(30):
        agent, metrics = learn(agent, jax.random.key(i))
        assert metrics["finite"]
    assert measure(agent) < 0.2 * before


@pytest.mark.long("compiles steps with images, and their gradient")
def test_analytic_gradients_pass_through_colors():
    """Of blurred images of the floor through a rolling shutter, which arrive late."""
    times = {"exposure": 0.01, "blur_samples": 2, "readout": 0.01, "latency": 0.02}
    camera = Camera(3, 2, rpy=(0, 1, 0), outputs=("rgb", "gray"), color_gradients=True, **times)
    env = make("hover", 4, camera=camera)
    jax.eval_shape(functools.partial(apg.init, env, (apg.Config(hidden=(8,)),)), jax.random.key(0)[None])

    def sum_of_images(actions, state):
        for action in actions:
            state = env.step(state, action)
        return sum(jnp.sum(state.obs[f"camera.{name}"]) for name in ("rgb", "gray"))

    actions, state = jnp.zeros((3, 4, 1, 4)), jax.jit(env.reset)(jax.random.key(1))
    gradient = np.asarray(jax.jit(jax.grad(sum_of_images))(actions, state))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient[0]).max(axis=(1, 2)).min() > 1e-3
    assert not gradient[-1].any(), "the image is older than the last action"


def test_law_09_convolutions_that_do_not_fit_are_refused(env):

    def init_learner(env, **config):
        jax.eval_shape(lambda key: ppo.init(AutoReset(env), (ppo.Config(minibatches=1, **config),), key), keys)

    def create(algorithm, network=None):
        TrainConfig.create("hover", algorithm, options=OPTIONS, config={"convolution": (2,)}, network=network)

    keys, colors = jax.random.key(0)[None], CameraImages(env.env, Camera(2, 2, outputs=("rgb",)))
    network = Network(lambda key, n: init_mlp(key, (n, 2), 1.0), lambda weights, obs, memory: (obs, memory))
    for call, message in (
        (lambda: init_learner(env.env, convolution=(2,)), r"an image among the observations .*Use depth_im"),
        (lambda: init_learner(env, convolution=(2,), critic="all_drones"), "critic of one drone .*'all_drones'"),
        (lambda: ppo.Config(convolution=8), r"convolution as the channels .*got 8\. Use"),
        (lambda: ppo.Config(convolution=(2, 0)), r"convolution\[1\] is 0"),
        (lambda: create("ppo", network), r"no convolution with a custom network"),
        (lambda: apg.Config(image_gradients=1), "image_gradients"),
        (lambda: apg.init(colors, (apg.Config(),), keys), r"gradients are not zero, got camera.rgb\. Use"),
    ):
        with pytest.raises(ConfigError, match=message):
            call()
