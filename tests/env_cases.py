"""Helpers of tests of environments: environments compiled once, states near an episode's end, parts of a state."""

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
from cases import leaf_on_host

from crazysim.engine.pytree import map_batched
from crazysim.envs import TASKS, AutoReset, make


class CompiledEnv:
    """An environment whose functions are compiled once, for tests that call them from Python and compare bits."""

    def __init__(self, env):
        self.env = env
        self.traces = collections.Counter()
        """Number of times that Python ran each of the functions."""
        for name in ("reset", "restart", "step"):
            setattr(self, name, jax.jit(self._counted(name, getattr(env, name))))

    def __getattr__(self, name):
        return getattr(self.env, name)

    def _counted(self, name, fn):
        def counted(*args):
            self.traces[name] += 1
            return fn(*args)

        return counted


@functools.cache
def make_compiled_env(name="hover", n_worlds=4, mode=None):
    """Return an environment of a task with its usual settings, with automatic resets if there is a mode.

    Its steps are interpreted: a kernel would take longer to compile than the tests take.
    """
    env = make(name, n_worlds, engine="interpret")
    return CompiledEnv(env if mode is None else AutoReset(env, mode))


def random_action(state, seed=0):
    """Return actions, some of them beyond the limits, on the host. (n_worlds, n_drones, k)"""
    return np.random.default_rng(seed).uniform(-1.2, 1.2, state.action.shape).astype(np.float32)


def set_last_step(env, state, mask):
    """Return the state with the clock of some worlds set to one step before the time runs out."""
    core = state.data.core
    steps = jnp.where(jnp.asarray(mask)[:, None], (env.max_steps - 1) * env.n_substeps, core.steps)
    return state.replace(data=state.data.replace(core=core.replace(steps=steps.astype(core.steps.dtype))))


def array_types(tree):
    """Return structure, shapes and types of a tree, including weak types."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(x.shape, x.dtype, getattr(x, "weak_type", False)) for x in leaves]


def select_state(state, mask, without=()):
    """Return the part of a state that belongs to some worlds, without some of its fields."""
    data = map_batched(lambda x: leaf_on_host(x)[mask], state.data)
    names = {"obs", "reward", "terminated", "truncated", "action", "info", "memory"} - set(without)
    fields = {name: getattr(state, name) for name in sorted(names)}
    return data, jax.tree.map(lambda x: leaf_on_host(x)[mask], fields)


def select_obs(state, mask):
    return jax.tree.map(lambda x: leaf_on_host(x)[mask], state.obs)


def task_names(one_per_class=False):
    return list({TASKS[name].task: name for name in reversed(TASKS)}.values() if one_per_class else TASKS)
