"""Policies with memory, custom networks, and critics with more inputs than the policy."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.envs import AutoReset, DroneEnv, Observe, PrivilegedObservation, RandomizeWith, make, state_of, uniform
from crazysim.envs.state import flatten
from crazysim.envs.tasks.hover import Hover
from crazysim.lab.export.out_of_tree import to_out_of_tree
from crazysim.lab.live.link import TrainedPolicy
from crazysim.lab.live.policy_pilot import PolicyPilot
from crazysim.plugins.sensors import MotionCapture
from crazysim.train import Network, ppo
from crazysim.train.checkpoint import read
from crazysim.train.config import TrainConfig
from crazysim.train.critic import critic_input, return_std
from crazysim.train.dagger import imitate
from crazysim.train.evaluation import evaluate
from crazysim.train.export import to_c
from crazysim.train.networks import Policies, gru_network, init_weights, unroll
from crazysim.train.seeds import rollout_seeds, stack_configs, take_seed
from crazysim.train.show import film
from crazysim.train.training import CHECKPOINT_FILE, load_policy, train

pytestmark = pytest.mark.usefixtures("shared_environments")
PAGE = Path(__file__).parents[2] / "docs" / "guides" / "training.md"
SMALL_CONFIG = {"n_steps": 8, "minibatches": 2, "epochs": 1, "hidden": (8,)}
RUN_SETTINGS = {"n_worlds": 16, "options": {"seconds": 0.1, "randomize": "generic", "engine": "interpret"}}


def train_quietly(folder, config, network=None, iterations=2, **options):
    config = TrainConfig.create(
        "hover", **RUN_SETTINGS, config=SMALL_CONFIG | {"iterations": iterations} | config, network=network
    )
    return train(config, folder, evaluation_worlds=8, log=lambda line: None, progress=False, **options)


def init_learner(env, **config):
    config = ppo.Config(**SMALL_CONFIG | config)
    learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, (config,), jax.random.key(0)[None])
    return learner, config


def test_an_update_computes_the_outputs_of_the_rollout(rng):
    """Unrolled over a rollout in which episodes end, the networks give the same actions and values, to rounding."""
    env = AutoReset(make("hover", 4, seconds=0.06, engine="interpret"))  # three steps an episode
    learner, config = init_learner(env, memory=5)
    memory = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), learner.memory)
    fly = jax.jit(rollout_seeds, static_argnums=(0, 2, 3, 6))
    seeds, key = (learner.agents, stack_configs((config,))), jax.random.key(1)[None]
    initial_memory = (learner.agents.network.make_memory(4, 1),) * 2
    _, after, (samples, _, _) = fly(
        env, learner.env, ppo.act, ppo.record, seeds, key, config.n_steps, initial_memory, memory
    )
    agent, samples = take_seed(learner.agents, 0), jax.tree.map(lambda x: x[:, 0], samples)
    assert samples.done.sum() == 2 * 4

    def outputs(done):
        out = unroll(agent.network, agent.policy, samples.obs, memory[0], done)
        log_prob = ppo.log_prob(jnp.tanh(out), agent.log_std, samples.action)
        return log_prob, unroll(agent.network, agent.value, samples.obs, memory[1], done)[..., 0]

    log_prob, value = outputs(samples.done)
    np.testing.assert_allclose(log_prob, samples.log_prob, atol=1e-4)
    scaled = value * return_std(agent.returns) + agent.returns.mean
    np.testing.assert_allclose(scaled, samples.value, atol=1e-5)
    assert np.abs(outputs(jnp.zeros_like(samples.done))[1] - value)[3:].max() > 1e-3, "memories are reset"
    assert np.abs(after[0]).max() > 0
    assert after[0].shape == (4, 1, 5)


def test_gradients_flow_back_in_time_to_the_start_of_an_episode(rng):
    network = gru_network(4)
    with jax.enable_x64(True):
        assert gru_network(4).initial_memory.dtype == np.float64
    weights = init_weights(network, jax.random.key(0), 3, (8, 2), 1.0)
    obs = jnp.asarray(rng.normal(size=(6, 2, 3)), jnp.float32)
    done = jnp.zeros((6, 2), bool).at[2, 1].set(True)

    def last_output(obs):
        return unroll(network, weights, obs, network.make_memory(2), done)[-1].sum()

    grads = np.abs(jax.grad(last_output)(obs)).max(axis=-1)
    assert (grads[:, 0] > 0).all()
    np.testing.assert_array_equal(grads[:, 1] > 0, [False, False, False, True, True, True])


class Recall(Hover):
    """A cue is observed only in the first step of an episode, and determines the reward of all steps."""

    def _cue(self, data):
        return jnp.where(data.plugins["task"].goal[..., :1] > data.states.pos[..., :1], 1.0, -1.0)

    def observe(self, data):
        """Return the cue in the first step, and zero later."""
        return {"cue": jnp.where(data.core.steps == 0, self._cue(data), 0.0)}

    def rewards(self, data, action, last_action):
        """Return how near the first action is to half the cue."""
        return {"action": -jnp.sum((action[..., :1] - 0.5 * self._cue(data)) ** 2, axis=-1)}


@pytest.mark.long("trains a policy")
def test_a_policy_with_memory_learns_a_task_that_needs_it():
    """Without memory the best action in four steps of five is 0, which costs 0.25 each: 0.2 on average."""
    base = make("hover", 128, freq=500, seconds=0.01)
    env = AutoReset(DroneEnv(base.sim, Recall(seconds=0.01), freq=500))
    learner, config = init_learner(
        env, memory=8, iterations=40, n_steps=20, epochs=4, init_std=0.2, discount=0.5, learning_rate=5e-3
    )
    for _ in range(config.iterations):
        learner, metrics = ppo.iterate(learner, env, (config,))
    assert metrics["finite"]
    assert float(metrics["reward"][0]) + float(metrics["std"][0]) ** 2 > -0.06  # without the cost of exploration


@pytest.mark.long("compiles two trainings")
def test_raptors_shape_is_trained_by_both_gradients_and_stored(tmp_path):
    """By PPO and by analytic gradients, weights of the memory change; actions are limited instead of squashed."""
    for name, config in (("ppo", {"critic": "privileged"}), ("apg", {"hidden": (8,)})):
        base = SMALL_CONFIG if name == "ppo" else {"n_steps": 4}
        settings = {"algorithm": name, "config": base | config | {"shape": "raptor", "memory": 4, "iterations": 2}}
        options = RUN_SETTINGS["options"] | {"engine": "interpret" if name == "ppo" else "plain"}
        run = train(
            TrainConfig.create("hover", n_worlds=16, options=options, **settings), tmp_path / name, evaluation_worlds=8,
            log=lambda line: None, progress=False,
        )  # fmt: skip
        arrays = read(tmp_path / name / CHECKPOINT_FILE)[0]
        moments = [x for key, x in arrays.items() if "recurrent" in key and x.shape[-2:] == (4, 12)]
        assert len(moments) == 4, "weights of learner and policy, and two moments of Adam"
        assert all(np.abs(x).max() > 0 for x in moments)
        policy, *_ = load_policy(tmp_path / name)
        assert evaluate(run.env, policy)["reward"] == evaluate(run.env, run.policy)["reward"]
        obs = jax.jit(run.env.reset)(jax.random.key(0)).obs
        loud = policy.replace(layers=[(weight, bias + 10) for weight, bias in policy.layers])
        assert np.all(np.asarray(loud.act(obs, policy.initial_memory(8, 1))[0]) == 1.0)
    with pytest.raises(ConfigError, match=r"shape='raptor'.*memory=16"):
        train_quietly(tmp_path / "none", {"shape": "raptor"})


@pytest.mark.long("compiles a training and renders a film")
def test_a_run_with_memory_is_stored_evaluated_filmed_and_exported(tmp_path):
    whole = train_quietly(tmp_path / "whole", {"memory": 4, "critic": "privileged"})
    arrays = read(tmp_path / "whole" / CHECKPOINT_FILE)[0]
    memories = [x for name, x in arrays.items() if name.startswith("['learner'].memory")]
    assert [x.shape for x in memories] == [(16, 1, 4)]  # the privileged critic has none
    assert all(np.abs(x).max() > 0 for x in memories)
    policy, loaded, meta = load_policy(tmp_path / "whole")
    assert loaded.config["memory"] == 4
    assert evaluate(whole.env, policy)["reward"] == evaluate(whole.env, whole.policy)["reward"]
    n_frames = film(loaded.make_env(1), policy, tmp_path / "film.gif", worlds=1)
    assert n_frames == 3 + 25
    assert "void policy_reset(policy_state *state)" in to_c(policy, tmp_path / "policy.h", meta).read_text()
    _, controller = to_out_of_tree(policy, tmp_path, meta, whole.env.sim.airframes[0], 50)
    assert "policy(&memory->state, observation, action);" in controller.read_text()
    with pytest.raises(ConfigError, match="teacher without memory, got one with a memory"):
        imitate(whole.env, policy)
    pilot = PolicyPilot(loaded.make_env(1), policy)
    live: Any = SimpleNamespace(sim=pilot.env.sim, command=np.zeros((1, 1, 4)), step=0)
    pilot(live)
    assert np.any(pilot._memory)
    pilot.reset(live)
    assert not np.any(pilot._memory)
    obs = jax.jit(whole.env.reset)(jax.random.key(0)).obs
    with pytest.raises(ConfigError, match=r"memory besides .*policy\.act\(obs, memory\)"):
        policy(obs)
    flight_policy = TrainedPolicy(policy, meta, goal=(0, 0, 1))
    memory = policy.initial_memory(8, 1)
    for _ in range(2):
        action, memory = policy.act(obs, memory)
        drone_obs = {name: np.asarray(x[0, 0]) for name, x in obs.items()}
        flight_policy._compute_observations = lambda _, drone_obs=drone_obs: drone_obs
        np.testing.assert_allclose(
            flight_policy(None), flight_policy._centre + flight_policy._scale * action[0, 0], atol=1e-6
        )
    np.testing.assert_allclose(flight_policy._memory, memory[0, 0], atol=1e-6)
    flight_policy.reset()
    assert not np.any(flight_policy._memory)


def test_policies_of_several_seeds_have_separate_memories(rng):
    env = AutoReset(make("hover", 4, seconds=0.06, engine="interpret"))
    config = ppo.Config(**SMALL_CONFIG | {"minibatches": 1, "memory": 3})
    keys = jax.random.split(jax.random.key(0), 2)
    learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, (config,) * 2, keys)
    policies, obs = learner.as_policy(), learner.env.obs
    memory = jnp.asarray(rng.normal(size=(4, 1, 3)), jnp.float32)
    action, after = Policies(policies).act(obs, memory)
    for i, worlds in enumerate((slice(2), slice(2, 4))):
        action_and_memory = take_seed(policies, i).act({name: x[worlds] for name, x in obs.items()}, memory[worlds])
        np.testing.assert_allclose(action[worlds], action_and_memory[0], atol=1e-6)
        np.testing.assert_allclose(after[worlds], action_and_memory[1], atol=1e-6)
    assert Policies(policies).initial_memory(4, 1).shape == (4, 1, 3)


@pytest.mark.long("compiles an environment with a sensor")
def test_privileged_observations_are_true_states_and_drawn_parameters():
    """With a sensor, the task observes measurements; the critic also gets true states, factors and masses."""

    def draw_masses(data, key):
        mass = data.params.mass * uniform(key, data.core.n_drones, 1, low=0.9, high=1.1)
        return data.replace(params=data.params.replace(mass=mass))

    base = make("hover", 3, randomize="generic", sensors=[MotionCapture(noise=0.1)], engine="interpret")
    env = AutoReset(PrivilegedObservation(RandomizeWith(base, draw_masses, params=("mass",))))
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    for _ in range(2):
        data, privileged = state.data, np.asarray(state.obs["privileged"])
        nominal = base.sim.default_data.params.mass
        record = data.plugins["randomize"]
        expected = [flatten(state_of(data)), data.states.rotor_vel, data.params.mass / nominal]
        expected += [record.factors, record.thrust_factors]
        np.testing.assert_allclose(privileged, np.concatenate(expected, axis=-1), rtol=1e-6)
        state = step(state, jnp.zeros((3, 1, 4)))
    assert np.abs(state.obs["pos"] - state.data.states.pos).max() > 0.01
    assert len(np.unique(privileged[..., -5:])) > 10
    learner, _ = init_learner(env, minibatches=1, critic="privileged")
    other = state.obs | {"privileged": 1 + state.obs["privileged"]}
    config = ppo.Config(critic="privileged")
    agent = take_seed(learner.agents, 0)
    values = [agent.estimate_value(agent.observe(obs, config)[1], (), config)[0] for obs in (state.obs, other)]
    assert np.abs(values[0] - values[1]).min() > 1e-4
    n_obs = flatten({name: x for name, x in state.obs.items() if name != "privileged"}).shape[-1]
    assert agent.n_obs == n_obs == agent.as_policy().stats.mean.shape[0]
    with pytest.raises(ConfigError, match=r"observation 'privileged' .*AutoReset\(PrivilegedObservation"):
        init_learner(AutoReset(base), minibatches=1, critic="privileged")
    with pytest.raises(ConfigError, match="observations without 'privileged', got "):
        PrivilegedObservation(PrivilegedObservation(base)).reset(jax.random.key(0))


def test_an_observation_of_the_task_may_be_named_privileged(rng):
    """Without a privileged critic it is an observation like the others."""
    base = make("hover", 2, seconds=0.06, engine="interpret")
    add = lambda obs, data: obs | {"privileged": data.states.rotor_vel, "zeros": 0 * obs["pos"]}  # noqa: E731
    env = AutoReset(Observe(base, add))
    learner, _ = init_learner(env, minibatches=1)
    n_obs = flatten(learner.env.obs).shape[-1]
    assert learner.agents.n_obs == n_obs == take_seed(learner.as_policy(), 0).stats.mean.shape[0]
    assert learner.agents.policy.layers[0][0].shape[1] == n_obs


def test_a_critic_of_all_drones_gets_all_observations_with_those_of_its_drone_first():
    obs = jnp.arange(2 * 3 * 2).reshape(2, 3, 2)
    inputs = np.asarray(critic_input(obs, "all_drones"))
    np.testing.assert_array_equal(inputs[0], [[0, 1, 2, 3, 4, 5], [2, 3, 4, 5, 0, 1], [4, 5, 0, 1, 2, 3]])
    np.testing.assert_array_equal(inputs[1, 2], [10, 11, 6, 7, 8, 9])


def test_a_critic_may_see_all_drones_and_their_true_states():
    """Its inputs are the observations and privileged observations of all drones; the policy gets its own drone's."""
    base = make("swarm", 2, seconds=0.1, engine="interpret")
    env = AutoReset(PrivilegedObservation(base))
    learner, _ = init_learner(env, minibatches=1, critic="all_drones_privileged")
    sizes = {name: x.shape[-1] for name, x in learner.env.obs.items()}
    n_obs = sum(sizes.values()) - sizes["privileged"]
    agent = take_seed(learner.agents, 0)
    assert agent.value.layers[0][0].shape[0] == base.sim.n_drones * (n_obs + sizes["privileged"])
    assert agent.policy.layers[0][0].shape[0] == agent.n_obs == n_obs


@pytest.mark.long("compiles a training")
def test_tasks_of_several_drones_train_with_a_critic_of_all():
    env = AutoReset(make("swarm", 4, seconds=0.1, engine="interpret"))
    learner, config = init_learner(env, critic="all_drones")
    value = take_seed(learner.agents, 0).value
    n_obs = learner.agents.n_obs
    assert value.layers[0][0].shape[0] == env.sim.n_drones * n_obs
    learner, metrics = ppo.iterate(learner, env, (config,))
    assert metrics["finite"]
    assert np.abs(take_seed(learner.agents, 0).value.layers[0][0] - value.layers[0][0])[n_obs:].max() > 1e-6


def plain_network():
    """Return a network in plain JAX, without memory."""

    def init(key, n_obs):
        return {"weight": jax.random.normal(key, (n_obs, 8)) / np.sqrt(n_obs)}

    return Network(init, lambda weights, obs, memory: (jax.nn.relu(obs @ weights["weight"]), memory))


def network_of_page():
    pytest.importorskip("flax")
    blocks = re.findall(r"```py\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (block,) = (block for block in blocks if "from flax " in block)
    names = {}
    exec(block, names)
    return names["network"]


@pytest.mark.long("compiles a training")
def test_a_custom_network_is_trained_saved_and_loaded(tmp_path):
    network = network_of_page()
    result = train_quietly(tmp_path, {}, network)
    policy, config, meta = load_policy(tmp_path, network=network)
    assert config.own_network
    for x, y in zip(jax.tree.leaves(policy), jax.tree.leaves(result.policy), strict=True):
        np.testing.assert_array_equal(x, y)
    obs, memory = jax.jit(result.env.reset)(jax.random.key(0)).obs, policy.initial_memory(8, 1)
    np.testing.assert_array_equal(policy.act(obs, memory)[0], result.policy.act(obs, memory)[0])
    assert evaluate(result.env, policy)["nonfinite"] == 0
    init = jax.jit(lambda key: ppo.init(AutoReset(result.env), (ppo.Config(minibatches=2),), key[None], network))
    start = take_seed(init(jax.random.key(0)).as_policy(), 0)
    changed = jax.tree.map(lambda x, y: bool(np.any(x != y)), start.body, policy.body)
    assert all(jax.tree.leaves(changed)), "all weights are trained"
    with pytest.raises(ConfigError, match=r"custom network with which .* was trained, got None\. Use"):
        load_policy(tmp_path)
    with pytest.raises(ConfigError, match=r"arrays of this task and version|expected .* in .* as float32"):
        load_policy(tmp_path, network=Network(lambda key, n: jnp.zeros((n, 3)), lambda w, x, m: (x @ w, m)))
    with pytest.raises(ConfigError, match=r"to be resumed with its custom network. Use network=network"):
        train_quietly(tmp_path, {}, resume=True)
    with pytest.raises(ConfigError, match="policy with the built-in network, got one with another network"):
        to_c(policy, tmp_path / "policy.h", meta)


def test_wrong_networks_are_errors():
    network = plain_network()
    for settings, message in (
        ({"config": {"memory": 8}, "network": network}, "memory=0 with a custom network"),
        ({"algorithm": "apg", "network": network}, r"no custom network for apg.*algorithm='ppo'"),
        ({"network": plain_network}, "a Network, got <function"),
    ):
        with pytest.raises(ConfigError, match=message):
            TrainConfig.create("hover", **RUN_SETTINGS, **settings)
    for apply, memory, message in (
        (lambda w, x, m: x @ w, (), "features .* and the memory"),
        (lambda w, x, m: ((x @ w)[None], m), (), "features .* and the memory"),
        (lambda w, x, m: (x @ w, ()), jnp.zeros(3), "memory like initial_memory"),
        (lambda w, x, m: (x @ w, m[:2]), jnp.zeros(3), r"memory like initial_memory, .*3.*got .*2"),
    ):
        with pytest.raises(ConfigError, match=message):
            init_weights(Network(lambda key, n: jnp.zeros((n, 3)), apply, memory), jax.random.key(0), 4, (2,), 1.0)
