"""Pillars, clutter, gates and rooms: distances, layouts, free paths, motion, and wrong input."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states
from scipy import ndimage

from crazysim import Clutter, Forest, Gates, Pillars, Rooms, Sim

TETRAHEDRON = np.array([[0, 0, 0.3], [0.3, 0, -0.1], [-0.15, 0.26, -0.1], [-0.15, -0.26, -0.1]])
KINDS = {
    "forest": Forest(size=(12.0, 12.0), difficulty=0.5),
    "pillars": Pillars(density=0.25, size=(8.0, 6.0), speed=1.0),
    "clutter": Clutter(size=(8.0, 4.0, 2.0), meshes=[TETRAHEDRON], difficulty=0.7),
    "gates": Gates(speed=0.5),
    "rooms": Rooms(count=(2, 2), difficulty=0.8),
}


def build(plugin, n_worlds=3, n_drones=2):
    sim = Sim(n_worlds, n_drones, control="rotor_vel", rng_key=5)
    sim.add(plugin)
    sim.reset()
    return sim


@functools.cache
def shared_build(name):
    return build(KINDS[name])


def poses_of(plugin, data):
    return map(np.asarray, jax.jit(plugin.poses)(data))  # compiled: one program instead of one for each operation


def data_at(sim, seconds):
    core = sim.data.core
    return sim.data.replace(core=core.replace(steps=core.steps + round(seconds * sim.freq)))


@pytest.mark.parametrize("name", KINDS)
def test_clearance_is_the_distance_of_the_contact_report(name):
    plugin, sim = KINDS[name], shared_build(name)
    ball = sim.scene.collision_model.drones[0].geoms[0]
    contacts, clearance = jax.jit(sim.scene.contact_fn(floor=False, drones=False)), jax.jit(plugin.clearance)
    rng, data, result, expected = np.random.default_rng(0), data_at(sim, 7.3), [], []
    pos, _ = poses_of(plugin, data)
    for _ in range(100):
        near = pos[:, rng.integers(pos.shape[1], size=2)] * [1, 1, 0] + [0, 0, 1.5]
        data = with_states(data, pos=near + rng.normal(0, 0.7, (3, 2, 3)))
        result.append(clearance(data, data.states.pos + np.float32(ball.pos)))
        expected.append(contacts(data).object_distance.min(axis=-1) + ball.shape.size[0])
    limit = plugin.cell if isinstance(plugin, (Forest, Pillars)) else np.inf
    assert np.min(result) < 0.02
    np.testing.assert_allclose(result, np.minimum(expected, limit), atol=3e-6)


@pytest.mark.parametrize("name", KINDS)
def test_law_10_a_layout_depends_on_world_and_episode(name):
    plugin = KINDS[name]
    sim, larger_sim = shared_build(name), build(plugin, 4, 1)
    first, all_worlds = (np.concatenate([*poses_of(plugin, s.data)], axis=-1) for s in (sim, larger_sim))
    np.testing.assert_array_equal(first, all_worlds[:3])
    assert len({x.tobytes() for x in all_worlds}) == 4
    larger_sim.reset(np.array([False, True, False, False]))
    changed = np.any(np.concatenate([*poses_of(plugin, larger_sim.data)], axis=-1) != all_worlds, axis=(1, 2))
    np.testing.assert_array_equal(changed, [False, True, False, False])


@pytest.mark.parametrize(
    "plugin", [Forest(size=(12.0, 12.0), speed=1.5), Clutter(size=(6.0, 4.0, 4.0), speed=1.5), Gates(speed=1.5)]
)
def test_moving_obstacles_stay_in_their_regions_below_their_speed(plugin):
    sim = build(plugin, 4)
    times = np.arange(0.0, 8.0, 0.02)
    poses = jax.jit(plugin.poses)
    path = np.array([poses(data_at(sim, t))[0] for t in times])
    vel = np.diff(path, axis=0) / 0.02
    assert np.abs(vel).max() <= 1.5 + 1e-3
    assert np.quantile(np.abs(vel[..., 0]), 0.9) > 1.2
    middle = np.concatenate([model.pos for model in plugin.models()])
    if not isinstance(plugin, Clutter):  # regions of clutter depend on the layout
        shift = np.abs(path - middle)[..., 0]
        reach = plugin.offset[0] if isinstance(plugin, Gates) else (plugin.cell - plugin.gap) / 2
        assert shift.max() <= reach + 1e-5
        assert shift.max() > 0.8 * reach
    sim.step(50)
    np.testing.assert_allclose(poses(sim.data)[0], path[5], atol=1e-5)  # 0.1 s


def test_boxes_and_balls_keep_their_distance():
    plugin = Clutter(density=1.0, size=(4.0, 3.0, 2.0), sizes=(0.1, 0.25), gap=0.3, free=np.zeros((0, 3)))
    sim = build(plugin, 20)
    pos, _ = poses_of(plugin, sim.data)
    models = plugin.models()
    radius = np.concatenate([np.full(len(m.pos), np.linalg.norm(m.shapes[0][0].size)) for m in models])
    assert pos.shape == (20, 24, 3)
    assert {m.source for m in models} == {"box", "sphere"}
    gap = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=-1) - radius[:, None] - radius
    assert gap[:, ~np.eye(24, dtype=bool)].min() >= 0.3 - 1e-5


def test_difficulty_moves_gates_off_their_line():
    easy, hard = (Gates(difficulty=x) for x in (0.0, 1.0))
    pos, quat = poses_of(easy, build(easy).data)
    np.testing.assert_allclose(pos, np.broadcast_to([[3 + 4 * k, 0, 1.5] for k in range(6)], (3, 6, 3)), atol=1e-6)
    np.testing.assert_array_equal(quat[..., 3], 1)
    moved, turned = poses_of(hard, build(hard, 200).data)
    np.testing.assert_allclose(np.abs(moved - pos[0]).max(axis=(0, 1)), [0.5, 2.0, 0.5], rtol=0.02)
    assert 2 * np.arcsin(np.abs(turned[..., 2]).max()) == pytest.approx(0.6, rel=0.02)


def test_a_path_leads_from_each_room_to_all_others():
    """On a grid of 0.2 m, at least 0.2 m from all walls, in 100 buildings."""
    plugin = Rooms(count=(3, 2))
    sim = build(plugin, 100, 1)
    x, y = np.meshgrid(np.arange(-5.9, 6, 0.2), np.arange(-3.9, 4, 0.2), indexing="ij")
    points = jnp.broadcast_to(np.float32(np.stack([x, y, x * 0 + 1], axis=-1).reshape(-1, 3)), (100, x.size, 3))
    gap = np.asarray(jax.jit(plugin.clearance)(sim.data, points)).reshape(100, *x.shape)
    in_layer = np.zeros((3, 3, 3))
    in_layer[1] = ndimage.generate_binary_structure(2, 1)
    area, _ = ndimage.label(gap >= 0.2, in_layer)
    middles = area[:, [10, 30, 50]][:, :, [10, 30]].reshape(100, -1)
    assert middles.min() > 0
    np.testing.assert_array_equal(middles, middles[:, :1].repeat(6, axis=1))
    np.testing.assert_allclose(np.mean(gap < 0.05), np.mean(gap[0] < 0.05), rtol=0.02)
    doors = [np.argmax(gap[k, 20, :20] > 0.4) for k in range(100)]
    assert len(set(doors)) > 2


@pytest.mark.parametrize(
    "plugin",
    [Rooms(), Rooms(count=(2, 1), room=2.35, door=0.75, thickness=0.3), Rooms(count=(1, 3), room=5.0, door=1.2)],
    ids=["default", "two", "three"],
)
def test_doors_have_the_stated_width_wherever_they_are(plugin):
    """Along the middle of every wall the clearance is positive over the width of one door only."""
    sim = build(plugin, 64, 1)
    (n_x, n_y), room = plugin.count, plugin.room
    walls = [(room * (i + 1), room * (j + 0.5), 0) for i in range(n_x - 1) for j in range(n_y)]
    walls += [(room * (i + 0.5), room * (j + 1), 1) for i in range(n_x) for j in range(n_y - 1)]
    t, clearance = np.linspace(-room / 2, room / 2, 2001), jax.jit(plugin.clearance)
    for x, y, is_along_x in walls:
        line = np.stack([x + t * is_along_x, y + t * (1 - is_along_x), t * 0 + 1], axis=-1)
        line -= [n_x * room / 2, n_y * room / 2, 0]
        points = jnp.broadcast_to(np.float32(line), (64, *line.shape))
        is_open = np.asarray(clearance(sim.data, points)) > 0
        np.testing.assert_allclose(is_open.sum(axis=1) * (t[1] - t[0]), plugin.door, atol=2 * (t[1] - t[0]))
