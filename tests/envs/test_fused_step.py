"""An environment step as one kernel gives what the same step gives unfused, or says why it is not fused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crazysim.envs as envs
from crazysim.core.stage import over_worlds
from crazysim.engine.backends import fused
from crazysim.engine.errors import UnsupportedError
from crazysim.envs.tasks.hover import Hover
from crazysim.envs.wrappers import AutoReset, Wrapper
from crazysim.errors import ConfigError, EngineWarning
from crazysim.pytree import CORE_NDIM_KEY, PyTree, leaf

pytestmark = pytest.mark.skipif(fused.missing("cpu") is not None, reason="there is no C++ compiler")
N = 6


class AsWritten(AutoReset):
    """The same without a kernel for the whole step."""

    def fused_step(self, *_, **__):
        return None


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


def lopsided(data, key):
    """Draw products of inertia, which are zero where all drones share them."""
    x = jax.random.uniform(key, (1, 1, 1), minval=2e-6, maxval=4e-6)
    off = jnp.array([[0.0, 1, 1], [1, 0, 1], [1, 1, 0]])
    inertia = data.params.J + x * off
    return data.replace(params=data.params.replace(J=inertia, J_inv=jnp.linalg.inv(inertia)))


class Bound(Wrapper):
    """Halves rewards by a method that it holds as an attribute."""

    def __init__(self, env):
        super().__init__(env)
        self.halve = self._halve

    def _halve(self, state):
        return state.replace(reward=state.reward / 2)

    def after_step(self, state):
        return self.halve(state)


CASES = {
    "hover, same step": (
        lambda: Bound(envs.EpisodeStatistics(envs.ObservationNoise(envs.make("hover", N, seconds=0.3), {"pos": 0.1}))),
        "SameStep",
    ),
    "hover, next step": (
        lambda: envs.FrameStack(
            envs.ActionDelay(envs.RandomizeWith(envs.make("hover", N, seconds=0.3), lopsided, ("J", "J_inv")), 1), 2
        ),
        "NextStep",
    ),
    "swarm": (lambda: envs.make("swarm", N, n_drones=3, seconds=0.3), "Disabled"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_whole_step_is_the_step_as_it_is_written(name):
    make, mode = CASES[name]
    one, written = both(make(), mode)
    state = jax.jit(written.reset)(jax.random.key(0))
    assert one.explain().startswith("a step is one kernel\nits physics, as in sim.explain():\nengine: fused\n")
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


def test_a_rollout_in_rows_is_a_loop_of_steps():
    """What a policy sees, what is kept and what remains; and derivatives and vmap of it."""
    one, written = both(envs.make("hover", N, seconds=0.3, control="rotor_vel"))
    start = jax.jit(one.reset)(jax.random.key(0))

    def fly(env, gain=1.0):
        # All that a step reads depends on the number that is differentiated: JAX goes through the step once.
        states, obs = jax.tree.map(lambda x: gain * x, (start.data.states, start.obs))
        begun = start.replace(data=start.data.replace(states=states), obs=obs)

        def act(state, key):
            noise = jax.random.uniform(key, state.action.shape, minval=-0.3, maxval=0.3)
            return noise - gain * 0.1 * (state.data.states.vel[..., :1] + state.obs["vel"][..., :1])

        keep = lambda s: (s.reward, s.done, s.info["error"], s.data.states.pos)  # noqa: E731
        return envs.rollout(env, begun, act, jax.random.key(1), 20, keep)

    def total(env):
        def rewarded(gain):
            end, kept = fly(env, gain)
            return kept[0].sum(), (end, kept)

        return rewarded

    # One compilation for each of values, values in a batch, and slopes in reverse; without a kernel, one for all.
    slope_too = jax.jit(lambda gain: jax.jvp(total(written), (gain,), (1.0,), has_aux=True))
    _, expected_slope, expected = slope_too(1.0)
    close(jax.jit(lambda: fly(one))(), expected)
    totals, _ = jax.jit(jax.vmap(total(one)))(jnp.array([0.5, 1.0]))
    np.testing.assert_allclose(totals[1], expected[1][0].sum(), rtol=1e-5)
    slope = jax.jit(jax.grad(lambda gain: total(one)(gain)[0]))(1.0)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-3)


def test_a_rollout_in_rows_takes_the_actions_of_each_step_where_a_wrapper_changes_them():
    one, written = both(envs.ActionDelay(envs.make("hover", N, seconds=0.3, control="rotor_vel"), 2))
    start = jax.jit(one.reset)(jax.random.key(0))

    def act(state, key):
        return jax.random.uniform(key, state.action.shape, minval=-0.3, maxval=0.3)

    keep = lambda s: (s.reward, s.action, s.data.states.vel)  # noqa: E731
    fly = lambda env: jax.jit(lambda: envs.rollout(env, start, act, jax.random.key(1), 20, keep))()  # noqa: E731
    close(fly(one), fly(written))


class Remembered(PyTree):
    """Memory whose leaves declare their axes."""

    of_drones: jax.Array = leaf("drone")
    of_world: jax.Array = leaf("world", 1)


class Remembers(Wrapper):
    """Remembers as many numbers of the world as there are drones, and one for each drone."""

    def after_reset(self, state):
        return self.remember(state, (jnp.zeros(2), Remembered(jnp.zeros(2), jnp.zeros(2))))

    def after_step(self, state):
        plain, record = self.recall(state)
        height = state.data.states.pos[:, 2]
        return self.remember(state, (plain + height, Remembered(record.of_drones + height, record.of_world - height)))


class Confused(Wrapper):
    """Returns observations of the world."""

    def after_reset(self, state):
        return state.replace(obs={"pos": state.data.states.pos[0]})

    after_step = after_reset


def test_law_02_memory_is_of_drones_where_it_is_declared_so():
    """An axis that is as long as there are drones is not theirs."""
    env = envs.make("hover", N, n_drones=2, control="rotor_vel")
    one, written = both(Remembers(env), "Disabled")
    state = jax.jit(written.reset)(jax.random.key(0))
    fused_step = one.fused_step(state, state.action)
    scopes = {x.name: x.scope for x in fused_step.program.leaves if ".memory" in x.name}
    assert sorted(scopes.values()) == ["drone", "world", "world"]
    after = jax.jit(fused_step)(state, state.action)
    close(after, jax.jit(written.step)(state, state.action))
    assert after.memory["Remembers"][1].of_world.shape == (N, 1, 2)
    state = jax.eval_shape(Confused(env).reset, jax.random.key(0))
    with pytest.raises(ConfigError, match=r"expected obs\['pos'\] of shape \(n_drones, ...\).* 2 drones, got \(3,\)"):
        AutoReset(Confused(env)).fused_step(state, state.action)


class Fourier(Hover):
    """Rewards by an operation that the engine does not have."""

    def rewards(self, data, *_):
        return {"spectrum": jnp.fft.fft(data.states.pos).real[..., 0]}


class Ranked(Hover):
    """Rewards a drone's height over the mean of all worlds."""

    batched = True

    def spawn(self, data, key):
        return over_worlds(super().spawn)(data, key)

    def terminated(self, data):
        return over_worlds(super().terminated)(data)

    def rewards(self, data, *_):
        height = data.states.pos[..., 2]
        return {"height": height - height.mean()}


def with_reset_stage(env):
    sim = envs.make("hover", N).sim
    sim.reset_pipeline["own"] = lambda data, default, mask: data
    return AutoReset(envs.DroneEnv(sim, env.task))


def with_other_defaults(env):
    sim = envs.make("hover", N).sim
    pos = sim.data.states.pos.at[0, 0, 0].set(1.0)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    sim.build_default_data()
    return AutoReset(envs.DroneEnv(sim, env.task))


class Numbers(PyTree):
    """Numbers of worlds."""

    number: jax.Array = leaf("world")


def with_the_numbers_of_worlds(env):
    """Return an environment with a record that holds the array of ``core.world_id``."""
    sim = envs.make("hover", N).sim
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"numbers": Numbers(sim.data.core.world_id)})
    sim.build_default_data()
    return AutoReset(envs.DroneEnv(sim, env.task))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Counts:
    """A record of another library, which declares its axes as Crazyflow does."""

    count: jax.Array = dataclasses.field(metadata={CORE_NDIM_KEY: 0})


def with_foreign_record(env):
    sim = envs.make("hover", N).sim
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"counts": Counts(jnp.zeros(N))})
    sim.build_default_data()
    return AutoReset(envs.DroneEnv(sim, env.task))


REFUSED = {
    "a record in data.plugins is of another library": with_foreign_record,
    "task 'hover' is declared to need all worlds at once": lambda env: AutoReset(envs.DroneEnv(env.sim, Ranked())),
    "wrapper 'Normalize' is declared to need all worlds at once": lambda env: AutoReset(envs.Normalize(env)),
    "a stage of one world is unrolled for at most 8 drones": lambda _: AutoReset(envs.make("swarm", 2, n_drones=9)),
    "the engine is 'lanes'": lambda env: AutoReset(envs.make("hover", N, engine="lanes")),
    "'own' of the reset pipeline takes all worlds at once": with_reset_stage,
    "episodes begin from different data in different worlds": with_other_defaults,
    "different data in different worlds": with_the_numbers_of_worlds,
}


@pytest.mark.parametrize("why", REFUSED)
def test_a_step_that_is_not_one_kernel_says_why_in_one_line(hover, why):
    env = REFUSED[why](hover)
    line, engine = env.explain().split("\n")[0:3:2]
    assert line.startswith("a step is not one kernel: ")
    assert engine.startswith("engine: ")
    assert why in line


def test_a_step_that_the_engine_cannot_lower_warns_once_or_raises(hover):
    env = AutoReset(envs.DroneEnv(hover.sim, Fourier()))
    with pytest.warns(
        EngineWarning, match=r"environment steps run unfused: primitive .*complex64 \(stage 'observations'"
    ):
        line = env.explain()
    assert line.startswith("a step is not one kernel: primitive ")
    assert env.explain() == line  # without another warning, which would be an error here
    strict = AutoReset(envs.DroneEnv(envs.make("hover", N, strict=True).sim, Fourier()))
    with pytest.raises(UnsupportedError, match="complex64"):
        strict.explain()


def test_every_environment_explains_its_step(hover):
    """One without automatic resets is not one kernel; those of other libraries have it inside."""
    assert hover.explain().startswith("a step is not one kernel: it begins no new episodes. AutoReset(env)")
    for adapted in (
        envs.DroneVectorEnv(hover),
        envs.BraxEnv(hover),
        envs.DroneSingleEnv(envs.make("hover")),
        envs.make_parallel("swarm", n_drones=2),
    ):
        assert "engine: fused" in adapted.explain()
    assert envs.DroneVectorEnv(hover).explain().startswith("a step is one kernel\n")


def test_a_task_of_all_worlds_is_rewarded_across_them(hover):
    env = REFUSED["task 'hover' is declared to need all worlds at once"](hover)
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, state.action)
    height = after.data.states.pos[..., 2]
    np.testing.assert_allclose(after.reward, height - height.mean(), atol=1e-6)
    np.testing.assert_allclose(np.mean(after.reward), 0, atol=1e-6)


@pytest.mark.parametrize("make", [with_reset_stage, with_other_defaults])
def test_episodes_begin_as_the_simulation_resets(hover, make):
    """What takes all worlds at once still takes part in every reset."""
    env = make(hover)
    if make is with_reset_stage:
        lift = lambda data, default, mask: data.replace(  # noqa: E731
            controls=data.controls.replace(rotor_vel=data.controls.rotor_vel + 7.0)
        )
        env.sim.reset_pipeline["own"] = lift
        env = AutoReset(envs.DroneEnv(env.sim, env.task))
    state = jax.jit(env.reset)(jax.random.key(0))
    if make is with_reset_stage:
        np.testing.assert_array_equal(state.data.controls.rotor_vel, 7.0)
    else:
        fresh = np.asarray(jax.jit(env.base.default_of)(state.data).states.pos)
        np.testing.assert_array_equal(fresh[:, 0, 0], [1.0, *np.zeros(N - 1)])


def test_records_of_other_libraries_are_reset_with_their_world(hover):
    env = with_foreign_record(hover)
    state = jax.jit(env.reset)(jax.random.key(0))
    data = state.data.replace(plugins=state.data.plugins | {"counts": Counts(jnp.ones(N))})
    mask = np.arange(N) == 1
    after = jax.jit(env.restart)(state.replace(data=data), mask)
    np.testing.assert_array_equal(after.data.plugins["counts"].count, ~mask)


class Buggy(Hover):
    """Adds what cannot be added, in a method that is not traced when the environment is made."""

    def before_step(self, data):
        return data.replace(states=data.states.pos[..., 2] + None)


def test_a_bug_in_a_task_is_not_taken_for_a_step_that_cannot_be_fused(hover):
    env = AutoReset(envs.DroneEnv(hover.sim, Buggy()))
    state = jax.eval_shape(env.reset, jax.random.key(0))
    with pytest.raises(TypeError, match="NoneType"):
        env.explain()
    with pytest.raises(TypeError, match="NoneType"):
        jax.eval_shape(env.step, state, state.action)
