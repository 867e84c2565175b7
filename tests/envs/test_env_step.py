"""The step and the rollout of an environment: the same on every engine, and split only where ``explain`` says so."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crazysim.envs as envs
from crazysim import Sim
from crazysim.core.pipeline import append_fn
from crazysim.engine.backends import fused
from crazysim.engine.pytree import CORE_NDIM_KEY, PyTree, leaf
from crazysim.engine.stage import vmap_worlds
from crazysim.envs.tasks.hover import Hover
from crazysim.envs.wrappers import AutoReset, Wrapper
from crazysim.errors import ConfigError, EngineWarning
from crazysim.sim import rollout

pytestmark = pytest.mark.skipif(fused.unavailable_reason("cpu") is not None, reason="there is no C++ compiler")
N_WORLDS = 6


def assert_close(actual, expected, tolerance=2e-5):
    """Compare two trees: engines may contract a product and a sum, and the difference grows from step to step."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for (path, x), y in zip(jax.tree_util.tree_flatten_with_path(actual)[0], jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(path)
        assert (x.shape, x.dtype) == (y.shape, y.dtype), name
        if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance, err_msg=name)


def draw_products_of_inertia(data, key):
    """Draw products of inertia, which are zero where all drones share them."""
    x = jax.random.uniform(key, (1, 1, 1), minval=2e-6, maxval=4e-6)
    is_off_diagonal = jnp.array([[0.0, 1, 1], [1, 0, 1], [1, 1, 0]])
    inertia = data.params.J + x * is_off_diagonal
    return data.replace(params=data.params.replace(J=inertia, J_inv=jnp.linalg.inv(inertia)))


class HalfRewards(Wrapper):
    """Halves rewards by a bound method that is an attribute."""

    def __init__(self, env):
        super().__init__(env)
        self.halve = self._halve

    def _halve(self, state):
        return state.replace(reward=state.reward / 2)

    def after_step(self, state):
        return self.halve(state)


def wrapped_hover(engine):
    env = envs.make("hover", N_WORLDS, seconds=0.3, engine=engine)
    env = envs.RandomizeWith(env, draw_products_of_inertia, ("J", "J_inv"))
    env = HalfRewards(envs.EpisodeStatistics(envs.ObservationNoise(env, {"pos": 0.1})))
    return AutoReset(envs.FrameStack(envs.ActionDelay(env, 1), 2), "NextStep")


def swarm(engine):
    return AutoReset(envs.make("swarm", N_WORLDS, n_drones=3, seconds=0.3, engine=engine), "Disabled")


def normalised_hover(engine):
    """Return an environment whose step is split by a wrapper of all worlds."""
    return AutoReset(envs.Normalize(envs.make("hover", N_WORLDS, seconds=0.3, engine=engine)), "SameStep")


@pytest.mark.long("compiles each case for two engines")
@pytest.mark.parametrize(
    ("make", "engine"),
    [(wrapped_hover, "fused"), (swarm, "interpret"), (normalised_hover, "lanes")],
)
def test_an_engine_steps_an_environment_like_the_reference(make, engine):
    env, reference = make(engine), make("plain")
    state, reference_step = jax.jit(reference.reset)(jax.random.key(0)), jax.jit(reference.step)
    assert env.explain().startswith(f"engine: {engine}")
    assert ("splits the step" in env.explain()) == (make is normalised_hover)
    step = jax.jit(env.step)
    n_ended = 0
    for k in range(40):
        action = jax.random.uniform(jax.random.key(k), state.action.shape, minval=-1, maxval=1)
        after = step(state, action)
        assert_close(after, reference_step(state, action))
        state, n_ended = after, n_ended + int(after.done.sum())
    assert n_ended or make is swarm, "no episode has ended"


@pytest.fixture(scope="module")
def hover():
    return envs.make("hover", N_WORLDS, seconds=0.3)


@pytest.mark.long("compiles a rollout and a loop, and derivatives of both")
def test_a_rollout_is_a_loop_of_steps(hover):
    """Observations of the policy, recorded values and the last state are equal, and so are derivatives and ``vmap``."""
    env = AutoReset(envs.make("hover", N_WORLDS, seconds=0.3, control="rotor_vel"))
    start = jax.jit(env.reset)(jax.random.key(0))
    key = jax.random.key(1)

    def act(gain, obs, memory, key):
        noise = jax.random.uniform(key, (N_WORLDS, 1, 4), minval=-0.3, maxval=0.3)
        return noise - gain * (0.1 * obs["vel"][..., :1] + memory[:, None, None]), memory + 0.01, memory

    def fly(gain):
        policy = lambda obs, memory, key: act(gain, obs, memory, key)  # noqa: E731
        keep = lambda t: (t.reward, t.done, t.state.info["error"], t.final_obs["pos"], t.extras, t.action)  # noqa: E731
        return envs.rollout(env, start, policy, key, 20, keep, jnp.zeros(N_WORLDS))

    def loop(gain):
        def step(carry, key):
            state, memory = carry
            action, memory, extras = act(gain, state.obs, memory, key)
            state = env.step(state, action)
            memory = jnp.where(state.done, 0.0, memory)
            recorded = state.reward, state.done, state.info["error"], state.info["final_obs"]["pos"], extras, action
            return (state, memory), recorded

        (state, memory), recorded = jax.lax.scan(step, (start, jnp.zeros(N_WORLDS)), jax.random.split(key, 20))
        return state, memory, recorded

    actual, expected = jax.jit(fly)(1.0), jax.jit(loop)(1.0)
    assert_close(actual, expected)
    assert expected[2][1].any(), "no episode has ended"
    slopes = [jax.jit(jax.grad(lambda gain, f=f: f(gain)[2][0].sum()))(1.0) for f in (fly, loop)]
    np.testing.assert_allclose(*slopes, rtol=1e-3)
    totals = jax.jit(jax.vmap(lambda gain: fly(gain)[2][0].sum()))(jnp.array([0.5, 1.0]))
    np.testing.assert_allclose(totals[1], expected[2][0].sum(), rtol=1e-5)


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_the_memory_of_a_policy_is_reset_with_an_episode(mode):
    env = AutoReset(envs.make("hover", 3, seconds=0.06, engine="interpret"), mode)  # three steps
    start = env.reset(jax.random.key(0))
    policy = lambda obs, memory, key: (jnp.zeros((3, 1, 4)), memory + 1, memory)  # noqa: E731
    keep = lambda t: (t.extras, t.state.data.core.steps[:, 0])  # noqa: E731
    _, last, (memory, steps) = envs.rollout(
        env, start, policy, jax.random.key(0), 8, keep, jnp.zeros(3), jnp.zeros(3) + 5
    )
    expected = {
        "SameStep": [5, 6, 7, 0, 1, 2, 0, 1],
        "NextStep": [5, 6, 7, 8, 0, 1, 2, 3],
        "Disabled": [5, 6, 7, 8, 9, 10, 11, 12],
    }
    np.testing.assert_array_equal(memory, np.broadcast_to(np.array(expected[mode])[:, None], (8, 3)))
    if mode != "Disabled":
        np.testing.assert_array_equal(np.diff(steps, axis=0)[:-1] < 0, np.diff(memory, axis=0)[1:] < 0)
    assert last.shape == (3,)


class DeclaredMemory(PyTree):
    """Memory whose leaves declare their axes."""

    of_drones: jax.Array = leaf("drone")
    of_world: jax.Array = leaf("world", 1)


class WithMemory(Wrapper):
    """Remembers as many numbers of the world as there are drones, and one for each drone."""

    def after_reset(self, state):
        return self.remember(state, (jnp.zeros(2), DeclaredMemory(jnp.zeros(2), jnp.zeros(2))))

    def after_step(self, state):
        plain, record = self.recall(state)
        height = state.data.states.pos[:, 2]
        return self.remember(
            state, (plain + height, DeclaredMemory(record.of_drones + height, record.of_world - height))
        )


class WorldObservations(Wrapper):
    """Returns observations without the axis of drones."""

    def after_reset(self, state):
        return state.replace(obs={"pos": state.data.states.pos[0]})

    after_step = after_reset


class WithInfo(Wrapper):
    """Adds entries of ``info``: one of the world, one of drones, and with ``has_wrong_entry`` one that is neither."""

    def __init__(self, env, has_wrong_entry=False):
        super().__init__(env)
        self.has_wrong_entry = has_wrong_entry

    def after_step(self, state):
        extra_info = {"n": jnp.float32(2), "each": state.data.states.pos}
        return state.replace(info=state.info | extra_info | ({"three": jnp.zeros(3)} if self.has_wrong_entry else {}))


def test_law_02_entries_of_a_state_are_of_worlds_or_drones_as_declared():
    """An axis whose length is the number of drones is not an axis of drones, unless it is declared."""
    env = envs.make("hover", N_WORLDS, n_drones=2, control="rotor_vel", engine="interpret")
    auto = AutoReset(WithInfo(WithMemory(env)), "Disabled")
    state = auto.reset(jax.random.key(0))
    after = auto.step(state, state.action)
    assert jax.tree.structure(state) == jax.tree.structure(after)
    scopes = {x.name: x.scope for x in auto.step_fn.plan(state.full_data).program.leaves if ".memory" in x.name}
    assert sorted(scopes.values()) == ["drone", "world", "world"]
    plain, record = after.memory["WithMemory"]
    assert (plain.shape, record.of_drones.shape, record.of_world.shape) == (
        (N_WORLDS, 2),
        (N_WORLDS, 2),
        (N_WORLDS, 1, 2),
    )
    assert (after.info["n"].shape, after.info["each"].shape) == ((N_WORLDS,), (N_WORLDS, 2, 3))
    for wrong, message in (
        (WorldObservations(env), r"expected obs\['pos'\] of shape \(n_drones, ...\).* 2 drones, got \(3,\)"),
        (
            WithInfo(env, has_wrong_entry=True),
            r"expected info\['three'\] as one number of a world, .* one row for each of 2 drones",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            wrong.reset(jax.random.key(0))


class Fourier(Hover):
    """Rewards by an operation that the engine does not have."""

    def rewards(self, data, *_):
        return {"spectrum": jnp.fft.fft(data.states.pos).real[..., 0]}


class Ranked(Hover):
    """Rewards a drone's height over the mean of all worlds."""

    batched = True

    def spawn(self, data, key):
        return vmap_worlds(super().spawn)(data, key)

    def terminated(self, data):
        return vmap_worlds(super().terminated)(data)

    def rewards(self, data, *_):
        height = data.states.pos[..., 2]
        return {"height": height - height.mean()}


def with_reset_stage(env):
    sim = envs.make("hover", N_WORLDS).sim
    sim.reset_pipeline["own"] = lambda data, default, mask: data
    return AutoReset(envs.DroneEnv(sim, env.task))


def with_other_defaults(env):
    sim = envs.make("hover", N_WORLDS).sim
    pos = sim.data.states.pos.at[0, 0, 0].set(1.0)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    sim.build_default_data()
    return AutoReset(envs.DroneEnv(sim, env.task))


class WorldNumbers(PyTree):
    """Numbers of the worlds."""

    number: jax.Array = leaf("world")


def with_world_numbers(env):
    """Return an environment with a record that holds the array of ``core.world_id``."""
    sim = envs.make("hover", N_WORLDS).sim
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"numbers": WorldNumbers(sim.data.core.world_id)})
    sim.build_default_data()
    return AutoReset(envs.DroneEnv(sim, env.task))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Counts:
    """A record of another library, which declares its axes as Crazyflow does."""

    count: jax.Array = dataclasses.field(metadata={CORE_NDIM_KEY: 0})


def with_foreign_record(env):
    sim = envs.make("hover", N_WORLDS).sim
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"counts": Counts(jnp.zeros(N_WORLDS))})
    sim.build_default_data()
    return AutoReset(envs.DroneEnv(sim, env.task))


SPLIT_STEPS = {
    "a record in data.plugins is of another library": with_foreign_record,
    "task 'hover' is declared to need all worlds at once": lambda env: AutoReset(envs.DroneEnv(env.sim, Ranked())),
    "wrapper 'Normalize' is declared to need all worlds at once": lambda env: AutoReset(envs.Normalize(env)),
    "a stage of one world is unrolled for at most 8 drones": lambda _: AutoReset(envs.make("swarm", 2, n_drones=9)),
    "'own' of the reset pipeline takes all worlds at once": with_reset_stage,
    "episodes begin from different data in different worlds": with_other_defaults,
    "different data in different worlds": with_world_numbers,
}
"""Functions that make an environment from ``hover``, by the reason why its step is split."""


@pytest.mark.parametrize("reason", SPLIT_STEPS)
def test_a_step_that_is_split_says_where_and_why(hover, reason):
    env = SPLIT_STEPS[reason](hover)
    text = env.explain()
    assert text.startswith("engine: fused\n")
    assert reason in next(line for line in text.split("\n") if line.startswith("splits the step: "))


def test_a_step_that_the_engine_cannot_lower_warns_once_or_raises(hover):
    env = AutoReset(envs.DroneEnv(hover.sim, Fourier()))
    with pytest.warns(EngineWarning, match=r"stage 'observe' is not fused: .*complex64"):
        text = env.explain()
    assert "splits the step: 'observe' is not fused" in text
    assert env.explain() == text  # without another warning, which would be an error here
    strict = AutoReset(envs.DroneEnv(envs.make("hover", N_WORLDS, strict=True).sim, Fourier()))
    with pytest.raises(ConfigError, match="complex64"):
        strict.explain()


@pytest.mark.long("plans the steps of four environments")
def test_environments_of_other_libraries_explain_their_steps(hover):
    for env in (
        envs.DroneVectorEnv(hover),
        envs.BraxEnv(hover),
        envs.DroneSingleEnv(envs.make("hover")),
        envs.make_parallel("swarm", n_drones=2),
    ):
        text = env.explain()
        assert text.startswith("engine: fused\n")
        assert "observe" in text
        assert "splits" not in text


def test_a_task_of_all_worlds_is_rewarded_across_them(hover):
    env = SPLIT_STEPS["task 'hover' is declared to need all worlds at once"](hover)
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, state.action)
    height = after.data.states.pos[..., 2]
    np.testing.assert_allclose(after.reward, height - height.mean(), atol=1e-6)
    np.testing.assert_allclose(np.mean(after.reward), 0, atol=1e-6)


@pytest.mark.parametrize("make", [with_reset_stage, with_other_defaults])
def test_episodes_begin_as_the_simulation_resets(hover, make):
    """Reset stages and default data of all worlds are used in every reset."""
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
        fresh = np.asarray(jax.jit(env.base.episode_reset.make_default)(state.data).states.pos)
        np.testing.assert_array_equal(fresh[:, 0, 0], [1.0, *np.zeros(N_WORLDS - 1)])


def test_records_of_other_libraries_are_reset_with_their_world(hover):
    env = with_foreign_record(hover)
    state = jax.jit(env.reset)(jax.random.key(0))
    data = state.data.replace(plugins=state.data.plugins | {"counts": Counts(jnp.ones(N_WORLDS))})
    mask = np.arange(N_WORLDS) == 1
    after = jax.jit(env.restart)(state.replace(data=data), mask)
    np.testing.assert_array_equal(after.data.plugins["counts"].count, ~mask)


class Buggy(Hover):
    """Adds None to an array, in a method that is not traced when the environment is made."""

    def before_step(self, data):
        return data.replace(states=data.states.pos[..., 2] + None)


def test_a_bug_in_a_task_is_raised_as_it_is(hover):
    env = AutoReset(envs.DroneEnv(hover.sim, Buggy()))
    with pytest.raises(TypeError, match="NoneType"):
        jax.eval_shape(env.reset, jax.random.key(0))


class StartInfo(Wrapper):
    """Sets an entry of ``info`` only at the start of an episode."""

    def after_reset(self, state):
        return state.replace(info=state.info | {"start": state.data.states.pos})


@pytest.mark.parametrize("mode", ["Disabled", "SameStep"])
def test_info_that_only_a_reset_sets_stays(mode):
    vec = envs.DroneVectorEnv(StartInfo(envs.make("hover", 2, engine="interpret")), mode)
    _, start_state = vec.reset(seed=0)
    _, _, _, _, info = vec.step(np.zeros((2, 4), np.float32))
    np.testing.assert_array_equal(info["start"], start_state["start"])


def test_a_restart_observes_the_episodes_that_it_begins():
    env = AutoReset(envs.make("hover", 2, engine="interpret"))
    state = env.step(env.reset(jax.random.key(0)), np.zeros((2, 1, 4), np.float32))
    after = env.restart(state, np.array([True, False]))
    for name, x in after.obs.items():
        np.testing.assert_array_equal(after.final_obs[name][0], x[0])


def test_two_wrappers_of_one_class_have_separate_memories():
    env = envs.make("hover", 1, engine="interpret")
    two_wrappers, one_wrapper = (
        AutoReset(x) for x in (envs.ActionDelay(envs.ActionDelay(env, 1), 1), envs.ActionDelay(env, 2))
    )
    assert [wrapper.name for wrapper in two_wrappers.wrappers][:2] == ["ActionDelay", "ActionDelay 2"]
    action, sent = np.full((1, 1, 4), 0.5, np.float32), []
    for delayed in (two_wrappers, one_wrapper):
        state = delayed.reset(jax.random.key(0))
        for _ in range(3):
            state = delayed.step(state, action)
            sent.append(float(state.action[0, 0, 0]))
    assert sent == [0, 0, 0.5] * 2


def test_law_09_stages_have_names_of_their_own():
    sim = envs.make("hover", 1, engine="interpret").sim
    append_fn(sim.step_pipeline, lambda data: data, "observe")
    env = envs.DroneEnv(sim, Hover())
    with pytest.raises(ConfigError, match="stages of different names, got observe twice"):
        env.explain()


def test_a_rollout_in_rows_takes_commands_of_every_level():
    """As on GPUs, also if the step writes the commands of the policy, such as limited rotor speeds."""
    for control in ("rotor_vel", "state"):
        sim = Sim(2, control=control)
        command = jnp.zeros((2, 1, 4)) + 15e3 if control == "rotor_vel" else jnp.zeros((2, 1, 16)).at[..., 2].set(1.0)
        step, final_states = sim.step_fn, []
        for platform in ("cpu", "gpu"):
            step.platform = platform  # which only decides whether rows are used
            fly = lambda data: rollout(step, data, lambda params, data: command, None, 4, 5)[0].states  # noqa: B023, E731
            final_states.append(jax.jit(fly)(sim.data))
        assert_close(*final_states)
