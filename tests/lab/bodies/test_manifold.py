"""Contact manifolds of balls and boxes: depths against the exact overlap, contact points, symmetry, gradients."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from oracle import normalize, rotations

from crazysim.geometry.heightfield import OUTSIDE_DISTANCE
from crazysim.lab.bodies import manifold

HALF_A, HALF_B = (0.1, 0.05, 0.08), (0.12, 0.2, 0.06)
"""Half sizes of the two boxes, m."""
EYE, ZERO = np.eye(3), np.zeros(3)
N = 500
"""Pairs in each call, so that each function is compiled once for all tests."""


def poses(rng, n):
    rot = rotations(normalize(rng.normal(size=(2 * n, 4))))
    return rng.uniform(-0.25, 0.25, size=(n, 3)), rot[:n], rot[n:]


def compile_for_pairs(fn, *cores):
    """Compile a function of one pair, with arguments of some shapes, for one pair or up to ``N`` pairs."""
    compiled = jax.jit(jax.vmap(fn))

    def call(*args):
        args = [np.asarray(x, np.float32) for x in args]
        batch = np.broadcast_shapes(*(x.shape[: x.ndim - len(core)] for x, core in zip(args, cores, strict=True)))
        n = max(batch, default=1)
        rows = [np.resize(np.broadcast_to(x, (n, *core)), (N, *core)) for x, core in zip(args, cores, strict=True)]
        return jax.tree.map(lambda x: np.asarray(x)[:n] if batch else np.asarray(x)[0], compiled(*rows))

    return call


boxes = compile_for_pairs(manifold.box_contacts, *[(3,), (3,), (3, 3)] * 2)
ball_on_box = compile_for_pairs(manifold.ball_box_contacts, (), (3,), (3,), (3,), (3, 3))


def contacts_of_boxes(pos, rot_a, rot_b):
    return boxes(HALF_A, pos, rot_a, HALF_B, ZERO, rot_b)


def largest_separation(pos, rot_a, rot_b):
    """Return the largest separation over the 15 axes, m, computed by loops in float64."""
    axes = [*rot_a.T, *rot_b.T, *(np.cross(x, y) for x in rot_b.T for y in rot_a.T)]
    result = []
    for axis in axes:
        length = np.linalg.norm(axis)
        if length > 1e-3:
            axis = axis / length
            reach = np.abs(rot_a.T @ axis) @ HALF_A + np.abs(rot_b.T @ axis) @ HALF_B
            result.append(abs(pos @ axis) - reach)
    return max(result)


def test_boxes_overlap_where_no_axis_separates_them(rng):
    """The deepest point has the minimum overlap; if faces are preferred to edges, it is a little deeper."""
    pos, rot_a, rot_b = poses(rng, 500)
    gap = contacts_of_boxes(pos, rot_a, rot_b).gap.min(axis=1)
    exact = np.array([largest_separation(*x) for x in zip(pos, rot_a, rot_b, strict=True)])
    touching = exact < 0
    assert 50 < touching.sum() < 450
    np.testing.assert_array_equal(gap[touching] < 0, True)
    assert np.all(gap[~touching] > 0)
    np.testing.assert_array_less(np.abs(gap - exact)[touching], 0.06 * np.abs(exact[touching]) + 0.011 * 0.05)


def test_a_box_on_a_box_rests_on_the_corners_of_their_overlap():
    result = boxes(HALF_A, [0.03, 0.02, 0.139], EYE, HALF_B, ZERO, EYE)
    is_contact = result.gap < 1
    points = result.point[is_contact]
    np.testing.assert_allclose(result.gap[is_contact], -0.001, atol=1e-6)
    np.testing.assert_allclose(result.normal[is_contact], np.tile([0, 0, 1.0], (is_contact.sum(), 1)), atol=1e-6)
    expected = [(x, y) for x in (-0.07, 0.12) for y in (-0.03, 0.07)]
    np.testing.assert_allclose(sorted(points[:, :2].round(4).tolist()), expected, atol=1e-4)
    np.testing.assert_allclose(points[:, 2], 0.0595, atol=1e-6)


def test_rounding_does_not_turn_contacts_of_faces_into_contacts_of_edges(rng):
    """If parallel faces touch up to rounding, there is no contact of two edges."""
    turned = rotations(np.array([[np.cos(x / 2), 0, 0, np.sin(x / 2)] for x in rng.uniform(0.05, 0.3, N)]))
    world = rotations(normalize(rng.normal(size=(N, 4))))
    offset = np.stack([*rng.uniform(-0.01, 0.01, (2, N)), 0.2 + rng.uniform(-1e-7, 1e-7, N)], axis=-1)
    first = (0.1, 0.1, 0.1), np.einsum("nij,nj->ni", world, offset), world @ turned
    result = boxes(*first, (0.1, 0.1, 0.1), ZERO, world)
    assert (result.gap[:, -1] == OUTSIDE_DISTANCE).all()
    assert (result.gap[:, :-1] < OUTSIDE_DISTANCE).sum(axis=1).min() >= 4


@pytest.mark.parametrize("above", [True, False])
def test_a_small_box_on_a_large_one_rests_on_its_four_corners_once_each(above):
    small, large = ((0.05, 0.04, 0.03), [0.1, 0.0, 0.089]), (HALF_B, ZERO)
    first, second = (small, large) if above else (large, small)
    result = boxes(*first, EYE, *second, EYE)
    points = result.point[result.gap < 1]
    expected = [(x, y) for x in (0.05, 0.12) for y in (-0.04, 0.04)]  # cut at the edge of the large one, at 0.12
    np.testing.assert_allclose(sorted(points[:, :2].round(4).tolist()), expected, atol=1e-4)


def test_edges_that_cross_touch_at_one_point():
    """Two long bars turned by 45 degrees about their axes, one along x above one along y."""
    half = [1.0, 0.1, 0.1]
    about_x = rotations([[np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]])[0]
    along_y = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ about_x
    height = 2 * 0.1 * np.sqrt(2) - 0.004
    result = boxes(half, [0.2, 0.3, height], about_x, half, ZERO, along_y)
    contacts = np.flatnonzero(result.gap < 1)
    assert contacts.tolist() == [12]
    np.testing.assert_allclose(result.gap[12], -0.004, atol=1e-5)
    np.testing.assert_allclose(result.normal[12], [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(result.point[12], [0.0, 0.3, height / 2], atol=1e-5)


@pytest.mark.parametrize("centre, gap, normal", [
    ([0.0, 0.0, 0.2], 0.2 - 0.06 - 0.05, [0, 0, 1]),
    ([0.12 + 0.03, 0.24, 0.0], 0.05 - 0.05, [0.6, 0.8, 0]),
    ([0.0, 0.0, 0.05], -0.01 - 0.05, [0, 0, 1]),
    ([-0.11, 0.0, 0.0], -0.01 - 0.05, [-1, 0, 0]),
])  # fmt: skip
def test_a_ball_on_a_box_by_hand(centre, gap, normal):
    result = ball_on_box(0.05, centre, HALF_B, ZERO, EYE)
    np.testing.assert_allclose(result.gap, [gap], atol=1e-6)
    np.testing.assert_allclose(result.normal[0], normal, atol=1e-5)


def test_gaps_are_those_of_mujoco(rng):
    """Gaps of separated balls and boxes equal distances of MuJoCo."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
        <body><freejoint/><geom type="sphere" size="0.05"/></body>
        <body><freejoint/><geom type="box" size="0.12 0.2 0.06"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    pos, _, rot = poses(rng, 40)
    pos *= 1.5
    result = ball_on_box(0.05, pos, HALF_B, ZERO, rot)
    for p, r, gap in zip(pos, rot, result.gap[:, 0], strict=True):
        data.qpos[:3], data.qpos[7:10] = p, 0
        mujoco.mju_mat2Quat(data.qpos[10:14], r.ravel())
        mujoco.mj_kinematics(model, data)
        expected = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
        np.testing.assert_allclose(gap, expected, atol=2e-6)


def test_law_07_values_and_gradients_are_finite(rng):
    """Boxes coincide, share an axis, or lie far away."""
    pos, rot_a, rot_b = poses(rng, 30)
    pos = np.concatenate([pos, [[0, 0, 0], [0, 0, 0.14], [1e4, 0, 0]]])
    rot_a, rot_b = (np.concatenate([r, np.tile(EYE, (3, 1, 1))]) for r in (rot_a, rot_b))

    def total(p, r, s):
        result = manifold.box_contacts(jnp.asarray(HALF_A), p, r, jnp.asarray(HALF_B), jnp.zeros(3), s)
        return (
            jnp.sum(jnp.where(result.gap < OUTSIDE_DISTANCE, result.gap, 0.0))
            + jnp.sum(result.normal)
            + jnp.sum(result.point)
        )

    box_gradients = jax.jit(jax.vmap(jax.value_and_grad(total, argnums=(0, 1))))(pos, rot_a, rot_b)
    ball_gradients = jax.jit(
        jax.value_and_grad(lambda p: jnp.sum(manifold.ball_contacts(0.1, p, 0.1, jnp.zeros(3)).gap))
    )(ZERO)
    for leaf in jax.tree.leaves((box_gradients, ball_gradients)):
        assert np.isfinite(leaf).all()
