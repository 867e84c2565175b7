"""Several seeds in one program: each is trained as in a program of its own."""

import csv
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.__main__ import main
from crazysim.core.random import drone_keys, world_keys
from crazysim.envs import AutoReset, make
from crazysim.errors import DivergedError
from crazysim.train import apg, checkpoint, ppo
from crazysim.train import training as trainings
from crazysim.train.evaluation import evaluate, evaluate_blocks
from crazysim.train.networks import Policies
from crazysim.train.runs import make_variants, run_many
from crazysim.train.seeds import take_seed
from crazysim.train.show import read_curve
from crazysim.train.training import load_policy

pytestmark = pytest.mark.usefixtures("shared_environments")
SHORT_EPISODES = {"seconds": 0.2}
PPO_CONFIGS = [
    ppo.Config(iterations=3, n_steps=12, minibatches=2, epochs=2, hidden=(8,), learning_rate=rate, discount=discount)
    for rate, discount in ((1e-3, 0.98), (5e-3, 0.9))
]
APG_CONFIGS = [
    apg.Config(iterations=3, n_steps=4, hidden=(8,), learning_rate=rate, critic_epochs=1, minibatches=2)
    for rate in (1e-3, 5e-3)
]


def block_observations(state, i):
    """Return the observations of the i-th block of four worlds, which are the worlds of one seed."""
    return {name: np.asarray(x[4 * i : 4 * i + 4]) for name, x in state.obs.items()}


@pytest.mark.long("compiles a training of one seed, and of two")
@pytest.mark.parametrize(("algorithm", "hyperparameters"), [(ppo, PPO_CONFIGS), (apg, APG_CONFIGS)], ids=["ppo", "apg"])
def test_a_seed_trains_with_others_like_a_single_seed(algorithm, hyperparameters):
    """Initial states are equal; agents, metrics and worlds agree to rounding after three iterations, with episodes that
    end in between. Hyperparameters of the seeds differ."""
    wrap = AutoReset if algorithm is ppo else lambda env: env
    env_of_one, env_of_both = (wrap(make("hover", n, randomize="crazyflie", **SHORT_EPISODES)) for n in (4, 8))
    keys = jax.random.split(jax.random.key(3), 2)
    init = jax.jit(algorithm.init, static_argnums=(0, 1))
    joint, separate = (
        init(env_of_both, tuple(hyperparameters), keys),
        [init(env_of_one, (hyperparameters[i],), keys[i : i + 1]) for i in range(2)],
    )
    for i in range(2):
        for name, x in block_observations(separate[i].env, 0).items():
            np.testing.assert_array_equal(block_observations(joint.env, i)[name], x, err_msg=name)
    assert np.any(block_observations(joint.env, 0)["pos"] != block_observations(joint.env, 1)["pos"])
    for _ in range(3):
        joint, metrics = algorithm.iterate(joint, env_of_both, tuple(hyperparameters))
        for i in range(2):
            separate[i], reference = algorithm.iterate(separate[i], env_of_one, (hyperparameters[i],))
            for name in metrics:
                np.testing.assert_allclose(metrics[name][i], reference[name][0], rtol=1e-3, atol=1e-5, err_msg=name)
    lost = joint.agents.replace(policy=jax.tree.map(lambda x: x + jnp.inf, joint.agents.policy))
    _, metrics = algorithm.iterate(joint.replace(agents=lost), env_of_both, tuple(hyperparameters))
    assert not metrics["finite"].any()
    for i in range(2):
        actual, reference = (jax.tree.leaves(take_seed(x.agents, j)) for x, j in ((joint, i), (separate[i], 0)))
        for x, y in zip(actual, reference, strict=True):
            if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
                x, y = map(jax.random.key_data, (x, y))
            np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-4)
        for name, x in block_observations(separate[i].env, 0).items():
            np.testing.assert_allclose(block_observations(joint.env, i)[name], x, rtol=1e-3, atol=1e-3, err_msg=name)


def test_the_policies_of_all_seeds_are_evaluated_in_one_program_like_single_ones():
    env = AutoReset(make("hover", 4, **SHORT_EPISODES))
    init = jax.jit(lambda keys: ppo.init(env, tuple(PPO_CONFIGS), keys).as_policy())
    policies = init(jax.random.split(jax.random.key(3), 2))
    result = evaluate_blocks(make("hover", 16, **SHORT_EPISODES), Policies(policies), n_blocks=2)
    env_of_one = make("hover", 8, **SHORT_EPISODES)
    for i in range(2):
        expected = evaluate(env_of_one, take_seed(policies, i))
        for name, x in expected.items():
            np.testing.assert_allclose(result[i][name], x, rtol=1e-4, atol=1e-6, err_msg=name)
    assert result[0]["error"] != result[1]["error"]


def test_one_kernel_call_steps_the_worlds_of_all_seeds():
    env, configs = AutoReset(make("hover", 8, **SHORT_EPISODES)), (PPO_CONFIGS[0],) * 2
    learner = jax.eval_shape(lambda keys: ppo.init(env, configs, keys), jax.random.split(jax.random.key(3), 2))
    program = str(jax.make_jaxpr(ppo.iterate, static_argnums=(1, 2))(learner, env, configs))
    assert re.findall(r"crazysim_kernel\[[^\]]*?\bn=(\d+)", program) == ["8"]


def test_the_random_numbers_of_a_block_depend_only_on_its_key():
    """Resets, ``world_keys`` and ``drone_keys`` give a block the same numbers with and without another block.

    All drones of a world draw from its key.
    """
    keys = jax.random.split(jax.random.key(5), 2)
    reset_two, reset_four = (jax.jit(make("swarm", n, engine="plain").reset) for n in (2, 4))
    joint, separate = reset_four(keys), [reset_two(key) for key in keys]
    for i, separate_state in enumerate(separate):
        for name, x in separate_state.obs.items():
            np.testing.assert_array_equal(joint.obs[name][2 * i : 2 * i + 2], x, err_msg=name)
        for draw in (world_keys, drone_keys):
            x, y = (jax.random.key_data(draw(state.full_data, "gusts")) for state in (joint, separate_state))
            np.testing.assert_array_equal(x[2 * i : 2 * i + 2], y)


def test_keys_must_divide_the_worlds():
    with pytest.raises(ConfigError, match=r"one key, or keys .* 4 worlds, got keys of shape \(3,\)"):
        make("hover", 4).reset(jax.random.split(jax.random.key(0), 3))


SMALL = {"n_steps": 4, "minibatches": 1, "epochs": 1, "hidden": (8,), "iterations": 3}


def train_quietly(folder, log=lambda line: None, **settings):
    """Train in 4 worlds for each seed."""
    options = {"n_worlds": 4, "options": {"seconds": 0.2}, "config": SMALL} | settings
    return run_many("hover", folder, evaluation_worlds=8, log=log, progress=False, **options)


@pytest.fixture(scope="module")
def sweep_run(tmp_path_factory):
    """Return a run of two seeds with two learning rates, one of which is too large, and its lines."""
    folder, lines = tmp_path_factory.mktemp("run") / "swept", []
    return train_quietly(folder, lines.append, seeds=(3, 5), sweep={"learning_rate": [1e-3, 1e38]}), folder, lines


@pytest.mark.long("compiles a training of four seeds")
def test_each_training_has_a_policy_and_a_row_and_one_that_diverges_ends_no_other(sweep_run):
    results, folder, lines = sweep_run
    names = [f"learning_rate-{rate}-seed-{seed}" for rate in (0.001, 1e38) for seed in (3, 5)]
    assert list(results) == names
    table = json.loads((folder / "seeds.json").read_text())
    with (folder / "seeds.csv").open(newline="") as file:
        cells = list(csv.DictReader(file))
    for name, row, texts in zip(names, table, cells, strict=True):
        policy, config, _ = load_policy(folder / name)
        assert (config.seed, config.config["learning_rate"]) == (row["seed"], row["learning_rate"])
        assert (row["name"], texts["name"], float(texts["success"])) == (name, name, row["success"])
        assert row["success"] == results[name].metrics["success"]
        curve = read_curve(folder / name)
        diverges = config.config["learning_rate"] > 1
        assert [point["iteration"] for point in curve] == ([0] if diverges else [0, 3])
        assert (row["diverged"] is not None) == (texts["diverged"] != "") == diverges
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(policy))
        assert sum(line.startswith(f"{name} diverged: NaN or infinity in iteration") for line in lines) == diverges
    first = [load_policy(folder / name)[0].layers[0][0] for name in names]
    assert np.any(first[0] != first[1])
    assert (folder / "curve.png").stat().st_size > 5000


@pytest.mark.long("compiles a training of two seeds")
def test_an_interrupted_run_of_several_seeds_resumes_bit_for_bit(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    seen = []
    train_quietly(whole, seeds=range(2), on_iteration=lambda *call: seen.append(call))
    assert [i for i, _ in seen] == [1, 2, 3]
    assert seen[0][1]["reward"].shape == seen[-1][1]["evaluation success"].shape == (2,)

    def interrupt(i, _):
        if i == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_quietly(cut, seeds=range(2), on_iteration=interrupt)
    with pytest.raises(ConfigError, match=r"seeds and the sweep of .*, seed-0, seed-1, got seed-1; resume"):
        train_quietly(cut, seeds=[1], resume=True)
    assert main(["train", "hover", "--resume", "--out", str(cut)]) == 2
    train_quietly(cut, seeds=range(2), resume=True)
    actual, reference = (checkpoint.read(folder / "checkpoint.npz")[0] for folder in (cut, whole))
    assert actual.keys() == reference.keys()
    for name, x in actual.items():
        np.testing.assert_array_equal(x, reference[name], err_msg=name)


@pytest.mark.long("compiles a training of two seeds")
def test_seeds_that_are_interrupted_before_the_first_iteration_have_files_and_all_that_diverged_are_named(
    tmp_path, monkeypatch
):
    """The error names the iteration of each seed."""

    def interrupt(*_):
        raise KeyboardInterrupt

    sweep = {"learning_rate": [1e38, 2e38]}
    with monkeypatch.context() as patch:
        patch.setattr(trainings, "_iteration_bar", interrupt)
        with pytest.raises(KeyboardInterrupt):
            train_quietly(tmp_path, sweep=sweep)
    first, second = "learning_rate-1e+38-seed-0", "learning_rate-2e+38-seed-0"
    assert [row["iteration"] for row in json.loads((tmp_path / "seeds.json").read_text())] == [0, 0]
    assert [point["kept"] for point in read_curve(tmp_path / first)] == [True]
    where = rf"2 \({re.escape(first)}\), 2 \({re.escape(second)}\)"
    expected = rf"NaN or infinity in iteration {where} of hover .*policy\.npz of iteration 0 \("
    with pytest.raises(DivergedError, match=expected):
        train_quietly(tmp_path, sweep=sweep, resume=True)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (("--seeds", "8:0"), "FIRST below END, .*'8:0'"),
        (("--seeds", "0:8:2"), "'0:8:2'"),
        (("--seeds", "1,2,1"), "each once, got '1,2,1'"),
        (("--seeds", "0:2", "--seed", "1"), "--seed or --seeds, got both"),
        (("--sweep", "learning_rate=fast"), "numbers to sweep, got 'learning_rate=fast'"),
        (("--sweep", "hidden=8,16"), "learning_rate, .*, got hidden"),
        (("--sweep", "clip=0.1,0.1"), r"values? of clip, and each once"),
        (("--sweep", "clip=0.1", "--config", "clip=0.2"), "clip to be swept or given, got both"),
        (("--sweep", "discount=0.9,1.1"), "discount as a number from 0 to 1, got 1.1"),
    ],
)
def test_wrong_options_are_refused(texts, message, capsys, tmp_path):
    try:
        status = main(["train", "hover", "--out", str(tmp_path / "out"), *texts])
    except SystemExit as error:  # of argparse
        status = error.code
    assert status == 2
    assert re.search(message, " ".join(capsys.readouterr().err.split()))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make_variants(5, {}, {}), "seeds as a list of values, got 5"),
        (lambda: make_variants([], {}, {}), "value of seeds, and each once, got none"),
        (lambda: make_variants([1], 5, {}), "sweep as a dict"),
        (lambda: make_variants([1], {"learning_rate": 1e-3}, {}), "learning_rate as a list of values"),
        (lambda: run_many("hover", config=[1]), "config as a dict"),
        (lambda: run_many("hover", seed=1), "settings among .*, got seed"),
        (lambda: make("hover", 4).reset(jax.random.split(jax.random.key(0), 3)), r"keys .* 4 worlds, got .*\(3,\)"),
    ],
)
def test_seeds_sweeps_configs_and_keys_of_a_wrong_kind_are_refused(call, message):
    with pytest.raises(ConfigError, match=message):
        call()
