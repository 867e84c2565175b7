"""Tasks as frozen records, their installation, and their random draws."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, Sim, Wind, state
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import AutoReset, DroneEnv, DroneVectorEnv, Task, draw, make, uniform
from crazysim.envs.random import episode_key, scale_symmetric, scale_to
from crazysim.envs.task import sum_terms
from crazysim.envs.tasks.hover import Hover
from crazysim.envs.tasks.land import Land
from crazysim.envs.tasks.race import Race
from crazysim.envs.wrappers import Wrapper


def test_making_a_task_changes_no_simulation_and_installing_it_does():
    sim = Sim(n_worlds=2, control="attitude")
    data, stages = sim.data, list(sim.step_pipeline)
    task = Land()
    assert sim.data is data
    assert list(sim.step_pipeline) == stages
    task.install(sim)
    assert isinstance(sim.data.plugins["task"], Land.Record)
    assert list(sim.step_pipeline) == [*stages[:-1], "task", stages[-1]]
    with pytest.raises(dataclasses.FrozenInstanceError):
        task.speed = 1.0
    assert task == Land()
    assert task != Land(speed=0.5)


@pytest.mark.parametrize("installed", [None, Hover()])
def test_an_environment_needs_the_task_installed(installed):
    sim = Sim(control="attitude")
    if installed is not None:
        installed.install(sim)
    with pytest.raises(ConfigError, match=r"simulation in which task 'land' is installed.*install\(sim\)"):
        DroneEnv(sim, Land())


def test_the_name_of_a_task_is_refused_where_a_task_is_expected():
    with pytest.raises(ConfigError, match="actions as Actions, got 3"):
        make("hover", actions=3)
    with pytest.raises(ConfigError, match="Task, got 'hover'"):
        DroneEnv(Sim(control="attitude"), "hover")


def test_goals_are_set_for_all_for_each_world_and_for_each_drone():
    """Goals are observed from the next step on, without another compilation; wrong shapes are errors."""
    env = AutoReset(make("hover", 3, n_drones=2, engine="interpret"))
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    full = np.arange(18, dtype=np.float32).reshape(3, 2, 3)
    for pos, expected in (
        ([0.1, 0.2, 1.0], np.broadcast_to(np.float32([0.1, 0.2, 1.0]), (3, 2, 3))),
        (full[:, 0].astype(float), np.broadcast_to(full[:, :1], (3, 2, 3))),
        (jnp.asarray(full), full),
        (full[:1], np.broadcast_to(full[:1], (3, 2, 3))),
    ):
        new = env.set_goal(state, pos)
        np.testing.assert_array_equal(env.target(new), expected)
        np.testing.assert_array_equal(new.obs["difference_to_goal"], state.obs["difference_to_goal"])
        after = step(new, jnp.zeros((3, 2, 4)))
        np.testing.assert_allclose(after.obs["difference_to_goal"], expected - after.data.states.pos, atol=1e-6)
    assert step._cache_size() == 1
    for wrong in (full[:2, 0], full[:, 0, :2], full[None], full[0, 0, 0], full[:2]):
        with pytest.raises(ConfigError, match=r"goals of shape \(3,\), .* = \(3, 2, 3\), got .*Use \(1, n_drones, 3\)"):
            env.set_goal(state, wrong)
    with pytest.raises(ConfigError, match="pos to be finite"):
        env.set_goal(state, [0.0, np.nan, 1.0])


def test_the_total_of_terms_is_their_sum_in_order():
    terms = {"a": jnp.float32(1e8), "b": jnp.float32(-1e8), "c": jnp.float32(1.0)}
    assert sum_terms(terms) == 1.0
    assert sum_terms({"a": terms["a"], "c": terms["c"], "b": terms["b"]}) == 0.0


def test_named_draws_are_parts_of_one_draw():
    key = jax.random.wrap_key_data(jnp.array([1, 2], jnp.uint32))

    @jax.jit
    def draw_all(key):
        others = draw(key, turn=1, places=(2, 3)), draw(key, turn=1, places=(2, 3), more=4)
        return draw(key, 3, start=2, yaw=1, pose=(2, 2)), uniform(key, 3, 7), *others

    x, row, world, more = jax.device_get(draw_all(key))
    assert {name: v.shape for name, v in x.items()} == {"start": (3, 2), "yaw": (3, 1), "pose": (3, 2, 2)}
    np.testing.assert_array_equal(x["start"], row[:, :2])
    np.testing.assert_array_equal(x["yaw"], row[:, 2:3])
    np.testing.assert_array_equal(x["pose"], row[:, 3:].reshape(3, 2, 2))
    np.testing.assert_array_equal(world["turn"], more["turn"])
    np.testing.assert_array_equal(world["places"], more["places"])


def test_draws_are_uniform_and_scaled():
    key = jax.random.wrap_key_data(jnp.array([3, 4], jnp.uint32))
    x = np.asarray(uniform(key, 20_000))
    assert 0 <= x.min() < 1e-3 < 0.999 < x.max() < 1
    np.testing.assert_allclose(np.histogram(x, 10, (0, 1))[0], 2000, atol=200)
    np.testing.assert_allclose(scale_to(x, 2.0, 4.0), 2 + 2 * x, rtol=1e-6)
    np.testing.assert_allclose(scale_symmetric(x, 0.5), x - 0.5, atol=1e-6)
    np.testing.assert_allclose(uniform(key, 5, low=-1.0, high=3.0), 4 * x[:5] - 1, rtol=1e-5, atol=1e-6)


def test_keys_depend_on_seed_world_episode_and_name_only():
    """Law 10."""
    four, two = (Sim(n_worlds=n, rng_key=7).data for n in (4, 2))

    def words(data, name="spawn"):
        return np.asarray(jax.random.key_data(vmap_worlds(lambda data: episode_key(data, name))(data)))

    first = words(four)
    np.testing.assert_array_equal(words(two), first[:2])
    others = [words(four, "another"), words(Sim(n_worlds=4, rng_key=8).data)]
    later = four.replace(core=four.core.replace(episode=four.core.episode + 1))
    assert len(np.unique(np.concatenate([first, words(later), *others]), axis=0)) == 16
    later_step = four.replace(core=four.core.replace(steps=four.core.steps + 5))
    np.testing.assert_array_equal(words(later_step), first)


class Still(Task):
    """A task of two drones that does nothing."""

    name = "still"

    def spawn(self, data, key):
        return data

    def observe(self, data):
        return {"pos": data.states.pos}

    def rewards(self, data, action, last_action):
        return {"height": data.states.pos[:, 2]}

    def terminated(self, data):
        return jnp.zeros((), bool)

    def error(self, data):
        return data.states.pos[:, 2]


class Counting(Still):
    """Counts physics steps of every drone, and episodes' first heights."""

    n_counted: jax.Array = state((), dtype=int)
    start_pos: jax.Array = state((3,))
    wind: jax.Array | None = state((2,), scope="world", optional=True)

    def spawn(self, data, key):
        return self.write(data, start_pos=data.states.pos)

    def after_substep(self, data):
        return self.write(data, n_counted=self.read(data).n_counted + 1)

    def error(self, data):
        return 1.0 * self.read(data).n_counted


class CountingTwice(Counting):
    """Declares one more state than its base."""

    seconds = 0.2
    best: jax.Array = state(())


def test_declared_states_count_every_physics_step_and_begin_at_zero_in_every_episode(two_drones):
    env = AutoReset(make(CountingTwice(), n_worlds=3, n_drones=2, engine="interpret"))
    reset_state = jax.jit(env.reset)(jax.random.key(0))
    record = reset_state.data.plugins["task"]
    assert record.n_counted.dtype == jnp.int32
    assert record.start_pos.shape == (3, 2, 3)
    assert record.wind is None
    step, action = jax.jit(env.step), jnp.zeros(reset_state.action.shape)
    after = step(step(reset_state, action), action)
    np.testing.assert_array_equal(after.info["error"], np.full((3, 2), 2 * env.n_substeps))
    for _ in range(env.max_steps - 2):
        after = step(after, action)
    assert np.all(after.truncated)
    np.testing.assert_array_equal(after.data.plugins["task"].n_counted, np.zeros((3, 2)))
    assert env.max_steps == 10, "a plain attribute sets an inherited setting"
    assert [f.name for f in dataclasses.fields(CountingTwice)] == ["seconds", "tolerance", "hold"]
    assert CountingTwice.Record.__mro__[1] is Counting.Record
    copied = pickle.loads(pickle.dumps(record))
    np.testing.assert_array_equal(copied.start_pos, record.start_pos)


def test_states_are_read_from_data_and_added_by_the_task_that_declares_them(two_drones):
    with pytest.raises(AttributeError, match=r"self\.read\(data\)\.n_counted.*self\.write"):
        _ = Counting().n_counted
    with pytest.raises(TypeError, match="n_counted"):
        Counting(n_counted=3)
    with pytest.raises(ConfigError, match="states among n_counted, start_pos, wind, got 'height'"):
        Counting().add_states(two_drones, height=0.0)
    sim = Sim(2)
    Counting().install(sim)
    with pytest.raises(ConfigError, match=r"n_counted.*got 'n_cuonted'"):
        Counting().write(sim.data, n_cuonted=0)
    with pytest.raises(ConfigError, match="annotation of state 'extra'"):
        type("Bad", (Still,), {"extra": state(())})
    with pytest.raises(ConfigError, match="another name than 'error'"):
        type("Bad", (Still,), {"error": state(()), "__annotations__": {"error": "Array"}})
    with pytest.raises(ConfigError, match=r"gates_visited.*\('gates',\).*add_states\(sim, gates_visited"):
        Race().add_states(two_drones, gates=None, obstacles=None)
    with pytest.raises(ConfigError, match=r"Counting|still.*add_states"):
        DroneEnv(two_drones, Counting())


@pytest.fixture(scope="module")
def two_drones():
    return Sim(n_worlds=3, n_drones=2, control="attitude", engine="interpret")


WRONG_METHODS = {
    "flat": ("observe", lambda s, d: {"height": d.states.pos[:, 2]}, r"'height' .*\(2,\) .*x\[:, None\]"),
    "of the world": ("observe", lambda s, d: {"ok": d.states.pos, "all": d.states.pos.ravel()}, r"'all' .*\(6,\)"),
    "matrix": ("observe", lambda s, d: {"m": jnp.zeros((2, 3, 3))}, r"'m' .*\(2, 3, 3\) .*x.reshape"),
    "no dict": ("observe", lambda s, d: d.states.pos, r"observe to return a dict .*\(2, 3\)"),
    "none": ("observe", lambda s, d: {"x": None}, "'x' .*NoneType"),
    "no terms": ("rewards", lambda s, d, a, b: {}, "rewards to return a dict .*empty"),
    "column": ("rewards", lambda s, d, a, b: {"bad": d.states.pos[:, :1]}, r"term 'bad' .*\(2, 1\)"),
    "one for all": ("rewards", lambda s, d, a, b: {"any": jnp.sum(d.states.pos)}, r"'any' .*\(\) .*jnp.full"),
    "of actions": ("rewards", lambda s, d, a, b: {"a": a}, r"term 'a' .*\(2, 4\)"),
    "info of the world": ("info", lambda s, d: {"wind": d.states.pos[0]}, r"info 'wind' .*got shape \(3,\)"),
    "no info": ("info", lambda s, d: None, "info to return a dict .*NoneType"),
    "error": ("error", lambda s, d: d.states.pos, r"error of .*\(2, 3\)"),
    "ends for each": ("terminated", lambda s, d: d.states.pos[:, 2] < 0, r"terminated .*bool .*\(2,\) .*jnp.any"),
    "ends as a number": ("terminated", lambda s, d: jnp.float32(0), "terminated .*bool .*float32"),
}
"""Name of a method of a task, a wrong one in its place, and words of the error."""


@pytest.mark.parametrize("case", WRONG_METHODS)
def test_law_09_wrong_shapes_of_a_task_are_refused_at_making(two_drones, case):
    method, fn, words = WRONG_METHODS[case]
    wrong = type("Wrong", (Still,), {method: fn})()
    with pytest.raises(ConfigError, match=f"task 'still': expected .*{words}"):
        DroneEnv(two_drones, wrong)


def make_nonfinite_env(sim, state="pos"):
    """Return an environment whose second world starts with NaN in a state."""

    class NonfiniteStart(Still):
        def spawn(self, data, key):
            value = getattr(data.states, state)
            wrong = jnp.where(data.core.world_id == 1, jnp.nan, value)
            return data.replace(states=data.states.replace(**{state: wrong}))

    return DroneEnv(sim, NonfiniteStart())


@pytest.mark.parametrize("state", ["pos", "quat", "ang_vel"])
def test_law_09_a_start_that_is_not_finite_is_refused(two_drones, state):
    env = make_nonfinite_env(two_drones, state)
    words = f"task 'still': expected spawn to return finite states, got {state} with NaN or infinity in world 1"
    with pytest.raises(ConfigError, match=words):
        env.reset(jax.random.key(0))
    with pytest.raises(ConfigError, match=words):
        DroneVectorEnv(env).reset(seed=0)


def test_a_start_that_is_not_finite_ends_at_the_first_step_of_compiled_code(two_drones):
    """Compiled code cannot raise; see ``Env.reset``."""
    env = make_nonfinite_env(two_drones)
    state = jax.jit(lambda key: env.step(start := env.reset(key), jnp.zeros_like(start.action)))(jax.random.key(0))
    np.testing.assert_array_equal(state.terminated, np.arange(two_drones.n_worlds) == 1)
    np.testing.assert_array_equal(state.info["nonfinite"], state.terminated)


def test_law_09_an_episode_without_a_step_is_refused(two_drones):
    with pytest.raises(
        ConfigError, match=r"at least one environment step, got seconds=0\.009 at 50 Hz. Use seconds=0\.02"
    ):
        DroneEnv(two_drones, Still(seconds=0.009))


@pytest.mark.parametrize("in_wrapper", [False, True])
def test_law_01_a_start_without_the_axis_of_drones_is_of_its_own_world(in_wrapper):
    """With as many worlds as drones, too: the start of a world is the same for its drones and no other world's."""

    def place(data):
        pos = jax.random.uniform(episode_key(data, "place"), (3,))
        return data.replace(states=data.states.replace(pos=pos))

    class Placed(Still):
        def spawn(self, data, key):
            return data if in_wrapper else place(data)

    class Place(Wrapper):
        def after_spawn(self, data):
            return place(data)

    env = DroneEnv(Sim(n_worlds=2, n_drones=2, control="attitude"), Placed())
    pos = np.asarray((Place(env) if in_wrapper else env).reset(jax.random.key(0)).data.states.pos)
    np.testing.assert_array_equal(pos[:, 0], pos[:, 1])
    assert np.all(pos[0] != pos[1])


def test_law_09_a_start_of_another_shape_is_named(two_drones):
    class Wide(Still):
        def spawn(self, data, key):
            return data.replace(params=data.params.replace(gravity_vec=jnp.zeros((2, 3))))

    with pytest.raises(ConfigError, match=r"task 'still': .*params.gravity_vec of shape \(3,\), got shape \(2, 3\)"):
        jax.eval_shape(DroneEnv(two_drones, Wide()).reset, jax.random.key(0))


def test_law_09_a_start_with_other_leaves_is_refused(two_drones):
    class Misspelt(Still):
        """A record under another name than the task's."""

        def spawn(self, data, key):
            return data.replace(plugins=data.plugins | {"tsk": data.states.pos})

    with pytest.raises(ConfigError, match=r"task 'still': expected spawn .*with \.plugins\['tsk'\].*plugins\['task'\]"):
        jax.eval_shape(DroneEnv(two_drones, Misspelt()).reset, jax.random.key(0))

    class Flat(Still):
        """One number of each drone in a record with an axis for it."""

        def spawn(self, data, key):
            return data.replace(params=data.params.replace(mass=jnp.zeros(2)))

    sim = Sim(n_worlds=3, drone=["cf21B_500", "cf2x_L250"], control="attitude")
    with pytest.raises(ConfigError, match=r"spawn to return \.params\.mass of shape \(2, 1\), got.*\[\.\.\., None\]"):
        jax.eval_shape(DroneEnv(sim, Flat()).reset, jax.random.key(0))


@pytest.mark.parametrize("method", ["spawn", "before_step", "after_spawn"])
def test_law_09_a_method_that_returns_no_data_is_named(two_drones, method):
    in_wrapper = method == "after_spawn"
    returned = {method: lambda *args: None}
    env = DroneEnv(two_drones, Still() if in_wrapper else type("Empty", (Still,), returned)())
    env = type("Empty", (Wrapper,), returned)(env) if in_wrapper else env
    with pytest.raises(ConfigError, match=f"expected {method} to return the data .* got a NoneType. .*return data"):
        jax.eval_shape(env.reset, jax.random.key(0))


def test_a_record_that_was_not_added_is_named(two_drones):
    reads_goal = type("Goals", (Still,), {"observe": lambda self, data: {"goal": data.plugins["task"].goal}})
    with pytest.raises(KeyError) as error:
        DroneEnv(two_drones, reads_goal())
    assert "self.add_states(sim, ...) in install" in "".join(error.value.__notes__)


def test_law_09_shapes_of_a_batched_task_have_worlds_in_front(two_drones):
    class Batched(Still):
        """All worlds at once."""

        batched = True

        def rewards(self, data, action, last_action):
            return {"height": data.states.pos[..., 2]}

        def terminated(self, data):
            return jnp.zeros(3, bool)

        def error(self, data):
            return data.states.pos[..., 2]

    class Flat(Batched):
        """Observations without the drones."""

        def observe(self, data):
            return {"pos": data.states.pos[:, 0]}

    DroneEnv(two_drones, Batched())
    with pytest.raises(
        ConfigError, match=r"'pos' of shape \(n_worlds, n_drones, k\) = \(3, 2, k\), got shape \(3, 3\)"
    ):
        DroneEnv(two_drones, Flat())


def test_law_09_missing_methods_are_named(two_drones):
    class Incomplete(Task):
        """A task without observations and an error."""

        name = "incomplete"
        spawn, rewards, terminated = Still.spawn, Still.rewards, Still.terminated

    with pytest.raises(
        ConfigError, match=r"task 'incomplete': expected class Incomplete to define .*, got no observe, error\. "
    ):
        DroneEnv(two_drones, Incomplete())
    with pytest.raises(
        NotImplementedError, match=r"task 'incomplete': expected class Incomplete to define observe\(data\); see docs"
    ):
        Incomplete().observe(two_drones.data)


def test_methods_that_nothing_calls_and_whose_names_are_nearly_those_of_others_are_errors():
    class Misspelt(Hover):
        def before_stpe(self, data):
            return data

    class Helped(Hover):
        def rewards(self, data, action, last_action):
            return {name: self.inform(x) for name, x in super().rewards(data, action, last_action).items()}

        def inform(self, x):
            return x

        def _targets(self):
            return None

    with pytest.raises(ConfigError, match=r"got 'before_stpe', .*Use the name 'before_step'"):
        make(Misspelt(), engine="interpret")
    make(Helped(), engine="interpret")


def test_plugins_that_are_added_to_the_simulation_of_an_environment_are_refused():
    env = make("hover", 2)
    env.sim.add(Wind((1.0, 0.0, 0.0)))
    with pytest.raises(ConfigError, match=r"was made \(.*\), got .*wind.*Use make\(\.\.\., effects="):
        env.reset(jax.random.key(0))


@pytest.mark.parametrize("task", ["forest", "race_by_camera", "land_on_marker"])
def test_tasks_fly_airframes_without_sizes(task):
    # Its file has no table [shape]: cameras and contacts take the defaults that its picture has.
    env = make(task, 1, drone="uzh_5inch")
    assert jax.eval_shape(env.reset, jax.random.key(0)).obs
