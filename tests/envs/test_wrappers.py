"""Every wrapper, compared with expected numbers, and environments that wrappers refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import leaf_on_host, trees_equal
from env_cases import random_action, select_state, set_last_step

from crazysim import ConfigError
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import (
    ActionDelay,
    AutoReset,
    DroneEnv,
    EpisodeStatistics,
    FrameStack,
    Normalize,
    ObservationNoise,
    Observe,
    RandomizeWith,
    RewardTerms,
    Wrapper,
    make,
    rollout,
)
from crazysim.envs.state import flatten
from crazysim.envs.tasks.hover import Hover

FIRST_WORLD = np.array([True, False, False, False])
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def env():
    return make("hover", 4, engine="interpret")  # without compilation


def assert_same_world(a, b):
    """Compare states of a world by two programs, with and without a wrapper, up to the rounding of a few steps."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(*(jax.tree.leaves(jax.tree.map(leaf_on_host, tree)) for tree in (a, b)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5)


def random_steps(env, state, n, seed=0):
    states = []
    for i in range(n):
        state = env.step(state, random_action(state, seed + i))
        states.append(state)
    return states


class Recorder(Wrapper):
    """Records calls of its hooks, and the shapes of their arguments."""

    def __init__(self, env, name, calls):
        super().__init__(env)
        self.name, self.calls = name, calls

    def after_spawn(self, data):
        self.calls.append((self.name, "after_spawn", data.states.pos.shape))
        return data

    def after_reset(self, state):
        self.calls.append((self.name, "after_reset", state.obs["pos"].shape))
        return self.remember(state, jnp.zeros((), jnp.int32))

    def before_step(self, state, action):
        self.calls.append((self.name, "before_step", action.shape))
        return self.remember(state, self.recall(state) + 1), action / 2

    def after_step(self, state):
        self.calls.append((self.name, "after_step", state.reward.shape))
        return state


def test_shared_parameters_stay_when_episodes_begin(env):
    state = env.reset(jax.random.key(0))
    heavier_params = state.data.params.replace(mass=state.data.params.mass * 2)
    after = env.restart(state.replace(data=state.data.replace(params=heavier_params)), jnp.asarray(FIRST_WORLD))
    assert trees_equal(after.data.params, heavier_params)


def test_hooks_are_called_in_order_with_data_of_one_world():
    calls = []
    env = Recorder(Recorder(make("hover", 3, n_drones=2), "inner", calls), "outer", calls)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    at_start = [("after_spawn", (2, 3)), ("after_reset", (2, 3))]
    assert calls[:4] == [(name, *call) for call in at_start for name in ("inner", "outer")]
    calls.clear()  # the first reset also traces a step
    jax.eval_shape(env.step, state, state.action)
    assert calls == [
        ("outer", "before_step", (2, 4)),
        ("inner", "before_step", (2, 4)),
        ("inner", "after_step", (2,)),
        ("outer", "after_step", (2,)),
    ]


def test_hooks_change_actions_and_remember(env):
    wrapped = Recorder(Recorder(env, "inner", []), "outer", [])
    state = wrapped.reset(jax.random.key(0))
    action = random_action(state)
    after = wrapped.step(state, action)
    np.testing.assert_allclose(after.action, action / 4)
    np.testing.assert_array_equal(after.memory["inner"], np.ones(4))
    again = wrapped.restart(wrapped.step(after, action), jnp.asarray(FIRST_WORLD))
    np.testing.assert_array_equal(again.memory["outer"], [0, 2, 2, 2])


def test_wrappers_that_step_the_environment_themselves_are_refused():
    """As wrappers of Gymnasium do."""
    with pytest.raises(ConfigError, match=r"hooks for one world, got Counting\.step\. Override before_step"):

        class Counting(Wrapper):
            def step(self, state, action):
                return self.env.step(state, action)


class OneMoreTerm(Hover):
    """Hover with one more reward."""

    def rewards(self, data, action, last_action):
        return super().rewards(data, action, last_action) | {"first": jnp.full(1, 3.0)}


def test_the_terms_of_a_reward_add_up_to_it(env):
    wrapped = RewardTerms(DroneEnv(env.sim, OneMoreTerm()))
    state = jax.jit(wrapped.reset)(jax.random.key(0))
    names = {"reward proximity", "reward spin", "reward action_rate", "reward crash", "reward first"}
    assert names <= set(state.info)
    assert not any(state.info[name].any() for name in names)
    action = random_action(state)
    action[1] = np.nan
    after = jax.device_get(jax.jit(wrapped.step)(state, action))
    total = sum(after.info[name] for name in sorted(names))
    np.testing.assert_allclose(total, after.reward, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(after.info["reward first"][:, 0], [3, 0, 3, 3])
    change = np.sum(np.square(action[[0, 2, 3]]), axis=-1)
    np.testing.assert_allclose(after.info["reward action_rate"][np.array([0, 2, 3])], -0.02 * change, rtol=1e-5)


def test_randomised_episodes_are_observed_through_other_wrappers(env):
    """RandomizeWith may be inside or outside: episodes are randomised before they are observed."""

    def lift(data, key):
        return data.replace(states=data.states.replace(pos=data.states.pos + jnp.array([0.0, 0.0, 0.5])))

    inside, outside = FrameStack(RandomizeWith(env, lift), 2), RandomizeWith(FrameStack(env, 2), lift)
    a, b = (wrapped.reset(jax.random.key(0)) for wrapped in (inside, outside))
    assert trees_equal(a.obs, b.obs)
    plain = env.reset(jax.random.key(0))
    np.testing.assert_allclose(a.obs["pos"][..., 2] - plain.obs["pos"][..., 2], 0.5, rtol=1e-5)
    distance = np.linalg.norm(a.obs["difference_to_goal"][..., -3:], axis=-1)
    np.testing.assert_allclose(a.info["error"], distance, rtol=1e-5)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_episode_statistics(env, mode):
    auto = AutoReset(EpisodeStatistics(env), mode)
    start_state = auto.reset(jax.random.key(0))
    assert not start_state.info["episode_length"].any()
    first, second = random_steps(auto, start_state, 2)
    last = auto.step(set_last_step(env, second, FIRST_WORLD), random_action(start_state, 7))
    np.testing.assert_array_equal(last.done, FIRST_WORLD)
    np.testing.assert_array_equal(last.info["episode_length"], [3, 0, 0, 0])
    total = first.reward + second.reward + last.reward
    np.testing.assert_allclose(last.info["episode_return"], total * FIRST_WORLD[:, None], rtol=1e-5)
    after = auto.step(last, random_action(start_state, 8))
    if mode == "Disabled":  # the episode continues and ends again
        np.testing.assert_array_equal(after.info["episode_length"], [1, 0, 0, 0])
        again = auto.restart(after, jnp.asarray(FIRST_WORLD))
        assert not again.info["episode_length"].any()
        np.testing.assert_array_equal(again.memory["EpisodeStatistics"].length[:, 0], [0, 4, 4, 4])
    else:
        assert not after.info["episode_length"].any()
        assert not after.info["episode_return"].any()
        length = 0 if mode == "NextStep" else 1
        np.testing.assert_array_equal(after.memory["EpisodeStatistics"].length[:, 0], [length, 4, 4, 4])


def test_observe_changes_observations_of_resets_steps_and_restarts(env):
    wrapped = Observe(env, lambda obs, data: {"all": flatten(obs), "clock": jnp.full((1, 1), data.core.steps)})
    state = wrapped.reset(jax.random.key(0))
    plain = env.reset(jax.random.key(0))
    for _ in range(2):
        assert set(state.obs) == {"all", "clock"}
        names = ("ang_vel", "difference_to_goal", "pos", "rot", "vel")
        assert_same_world(state.obs["all"], np.concatenate([plain.obs[n] for n in names], axis=-1))
        np.testing.assert_array_equal(state.obs["clock"][:, 0, 0], state.data.core.steps[:, 0])
        state, plain = wrapped.step(state, random_action(plain)), env.step(plain, random_action(plain))
    state, plain = wrapped.restart(state, jnp.asarray(FIRST_WORLD)), env.restart(plain, jnp.asarray(FIRST_WORLD))
    assert_same_world(state.obs["all"], flatten(plain.obs))


def test_observations_are_normalised_by_all_observations_so_far(env):
    wrapped = AutoReset(Normalize(env), "NextStep")
    start_state = wrapped.reset(jax.random.key(0))
    states = [start_state, *random_steps(wrapped, start_state, 9)]
    plain = env.reset(jax.random.key(0))
    seen = [s.obs["pos"] for s in (plain, *random_steps(env, plain, 9))]
    stats = states[-1].memory["Normalize"]["pos"]
    flat = np.concatenate([np.asarray(x, float).reshape(-1, 3) for x in seen])
    # Errors are rounding of float32, and a prior with variance 1 that counts as 1e-4 of the 40 observations.
    np.testing.assert_allclose(stats.mean, flat.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(stats.var, flat.var(axis=0), atol=1e-4)
    expected = (seen[-1] - flat.mean(axis=0)) / np.sqrt(flat.var(axis=0) + 1e-6)
    np.testing.assert_allclose(states[-1].obs["pos"], expected, rtol=1e-3, atol=1e-3)
    # a new episode is normalised by the same statistics, and its first observation is not counted twice
    again = wrapped.restart(states[-1], jnp.asarray(FIRST_WORLD))
    assert trees_equal(again.memory, states[-1].memory)
    np.testing.assert_array_equal(again.obs["pos"][1:], states[-1].obs["pos"][1:])


def test_statistics_that_are_passed_are_not_updated(env):
    statistics = Normalize(env).reset(jax.random.key(0)).memory["Normalize"]
    frozen = Normalize(env, statistics)
    state = frozen.step(frozen.reset(jax.random.key(3)), jnp.zeros((4, 1, 4)))
    assert trees_equal(state.memory["Normalize"], statistics)
    plain = env.step(env.reset(jax.random.key(3)), jnp.zeros((4, 1, 4)))
    np.testing.assert_allclose(state.obs["vel"], statistics["vel"].normalize(plain.obs["vel"]), rtol=1e-6)
    del statistics["vel"]
    with pytest.raises(ConfigError, match="vel is in one of them only"):
        frozen.reset(jax.random.key(0))


def test_noise_has_its_standard_deviation_and_is_reproducible(env):
    std = {"pos": 0.1, "vel": 0.01}
    wrapped = ObservationNoise(env, std)
    noisy, plain = jax.jit(vmap_worlds(wrapped._add_noise)), env.reset(jax.random.key(0))
    seen = {name: [] for name in plain.obs}
    for state in (plain, *random_steps(env, plain, 60)):
        obs = noisy(state.obs, state.data)
        for name, values in seen.items():
            values.append(np.asarray(obs[name] - state.obs[name]))
    for name, values in seen.items():
        noise = np.stack(values)  # (61, 4, 1, k)
        if name not in std:
            assert not noise.any(), name
            continue
        np.testing.assert_allclose(noise.std(), std[name], rtol=0.1)
        np.testing.assert_allclose(noise.mean(), 0.0, atol=0.15 * std[name])
        flat = noise.reshape(len(noise), -1)
        correlation = np.abs(np.corrcoef(flat, rowvar=False) - np.eye(flat.shape[1]))
        assert correlation.max() < 0.6, "the noise of worlds and axes is independent"
    ratio = np.stack(seen["pos"]) / np.stack(seen["vel"])
    assert ratio.std() > 1, "the noise of observations is independent"
    again = wrapped.reset(jax.random.key(0))
    assert trees_equal(again.obs, wrapped.reset(jax.random.key(0)).obs)
    assert not trees_equal(again.obs["pos"], wrapped.reset(jax.random.key(1)).obs["pos"])
    assert_same_world(again.data, plain.data)  # the states have no noise
    restarted = wrapped.restart(again, jnp.asarray(FIRST_WORLD))
    assert trees_equal(restarted.obs["pos"][1:], again.obs["pos"][1:]), "observations of other worlds stay"


def test_noise_of_two_wrappers_is_independent(env):
    wrapped = ObservationNoise(ObservationNoise(env, {"vel": 1.0}), {"ang_vel": 1.0})
    noisy, plain = wrapped.reset(jax.random.key(0)), env.reset(jax.random.key(0))
    noise = [np.asarray(noisy.obs[name] - plain.obs[name]) for name in ("vel", "ang_vel")]
    assert np.abs(noise[0] - noise[1]).min() > 1e-4


def test_frames_are_stacked_oldest_first(env):
    wrapped = FrameStack(env, 3)
    state, plain = wrapped.reset(jax.random.key(0)), env.reset(jax.random.key(0))
    seen = [plain.obs] * 3
    for i in range(4):
        for name, x in state.obs.items():
            assert_same_world(x, np.concatenate([frame[name] for frame in seen[-3:]], axis=-1))
        state, plain = wrapped.step(state, random_action(plain, i)), env.step(plain, random_action(plain, i))
        seen.append(plain.obs)
    restarted = wrapped.restart(state, jnp.asarray(FIRST_WORLD))
    first = env.restart(plain, jnp.asarray(FIRST_WORLD)).obs["pos"][0]
    assert_same_world(restarted.obs["pos"][0], np.tile(first, 3))
    assert trees_equal(select_state(restarted, ~FIRST_WORLD), select_state(state, ~FIRST_WORLD))


def test_delayed_actions_arrive_after_their_steps(env):
    delayed = ActionDelay(env, 2)
    state, plain = delayed.reset(jax.random.key(0)), env.reset(jax.random.key(0))
    sent = [np.zeros_like(plain.action)] * 2
    for i in range(4):
        sent.append(random_action(plain, i))
        state, plain = delayed.step(state, sent[-1]), env.step(plain, sent[i])
        assert_same_world(state.data, plain.data)
        np.testing.assert_array_equal(state.action, sent[i])
    state, plain = delayed.restart(state, jnp.asarray(FIRST_WORLD)), env.restart(plain, jnp.asarray(FIRST_WORLD))
    sent.append(random_action(plain, 9))
    for i in (4, 5):
        action = np.array(sent[i])
        action[0] = 0  # actions of the last episode are discarded
        state, plain = delayed.step(state, sent[6]), env.step(plain, action)
        np.testing.assert_array_equal(state.action, action)
        assert_same_world(state.data, plain.data)


def test_a_wrong_action_is_refused_around_every_wrapper(env):
    for wrapped in (env, ActionDelay(env, 2)):
        state = wrapped.reset(jax.random.key(0))
        with pytest.raises(ValueError, match=r"actions of shape \(4, 1, 4\) = .*, got \(4, 4\)"):
            wrapped.step(state, jnp.zeros((4, 4)))


def draw_masses(data, key):
    """Draw masses between 1 and 2 times the nominal one, for every drone of a world."""
    factor = jax.random.uniform(key, (data.core.n_drones, 1), minval=1.0, maxval=2.0)
    return data.replace(params=data.params.replace(mass=0.0434 * factor))


@pytest.fixture(scope="module")
def randomized(env):
    return RandomizeWith(env, draw_masses, params=("mass",))


@pytest.fixture(scope="module")
def randomized_state(randomized):
    return jax.jit(randomized.reset)(jax.random.key(0))


def test_every_drone_has_its_own_randomised_parameters(env, randomized_state):
    mass = np.asarray(randomized_state.data.params.mass)
    assert mass.shape == (4, 1, 1)
    assert ((mass >= 0.0434) & (mass <= 0.0868)).all()
    assert len(np.unique(mass)) == 4
    assert randomized_state.data.params.J.shape == (3, 3), "parameters that are not named stay shared"
    assert trees_equal(randomized_state.data.states, jax.jit(env.reset)(jax.random.key(0)).data.states)


def test_only_restarted_worlds_are_randomised_again(randomized, randomized_state):
    new = jax.jit(randomized.restart)(randomized_state, jnp.asarray(FIRST_WORLD))
    assert new.data.params.mass[0] != randomized_state.data.params.mass[0]
    assert trees_equal(select_state(new, ~FIRST_WORLD), select_state(randomized_state, ~FIRST_WORLD))


def replace_mass(data, key):
    return data.replace(params=data.params.replace(mass=jnp.float32(0.03)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: Observe(env, None), "a function"),
        (lambda env: Observe(env, lambda obs, data: 1).reset(KEY), "a dict of names to arrays, got 1"),
        (lambda env: Observe(env, lambda obs, data: {}).reset(KEY), "a dict of names to arrays"),
        (lambda env: Observe(env, lambda obs, data: {"z": data.states.pos[:, 2]}).reset(KEY), r"\(n_drones, k\)"),
        (lambda env: RandomizeWith(env, None), "a function"),
        (lambda env: RandomizeWith(env, lambda data, key: None).reset(KEY), "to return the data"),
        (lambda env: RandomizeWith(env, replace_mass, ("mass",)).reset(KEY), r"\(1, 1\) of params.mass.*broadcast_to"),
        (lambda env: RandomizeWith(env, draw_masses, params=("mass", "colour")), "mass.* got colour"),
        (lambda env: RandomizeWith(env, draw_masses).reset(KEY), "params.mass .*all worlds share it.*params="),
        (lambda env: Normalize(env, 5), "stats as a dict"),
        (lambda env: ObservationNoise(env, {"pos": 0.1, "colour": 0.1}).reset(KEY), "observations, .* got colour"),
        (lambda env: AutoReset(env, "sometimes"), "'NextStep', 'SameStep', 'Disabled'"),
        *((lambda env, n=n: FrameStack(env, n), "positive whole number") for n in (0, -1, 1.5, True, "2")),
        (lambda env: ActionDelay(env, 0), "positive whole number"),
        (lambda env: EpisodeStatistics(AutoReset(env)), "without AutoReset"),
        (lambda env: AutoReset(AutoReset(env)), "without AutoReset"),
        (lambda env: env.reset(0), r"random key, got 0.*jax.random.key\(0\)"),
        (lambda env: env.reset(jax.random.PRNGKey(0)), "wrap_key_data"),
        (lambda env: fly(env, key=0), "random key, got 0"),
        (lambda env: fly(env, policy=None), "policy as a function, got None"),
        (lambda env: fly(env, keep="x"), "keep as a function, got 'x'"),
        (lambda env: fly(env, policy=lambda obs, memory, key: obs), "returns .action, memory, extras."),
        (lambda env: fly(env, policy=lambda *args: (jnp.zeros((4, 1, 4)), 5.0, ())), "initial_memory="),
        (lambda env: fly(env, initial_memory=5), r"initial_memory of shape \(4, ...\)"),
    ],
)
def test_law_09_wrong_functions_keys_and_memories_are_named(env, call, message):
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        call(env)


def fly(env, policy=lambda obs, memory, key: (jnp.zeros((4, 1, 4)), memory, ()), key=KEY, **options):
    auto = AutoReset(env)
    return rollout(auto, auto.reset(KEY), policy, key, 3, **options)


def test_one_parameter_may_be_named_without_a_tuple(env):
    assert RandomizeWith(env, lambda data, key: data, params="mass").params == ("mass",)
