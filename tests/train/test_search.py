"""Search for hyperparameters, factors of rewards, and demonstrations."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.envs import AutoReset, DroneEnv, RewardTerms, make
from crazysim.envs.registry import entry_of
from crazysim.envs.state import terms_of
from crazysim.envs.tasks.hover import Hover
from crazysim.errors import ConfigError
from crazysim.train import TrainConfig, ppo, tune
from crazysim.train import search as search_module
from crazysim.train.config import WORLDS
from crazysim.train.seeds import rollout_seeds, stack_configs, take_seed

TASK = f"{Path(__file__).with_name('own_tasks') / 'dock.py'}:Dock"
SMALL = {"n_steps": 4, "minibatches": 2, "epochs": 1, "hidden": (8,)}


class Shown(Hover):
    """Hovering with a demonstration that leans against the velocity."""

    @staticmethod
    def demonstrate(obs):
        lean = jnp.clip(0.8 * obs["vel"], -0.5, 0.5)
        return jnp.concatenate([lean, 0.3 + 0.0 * lean[..., :1]], axis=-1)


@pytest.fixture
def small_search(monkeypatch):
    monkeypatch.setattr(search_module, "SIZES", {"cpu": search_module.Size(300.0, 4, 4, 5)})
    monkeypatch.setattr(search_module, "N_STARTS", 4)
    monkeypatch.setattr(search_module, "MAX_ROUNDS", 3)


def reward_terms():
    env = RewardTerms(make("hover", 1, engine="interpret"))
    return [*terms_of(jax.eval_shape(env.reset, jax.random.key(0)).info)]


def search(folder, **settings):
    lines = []
    config = SMALL | settings.pop("config", {})
    options = {"seconds": 0.1, "engine": "interpret"}
    recipe = tune("hover", folder, options=options, config=config, log=lines.append, **settings)
    return recipe, json.loads((folder / "tune.json").read_text()), lines


@pytest.mark.usefixtures("small_search")
def test_a_search_compares_settings_and_then_seeds(tmp_path):
    """Given hyperparameters stay; what is returned has the highest score of those with several seeds."""
    recipe, found, lines = search(tmp_path, config={"discount": 0.9, "entropy": 0.0}, search="rewards", seconds=600.0)
    assert found["recipe"] == recipe
    first, second, *_ = found["candidates"]
    assert len(found["candidates"]) >= 4
    assert max(len(x["curves"]) for x in found["candidates"]) > 1
    assert first["success"] >= second["success"]
    drawn = [x["settings"] for x in found["candidates"] if x["settings"]]
    assert all({"gae_lambda", "learning_rate", "clip", "rewards"} == x.keys() for x in drawn)
    assert all(0.9 <= x["gae_lambda"] <= 0.99 and x["rewards"].keys() == set(reward_terms()) for x in drawn)
    assert len({str(x) for x in drawn}) == len(drawn)
    assert (tmp_path / "tune.png").exists()
    assert "4 policies a round, each 5 iterations" in lines[0]
    assert ("no policy succeeded" in lines[-1]) == (first["success"] == 0)
    assert not recipe or first["success"] > 0
    TrainConfig.create("hover", config=recipe)  # a recipe that trains


@pytest.mark.usefixtures("small_search")
def test_the_compiled_search_trains_as_the_algorithm_does():
    """Hyperparameters that are arguments of the program give the iterations of those that are constants."""
    config = TrainConfig.create("hover", options={"seconds": 0.1, "engine": "interpret"}, config=SMALL)
    trial = search_module._Trial(config, "hyperparameters", {})
    base = trial.config.algorithm_config()
    configs = tuple([dataclasses.replace(base, discount=x, entropy=x, clip=0.1) for x in (0.5, 0.9, 0.5, 0.9)])
    learner = trial.init(np.arange(4))
    expected, _ = ppo.iterate(learner, trial.env, configs)
    actual = trial.advance(learner, stack_configs(configs).values)
    for x, y in zip(jax.tree.leaves(actual.agents.policy), jax.tree.leaves(expected.agents.policy), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)
    x = jax.tree.leaves(actual.agents.policy)[0]
    assert np.abs(x[0] - x[1]).max() > 1e-3


def test_factors_change_the_terms_of_the_reward():
    env = AutoReset(RewardTerms(make("hover", 4, seconds=0.1, engine="interpret")))
    names = reward_terms()
    assert len(names) > 1

    def fly(**factors):
        config = ppo.Config(**SMALL, rewards=factors)
        learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, (config,), jax.random.key(0)[None])
        seeds = learner.agents, stack_configs((config,))
        run = jax.jit(rollout_seeds, static_argnums=(0, 2, 3, 6))
        return np.asarray(
            run(env, learner.env, ppo.act, ppo.record, seeds, jax.random.key(1)[None], 3, ((), ()))[2][0].reward
        )

    alone = [fly(**{name: float(name == term) for name in names}) for term in names]
    np.testing.assert_allclose(fly(), sum(alone), atol=1e-5)
    tripled = fly(**{names[0]: 3.0})
    np.testing.assert_allclose(tripled - fly(), 2 * alone[0], atol=1e-5)
    assert np.abs(tripled - fly()).max() > 1e-4
    with pytest.raises(ConfigError, match=r"rewards of terms among .*, got \['wrong'\]"):
        fly(wrong=2.0)


@pytest.mark.parametrize("rewards", [5, {"near": "much"}, {"near": np.nan}, ["near"]])
def test_other_factors_are_refused(rewards):
    with pytest.raises(ConfigError, match="rewards as finite factors"):
        ppo.Config(rewards=rewards)


def test_demonstrations_are_learnt_and_then_improved():
    """Thirty iterations of them bring the actions to those shown; without them the policy stays away."""
    base = make("hover", 64, seconds=0.2)
    env = AutoReset(DroneEnv(base.sim, Shown(seconds=0.2)))

    def distance(n_shown):
        config = ppo.Config(iterations=30, n_steps=8, minibatches=2, hidden=(32,), demonstrations=n_shown)
        learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, (config,), jax.random.key(0)[None])
        for _ in range(30):
            learner, _ = ppo.iterate(learner, env, (config,))
        policy = take_seed(learner.as_policy(), 0)
        obs = learner.env.obs
        return float(jnp.abs(policy(obs) - Shown.demonstrate(obs)).mean()), float(
            jnp.exp(learner.agents.log_std).mean()
        )

    (shown, std), (other, _) = distance(30), distance(0)
    assert shown < 0.07
    assert other > 0.15
    assert std > 0.9 * ppo.LEAST_STD, "exploration goes on"


def test_a_class_with_a_demonstration_begins_with_it():
    assert TrainConfig.create(TASK).config["demonstrations"] == 80
    assert TrainConfig.create(TASK, config={"iterations": 50}).config["demonstrations"] == 25
    assert TrainConfig.create(TASK, config={"demonstrations": 0}).config["demonstrations"] == 0
    assert TrainConfig.create("hover").config["demonstrations"] == 0


def test_a_policy_of_another_run_begins_with_its_value_function(monkeypatch):
    config = TrainConfig.create(TASK, config={"start": "run", "iterations": 50}).config
    assert (config["value_iterations"], config["demonstrations"]) == (25, 0)
    monkeypatch.setattr(entry_of(TASK).task, "recipe", {"demonstrations": 40})
    for given, demonstrations in (({}, 40), ({"start": "run"}, 0), ({"start": "run", "demonstrations": 5}, 5)):
        assert TrainConfig.create(TASK, config=given).config["demonstrations"] == demonstrations


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (Hover, "demonstrations, got Hover.*demonstrations=0"),
        (type("Flat", (Hover,), {"demonstrate": lambda self, obs: obs["vel"]}), r"shape \(2, 1, 4\).*got \(2, 1, 3\)"),
        (type("Typo", (Hover,), {"demonstrate": lambda self, obs: obs["gaol"]}), "observations are .*vel"),
        (type("NoSelf", (Hover,), {"demonstrate": lambda obs: obs}), "@staticmethod"),
    ],
)
def test_other_demonstrations_are_refused(task, message):
    env = AutoReset(DroneEnv(make("hover", 2, engine="interpret").sim, task()))
    with pytest.raises(ConfigError, match=message):
        ppo.init(env, (ppo.Config(**SMALL, demonstrations=1),), jax.random.key(0)[None])


def test_default_worlds_depend_on_the_device():
    assert TrainConfig.create(TASK).n_worlds == WORLDS["cpu"]
    assert TrainConfig.create(TASK, n_worlds=64).n_worlds == 64
