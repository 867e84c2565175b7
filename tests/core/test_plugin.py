"""Plugins: added, replaced and removed without a trace, integrated with the drone, and observed and drawn."""

from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_command, make_hovering_sim, repeat_command, trees_equal, with_states
from jax import Array
from numpy.typing import ArrayLike
from scipy.linalg import expm

from crazysim import (
    Battery,
    ConfigError,
    Integrator,
    Latency,
    Plugin,
    PyTree,
    RangeFinder,
    Sim,
    StagePlacement,
    Wind,
    leaf,
    stage,
)
from crazysim.core.integration import INTEGRATORS, Integration
from crazysim.core.pipeline import replace_fn
from crazysim.core.plugin import FunctionPlugin, Param, param, state
from crazysim.core.settings import setting
from crazysim.core.stages import first_principles_derivative
from crazysim.errors import UnknownNameError

DURATION = 0.5
STEPS = np.array([32, 64, 128])
MASS = 0.0434
"""Mass of a drone, kg."""


class WakeData(PyTree):
    vel: Array = leaf("drone", 1)
    """Velocity, world frame, m/s. (n_worlds, n_drones, 3)"""
    rate: Array = leaf("parameter", 1, (1,))
    """Decay rate, 1/s. (1,)"""


class Wake(Plugin):
    """A state that the drone drives, and the force of this state on the drone: z' = vel - rate z, F = -strength z."""

    rate: float = param(default=6.0, keep=False)
    strength: float = 0.8
    name: str = "wake"

    def record(self, sim):
        pos = sim.data.states.pos
        return WakeData(np.zeros(pos.shape, pos.dtype), np.full(1, self.rate, pos.dtype))

    def influence(self, data):
        force = data.states.force - self.strength * self.read(data).vel
        return data.replace(states=data.states.replace(force=force))

    def derivative(self, data):
        wake = self.read(data)
        return {"vel": data.states.vel - wake.rate * wake.vel}

    def observations(self, data):
        return {"vel": self.read(data).vel, "height": data.states.pos[2:] * 1.0}


@partial(jax.jit, static_argnames="integrator")
def fly(data, integrator):
    n_steps = STEPS[None, :, None]
    integrate = Integration(INTEGRATORS[integrator], first_principles_derivative, (Wake(),))

    def step(k, now):
        states, vel = now
        core = data.core.replace(freq=n_steps / DURATION)
        plugins = {"wake": data.plugins["wake"].replace(vel=vel)}
        new = integrate(data.replace(states=states, plugins=plugins, core=core))
        return jax.tree.map(lambda a, b: jnp.where(k < n_steps, a, b), (new.states, new.plugins["wake"].vel), now)

    return jax.lax.fori_loop(0, n_steps.max(), step, (data.states, data.plugins["wake"].vel))


@pytest.mark.parametrize("integrator", list(Integrator))
def test_law_08_states_of_a_plugin_keep_the_order_of_the_integrator(integrator, x64):
    """p' = v, v' = -s z / m + g, z' = v - r z, solved by a matrix exponential: drone and plugin drive each other."""
    sim = Sim(n_drones=3, control="rotor_vel")
    sim.add(Wake())
    p, v0 = sim.data.params, np.array([3.0, -2.0, 5.0])
    names = ("drag_matrix", "rpm2thrust", "rpm2torque")
    still = p.replace(**{name: np.zeros_like(getattr(p, name)) for name in names})
    data = with_states(sim.data, pos=[0, 0, 10.0], vel=v0).replace(params=still)
    states, wake_vel = fly(data, integrator)
    system = np.array([[0, 1, 0, 0], [0, 0, -0.8 / float(p.mass[0]), 1], [0, 1, -6.0, 0], [0, 0, 0, 0]])
    for axis, (start, g) in enumerate(zip([0, 0, 10.0], [0, 0, -9.81], strict=True)):
        exact = expm(DURATION * system) @ [start, v0[axis], 0.0, g]
        for result, expected in ((states.pos, exact[0]), (states.vel, exact[1]), (wake_vel, exact[2])):
            errors = np.abs(np.asarray(result)[0, :, axis] - expected)
            assert np.all(errors > 1e-14), "rounding hides the order"
            slope = np.polyfit(np.log(1 / STEPS), np.log(errors), 1)[0]
            assert abs(slope - Integrator(integrator).order) < 0.3, (axis, errors)


def fly_on(sim, n_steps=20):
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data) + [0.1, -0.1, 0.2, 0.05]))
    sim.step(n_steps)
    return sim.data


def test_a_simulation_is_made_with_plugins_as_if_they_were_added():
    """``estimator`` and ``aero`` are short for plugins, which come before the listed plugins."""
    wind, battery = Wind((1.0, 0, 0), speed_20ft=7.7), Battery()
    settings = {"engine": "interpret", "drone": "cf21B_500_idsia", "control": "state", "rng_key": 4}
    shorthand = Sim(2, estimator="kalman", aero="identified", plugins=[wind, battery], **settings)
    sensors = [shorthand.plugins[name] for name in ("imu", "motion_capture")]
    listed = Sim(
        2, plugins=[*sensors, shorthand.plugins["kalman"], shorthand.plugins["residual"], wind, battery], **settings
    )
    added = Sim(2, **settings)
    for plugin in shorthand.plugins.values():
        added.add(plugin)
    assert [*shorthand.plugins] == ["imu", "motion_capture", "kalman", "residual", "wind", "battery"]
    for sim in (listed, added):
        assert [*sim.plugins.items()] == [*shorthand.plugins.items()]
        assert [*sim.step_pipeline] == [*shorthand.step_pipeline]
        assert trees_equal(sim.data, shorthand.data)
        assert trees_equal(sim.default_data, shorthand.default_data)


def test_replace_changes_numbers_without_compiling_and_keeps_states():
    sim = make_hovering_sim()
    sim.add(Wind((2.0, 0, 0), 7.7))
    sim.add(Wake())
    fly_on(sim)
    sim.plugins.observations(sim.data)
    flown, step, n = sim.data.plugins, sim.step_pipeline, sim.step_fn._cache_size()
    observe = sim.plugins._observe_fn[1]
    wind = sim.replace(Wind(np.full((3, 2, 3), 4.0) * [1, 0, 0], 3.0))
    sim.plugins.observations(sim.data)
    assert sim.plugins._observe_fn[1] is observe
    sim.replace(Wake(rate=60.0))
    sim.replace(Wind((4.0, 0, 0), 3.0))
    assert sim.plugins["wind"] is not wind
    assert sim.step_pipeline is step
    np.testing.assert_array_equal(sim.data.plugins["wind"].velocity, [4.0, 0, 0])
    np.testing.assert_array_equal(sim.data.plugins["wind"].gust, flown["wind"].gust)
    np.testing.assert_array_equal(sim.data.plugins["wake"].vel, flown["wake"].vel)
    np.testing.assert_array_equal(sim.default_data.plugins["wind"].velocity, [4.0, 0, 0])
    np.testing.assert_array_equal(sim.default_data.plugins["wind"].gust, 0.0)
    fly_on(sim, 60)
    assert sim.step_fn._cache_size() == n
    # After 7 time constants the wake's velocity is the drone's over the rate. The drone's changes by 10% meanwhile.
    np.testing.assert_allclose(sim.data.plugins["wake"].vel, np.asarray(sim.data.states.vel) / 60, rtol=0.15, atol=2e-4)


def test_replace_adds_stages_that_the_new_settings_need():
    """Gusts need a stage, and ``strength`` is a constant of the compiled step."""
    sim = make_hovering_sim(engine="interpret")
    sim.add(Wind((2.0, 0, 0)))
    sim.add(Wake())
    assert "wind" not in sim.step_pipeline
    fly_on(sim)
    vel = np.asarray(sim.data.plugins["wake"].vel)
    sim.replace(Wind((2.0, 0, 0), 20.0))
    sim.replace(Wake(strength=0.0))
    assert list(sim.step_pipeline).index("wind") == list(sim.step_pipeline).index("integration") - 1
    np.testing.assert_array_equal(sim.data.plugins["wake"].vel, vel)
    data = sim.data
    fly_on(sim)
    assert np.abs(sim.data.plugins["wind"].gust).max() > 0.1
    without = make_hovering_sim(engine="interpret")
    without.add(Wind((2.0, 0, 0), 20.0))
    without.data = data.replace(plugins={"wind": data.plugins["wind"]})
    fly_on(without)
    # two programs of the same arithmetic, float32
    np.testing.assert_allclose(sim.data.states.vel, without.data.states.vel, rtol=1e-5, atol=1e-6)


def test_replace_finds_the_controller_that_latency_had_wrapped():
    sim = make_hovering_sim(engine="interpret")
    controller = sim.step_pipeline["attitude_controller"]
    sim.add(Latency(3))
    sim.replace(Latency(2, max_delay=8))
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
    arrived = []
    for _ in range(4):
        sim.step()
        arrived.append(bool(np.any(np.asarray(sim.data.controls.attitude.cmd))))
    assert arrived == [False, False, True, True]
    sim.remove("latency")
    assert sim.step_pipeline["attitude_controller"] is controller


def test_two_of_a_kind_have_two_names():
    sim = make_hovering_sim(engine="interpret")
    first = sim.add(Wind((1.0, 0, 0), 7.7))
    second = sim.add(Wind((0, 2.0, 0), 7.7), name="thermal")
    assert (first.name, second.name) == ("wind", "thermal")
    assert list(sim.plugins) == ["wind", "thermal"]
    fly_on(sim, 3)
    gusts = [np.asarray(plugin.read(sim.data).gust) for plugin in (first, second)]
    assert np.abs(gusts[0] - gusts[1]).min() > 1e-6
    sim.remove("wind")
    assert list(sim.data.plugins) == ["thermal"]
    sim.step()


def test_observations_are_those_of_each_drone():
    sim = make_hovering_sim(engine="interpret")
    sim.add(Wake())
    sim.add(Battery(0.25, 0.1))
    fly_on(sim)
    result = sim.plugins.observations(sim.data)
    assert set(result) == {"wake.vel", "wake.height", "battery.voltage", "battery.charge"}
    np.testing.assert_array_equal(result["wake.vel"], sim.data.plugins["wake"].vel)
    np.testing.assert_array_equal(result["wake.height"], np.asarray(sim.data.states.pos)[..., 2:])
    np.testing.assert_array_equal(result["battery.voltage"], sim.data.plugins["battery"].voltage)


def test_plugins_draw_into_images():
    sim = Sim()
    sim.scene.add("wall", pos=[2, 0, 0], length=8, height=8)
    finder = sim.add(RangeFinder(visible=True))
    sim.plugins.draw(0)
    assert len(sim.overlays) == 6
    sim.overlays.clear()
    sim.replace(RangeFinder())
    sim.plugins.draw(0)
    assert len(sim.overlays) == 0
    assert finder.visible


class StartRecorder(Plugin):
    pos: Array = state((3,))
    """Position at which the episode began, world frame, m. (n_worlds, n_drones, 3)"""
    name: str = "start"

    def reset_episode(self, data):
        return self.write(data, self.replace(pos=data.states.pos + 0.0))


class LateStartRecorder(StartRecorder):
    reset_before: ClassVar[str | None] = "increment_steps"
    name: str = "late_start"


def test_episodes_begin_at_resets_or_in_front_of_a_stage_of_their_first_step():
    sim = make_hovering_sim(engine="interpret")
    start, late_start = sim.add(StartRecorder()), sim.add(LateStartRecorder())
    assert [*sim.reset_pipeline] == ["reset", "start"]
    sim.data = with_states(sim.data, vel=[0, 0, 1.0])
    before = np.array(sim.data.states.pos)
    sim.step()
    after = np.array(sim.data.states.pos)
    assert (after[..., 2] > before[..., 2]).all()
    for k in range(2):
        np.testing.assert_array_equal(start.read(sim.data).pos, before, err_msg=f"after {k} more")
        np.testing.assert_array_equal(late_start.read(sim.data).pos, after, err_msg=f"after {k} more")
        sim.step()
    sim.reset(np.array([True, False, False]))
    np.testing.assert_array_equal(start.read(sim.data).pos[0], sim.default_data.states.pos[0])
    np.testing.assert_array_equal(start.read(sim.data).pos[1:], before[1:])
    np.testing.assert_array_equal(late_start.read(sim.data).pos[0], 0.0)


@pytest.mark.parametrize(
    ("observe", "message"),
    [
        (lambda data: {"height": data.states.pos[2]}, r"'height' of plugin 'observer' of shape \(k,\) .* got \(\)"),
        (lambda data: {"height": jnp.zeros((2, 3))}, r"got \(2, 3\).*reshape\(-1\)"),
        (lambda data: {"height": "high"}, "got 'high'"),
        (lambda data: data.states.pos, "observations of 'observer' as a dict by name"),
    ],
)
def test_observations_of_another_form_are_named(observe, message):
    class Observer(Plugin):
        name: str = "observer"

        def observations(self, data):
            return observe(data)

    sim = Sim(2, 2)
    sim.add(Observer())
    with pytest.raises(ConfigError, match=message):
        sim.plugins.observations(sim.data)


def add_stage(sim, fn):
    sim.step_pipeline = sim.step_pipeline | {"mine": fn}
    sim.step()


def add_reset(sim):
    sim.reset_pipeline = sim.reset_pipeline | {"mine": lambda data, default_data, mask: None}
    sim.reset()


@pytest.mark.parametrize(
    "act",
    [
        lambda sim: add_stage(sim, lambda data: None),
        lambda sim: add_stage(sim, stage("drone")(lambda data: None)),
        lambda sim: add_stage(sim, stage("world")(lambda data: data.states.pos)),
        add_reset,
    ],
)
@pytest.mark.parametrize("engine", ["plain", "auto"])
def test_a_stage_that_does_not_return_the_data_is_named(act, engine):
    with pytest.raises(ConfigError, match=r"expected stage '(mine|<lambda>)' .*to return the data .*End its function"):
        act(Sim(engine=engine))


def test_functions_can_be_a_plugin():
    sim = Sim(n_worlds=2)

    @stage("drone")
    def count(data):
        record = data.plugins["count"]
        return data.replace(plugins=data.plugins | {"count": record.replace(vel=record.vel + 1)})

    def push(data):
        return data.replace(states=data.states.replace(force=data.states.force + jnp.array([0, 0, 1.0])))

    record = WakeData(np.zeros((2, 1, 3), np.float32), np.ones(1, np.float32))
    sim.add(FunctionPlugin("count", record, [StagePlacement(count, before="increment_steps")], push))
    sim.step(3)
    np.testing.assert_array_equal(sim.data.plugins["count"].vel, 3.0)
    # less the drag, which takes 0.57 per s
    np.testing.assert_allclose(np.asarray(sim.data.states.vel)[..., 2], 3 * 0.002 * (1.0 / MASS - 9.81), rtol=2e-3)
    sim.reset()
    np.testing.assert_array_equal(sim.data.plugins["count"].vel, 0.0)


class DuplicateStage(FunctionPlugin):
    name: str = "duplicate"
    order: ClassVar[int] = 3

    def stages(self, sim):
        return [StagePlacement(lambda data: data, name="clip_floor_pos")]


class FailingPlugin(Plugin):
    fails: str = "never"
    """Result that is wrong: ``"record"``, ``"stages"``, ``"pipeline"`` or ``"never"``."""
    name: str = "failing"

    def record(self, sim):
        sim.scene.add_once(PAINTED_BOX, "failing", 2)
        return 3 if self.fails == "record" else None

    def stages(self, sim):
        fn = 3 if self.fails == "pipeline" else lambda data: data
        return [StagePlacement(fn, before="lunch" if self.fails == "stages" else "integration")]

    def reset_episode(self, data):
        return data


PAINTED_BOX = """
<mujoco>
  <asset><texture name="paint" type="2d" builtin="flat" width="4" height="4"/><material name="paint" texture="paint"/>
  </asset>
  <worldbody><geom type="box" size="0.1 0.1 0.1" material="paint"/></worldbody>
</mujoco>
"""


@pytest.mark.parametrize("fails", ["record", "stages", "pipeline"])
def test_an_addition_that_fails_changes_nothing(fails):
    sim = Sim()
    post = sim.scene.add("box")
    pipelines, data, default = (sim.step_pipeline, sim.reset_pipeline), sim.data, sim.default_data
    with pytest.raises(ValueError, match=r"expected|No stage named"):
        sim.add(FailingPlugin(fails))
    assert (sim.step_pipeline, sim.reset_pipeline) == pipelines
    assert dict(sim.plugins) == {}
    assert trees_equal(sim.data, data)
    assert trees_equal(sim.default_data, default)
    assert [body.name for body in sim.spec.worldbody.bodies] == ["drone:0", "_dummy", "box:0"]
    sim.add(FailingPlugin())
    sim.data = post.set_pose(sim.data, (0, 0, 3))
    assert sim.mj_model.body("failing:1").id
    assert sim.data.objects.names == ("box:0", "failing:0", "failing:1")


class Unlisted(Plugin):
    """A plugin that returns a stage without a list."""

    name: str = "unlisted"

    def stages(self, sim):
        return StagePlacement(lambda data: data)


class Unstaged(Plugin):
    """A plugin whose stage is a method without a scope, which would see numbers instead of arrays."""

    name: str = "unstaged"
    count: jax.Array = state()

    def add_one(self, data):
        return self.write(data, self.replace(count=self.count + 1))

    def stages(self, sim):
        return [StagePlacement(self.add_one)]


class Functional(Plugin):
    name: str = "functional"

    def stages(self, sim):
        return [StagePlacement(self.stage(lambda data: data))]


class Undeclared(Plugin):
    name: str = "undeclared"

    def record(self, sim):
        return {"height": np.zeros((1, 1, 1))}


class Forgetful(Plugin):
    number: Param = param(default=0.1)
    name: str = "forgetful"

    def bind(self, sim):
        self.with_arrays(sim)


class Discs(Plugin):
    level: Param = param(default=1.0)
    discs: ArrayLike = setting(default=((0.0, 1.0),))
    table: Any = ()
    name: str = "discs"


class Sail(Plugin, requires=Wind):
    name: str = "sail"


def test_a_required_plugin_may_be_added_later_and_is_missed_at_the_first_step():
    sim = Sim(engine="interpret")
    earlier_step, earlier_data = sim.build_step_fn(), sim.data
    sim.add(Sail())
    assert repr(sim.plugins) == "<plugins sail: Sail>"
    earlier_step(earlier_data)
    step, reset = sim.build_step_fn(), sim.build_reset_fn()
    for act in (sim.step, sim.reset, lambda: step(sim.data), lambda: jax.eval_shape(step, sim.data),
                lambda: reset(sim.data, sim.default_data)):  # fmt: skip
        with pytest.raises(ConfigError, match="expected a simulation with a Wind, which Sail 'sail' needs, got 'sail'"):
            act()
    sim.add(Wind())
    sim.step()
    with pytest.raises(ConfigError, match="expected no plugin that needs 'wind', got Sail 'sail'"):
        sim.remove("wind")


@pytest.mark.parametrize("act, error, words", [
    (lambda sim: sim.add(Wind()), ConfigError, r"wind is already enabled. Use sim.replace\(Wind\(...\)\)"),
    (lambda sim: sim.add("wind"), ConfigError, "expected a plugin, got 'wind'"),
    (lambda sim: sim.add(Wake(), name=""), ConfigError, "non-empty string as name of a Wake"),
    (lambda sim: sim.add(Wake(), name="mine"), ConfigError, "already has a record 'mine'"),
    (lambda sim: sim.add(DuplicateStage()), ConfigError, "already has a stage 'clip_floor_pos'"),
    (lambda sim: sim.add(FunctionPlugin("a", None, [StagePlacement(lambda data: data, before="lunch")])),
     UnknownNameError, "No stage named 'lunch'"),
    (lambda sim: sim.add(Unlisted()), ConfigError, "expected stages of plugin 'unlisted' to return a list"),
    (lambda sim: sim.add(Unstaged()), ConfigError, r"'unstaged' .*Use StagePlacement\(self.stage\(self.add_one\)\)"),
    (lambda sim: sim.add(Functional()), ConfigError, r"a method of the plugin as its stage, got .*Use self.stage\("),
    (lambda sim: sim.add(Undeclared()), ConfigError, "expected record of plugin 'undeclared' to return a PyTree or"),
    (lambda sim: sim.add(Forgetful()), ConfigError, r"from Forgetful.bind, got None. Return self.with_arrays"),
    (lambda sim: sim.add(Discs(table=np.ones(2))), ConfigError, r"table of Discs to be hashable.*param\("),
    (lambda sim: sim.replace(Wind((1.0, 0, 0), -1.0)), ConfigError, "speed_20ft"),
    (lambda sim: sim.remove("wake"), UnknownNameError, "got 'wake'. Added are: wind, latency"),
    (lambda sim: sim.replace(Wake()), UnknownNameError, "got 'wake'"),
    (lambda sim: sim.replace(Wake(name="wind")), ConfigError, "expected a Wind to replace 'wind', got a Wake"),
    *[
        (lambda sim, stage=stage, act=act: replace_fn(sim.step_pipeline, lambda d: d, stage) or act(sim),
         ConfigError, f"expected stage '{stage}' as it was when you replaced it, got")
        for stage in ("latency", "attitude_controller")
        for act in (lambda sim: sim.remove("latency"), lambda sim: sim.replace(Latency(3, max_delay=4)))
    ],
])  # fmt: skip
def test_law_09_impossible_additions_replacements_and_removals_are_refused(act, error, words):
    sim = Sim()
    sim.add(Wind((1.0, 0, 0)))
    sim.add(Latency(2))
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"mine": WakeData(np.zeros((1, 1, 3)), np.ones(1))})
    pipeline, stages, plugins, data = sim.step_pipeline, list(sim.step_pipeline), dict(sim.plugins), sim.data
    with pytest.raises(error, match=words):
        act(sim)
    assert sim.step_pipeline is pipeline
    assert list(pipeline) == stages
    assert dict(sim.plugins) == plugins
    assert trees_equal(sim.data, data)


def test_arrays_of_declared_settings_become_tuples():
    sim = Sim()
    sim.add(Discs(discs=np.ones((1, 2)), table=[[1, 2]]))
    record = sim.data.plugins["discs"]
    assert record.discs == ((1.0, 1.0),)
    assert record.table == ((1, 2),)
