"""Trainings on several devices: the policies of one device, one checkpoint, and exchange of sums only."""

import dataclasses
import functools
import re

import jax
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.__main__ import main
from crazysim.engine.sharding import world_mesh
from crazysim.envs import AutoReset, make
from crazysim.train import apg, checkpoint, ppo
from crazysim.train import config as configs
from crazysim.train.config import TrainConfig
from crazysim.train.devices import exchanged_bytes, find_devices, learner_shardings, replicated_sharding
from crazysim.train.show import read_curve
from crazysim.train.training import CHECKPOINT_FILE, load_policy, train

PPO_CONFIG = ppo.Config(iterations=3, n_steps=8, minibatches=4, epochs=2, hidden=(8,), learning_rate=1e-2)
APG_CONFIG = apg.Config(iterations=3, n_steps=4, hidden=(8,), learning_rate=1e-2)


def key_of(seed):
    """Return the key that a run derives from a seed."""
    return jax.random.fold_in(jax.random.key(seed), 1)


@functools.cache
class Training:
    """A training of some seeds on some devices, without its files."""

    def __init__(self, algorithm, config, n_seeds, n_worlds, n_devices):
        mesh = world_mesh(jax.devices()[:n_devices]) if n_devices > 1 else None
        env = make("hover", n_seeds * n_worlds, seconds=0.2, mesh=mesh)
        init, configs = algorithm.init, (config,) * n_seeds
        env = env if algorithm is apg else AutoReset(env)
        replicated = replicated_sharding(env.sim)
        keys = jax.device_put(jax.numpy.stack([key_of(seed) for seed in range(n_seeds)]), replicated)
        shapes = jax.eval_shape(functools.partial(init, env, configs), keys)
        self.shardings = learner_shardings(shapes, env.sim, n_seeds)
        init = jax.jit(init, static_argnums=(0, 1), out_shardings=self.shardings)
        iterate = jax.jit(algorithm.iterate, static_argnums=(1, 2), out_shardings=(self.shardings, replicated))
        learner = self.initial_learner = init(env, configs, keys)
        self.program = iterate.lower(learner, env, configs).compile()
        for _ in range(3):
            learner, self.metrics = self.program(learner)
        self.learner = learner


def assert_same(actual, others, atol):
    """Assert that two trees agree; keys, integers and flags exactly."""
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(actual), jax.tree.leaves(others), strict=True):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        name = jax.tree_util.keystr(path)
        if np.issubdtype(x.dtype, np.floating) and atol:
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=atol, err_msg=name)
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)


def agent_of(training, seed):
    """Return networks, optimiser and statistics of a seed."""
    return jax.tree.map(lambda x: x[seed], training.learner.agents)


@pytest.mark.long("compiles each algorithm for one device and for four")
@pytest.mark.parametrize(("algorithm", "config"), [(ppo, PPO_CONFIG), (apg, APG_CONFIG)], ids=["ppo", "apg"])
def test_four_devices_train_the_policy_of_one(algorithm, config):
    """The first episodes are equal bit for bit, weights and statistics after three iterations to rounding. Devices only
    exchange sums."""
    one, four = (Training(algorithm, config, 1, 16, n) for n in (1, 4))
    assert_same(four.initial_learner.env, one.initial_learner.env, atol=0)
    assert_same(four.learner, one.learner, atol=1e-5)
    assert_same(four.metrics, one.metrics, atol=1e-5)
    assert four.learner.env.obs["pos"].addressable_shards[0].data.shape[0] == 4
    assert exchanged_bytes(one.program.as_text()) == {}
    exchanged = exchanged_bytes(four.program.as_text())
    assert set(exchanged) == {"all-reduce"}
    # The gradients of all weights, once for each update; analytic gradients are summed after all steps.
    agents = one.learner.agents
    weights, n_updates = ((agents.policy, agents.value), 8) if algorithm is ppo else (agents.policy, 1)
    n_bytes = n_updates * sum(x.nbytes for x in jax.tree.leaves(weights))
    assert n_bytes < exchanged["all-reduce"] < 2 * n_bytes


@pytest.mark.long("compiles a training of two seeds and of three for two devices")
def test_seeds_are_divided_among_devices_or_trained_on_all():
    """Devices that divide the seeds train them without exchange. Seeds are trained as in runs of one seed."""
    single_training = Training(ppo, PPO_CONFIG, 1, 16, 1)
    two, three = (Training(ppo, PPO_CONFIG, n, 16, 2) for n in (2, 3))
    for training in (two, three):
        assert_same(agent_of(training, 0), agent_of(single_training, 0), atol=1e-5)
        assert np.any(agent_of(training, 1).log_std != agent_of(training, 0).log_std)
    assert [x.learner.agents.log_std.addressable_shards[0].data.shape[0] for x in (two, three)] == [1, 3]
    metrics = sum(x.nbytes for x in jax.tree.leaves(two.metrics))
    assert sum(exchanged_bytes(two.program.as_text()).values()) == metrics


@pytest.mark.long("compiles a training for four devices and for two")
def test_a_run_continues_on_another_number_of_devices(tmp_path, monkeypatch):
    """Interrupted after two iterations on four devices and continued on two, a run ends with the policy of one device,
    in one checkpoint that does not hold the devices."""
    monkeypatch.setattr(configs, "make", functools.cache(make))
    options, lines = {"seconds": 0.2}, []
    settings = {"n_worlds": 16, "options": options, "config": dataclasses.asdict(PPO_CONFIG)}

    def train_quietly(devices, **others):
        config = TrainConfig.create("hover", devices=devices, **settings)
        train(config, tmp_path, evaluation_worlds=8, log=lines.append, progress=False, **others)

    def interrupt(i, _):
        if i == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_quietly("all", on_iteration=interrupt)
    assert re.search(r"in 16 worlds, 4 on each of 4 devices, which exchange [\d,]{5,} bytes an iteration", lines[0])
    lines.clear()
    train_quietly("2,0", resume=True)
    assert re.search(r"in 16 worlds, 8 on each of 2 devices, .*; continues after iteration 2", lines[0])
    arrays, meta = checkpoint.read(tmp_path / CHECKPOINT_FILE)
    one = Training(ppo, PPO_CONFIG, 1, 16, 1).learner
    result = checkpoint.restore("", {k: x for k, x in arrays.items() if k.startswith("['learner']")}, {"learner": one})
    assert_same(result["learner"], one, atol=1e-5)
    assert [point["iteration"] for point in read_curve(tmp_path)] == [0, 2, 3]
    assert not {"devices", "mesh"} & {*meta["runs"][""]["settings"], *load_policy(tmp_path)[1].options}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ("--set mesh=2", "no option 'mesh' .*--devices all"),
        ("--devices 5", "devices among the 4 of 'cpu', got cpu:4. .*device_count=N"),
        ("--devices 0,7 --device cpu", "got cpu:7"),
        ("--devices 3 --worlds 64", "worlds that 3 devices divide, got 64. Use .*--worlds 66"),
        ("--devices 0", "got '0'. Use .*--devices 2"),
        ("--devices 1,1", "each once, got '1,1'"),
        ("--devices most", "got 'most'"),
        ("--devices 2 --device gpu", "a device of this host .*, got 'gpu': "),
    ],
)
def test_devices_that_cannot_be_used_are_errors(texts, message, tmp_path, capsys):
    assert main(["train", "hover", "--out", str(tmp_path / "out"), *texts.split()]) == 2
    assert re.search(message, " ".join(capsys.readouterr().err.split()))
    assert not (tmp_path / "out").exists()


def test_a_mesh_is_no_option_of_a_training():
    for call, remedy in (
        (lambda: TrainConfig.create("hover", options={"mesh": world_mesh(jax.devices())}), "devices='all' in Python"),
        (lambda: make("hover", 4, mesh=2), r"world_mesh\(jax\.devices\(\)\), or --devices"),
    ):
        with pytest.raises(ConfigError, match=f"mesh.*got .*{remedy}"):
            call()


def test_a_training_on_several_devices_is_evaluated_on_the_first_of_them():
    def device_option(**settings):
        return TrainConfig.create("hover", **settings).options.get("device")

    assert [device_option(), device_option(devices="all"), device_option(devices=2)] == [None, "cpu", "cpu"]
    assert [device_option(devices="2,3"), device_option(devices=[3])] == ["cpu:2", "cpu:3"]
    assert device_option(devices="2,3", options={"device": "cpu:1"}) == "cpu:1"
    env = TrainConfig.create("hover", devices=[3], n_worlds=2).make_training_env()
    assert (env.sim.device, env.sim.mesh) == (jax.devices()[3], None)
    assert find_devices("cpu", "2,0") == [jax.devices()[2], jax.devices()[0]]
    assert find_devices("cpu:1", 2) == jax.devices()[1:3]
