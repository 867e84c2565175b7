"""Twins: objects at measured poses, which simulated drones measure, avoid and hit."""

import dataclasses

import numpy as np
import pytest

from crazysim import ContactResponse, RangeFinder, Sim
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.lab.live.attitude import from_rpy, rotate
from crazysim.lab.live.mocap import (
    Frame,
    FunctionSource,
    MocapSource,
    Poll,
    RealTimeSource,
    ReplaySource,
    Rules,
    Twin,
    Twins,
    discover,
    twin_of,
)

LEVEL_QUAT = (0.0, 0.0, 0.0, 1.0)
BOX = Twin("box", {"size": (0.2, 0.2, 0.2)})
BALL = Twin("sphere", {"radius": 0.1})


class ManualSource(MocapSource):
    """Source of the frames that a test sends."""

    def __init__(self):
        self.t, self.frames = 0.0, []

    def send(self, **bodies):
        self.t += 0.01
        self.frames.append(Frame.of(self.t, {n: b if len(b) == 2 else (b, LEVEL_QUAT) for n, b in bodies.items()}))

    def poll(self, step, freq):
        frames, self.frames = self.frames, []
        return Poll(self.t, frames)


@pytest.fixture
def sim():
    return Sim(n_worlds=2, n_drones=1, control="state")


def create_meeting(source, *settings):
    """Return a simulation with two moving balls, its twins, and plugins with which drones measure and hit the balls."""
    sim = Sim(n_worlds=2, n_drones=1, control="state")
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos + np.array([0, 0, 1.0])))
    twins = Twins(sim, source, {"cf": BALL}, ["cf1", "cf2"], *settings)
    rays = sim.add(RangeFinder(directions=[(1, 0, 0)]))
    return sim, twins, rays, sim.add(ContactResponse())


@pytest.fixture(scope="module")
def step():
    """Return the compiled step of the simulations of ``create_meeting``."""
    return create_meeting(ManualSource())[0].build_step_fn()


def test_names_take_the_longest_prefix():
    twins = {"cf": Twin(), "cf_hook": BOX, "bb1": Twin.drone("bumblebee")}
    assert twin_of("cf_hook3", twins) is BOX
    assert twin_of("cf7", twins) is twins["cf"]
    assert twin_of("bb1", twins) is twins["bb1"]
    assert twin_of("bb3", twins) is None


def test_poses_reach_every_world_in_one_write(sim):
    source = ManualSource()
    twins = Twins(sim, source, {"cf": BOX}, ["cf1", "cf2"])
    turned = from_rpy([0.1, 0.2, 0.3])
    source.send(cf1=((1, 2, 3), 5 * turned), cf2=(0, 0, 1))
    twins.update(sim)
    pos, quat = twins.handles["cf1"].pose(sim.data)
    np.testing.assert_allclose(pos, [[[1, 2, 3]]] * 2)
    np.testing.assert_allclose(quat[0, 0], turned, atol=1e-6)
    source.send(cf1=((1.02, 2, 3), turned), cf2=(0, 0, 1))
    twins.update(sim)
    np.testing.assert_allclose(sim.data.objects.vel[:, 0], [[[2, 0, 0], [0, 0, 0]]] * 2, atol=1e-5)
    np.testing.assert_allclose(twins.pose("cf1")[2], [2, 0, 0])


@pytest.mark.parametrize("fixed", [(0.0, None), ("level", None, None), (np.nan, None, None), 0.0, "abc"])
def test_wrong_fixed_angles_are_errors(fixed):
    with pytest.raises(ConfigError, match="expected fixed of Twin"):
        Twin("box", fixed=fixed)


def test_offset_turn_and_fixed_angles(sim):
    source = ManualSource()
    kinds = {
        "a": Twin("box", offset=(0.1, 0, 0), turn=(0, 0, np.pi / 2)),
        "b": Twin("box", offset=(0.1, 0, 0), fixed=(0.0, 0.0, None)),
    }
    twins = Twins(sim, source, kinds, ["a", "b"])
    tilted = from_rpy([0.3, -0.2, np.pi / 2])
    source.send(a=((1, 0, 1), LEVEL_QUAT), b=((2, 0, 1), tilted))
    twins.update(sim)
    np.testing.assert_allclose(twins.pose("a")[0], [1, 0.1, 1], atol=1e-12)
    np.testing.assert_allclose(twins.pose("a")[1], from_rpy([0, 0, np.pi / 2]), atol=1e-12)
    np.testing.assert_allclose(twins.pose("b")[0], [2, 0.1, 1], atol=1e-12)
    np.testing.assert_allclose(twins.pose("b")[1], from_rpy([0, 0, np.pi / 2]), atol=1e-12)


def test_twins_with_a_parent_hang_at_its_joint(sim):
    """A hook hangs at its joint below a drone; a trailer stays at the length of its drawbar."""
    source = ManualSource()
    kinds = {
        "bb": Twin.drone("bumblebee"),
        "hook": Twin("pole", {"height": 0.4}, parent="bb1", at=(0.03, 0, -0.03)),
        "car": BOX,
        "trailer": Twin("box", parent="car1", at=(-0.18, 0, 0), length=0.18),
    }
    twins = Twins(sim, source, kinds, ["hook3", "trailer", "bb1", "car1"])
    yawed, swung = from_rpy([0, 0, np.pi / 2]), from_rpy([0.4, 0, 0])
    source.send(bb1=((1, 1, 1), yawed), hook3=((1.1, 1.2, 0.9), swung), car1=(0, 0, 0.1), trailer=(-0.18, 0.5, 0.1))
    twins.update(sim)
    np.testing.assert_allclose(twins.pose("hook3")[0], [1, 1.03, 0.97], atol=1e-12)
    np.testing.assert_allclose(twins.pose("hook3")[1], swung, atol=1e-12)
    np.testing.assert_allclose(twins.pose("trailer")[0], [-0.18, 0.18, 0.1], atol=1e-12)


def test_wrong_skeletons_and_names(sim):
    with pytest.raises(ConfigError, match="without a circle"):
        Twins(sim, ManualSource(), {"a": Twin(parent="b"), "b": Twin(parent="a")}, ["a", "b"])
    with pytest.raises(ConfigError, match="expected parents among"):
        Twins(sim, ManualSource(), {"a": Twin(parent="b")}, ["a"])
    with pytest.raises(UnknownNameError, match="names that begin with"):
        Twins(sim, ManualSource(), {"a": Twin()}, ["x"])
    twins = Twins(sim, ManualSource(), {"a": Twin()}, ["a"])
    with pytest.raises(UnknownNameError, match="one of the bodies"):
        twins.freeze("b")


def test_a_frozen_twin_keeps_its_pose(sim):
    source = ManualSource()
    twins = Twins(sim, source, {"": BOX}, ["a", "b"])
    source.send(a=(1, 0, 1), b=(2, 0, 1))
    twins.update(sim)
    twins.freeze("a")
    source.send(a=(1.1, 0, 1), b=(2.1, 0, 1))
    twins.update(sim)
    np.testing.assert_allclose(sim.data.objects.pos[0, 0], [[1, 0, 1], [2.1, 0, 1]])
    np.testing.assert_allclose(sim.data.objects.vel[0, 0, 0], 0)
    twins.thaw()
    twins.update(sim)
    np.testing.assert_allclose(sim.data.objects.pos[0, 0], [[1.1, 0, 1], [2.1, 0, 1]])


def test_the_rest_continues_when_one_body_fails(sim):
    source = ManualSource()
    twins = Twins(sim, source, {"": BOX}, ["a", "b"])
    source.send(a=(1, 0, 1), b=(2, 0, 1))
    source.send(a=(np.nan, 0, 1), b=(2.01, 0, 1), stranger=(0, 0, 0))
    twins.update(sim)
    np.testing.assert_allclose(sim.data.objects.pos[0, 0], [[1, 0, 1], [2.01, 0, 1]])
    assert [(r.kind, r.name) for r in twins.reports.latest] == [("unknown", "stranger"), ("invalid", "a")]


def test_objects_before_their_first_pose_are_out_of_the_way(sim):
    twins = Twins(sim, ManualSource(), {"": BOX}, ["a"])
    twins.update(sim)
    report = sim.contact_report(twins.handles["a"], floor=False, drones=False)
    assert report.object_distance.min() > 90


def test_a_reset_keeps_the_measured_pose(sim):
    source = ManualSource()
    twins = Twins(sim, source, {"": BOX}, ["a"])
    source.send(a=(1, 0, 1))
    twins.update(sim)
    sim.step(2)
    sim.reset()
    twins.update(sim)
    np.testing.assert_allclose(sim.data.objects.pos[0, 0, 0], [1, 0, 1])


def test_a_source_in_simulated_time_begins_again_after_a_reset(sim):
    twins = Twins(sim, FunctionSource(lambda t: {"a": ((1 + t, 0, 1), LEVEL_QUAT)}, 100.0), {"": BOX}, ["a"])
    for _ in range(2):
        for _ in range(5):
            twins.update(sim)
            sim.step(50)
        assert twins.pose("a")[0][0] == pytest.approx(1.4)
        sim.reset()
    twins.update(sim)
    assert twins.pose("a")[0][0] == pytest.approx(1.0)
    assert not twins.reports.latest


def test_simulated_drones_measure_report_and_hit_a_real_one(step):
    source = ManualSource()
    sim, twins, rays, response = create_meeting(source)
    command = np.zeros((2, 1, 16))
    command[..., 2] = 1.0
    sim.state_control(command)
    source.send(cf1=(1.1, 0, 1))
    twins.update(sim)
    sim.data = step(sim.data, 5)
    np.testing.assert_allclose(rays.read(sim.data).distance, 1.0, atol=0.01)
    assert not sim.contact_report(twins.handles["cf1"]).objects.any()
    impulse, has_touched = 0.0, False
    for k in range(100):  # the real drone flies at 1 m/s through the simulated drone
        source.send(cf1=(1.1 - 0.01 * k, 0, 1))
        twins.update(sim)
        for _ in range(5):
            sim.data = step(sim.data, 1)
            impulse = min(impulse, float(response.read(sim.data).impulse[0, 0, 0]))
        has_touched |= bool(sim.contact_report(twins.handles["cf1"]).objects.any())
    assert has_touched
    assert impulse < -0.001  # pushed along -x, N s
    assert float(sim.data.states.pos[0, 0, 0]) < -0.02  # it slides off a ball


def test_simulated_drones_avoid_a_real_one(sim):
    """A drone that keeps 0.5 m from the twin's pose in the data never touches it."""
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(1.0)))
    source = ManualSource()
    twins = Twins(sim, source, {"cf": BOX}, ["cf1"])
    closest = np.inf
    for k in range(150):
        source.send(cf1=(1.5 - 0.01 * k, 0.05, 1))
        twins.update(sim)
        real = np.asarray(twins.handles["cf1"].pose(sim.data)[0])
        offset = np.asarray(sim.data.states.pos) - real
        command = np.zeros((2, 1, 16))
        gap = np.linalg.norm(offset, axis=-1, keepdims=True)
        command[..., :3] = np.where(gap < 0.8, real + 0.8 * offset / gap, np.asarray(sim.data.states.pos))
        command[..., 2] = 1.0
        sim.state_control(command)
        sim.step(5)
        closest = min(closest, float(sim.contact_report(twins.handles["cf1"]).object_distance.min()))
    assert closest > 0.1


def test_discovery_lists_names_that_have_a_twin():
    poses = {"cf1": ((0, 0, 1), LEVEL_QUAT), "wand": ((0, 0, 1), LEVEL_QUAT)}
    with RealTimeSource(FunctionSource(lambda t: poses, 100.0)).start() as source:
        assert discover(source, {"cf": BOX}, 0.3) == ("cf1",)


def test_a_recorded_stream_gives_the_same_run_bit_for_bit(tmp_path, step):
    """A thread sends in real time, so that frames arrive between any two steps; the replay repeats all of it."""

    def bodies(t):
        swing = 0.25 * np.cos(3 * t)
        return {"cf1": ((swing, 0, 1.0), from_rpy([0, 0, t])), "cf2": ((0, swing, 1.2), LEVEL_QUAT)}

    def run(source, record=None):
        sim, twins, *_ = create_meeting(source, Rules(stalled=0.01), record)
        command = np.zeros((2, 1, 16))
        command[..., 2] = 1.0
        steps = []
        with twins:
            for _ in range(60):
                twins.update(sim)
                command[:, 0, :2] = 0.1 * np.asarray(sim.data.objects.pos)[:, 0, [0, 1], :2].sum(axis=1)
                sim.state_control(command)
                sim.data = step(sim.data, 5)
                steps.append([np.asarray(x) for x in (sim.data.states.pos, sim.data.states.quat, sim.data.objects.vel)])
        return steps, twins

    path = tmp_path / "stream.mocap"
    live, twins = run(RealTimeSource(FunctionSource(bodies, 240.0)).start(), str(path))
    assert twins.tracker.n_frames > 5
    replayed, _ = run(ReplaySource(path))
    for a, b in zip(live, replayed, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    assert np.ptp([x[0][0, 0, 0] for x in live]) > 1e-4
    assert np.isfinite(rotate(live[-1][1], np.ones(3))).all()


def test_playback_moves_objects_in_the_compiled_step():
    """Every world replays the stream from its own start time; drones measure the objects within the step."""
    sim = Sim(n_worlds=3, n_drones=1, control="state")
    sim.scene.add("box", "fixed_by_handle", pos=[0.0, -5.0, 0.0])
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(1.0)))

    def bodies(t):
        return {"cf1": ((1.0 + t, 0, 1), from_rpy([0, 0, 3 * t])), "cf2": ((0, 2, 1), LEVEL_QUAT)}

    source = FunctionSource(bodies, 50.0)
    twins = Twins(sim, source, {"cf": BOX}, ["cf1", "cf2"])
    playback = sim.add(twins.playback(source, 2.0, freq=50, start=[0.0, 0.5, 10.0]))
    rays = sim.add(RangeFinder(directions=[(1, 0, 0)]))
    command = np.zeros((3, 1, 16))
    command[..., 2] = 1.0
    sim.state_control(command)
    sim.step(101)  # the last step began at 0.2 s
    pos, quat = twins.handles["cf1"].pose(sim.data)
    np.testing.assert_allclose(pos[:, 0], [[1.2, 0, 1], [1.7, 0, 1], [2.98, 0, 1]], atol=1e-5)
    np.testing.assert_allclose(np.abs(quat[1, 0] @ from_rpy([0, 0, 2.1])), 1, atol=1e-5)
    np.testing.assert_allclose(sim.data.objects.vel[:, 0, 1, 0], [1, 1, 0], atol=1e-3)
    np.testing.assert_allclose(sim.data.objects.pos[:, 0, 0, 1], -5)
    assert np.all(np.asarray(rays.read(sim.data).distance)[0] < 1.15)
    sim.reset()
    sim.step()
    np.testing.assert_allclose(twins.handles["cf1"].pose(sim.data)[0][0, 0], [1, 0, 1], atol=1e-5)
    assert playback.read(sim.data).start.shape == (3, 1)


def test_wrong_playbacks(sim):
    source = FunctionSource(lambda t: {"a": ((t, 0, 1), LEVEL_QUAT)}, 50.0)
    twins = Twins(sim, source, {"a": BOX}, ["a"])
    with pytest.raises(ConfigError, match="at least two samples"):
        twins.playback(source, 0.0)
    good = twins.playback(source, 1.0)
    for wrong in ({"pos": good.pos[:1]}, {"start": [0.0] * 5}, {"freq": 0.0}, {"quat": np.nan * good.quat}):
        with pytest.raises(ConfigError, match="expected"):
            sim.add(dataclasses.replace(good, **wrong))
