"""Several policies in one environment, and trainings against earlier versions of the policy."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.commands.options import load_policy_and_env
from crazysim.envs import AutoReset, make, rollout
from crazysim.train import MultiPolicy, evaluate, evaluate_each, ppo
from crazysim.train.config import TrainConfig
from crazysim.train.interface import Interface
from crazysim.train.networks import Policy
from crazysim.train.seeds import take_seed
from crazysim.train.training import train

N_WORLDS, N_DRONES = 4, 3
SMALL = {"n_steps": 4, "minibatches": 2, "epochs": 1, "hidden": (8,)}


@pytest.fixture(scope="module")
def env():
    return make("swarm", N_WORLDS, n_drones=N_DRONES, engine="interpret", seconds=0.2)


def constant(value):
    return lambda obs: jnp.full((*obs["pos"].shape[:2], 4), value)


def train_iterations(env, n, **config):
    configs = (ppo.Config(**SMALL | config),)
    learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, configs, jax.random.key(0)[None])
    learners = [learner]
    for _ in range(n):
        learners.append(ppo.iterate(learners[-1], env, configs)[0])
    return learners


# Several policies -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("who", "expected"),
    [(None, [0, 1, 1]), ([1, 0, 0], [1, 0, 0]), ([[0, 0, 1], [1, 0, 1], [0, 1, 0], [1, 1, 1]], None)],
    ids=["in order", "drones", "worlds"],
)
def test_each_drone_has_the_action_of_its_policy(env, who, expected):
    policy = MultiPolicy.of([constant(0.25), constant(-0.5)], who)
    state = env.reset(jax.random.key(0))
    expected = np.broadcast_to(expected or who, (N_WORLDS, N_DRONES))
    values = np.where(expected, -0.5, 0.25)[..., None]
    np.testing.assert_array_equal(policy(state.obs), np.broadcast_to(values, (N_WORLDS, N_DRONES, 4)))


def test_policies_with_memory_and_fewer_observations_fly_together_with_functions(env):
    """A member sees what its training had, by name, and its memory begins anew with every episode."""
    reset_env = AutoReset(env)
    (learner,) = train_iterations(reset_env, 0, memory=3)
    remembering = take_seed(learner.as_policy(), 0)
    sizes = {"pos": 3, "vel": 3}
    interface = Interface(tuple(sizes.items()), (), "attitude", ((0.0, 1.0),) * 4)
    stats = remembering.stats.replace(mean=jnp.zeros(6), var=jnp.ones(6))
    small = Policy(stats, [(jnp.eye(6, 4), jnp.zeros(4))], interface=interface)
    policy = MultiPolicy.of([remembering, small, constant(0.25)])
    state, memory = env.reset(jax.random.key(0)), policy.initial_memory(N_WORLDS, N_DRONES)
    action, after = policy.act(state.obs, memory)
    expected, expected_memory = remembering.act(state.obs, memory[0])
    np.testing.assert_array_equal(action[:, 0], expected[:, 0])
    np.testing.assert_array_equal(after[0], expected_memory)
    np.testing.assert_allclose(action[:, 1, :3], np.tanh(state.obs["pos"][:, 1]), atol=1e-6)
    np.testing.assert_array_equal(action[:, 2], 0.25)

    def fly(n_steps):
        return rollout(
            reset_env,
            reset_env.reset(jax.random.key(0)),
            lambda obs, memory, key: (*policy.act(obs, memory), ()),
            jax.random.key(0),
            n_steps,
            lambda step: step.action,
            memory,
        )

    _, kept, _ = fly(9)
    _, forgotten, actions = fly(10)  # the episode has ten steps
    assert np.abs(kept[0]).max() > 0
    assert not np.any(forgotten[0])
    np.testing.assert_array_equal(actions[:, :, 2], 0.25)


def test_each_policy_is_judged_by_its_own_drones(env):
    climb, fall = constant(0.0), lambda obs: constant(1.0)(obs) * jnp.array([0.0, 0.0, 0.0, -1.0])
    both = evaluate_each(env, MultiPolicy.of([climb, fall], [0, 1, 1]))
    together = evaluate(env, MultiPolicy.of([climb, fall], [0, 1, 1]))
    assert [sorted(x) for x in both] == [["reward", "success"]] * 2, "this task has no outcomes"
    mean = (both[0]["reward"] + 2 * both[1]["reward"]) / 3
    np.testing.assert_allclose(mean, together["reward"], rtol=1e-5)
    assert both[0]["reward"] != both[1]["reward"]


def test_policies_that_do_not_fit_are_named(env):
    for policies, who in (([], None), ([1], None), ([constant(0)], [0, 1]), ([constant(0)], 0), ([constant(0)], [0.0])):
        with pytest.raises(ConfigError, match=r"expected (a list of policies|who as indices)"):
            MultiPolicy.of(policies, who)
    for who in ([[0]], [0, 0, 0, 0]):
        with pytest.raises(ConfigError, match="policies for 3 drones in 4 worlds"):
            evaluate(env, MultiPolicy.of([constant(0)], who))
    interface = Interface((("pos", 3), ("wind", 2)), (), "attitude", ((0.0, 1.0),) * 4)
    stats = train_iterations(AutoReset(env), 0)[0].agents.stats
    with pytest.raises(ConfigError, match="no wind 2"):
        evaluate(env, MultiPolicy.of([Policy(stats, [], interface=interface)]))


# Training against earlier versions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [{}, {"memory": 3}, {"critic": "all_drones"}], ids=["plain", "memory", "all drones"])
def test_earlier_versions_fly_the_opponents(env, config):
    reset_env = AutoReset(env)
    learners = train_iterations(reset_env, 4, opponents=2, versions=2, version_every=2, **config)
    first, _, second, _, third = [jax.tree.leaves(x.as_policy()) for x in learners]
    versions = [[x[:, k] for x in jax.tree.leaves(learners[-1].agents.versions)] for k in (0, 1)]
    jax.tree.map(np.testing.assert_array_equal, versions, [third, second])
    before = [[x[:, k] for x in jax.tree.leaves(learners[1].agents.versions)] for k in (0, 1)]
    jax.tree.map(np.testing.assert_array_equal, before, [first, first])
    assert any(np.any(x != y) for x, y in zip(second, third, strict=True))
    # Each version flies half of the worlds.
    agent, learner = take_seed(learners[-1].agents, 0), learners[-1]
    action, memory, extras = ppo.act(
        agent, ppo.Config(**SMALL | config), learner.env.obs, learner.memory, jax.random.key(1)
    )
    assert action.shape == (N_WORLDS, N_DRONES, 4)
    assert extras[2].shape == (N_WORLDS, 1, 4), "the policy learns from its own drone"
    for k, worlds in enumerate((np.s_[:2], np.s_[2:])):
        version = take_seed(agent.versions, k)
        inputs = jax.tree.map(lambda x, w=worlds: x[w, 1:], (learner.env.obs, learner.memory[0]))
        expected, expected_memory = version.act(*inputs)
        np.testing.assert_allclose(action[worlds, 1:], expected, atol=1e-6)  # rounding of other products
        jax.tree.map(
            lambda x, y, w=worlds: np.testing.assert_allclose(x[w, 1:], y, atol=1e-6), memory[0], expected_memory
        )


def test_opponents_leave_a_drone_that_learns_and_divide_the_worlds(env):
    for config, text in (
        ({"opponents": 3}, "fewer opponents than the 3 drones"),
        ({"opponents": 1, "versions": 3}, "3 versions and 0 rivals divide"),
    ):
        with pytest.raises(ConfigError, match=text):
            train_iterations(AutoReset(env), 0, **config)


@pytest.mark.long("compiles a training")
def test_policies_of_other_runs_are_opponents_of_their_share_of_the_worlds(tmp_path):
    """A policy of a training alone, which has fewer observations, flies in every second world of a race of two."""
    options = {"engine": "interpret", "seconds": 0.1}
    solo = TrainConfig.create("race", n_worlds=2, options=options, config=SMALL | {"iterations": 1, "n_steps": 2})
    solo_policy = train(solo, tmp_path / "solo", evaluation_worlds=2, log=lambda line: None, progress=False).policy
    env = AutoReset(make("head_to_head", N_WORLDS, n_drones=2, **options))
    rivals = [str(tmp_path / "solo")]
    learners = train_iterations(env, 2, opponents=1, versions=1, version_every=1, rivals=rivals, memory=3)
    agent, state, memory = take_seed(learners[-1].agents, 0), learners[-1].env, learners[-1].memory
    action, _, _ = ppo.act(agent, ppo.Config(**SMALL, memory=3), state.obs, memory, jax.random.key(0))
    known = {name: x[2:, 1:] for name, x in state.obs.items() if name in solo_policy.interface.sizes}
    np.testing.assert_allclose(action[2:, 1:], solo_policy(known), atol=1e-6)
    jax.tree.map(np.testing.assert_array_equal, agent.rivals[0].layers, solo_policy.layers)
    # Settings that the runs share are those of the race that they fly together.
    folders, settings = [tmp_path / "solo"] * 2, {"n_drones": 2, "seconds": 0.2}
    _, config, _ = load_policy_and_env(Path("head_to_head"), None, 1, policies=folders, settings=settings)
    assert config.options == options | settings
    with pytest.raises(ConfigError, match="1 versions and 2 rivals divide, got 4"):
        train_iterations(env, 0, opponents=1, versions=1, rivals=rivals * 2)
