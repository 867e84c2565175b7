"""Searches over orders: of objects, plugins that read the scene, and plugins that need each other.

Whatever the order of calls, the flight is that of a simulation that was built in the order of a textbook, or the call
that cannot be followed is an error at once.
"""

import jax
import numpy as np
import pytest
from cases import hover_command, repeat_command, trees_equal
from hypothesis import given, settings
from hypothesis import strategies as st

from crazysim import (
    IMU,
    Battery,
    Camera,
    Cars,
    ConfigError,
    ContactLog,
    ContactResponse,
    Downwash,
    DroneCollisions,
    FreeBodies,
    GroundEffect,
    Kalman,
    Latency,
    Lidar,
    MotionCapture,
    Pillars,
    Radar,
    Randomize,
    RangeFinder,
    RotorJet,
    Sim,
    SlungLoad,
    Terrain,
    Wind,
    make,
)
from crazysim.core.pipeline import insert_fn_after, prepend_fn, remove_fn, replace_fn
from crazysim.envs import DroneEnv
from crazysim.plugins.sensors import BatteryVoltage, MultiRanger
from crazysim.scene import build

N_STEPS = 50
"""Steps of a flight: 0.1 s, in which the drones reach the objects."""
OBJECTS = {
    "ahead": {"pos": (0.2, 0, 0.38), "radius": 0.1, "mocap": True},
    "beside": {"pos": (0.2, 0.5, 0.35), "radius": 0.08, "mocap": False},
    "below": {"pos": (0.1, 0, 0.2), "radius": 0.15, "mocap": False},
}
"""Balls, whose contacts compile sooner than those of boxes."""
READERS = {
    "range_finder": lambda: RangeFinder(directions=[(1, 0, 0), (0, -1, 0), (0, 0, -1)], freq=50),
    "camera": lambda: Camera(4, 3, freq=50),
    "lidar": lambda: Lidar((0.0,), (-45.0, 0.0, 45.0), outputs=("distance",), freq=50),
    "contact_response": lambda: ContactResponse(iterations=2),
    "contacts": lambda: ContactLog(drones=False),
    "bodies": lambda: FreeBodies(1, size=0.05, pos=(0.3, 0.5, 0.1)),
    "load": lambda: SlungLoad(0.005, length=0.1, size=0.02),
    "scenery": lambda: Pillars(density=0.3, size=(4.0, 4.0), free=((0, 0, 0.5), (0, 0.5, 0.5))),
    "ground_effect": GroundEffect,
}
EXAMPLES = settings().max_examples // 10


def new_sim():
    """Return a simulation of two drones, one beside the other, that fly ahead; nothing is compiled."""
    return place(Sim(n_drones=2, control="attitude", engine="interpret"))


def place(sim):
    states = sim.data.states
    pos, vel = np.array([[[0, 0, 0.4], [0, 0.5, 0.4]]], np.float32), np.array([[[1.5, 0, -0.3]] * 2], np.float32)
    sim.data = sim.data.replace(states=states.replace(pos=pos, vel=vel))
    sim.build_default_data()
    return sim


def fly(sim):
    sim.reset()
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
    sim.step(N_STEPS)
    data = jax.device_get(sim.data)
    leaves = {f"states.{name}": getattr(data.states, name) for name in ("pos", "quat", "vel", "ang_vel")}
    for name, record in data.plugins.items():
        fields = {key: getattr(record, key) for key in record.__dataclass_fields__}
        if name == "contacts":
            fields["objects"] = fields["objects"][..., np.argsort(record.object_names)]
        if name == "bodies":  # impulses of contact points follow the order of the bodies of the scene
            fields = {key: x for key, x in fields.items() if key not in ("normal_impulse", "friction_impulse")}
        for key, x in fields.items():
            leaves |= {f"{name}.{key}{k}": leaf for k, leaf in enumerate(jax.tree.leaves(x)) if np.ndim(leaf)}
    return leaves


def require_same_flight(sim, expected):
    actual, desired = fly(sim), fly(expected)
    assert actual.keys() == desired.keys()
    for name, x in actual.items():
        np.testing.assert_allclose(x, desired[name], atol=1e-4, rtol=1e-4, err_msg=name)


def add_object(sim, name, pos=None):
    return sim.scene.add("sphere", name, **OBJECTS[name] | ({} if pos is None else {"pos": pos}))


def remove_object(sim, name):
    sim.spec.delete(sim.spec.body(f"{name}:0"))
    sim.build_mjx()


@st.composite
def histories(draw):
    plugins = draw(st.lists(st.sampled_from(list(READERS)), min_size=1, max_size=2, unique=True))
    objects = draw(st.lists(st.sampled_from(list(OBJECTS)), min_size=1, max_size=2, unique=True))
    events = [("plugin", name) for name in plugins] + [("object", name) for name in objects]
    events += [("change", name) for name in draw(st.lists(st.sampled_from(objects), max_size=2, unique=True))]
    events += [("read", name) for name in draw(st.lists(st.sampled_from(["data", "step_fn", "reset_fn"]), max_size=2))]
    return draw(st.permutations(events))


@settings(max_examples=EXAMPLES)
@given(history=histories())
@pytest.mark.long("traces the steps of drawn plugins")
def test_objects_before_between_and_after_plugins_give_the_same_flight(history):
    sim, handles, positions, plugins = new_sim(), {}, {}, []
    for event, name in history:
        if event == "plugin":
            sim.add(READERS[name]())
            plugins.append(name)
        elif event == "object":
            handles[name], positions[name] = add_object(sim, name), OBJECTS[name]["pos"]
        elif event == "read":
            getattr(sim, name)
        elif name in handles and handles[name].movable:
            positions[name] = tuple(np.add(OBJECTS[name]["pos"], (0.03, 0.02, 0)))
            sim.data = handles[name].set_pose(sim.data, positions[name])
            sim.default_data = handles[name].set_pose(sim.default_data, positions[name])
        elif name in handles:
            remove_object(sim, name)
            del positions[name]
    expected = new_sim()
    for name, pos in positions.items():
        add_object(expected, name, pos)
    for name in plugins:
        expected.add(READERS[name]())
    place(sim)
    assert list(sim.step_pipeline) == list(expected.step_pipeline)
    require_same_flight(sim, expected)


def wall_ahead(sim):
    return sim.scene.add("wall", pos=[0.55, 0, 0], length=4.0, height=3.0, thickness=0.1)


def test_a_plugin_of_the_constructor_sees_objects_that_are_added_later():
    plugins = [RangeFinder([(1, 0, 0)]), Lidar((0.0,), (0.0,), pos=(0, 0, 0))]
    sim = Sim(plugins=plugins, engine="interpret")
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.full((1, 1, 3), (0, 0, 1), np.float32)))
    wall = wall_ahead(sim)
    sim.step()
    np.testing.assert_allclose(sim.data.plugins["range_finder"].distance, 0.5, atol=1e-4)
    np.testing.assert_allclose(sim.data.plugins["lidar"].images["distance"].squeeze(), 0.5, atol=1e-4)
    sim.data = wall.set_pose(sim.data, [1.55, 0, 0])
    sim.scene.add("pole", pos=[0.25, 0, 0], radius=0.05, height=3.0, mocap=False)
    sim.step()
    np.testing.assert_allclose(sim.data.plugins["range_finder"].distance, 0.2, atol=1e-4)
    np.testing.assert_allclose(sim.data.plugins["lidar"].images["distance"].squeeze(), 0.2, atol=1e-4)
    remove_object(sim, "pole")
    sim.step()
    np.testing.assert_allclose(sim.data.plugins["range_finder"].distance, 1.5, atol=1e-4)
    np.testing.assert_allclose(sim.data.plugins["lidar"].images["distance"].squeeze(), 1.5, atol=1e-4)


def test_law_06_ten_objects_compile_scene_and_step_once(monkeypatch):
    sim, compiled = Sim(plugins=[RangeFinder()]), []
    compile_spec = build.compile_spec
    monkeypatch.setattr(build, "compile_spec", lambda spec: (compiled.append(1), compile_spec(spec))[1])
    steps = {id(sim.step_fn): sim.step_fn}
    for k in range(10):
        sim.scene.add("box", f"box-{k}", pos=[k, 0, 0])
    for _ in range(3):
        sim.step()
        steps[id(sim.step_fn)] = sim.step_fn
    assert len(compiled) == 1
    assert len(steps) == 2
    assert sim.step_fn._cache_size() == 1


def test_states_settings_and_edits_of_the_pipeline_survive_an_object():
    """Charge, log, a number set in a record, and stages that a user has inserted, replaced and removed."""

    def count(data):
        return data

    def other_camera(data):
        return data

    plugins = [Battery(), ContactLog(), ContactResponse(), RangeFinder(), Camera(2, 2), Lidar((0.0,), (0.0,))]
    sim = Sim(plugins=plugins, engine="interpret")
    sim.step(20)
    sim.data = sim.data.replace(
        plugins=sim.data.plugins
        | {"contact_response": sim.data.plugins["contact_response"].replace(friction=np.full(1, 0.1, np.float32))}
    )
    pipeline = sim.step_pipeline
    insert_fn_after(pipeline, "range_finder", count, "count")
    replace_fn(pipeline, other_camera, "camera")
    remove_fn(pipeline, "lidar")
    before, names = sim.data.plugins, list(pipeline)
    assert bool(np.all(before["contacts"].floor))
    wall_ahead(sim)
    after = sim.data.plugins
    assert sim.step_pipeline is pipeline
    assert list(pipeline) == names
    assert (pipeline["count"], pipeline["camera"]) == (count, other_camera)
    assert after["contacts"].object_names == ("wall:0",)
    for name in ("battery", "contact_response", "range_finder"):
        assert trees_equal(after[name], before[name])
    np.testing.assert_array_equal(after["contacts"].first_step, before["contacts"].first_step)
    sim.step()
    sim.data = sim.data.replace(
        plugins=after | {"contacts": after["contacts"].replace(objects=np.ones((1, 1, 1), bool))}
    )
    sim.scene.add("box", pos=[0, 3, 0])
    assert sim.data.plugins["contacts"].object_names == ("wall:0", "box:0")
    np.testing.assert_array_equal(sim.data.plugins["contacts"].objects, [[[True, False]]])


def test_edits_are_replayed_when_plugins_come_and_go():
    """An inserted stage stays between its neighbours, a removed one stays away, a wrapped one calls the user's."""

    def first(data):
        return data

    def count(data):
        return data

    def controller(data):
        called.append(data)
        return data

    called, sim = [], Sim(plugins=[Battery()], control="attitude", engine="plain")
    pipeline = sim.step_pipeline
    prepend_fn(pipeline, first)
    insert_fn_after(pipeline, "integration", count)
    remove_fn(pipeline, "clip_floor_pos")
    replace_fn(pipeline, controller, "attitude_controller")
    sim.add(Latency(2))
    sim.add(ContactResponse(iterations=2))
    sim.remove("battery")
    sim.step()
    assert sim.step_pipeline is pipeline
    names = ["first", "latency", "attitude_controller", "clip_rotor_vel_cmd", "integration", "count"]
    assert list(pipeline) == [*names, "contact_response", "increment_steps"]
    assert called
    sim.remove("latency")
    sim.remove("contact_response")
    remove_fn(pipeline, "first")
    sim.add(Wind())
    names = ["attitude_controller", "clip_rotor_vel_cmd", "integration", "count", "increment_steps"]
    assert list(pipeline) == names
    assert pipeline["attitude_controller"] is controller


@pytest.mark.parametrize("make_sensor", [IMU, RangeFinder, lambda: Radar((0, 0, 0)), ContactLog])
@pytest.mark.parametrize("make_plugin", [DroneCollisions, ContactResponse, Cars, lambda: FreeBodies(1, size=0.05)])
def test_sensors_measure_behind_stages_that_move_drones(make_plugin, make_sensor):
    """Whatever was added first: an impact within a step is in the IMU's measurement of that step."""
    sims = [Sim(n_drones=2), Sim(n_drones=2)]
    sims[0].add(make_sensor())
    for sim in sims:
        sim.add(make_plugin())
    sims[1].add(make_sensor())
    assert list(sims[0].step_pipeline) == list(sims[1].step_pipeline)


def test_data_from_before_an_object_are_completed_when_they_are_assigned():
    sim = Sim(plugins=[ContactLog()])
    data = sim.data
    wall_ahead(sim)
    sim.step()
    sim.data = data
    assert sim.data.objects.names == ("wall:0",)
    assert sim.data.plugins["contacts"].objects.shape == (1, 1, 1)
    sim.step()


@pytest.mark.parametrize("mocap", [True, False])
def test_law_09_steps_and_data_of_an_earlier_scene_are_refused(mocap):
    sim = Sim(plugins=[RangeFinder(), ContactLog()])
    step, data, default = sim.build_step_fn(), sim.data, sim.default_data
    sim.scene.add("box", pos=[0, 3, 0], mocap=mocap)
    with pytest.raises(ConfigError, match=r"Use sim.step_fn and sim.data after sim.scene.add"):
        step(data)
    with pytest.raises(ConfigError, match=r"Use sim.step_fn and sim.data after sim.scene.add"):
        jax.jit(step)(sim.data)
    with pytest.raises(ConfigError, match=r"Use sim.step_fn and sim.data after sim.scene.add"):
        sim.step_fn(data)
    with pytest.raises(ConfigError, match=r"expected data and default_data of one simulation"):
        sim.reset_fn(sim.data, default)
    jax.eval_shape(sim.step_fn, sim.data)


def test_law_09_an_environment_refuses_objects_that_are_added_later():
    env = make("hover", 1)
    with pytest.raises(ConfigError, match=r"Use sim.scene.add before DroneEnv\(sim, ...\)"):
        env.sim.scene.add("wall")
    with pytest.raises(ConfigError, match=r"Use sim.scene.add before DroneEnv\(sim, ...\)"):
        env.sim.add(SlungLoad(0.01))
    env.reset(jax.random.key(0))
    sim = Sim(control="attitude")
    env.task.install(sim)
    sim.scene.add("wall", pos=[3, 0, 0])
    assert DroneEnv(sim, env.task).reset(jax.random.key(0)).data.objects.names == ("wall:0",)


def kalman():
    return Kalman([IMU(), MotionCapture()])


@pytest.mark.parametrize("needed, plugin", [
    (Battery(), BatteryVoltage()),
    (RangeFinder(), MultiRanger()),
    (IMU(), Kalman([IMU(), MotionCapture()])),
    (Battery(), Randomize(charge=(0.5, 1.0))),
    (Latency(np.zeros((1, 1), int), max_delay=2), Randomize(delay=(0, 2))),
])  # fmt: skip
def test_law_09_a_plugin_that_another_one_needs_cannot_be_removed(needed, plugin):
    sim = Sim(control="attitude")
    for p in (MotionCapture(), needed, plugin):
        sim.add(p)
    stages, data = dict(sim.step_pipeline), sim.data
    with pytest.raises(ConfigError, match=rf"^(?!.*sim.add).*Use sim.remove\({plugin.name!r}\) first"):
        sim.remove(needed.name)
    assert dict(sim.step_pipeline) == stages
    assert trees_equal(sim.data, data)
    sim.remove(plugin.name)
    sim.remove(needed.name)
    assert list(sim.plugins) == ["motion_capture"]


PLUGINS = {
    "battery": Battery,
    "battery_voltage": BatteryVoltage,
    "wind": lambda: Wind((1.0, 0, 0)),
    "imu": IMU,
    "motion_capture": MotionCapture,
    "kalman": kalman,
    "latency": lambda: Latency(np.zeros((1, 2), int), max_delay=3),
    "randomize": lambda: Randomize(charge=(0.5, 1.0), delay=(0, 3), mass=(0.9, 1.1)),
    "range_finder": RangeFinder,
    "multi_ranger": MultiRanger,
    "contact_response": lambda: ContactResponse(iterations=2),
    "contacts": ContactLog,
    "load": lambda: SlungLoad(0.005, length=0.1, size=0.02),
    "rotor_jet": RotorJet,
    "terrain": lambda: Terrain(np.zeros((3, 3)), (2.0, 2.0)),
    "downwash": Downwash,
}
GROUPS = [
    ("battery", "battery_voltage"),
    ("range_finder", "multi_ranger"),
    ("imu", "motion_capture", "kalman"),
    ("battery", "latency", "randomize"),
    ("load", "rotor_jet", "contact_response"),
    ("terrain", "contact_response", "contacts"),
    ("wind", "downwash"),
]
"""Plugins that need, replace or touch each other."""
FLYING = ("battery", "battery_voltage", "wind", "motion_capture", "latency", "range_finder", "contact_response", "load")


@st.composite
def changes(draw):
    """Draw names of plugins of one or two groups, which are added or, if they are there, removed."""
    groups = draw(st.lists(st.sampled_from(GROUPS), min_size=1, max_size=2, unique=True))
    return draw(st.lists(st.sampled_from([name for group in groups for name in group]), min_size=3, max_size=12))


def try_orders(sim, names):
    """Add each plugin that is not there and remove each one that is; after an error nothing has changed."""
    for name in names:
        stages, data, default = dict(sim.step_pipeline), sim.data, sim.default_data
        present = dict(sim.plugins)
        try:
            sim.remove(name) if name in present else sim.add(PLUGINS[name]())
        except ConfigError:
            assert dict(sim.plugins) == present
            assert list(sim.step_pipeline) == list(stages)
            assert trees_equal(sim.data, data)
            assert trees_equal(sim.default_data, default)


def rebuilt(sim):
    expected = new_sim()
    for name in sim.plugins:
        expected.add(PLUGINS[name]())
    return expected


@settings(max_examples=3 * EXAMPLES)
@given(names=changes())
@pytest.mark.long("traces the steps of drawn plugins")
def test_plugins_added_and_removed_in_any_order_give_the_same_simulation(names):
    sim = new_sim()
    try_orders(sim, names)
    expected = rebuilt(sim)
    assert list(sim.step_pipeline) == list(expected.step_pipeline)
    assert list(sim.reset_pipeline) == list(expected.reset_pipeline)
    records, expected_records = sim.data.plugins, expected.data.plugins
    assert list(records) == list(expected_records)
    for name in set(records) - {"contacts"}:  # bodies of removed loads stay in the scene, and in the log
        assert trees_equal(records[name], expected_records[name])
    try:
        sim.plugins.check()
    except ConfigError:
        return  # Randomize without a battery, say, which may still be added
    jax.eval_shape(sim.step_fn, sim.data)


@settings(max_examples=max(EXAMPLES // 2, 1))
@given(names=st.lists(st.sampled_from(FLYING), min_size=4, max_size=8))
@pytest.mark.long("traces the steps of drawn plugins")
def test_plugins_added_and_removed_in_any_order_give_the_same_flight(names):
    sim = new_sim()
    try_orders(sim, names)
    require_same_flight(sim, rebuilt(sim))


def test_a_stage_stays_where_it_was_inserted_when_its_neighbours_go():
    sim = Sim(plugins=[IMU(), MotionCapture(), ContactResponse()])
    for k, anchor in enumerate(("integration", "contact_response", "imu", "motion_capture_begin")):
        insert_fn_after(sim.step_pipeline, anchor, lambda data: data, f"mine_{k}")
    for name in list(sim.plugins):
        sim.remove(name)
    names = ["integration", "mine_0", "clip_floor_pos", "mine_1", "mine_2", "mine_3", "increment_steps"]
    assert list(sim.step_pipeline)[2:] == names
