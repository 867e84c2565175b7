"""Maps: every world sees and touches its own map and no other, whichever query asks; draws, choices, wrong input."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import with_states

from crazysim import ConfigError, ContactLog, ContactResponse, Maps, RangeFinder, Sim
from crazysim.envs import AutoReset, make
from crazysim.media import Recorder
from crazysim.media.flight_recorder import show_flight_at

KINDS = ("box", "sphere", "cylinder", "capsule")
INDEX = [2, 0, 1, 2, 1, 0]
BEAMS = [(1, 0, 0), (-0.3, 1, 0.1), (0, -1, 0)]


def random_map(seed, n):
    """Return a map of ``n`` geoms of all kinds, which lie within 3 m and overlap."""
    spec, rng = mujoco.MjSpec(), np.random.default_rng(seed)
    for k in range(n):
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{KINDS[k % len(KINDS)].upper()}")
        quat, color = rng.normal(size=4), [*rng.uniform(size=3), 1.0]
        pos, size = rng.uniform([-3, -3, 0], [3, 3, 3]), rng.uniform(0.1, 0.5, 3)
        spec.worldbody.add_geom(type=kind, pos=pos, size=size, quat=quat / np.linalg.norm(quat), rgba=color)
    return spec


SPECS = [random_map(0, 8), random_map(1, 40), mujoco.MjSpec()]
"""The last map is empty."""


def build(spec=None, index=None, **settings):
    """Return a simulation with one map, or with all maps and their plugin; a pole stands in both."""
    maps = None if index is None else Maps(SPECS)
    sim = Sim(1 if index is None else len(index), 2, control="state", **settings)
    sim.scene.add("pole", pos=[1, 1, 0])
    if maps is not None:
        sim.add(maps)
    elif len(spec.geoms):
        sim.scene.add(spec, "maps", mocap=False)
    sim.add(RangeFinder(BEAMS))
    sim.add(ContactLog())
    sim.reset()
    if maps is not None:
        sim.data = maps.select(sim.data, index)
    return sim, maps


@functools.cache
def all_maps():
    return build(index=INDEX)


@functools.cache
def queries_of_all_maps():
    sim, maps = all_maps()
    return jax.jit(sim.scene.depth_fn("fpv_cam", 16, 12, color=True)), jax.jit(maps.clearance)


def random_poses(rng, n):
    quat = rng.normal(size=(n, 2, 4))
    return rng.uniform([-3, -3, 0.1], [3, 3, 3], (n, 2, 3)), quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def named(hits):
    names = [*(name.replace("maps:0", "maps") for name in hits.names), "nothing"]
    return np.array(names)[np.asarray(hits.body_index)]


def finite(x):
    return np.nan_to_num(np.asarray(x), posinf=1e3)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_a_world_sees_and_touches_its_map_alone(k):
    """All queries equal, to rounding, those of a simulation that has only this map, in random poses."""
    (sim, _), (one, _), (images, clearance) = all_maps(), build(SPECS[k]), queries_of_all_maps()
    image, rng = jax.jit(one.scene.depth_fn("fpv_cam", 16, 12, color=True)), np.random.default_rng(k)
    worlds, seen = np.flatnonzero(np.array(INDEX) == k), 0
    for _ in range(10):
        pos, quat = random_poses(rng, len(INDEX))
        data = with_states(sim.data, pos=pos, quat=quat)
        hits, sim.data = images(data), data
        report = sim.contact_report()
        gaps = clearance(data, data.states.pos)
        for i in worlds:
            one.data = with_states(one.data, pos=pos[i : i + 1], quat=quat[i : i + 1])
            hit = image(one.data)
            np.testing.assert_allclose(finite(hits.distance[i]), finite(hit.distance[0]), rtol=1e-6)
            np.testing.assert_allclose(hits.normal[i], hit.normal[0], atol=1e-5)
            np.testing.assert_array_equal(named(hits)[i], named(hit)[0])
            np.testing.assert_array_equal(hits.color[i], hit.color[0])
            seen += np.sum(named(hits)[i] == "maps")
            single = one.contact_report()
            columns = [report.object_names.index(name.replace("maps:0", "maps")) for name in single.object_names]
            distances = np.asarray(report.object_distance[i])[:, columns]
            np.testing.assert_allclose(distances, single.object_distance[0], atol=1e-6)
            ball = one.scene.collision_model.drones[0].geoms[0]
            near = report.object_distance[i][:, report.object_names.index("maps")]
            assert np.all(np.isinf(near) == (k == 2))
            # The nearest points of a ball around another centre may be as much farther as the centre is.
            reach = ball.shape.size[0] + np.linalg.norm(ball.pos) + 1e-5
            assert np.all(np.abs(finite(gaps[i]) - finite(near)) <= reach)
    assert (seen > 100) == (k < 2)


def test_a_step_measures_and_logs_the_map_of_its_world():
    """Range finders and contact logs in the step equal the queries of the scene after it."""
    sim, _ = all_maps()
    pos, quat = random_poses(np.random.default_rng(7), len(INDEX))
    pos[1, 0] = SPECS[0].geoms[0].pos  # inside a box of the map of this world
    sim.data = with_states(sim.data, pos=pos, quat=quat)
    sim.step(1)
    report, log = sim.contact_report(), sim.plugins["contacts"].read(sim.data)
    np.testing.assert_array_equal(log.objects, report.objects)
    assert log.objects[1, 0, log.object_names.index("maps")]
    for i, k in ((0, 2), (1, 0), (2, 1)):
        one, _ = build(SPECS[k])
        one.data = with_states(one.data, pos=pos[i : i + 1], quat=quat[i : i + 1])
        one.step(1)
        expected = one.data.plugins["range_finder"].distance[0]
        np.testing.assert_allclose(sim.data.plugins["range_finder"].distance[i], expected, rtol=1e-5)


def test_mujoco_has_the_map_of_the_world_that_is_drawn():
    """The other maps are out of sight, in images and in MJX, and the image is that of the map alone."""
    (sim, _), (one, _) = all_maps(), build(SPECS[1])
    pos, quat = random_poses(np.random.default_rng(3), 1)
    sim.data, one.data = (with_states(s.data, pos=pos, quat=quat) for s in (sim, one))
    expected_heights = np.where(np.array(INDEX)[:, None] == np.arange(len(SPECS)), 0.0, -1e4)
    for world, heights in enumerate(expected_heights):
        sim.scene.sync_one(sim.data, world)
        np.testing.assert_allclose([sim.mj_data.body(f"maps:{k}").xpos[2] for k in range(len(SPECS))], heights)
    sim.contacts()
    heights = sim.mjx_data.mocap_pos[:, np.asarray(sim.data.objects.map_ids), 2]
    np.testing.assert_allclose(heights, expected_heights)
    camera = {"distance": 8.0, "lookat": (0.0, 0.0, 1.0), "elevation": -30.0}
    drawn, other, expected = (
        s.render("rgb_array", world, cam_config=camera, width=64, height=48).astype(int)
        for s, world in ((sim, INDEX.index(1)), (sim, INDEX.index(0)), (one, 0))
    )
    np.testing.assert_array_equal(drawn, expected)
    assert np.mean(np.abs(other - expected)) > 10


def test_law_10_draws_depend_on_world_and_episode():
    def draws(n_worlds, n_drones=1):
        sim, maps = Sim(n_worlds, n_drones, rng_key=5), Maps([f"<mujoco model='{k}'/>" for k in range(5)])
        sim.add(maps)
        assert not maps.index(sim.data).any()
        sim.reset()
        return sim, maps

    (sim, maps), (small, _) = draws(200), draws(3, 2)
    first = np.asarray(maps.index(sim.data))
    np.testing.assert_array_equal(maps.index(small.data), first[:3])
    assert np.bincount(first, minlength=5).min() > 20  # 40 expected, 5.7 its deviation
    sim.step(3)
    np.testing.assert_array_equal(maps.index(sim.data), first)
    mask = np.arange(200) < 100
    sim.reset(mask)
    second = np.asarray(maps.index(sim.data))
    np.testing.assert_array_equal(second[100:], first[100:])
    assert 50 < np.sum(second != first) <= 100
    # A choice holds to the end of the episode, and for the chosen worlds alone.
    sim.data = maps.select(sim.data, 4, mask)
    sim.step(3)
    np.testing.assert_array_equal(maps.index(sim.data), np.where(mask, 4, second))
    sim.reset()
    assert len(np.unique(maps.index(sim.data))) == 5
    sim.remove("maps")  # the maps stay, as they are
    sim.reset()
    assert sim.data.objects.map_index.shape == (200, 1)


def test_episodes_of_a_task_draw_maps():
    maps = Maps(SPECS)
    env = AutoReset(make("hover", n_worlds=64, effects=[maps], seconds=0.1))
    state, step, indices = env.reset(jax.random.key(0)), jax.jit(env.step), []
    for _ in range(12):
        indices.append(np.asarray(maps.index(state.data)))
        state = step(state, jnp.zeros((64, 1, 4)))
    changes = np.any(np.diff(indices, axis=0) != 0, axis=1)
    assert np.bincount(indices[0], minlength=3).min() > 8  # 21 expected, 3.8 its deviation
    assert 1 <= changes.sum() <= 3  # at the starts of episodes of 5 steps


def test_a_recorded_flight_is_shown_with_its_maps():
    sim, maps = all_maps()
    recorder = Recorder(sim, worlds=[2, 0])
    for index in (INDEX, [0, 0, 1, 0, 0, 0]):
        sim.data = maps.select(sim.data, index)
        core = sim.data.core
        sim.data = sim.data.replace(core=core.replace(steps=core.steps + sim.freq))
        recorder.add()
    flight = recorder.flight()
    shown, other_maps = build(index=[1] * 6)
    show_flight_at(shown, flight, flight.time[0])
    np.testing.assert_array_equal(other_maps.index(shown.data), [2, 1, 1, 1, 1, 1])
    show_flight_at(shown, flight, flight.time[1])
    np.testing.assert_array_equal(other_maps.index(shown.data), [0, 1, 1, 1, 1, 1])
    sim.data = maps.select(sim.data, INDEX)


def replaced(specs):
    sim = Sim()
    sim.add(Maps(SPECS))
    sim.remove("maps")
    return sim.add(Maps(specs))


def test_maps_return_and_calls_of_clearance_are_traced_once(monkeypatch):
    maps, calls = replaced(SPECS), []
    body = type(maps).body
    monkeypatch.setattr(type(maps), "body", property(lambda self: calls.append(1) or body.func(self)))
    sim, maps = all_maps()
    fresh = Maps(SPECS)
    for x in range(3):
        fresh.clearance(sim.data, jnp.full((len(INDEX), 1, 3), 0.1 * x))
    assert len(calls) == 1


WRONG = [
    (lambda: Maps([]), "1 to"),
    (lambda: Maps(SPECS[0]), r"Maps\(\[spec"),
    (lambda: Sim().add(Maps(["none.xml"])), "an MJCF file"),
    (lambda: Sim().add(Maps([3])), "a body of one"),
    (lambda: Sim().add(Maps(["<mujoco><worldbody><light/></worldbody></mujoco>"])), "Sim.xml_path"),
    (lambda: Maps(SPECS).index(Sim().data), "sim.add"),
    (lambda: all_maps()[1].select(all_maps()[0].data, 3), "index"),
    (lambda: all_maps()[1].select(all_maps()[0].data, [0, 1]), "index of shape"),
    (lambda: all_maps()[0].add(Maps(SPECS[:2]), "more"), "one list of maps"),
    (lambda: all_maps()[0].add(ContactResponse()), "objects="),
    (lambda: replaced(SPECS[::-1]), "one list of maps"),
]


@pytest.mark.parametrize(("act", "message"), WRONG)
def test_wrong_maps_are_refused(act, message):
    with pytest.raises(ConfigError, match=message):
        act()
