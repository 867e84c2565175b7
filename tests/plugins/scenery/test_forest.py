"""Forests: layouts of worlds and episodes, distances, free paths, difficulty, tasks, and wrong input."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import with_states
from scipy import ndimage

from crazysim import Forest, Sim

SMALL_FOREST = {"size": (20.0, 16.0), "center": (4.0, -2.0), "free": [[4.0, -2.0, 2.0]]}
"""Settings of a forest of 20 cells with a free disc in its middle."""


def build(n_worlds=3, n_drones=2, **settings):
    sim = Sim(n_worlds, n_drones, control="rotor_vel", rng_key=5)
    forest = sim.add(Forest(**SMALL_FOREST | settings))
    sim.reset()
    return sim, forest


@pytest.fixture(scope="module")
def half_forest():
    return build(difficulty=0.5)


def positions(sim, forest):
    return np.asarray(jax.jit(forest.poses)(sim.data)[0])


def standing_trees(sim, forest):
    pos = positions(sim, forest)
    radii = np.concatenate([np.full(len(m.pos), m.options["radius"]) for m in forest.models()])
    return [(p[p[:, 2] == 0], radii[p[:, 2] == 0]) for p in pos]


def test_trees_stand_in_their_cells_at_the_requested_density():
    sim, forest = build(n_worlds=200, free=np.zeros((0, 3)))
    assert (forest.cell, forest.n_cells) == (4.0, (5, 4))
    radii = np.concatenate([np.full(len(m.pos), m.options["radius"]) for m in forest.models()])
    assert len(radii) == 20 * 16 / 16
    assert radii.min() == 0.1
    assert radii.max() == pytest.approx(0.3)
    assert len(np.unique(radii)) == 8
    middle = np.concatenate([m.pos for m in forest.models()])[:, :2]
    np.testing.assert_allclose(middle.mean(axis=0), SMALL_FOREST["center"])
    offset = positions(sim, forest)[..., :2] - middle
    reach = (4.0 - 0.6) / 2 - radii
    assert np.all(np.abs(offset[..., 0]) <= reach + 1e-5)
    assert np.all(np.abs(offset[..., 1]) <= reach + 2 + 1e-5)
    scaled = offset / reach[:, None]
    assert np.abs(scaled.mean(axis=(0, 1))).max() < 0.05
    np.testing.assert_allclose(np.std(scaled[..., 0]), 1 / np.sqrt(3), rtol=0.02)  # of a uniform distribution
    assert abs(np.corrcoef(scaled[:, 0, 0], scaled[:, 1, 0])[0, 1]) < 0.25


def test_clearance_points_away_from_the_nearest_tree(half_forest):
    sim, forest = half_forest
    trees, radii = standing_trees(sim, forest)[1]
    point = trees[0] + [radii[0] + 0.2, 0, 1.0]
    slope_of = jax.jit(jax.value_and_grad(lambda pos: forest.clearance(sim.data, pos)[1, 0]))
    value, slope = slope_of(jnp.broadcast_to(jnp.float32(point), (3, 2, 3)))
    assert value == pytest.approx(0.2, abs=1e-5)
    np.testing.assert_allclose(slope[1, 0], [1, 0, 0], atol=1e-5)


def test_a_path_leads_through_each_of_1000_forests():
    """On a grid of 0.2 m, from the near to the far edge, at least 0.2 m from all trees."""
    _, forest = build(1, density=0.25, size=(14.0, 8.0), center=(0.0, 0.0), free=np.zeros((0, 3)))
    x, y = np.meshgrid(np.arange(-7.0, 7.1, 0.2), np.arange(-4.0, 4.1, 0.2), indexing="ij")
    points = jnp.float32(np.stack([x, y, np.ones_like(x)], axis=-1).reshape(1, -1, 3))
    sim = Sim(1000, control="rotor_vel", rng_key=1)
    sim.add(forest)
    sim.reset()
    points = jnp.broadcast_to(points, (1000, *points.shape[1:]))
    gap = np.asarray(jax.jit(forest.clearance)(sim.data, points)).reshape(1000, *x.shape)
    assert np.mean(gap < 0) > 0.005
    in_layer = np.zeros((3, 3, 3))
    in_layer[1] = ndimage.generate_binary_structure(2, 1)
    area = np.asarray(ndimage.label(gap >= 0.2, in_layer)[0])
    n_paths = [np.intersect1d(a[0][a[0] > 0], a[-1][a[-1] > 0]).size for a in area]
    assert min(n_paths) > 0
    assert np.mean(np.all(gap >= 0.2, axis=1).any(axis=1)) < 0.8  # paths are not always straight


def test_difficulty_is_the_fraction_of_trees_that_stand():
    sim, forest = build(n_worlds=300, difficulty=(0.2, 0.6), free=np.zeros((0, 3)))
    difficulty = np.asarray(forest.read(sim.data).difficulty)[:, 0]
    assert difficulty.min() < 0.22
    assert difficulty.max() > 0.58
    fraction = np.mean(positions(sim, forest)[..., 2] == 0, axis=1)
    np.testing.assert_allclose(np.mean(fraction), 0.4, atol=0.03)
    assert np.corrcoef(fraction, difficulty)[0, 1] > 0.6
    stage_before = sim.step_pipeline["forest_begin"]
    sim.replace(Forest(**SMALL_FOREST | {"difficulty": 0.0, "free": np.zeros((0, 3))}))
    assert sim.step_pipeline["forest_begin"] is stage_before  # no stage was built
    sim.reset()
    assert not any(len(trees) for trees, _ in standing_trees(sim, forest))
    assert np.all(np.asarray(jax.jit(forest.clearance)(sim.data, sim.data.states.pos)) == forest.cell)


def test_free_discs_have_no_trees(half_forest):
    sim, forest = half_forest
    for trees, radii in standing_trees(sim, forest):
        assert np.all(np.linalg.norm(trees[:, :2] - [4, -2], axis=1) > 2 + radii)
    sim_without_discs, _ = build(n_worlds=50, free=np.zeros((0, 3)), difficulty=1.0)
    all_trees = np.concatenate([t for t, _ in standing_trees(sim_without_discs, sim_without_discs.plugins["forest"])])
    assert np.any(np.linalg.norm(all_trees[:, :2] - [4, -2], axis=1) < 2)


def test_rays_meet_the_trees_of_each_world(half_forest):
    """Each world has its own image, with the distances of C MuJoCo's rays; hidden trees are in no image."""
    sim, _ = half_forest
    sim.data = with_states(sim.data, pos=[[4, -2, 1.5], [4, -2, 50]], quat=[0, 0, 0, 1])
    hits = jax.jit(sim.scene.depth_fn("fpv_cam:0", 64, 4, drones=False, along="ray"))(sim.data)
    distance, eye = (
        np.asarray(hits.distance)[:, 0, 1],
        np.asarray(sim.airframe.value("shape.fpv_camera")) + [4, -2, 1.5],
    )
    assert not np.allclose(distance[0], distance[1], rtol=0.01)
    image = sim.depth("fpv_cam:0", 64, 4, drones=False, along="ray")
    np.testing.assert_allclose(image, hits.distance, rtol=1e-6)
    points, geom = np.asarray(hits.point)[:, 0, 1], np.zeros(1, np.int32)
    model, own = sim.scene.mj_model, sim.scene.mj_model.body("drone:0").id
    n_trees = 0
    for world in range(3):
        sim.scene.sync_one(sim.plugins.with_moved_objects(sim.data), world)
        for d, point in zip(distance[world], points[world], strict=True):
            if np.isfinite(d):
                ray = (point - eye) / np.linalg.norm(point - eye)
                expected = mujoco.mj_ray(model, sim.scene.mj_data, eye, ray, None, 1, own, geom, None)
                n_trees += model.geom_type[geom[0]] == mujoco.mjtGeom.mjGEOM_CYLINDER
                assert d == pytest.approx(expected, abs=1e-4)
    assert n_trees > 5
