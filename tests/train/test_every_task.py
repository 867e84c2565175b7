"""Every built-in task is learned: seconds of training with its recipe increase the reward."""

import jax
import numpy as np
import pytest

from crazysim.envs import TASKS, AutoReset, PrivilegedObservation
from crazysim.envs.registry import BUILT_IN_TASKS
from crazysim.train import apg
from crazysim.train.config import ALGORITHMS, TrainConfig

N_WORLDS, ITERATIONS = {"ppo": 256, "apg": 64}, {"ppo": 30, "apg": 15}


@pytest.mark.slow("trains every task; the tests of both algorithms on one task are quicker")
@pytest.mark.parametrize("task", [task for task in TASKS if task in BUILT_IN_TASKS])
def test_the_reward_rises(task):
    """The reward of the last ten iterations exceeds that of an untrained policy by more than two standard errors.

    All episodes begin together, so different iterations have rewards of different parts of an episode. The untrained
    policy flies the same parts. If the recipe has a teacher, the teacher is trained.
    """
    recipe = TrainConfig.create(task)
    recipe = recipe.teacher_config() or recipe
    name = recipe.algorithm
    hyperparameters = recipe.config | {"iterations": ITERATIONS[name]}
    config = TrainConfig.create(task, name, n_worlds=N_WORLDS[name], options=recipe.options, config=hyperparameters)
    algorithm, hyperparameters = ALGORITHMS[name], config.algorithm_config()
    env = config.make_env(**config.practice_options())
    env = PrivilegedObservation(env) if config.config.get("critic") == "privileged" else env
    env = env if algorithm is apg else AutoReset(env)
    first = jax.jit(algorithm.init, static_argnums=(0, 1))(env, (hyperparameters,), jax.random.key(0)[None])
    initial_weights = {x: getattr(first.agents, x) for x in ("policy", "log_std") if hasattr(first.agents, x)}
    learner, untrained, gains = first, first, []
    for _ in range(hyperparameters.iterations):
        learner, metrics = algorithm.iterate(learner, env, (hyperparameters,))
        untrained = untrained.replace(agents=untrained.agents.replace(**initial_weights))
        untrained, untrained_metrics = algorithm.iterate(untrained, env, (hyperparameters,))
        gains.append(float(metrics["reward"][0] - untrained_metrics["reward"][0]))
    assert np.mean(gains[-10:]) > 2 * np.std(gains[-10:], ddof=1) / np.sqrt(10)
