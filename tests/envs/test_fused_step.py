"""A step of an environment as one kernel gives what the same step gives as it is written, or says why there is none."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crazysim.envs as envs
from crazysim.engine import fused
from crazysim.envs.wrappers import AutoReset, Wrapper

pytestmark = pytest.mark.skipif(fused.missing("cpu") is not None, reason="there is no C++ compiler")
N = 6


class AsWritten(AutoReset):
    """The same without a kernel for the whole."""

    def whole(self, *_, **__):
        return "it was not asked for"


def both(env, mode="SameStep"):
    return AutoReset(env, mode), AsWritten(env, mode)


def close(found, expected, tolerance=2e-5):
    """Compare two trees: engines may contract a product and a sum, and each step multiplies what that does."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for (path, x), y in zip(jax.tree_util.tree_flatten_with_path(found)[0], jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(path)
        assert (x.shape, x.dtype) == (y.shape, y.dtype), name
        if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance, err_msg=name)


def lopsided(data, keys):
    """Draw products of inertia, which are zero where all drones share them."""
    x = jax.vmap(lambda key: jax.random.uniform(key, (1, 1, 1), minval=2e-6, maxval=4e-6))(keys)
    off = jnp.array([[0.0, 1, 1], [1, 0, 1], [1, 1, 0]])
    inertia = data.params.J + x * off
    return data.replace(params=data.params.replace(J=inertia, J_inv=jnp.linalg.inv(inertia)))


CASES = {
    "hover, same step": (lambda: envs.EpisodeStatistics(envs.make("hover", N, seconds=0.3)), "SameStep"),
    "hover, next step": (
        lambda: envs.FrameStack(envs.Randomize(envs.make("hover", N, seconds=0.3), lopsided, ("J", "J_inv")), 2),
        "NextStep",
    ),
    "race": (lambda: envs.ActionDelay(envs.make("race", N, practice=True), 1), "SameStep"),
    "swarm": (lambda: envs.make("swarm", N, n_drones=3, seconds=0.3), "Disabled"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_whole_step_is_the_step_as_it_is_written(name):
    make, mode = CASES[name]
    one, written = both(make(), mode)
    state = jax.jit(written.reset)(jax.random.key(0))
    assert one.explain(state) == "a step is one kernel"
    step, expected = jax.jit(one.step), jax.jit(written.step)
    ended = 0
    for k in range(40):
        action = jax.random.uniform(jax.random.key(k), state.action.shape, minval=-1, maxval=1)
        after = step(state, action)
        close(after, expected(state, action))
        state, ended = after, ended + int(after.done.sum())
    assert ended or mode == "Disabled", "no episode has ended"


@pytest.fixture(scope="module")
def hover():
    return envs.make("hover", N, seconds=0.3)


def test_a_rollout_in_rows_is_a_loop_of_steps(hover):
    """What a policy sees, what is kept and what remains; and derivatives and vmap of it."""
    one, written = both(hover)
    start = jax.jit(one.reset)(jax.random.key(0))

    def fly(env, gain=1.0):
        def act(state, key):
            noise = jax.random.uniform(key, state.action.shape, minval=-0.3, maxval=0.3)
            return noise - gain * 0.1 * (state.data.states.vel[..., :1] + state.obs["vel"][..., :1])

        keep = lambda s: (s.reward, s.done, s.info["error"], s.data.states.pos)  # noqa: E731
        return envs.rollout(env, start, act, jax.random.key(1), 20, keep)

    close(jax.jit(lambda: fly(one))(), jax.jit(lambda: fly(written))())

    def total(env):
        return lambda gain: fly(env, gain)[1][0].sum()

    slopes = [jax.jit(jax.grad(total(env)))(1.0) for env in (one, written)]
    np.testing.assert_allclose(*slopes, rtol=1e-3)
    gains = jnp.array([0.0, 1.0])
    np.testing.assert_allclose(jax.jit(jax.vmap(total(one)))(gains)[1], jax.jit(total(written))(1.0), rtol=1e-5)


def changed(env, **functions):
    new = envs.DroneEnv(env.sim, dataclasses.replace(env.task, **functions))
    return AutoReset(new)


class Remembers(Wrapper):
    """Pays for what was flown."""

    def step(self, state, action):
        before = state.data.states.pos
        state = self.env.step(state, action)
        return state.replace(reward=jnp.sum(state.data.states.pos - before, axis=-1))


class Twice(Wrapper):
    """Takes two steps for one."""

    def step(self, state, action):
        return self.env.step(self.env.step(state, action), action)


REFUSED = {
    "looks from one world into another": lambda env: changed(
        env, reward=lambda data, action, last: data.states.pos[..., 2] - data.states.pos[..., 2].mean()
    ),
    "does not do the same in every world": lambda env: changed(
        env, reward=lambda data, action, last: data.states.pos[..., 2] + jnp.arange(len(data.states.pos))[:, None]
    ),
    "the data from before the step": lambda env: AutoReset(Remembers(env)),
    "steps its environment 2 times": lambda env: AutoReset(Twice(env)),
    "is not of worlds": lambda env: AutoReset(envs.Normalize(env)),
    "primitive": lambda env: changed(env, reward=lambda data, action, last: jnp.fft.fft(data.states.pos).real[..., 0]),
    "the engine is 'lanes'": lambda env: AutoReset(envs.make("hover", N, engine="lanes")),
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_written_out_is_told_and_runs_as_it_is_written(hover, why):
    env = REFUSED[why](hover)
    state = jax.jit(env.reset)(jax.random.key(0))
    told = env.explain(state)
    assert told.startswith("a step is not one kernel: ")
    assert why in told
    if why == "looks from one world into another":
        after = jax.jit(env.step)(state, state.action)
        np.testing.assert_allclose(np.mean(after.reward), 0, atol=1e-6)
