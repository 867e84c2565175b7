"""Law 7 for what a user hands over inside ``jit``: NaN and infinity end the world, and change no other.

Outside of ``jit`` such values are errors. Inside, nothing can raise: the world is flagged as nonfinite, its episode
ends, and the next episode is as if nothing had happened.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import leaf_on_host
from env_cases import random_action

from crazysim import IMU, Battery, Cars, ConfigError, MotionCapture, RangeFinder, Sim, SlungLoad, Wind
from crazysim.core.plugin import Plugin
from crazysim.engine.pytree import PyTree, host_array, leaf, scopes
from crazysim.envs import ActionDelay, AutoReset, EpisodeStatistics, FrameStack, ObservationNoise, make

N_WORLDS = 512
"""Worlds of a simulation or an environment, of which odd ones get bad values, and even ones must stay as they are."""
BAD = (np.nan, np.inf, -np.inf)


def batched_floats(tree):
    leaf_scopes, leaves = jax.tree.leaves(scopes(tree)), jax.tree.leaves(tree)
    return [i for i, (scope, x) in enumerate(zip(leaf_scopes, leaves, strict=True))
            if scope not in ("shared", "opaque") and jnp.issubdtype(x.dtype, jnp.floating)]  # fmt: skip


def poison(tree, values):
    """Return a tree in which every number of some leaves and worlds is a value, by the leaf's index and the world."""
    leaves, treedef = jax.tree.flatten(tree)
    for i in {i for i, _ in values}:
        leaves[i] = np.array(leaves[i])
    for (i, world), value in values.items():
        leaves[i][world] = value
    return treedef.unflatten(leaves)


def assert_worlds_equal(tree, expected, worlds):
    leaf_scopes = jax.tree.leaves(scopes(tree))
    paths = jax.tree_util.tree_leaves_with_path(tree)
    for scope, (path, x), y in zip(leaf_scopes, paths, jax.tree.leaves(expected), strict=True):
        if scope not in ("shared", "opaque"):
            x, y = leaf_on_host(x), leaf_on_host(y)
            np.testing.assert_array_equal(x[worlds], y[worlds], err_msg=jax.tree_util.keystr(path))


def cases_by_world(tree, values):
    """Return the index of a leaf of floats and a value for each odd world, until all leaves have had all values."""
    cases = dict(zip(range(1, N_WORLDS, 2), itertools.product(batched_floats(tree), values)))  # noqa: B905
    assert len(cases) == len(values) * len(batched_floats(tree)) < N_WORLDS // 2
    return cases


@pytest.mark.long("compiles a simulation with many plugins")
def test_a_bad_value_in_the_data_flags_its_world_or_vanishes():
    """What no stage writes may stay as it is, if nothing reads it: poses of objects, and parameters without use."""
    plugins = [Battery(), Wind((1.0, 0, 0)), RangeFinder(), IMU(delay=0.004), MotionCapture(freq=250), SlungLoad(0.005),
               Cars(1)]  # fmt: skip
    sim = Sim(N_WORLDS, 2, control="attitude", plugins=plugins, engine="interpret")
    data, fly = sim.data, jax.jit(lambda data: sim.step_fn(data, 2))
    clean, cases = fly(data), cases_by_world(data, BAD)
    after = fly(poison(data, {(i, world): value for world, (i, value) in cases.items()}))
    assert_worlds_equal(after, clean, np.arange(0, N_WORLDS, 2))
    watched, flagged = after.roles().watched, np.asarray(after.core.nonfinite)[:, 0]
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(after)]
    starts, ends, cleans = ([np.asarray(leaf_on_host(x)) for x in jax.tree.leaves(t)] for t in (data, after, clean))
    tests = {k: np.isfinite if watched.get(k) else lambda x: ~np.isnan(x) for k in batched_floats(after)}
    for world, (i, value) in cases.items():
        bad = {names[k] for k, is_valid in tests.items() if not is_valid(ends[k][world]).all()}
        is_written = not np.array_equal(starts[i], cleans[i])
        unread = set() if i in watched and is_written else {names[i]}
        assert flagged[world] or bad <= unread, f"{names[i]} set to {value} is silent in {bad}"
    assert flagged.any()
    assert not flagged[::2].any()


@functools.cache
def environment(task, mode):
    env = make(task, N_WORLDS, engine="interpret")
    env = (
        EpisodeStatistics(FrameStack(ActionDelay(ObservationNoise(env, {"pos": 0.01}), 1), 2))
        if task == "hover"
        else env
    )
    env = AutoReset(env, mode)
    state = env.reset(jax.random.key(0))
    step = jax.jit(env.step)
    action = random_action(state)
    return env, state, step, action, step(state, action)


def test_a_goal_that_is_not_finite_ends_the_episode_in_jit():
    env, state, step, action, _ = environment("hover", "NextStep")
    goals = np.broadcast_to(np.float32([0.5, 0.5, 1.0]), state.full_data.states.pos.shape).copy()
    set_goal = jax.jit(env.set_goal)
    clean = step(set_goal(state, goals), action)
    for world, value in zip(BAD_WORLDS, BAD, strict=True):
        with pytest.raises(ConfigError, match="expected pos"):
            env.set_goal(state, np.full(3, value))
        goals[world, 0, 0] = value
    assert_end_and_heal(step(set_goal(state, goals), action), clean, step, action)


BAD_WORLDS = (1, 3, 5)
"""Worlds whose goals or actions are not finite."""


def assert_end_and_heal(after, clean, step, action):
    flagged = np.asarray(after.info["nonfinite"])
    np.testing.assert_array_equal(np.flatnonzero(flagged), BAD_WORLDS)
    assert after.done[flagged].all()
    assert_worlds_equal(after, clean, ~flagged)
    for x in jax.tree.leaves((after.obs, after.reward, after.final_obs)):
        assert np.isfinite(x).all()
    later = step(step(after, action), action)
    assert not later.info["nonfinite"].any()
    for x in jax.tree.leaves((later.obs, later.reward)):
        assert np.isfinite(x).all()


@pytest.mark.parametrize("task, mode", [("hover", "NextStep"), ("race", "SameStep")])
def test_any_bad_value_in_a_state_ends_its_episode_or_vanishes(task, mode):
    _, state, step, action, clean = environment(task, mode)
    cases = cases_by_world(state, BAD[:2])
    after = step(poison(state, {(i, world): value for world, (i, value) in cases.items()}), action)
    paths = jax.tree_util.tree_leaves_with_path(state)

    def bad_cases(tree):
        leaves = jax.tree.leaves(tree)
        bad = sorted({int(k) for x in leaves for k in np.argwhere(~np.isfinite(x))[:, 0]})
        return [(jax.tree_util.keystr(paths[cases[k][0]][0]), cases[k][1], bool(flagged[k])) for k in bad]

    flagged = np.asarray(after.info["nonfinite"])
    assert flagged.any()
    assert set(np.flatnonzero(flagged)) <= set(cases)
    assert after.done[flagged].all()
    assert_worlds_equal(after, clean, np.arange(0, N_WORLDS, 2))
    assert not bad_cases((after.obs, after.reward, after.final_obs))
    assert not [case for case in bad_cases(after.full_data.states) if not case[2]]
    following = step(after, action)
    assert not bad_cases(following.obs)
    later = step(following, action)
    assert not later.info["nonfinite"][flagged].any()
    assert not [case for case in bad_cases((later.obs, later.reward)) if case[2]]


def test_an_action_that_is_not_finite_ends_the_episode():
    env, state, step, action, clean = environment("race", "SameStep")
    bad = action.copy()
    for world, value in zip(BAD_WORLDS, BAD, strict=True):
        one = action.copy()
        one[world] = bad[world] = value
        with pytest.raises(ConfigError, match=rf"expected finite actions, got NaN or infinity in world.s. .{world}"):
            env.step(state, one)
    assert_end_and_heal(step(state, bad), clean, step, action)


class Best(PyTree):
    value: object = leaf("drone")


class KeepBest(Plugin):
    name: str = "best"
    start: object = np.inf

    def record(self, sim):
        return Best(host_array(self.start, sim.n_worlds, sim.n_drones))


def test_a_record_that_begins_with_nan_is_refused():
    """Infinity is a usual start of a smallest value; NaN would flag every world."""
    with pytest.raises(ConfigError, match=r"KeepBest 'best': expected numbers in \.value, got NaN"):
        Sim(plugins=[KeepBest(start=np.nan)])
    sim = Sim(plugins=[KeepBest()], engine="plain")
    sim.step()
    assert not sim.data.core.nonfinite.any()
