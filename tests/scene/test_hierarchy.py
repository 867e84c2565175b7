"""The hierarchy of boxes: its orders, and what rays find in it."""

import numpy as np
import pytest

from crazysim.scene.hierarchy import BOX_PADDING, N_ORDERS, build_hierarchy


@pytest.fixture(scope="module")
def boxes():
    """Return least and greatest corners of boxes, two of them unbounded. (60, 3) each"""
    rng = np.random.default_rng(0)
    middle, half = rng.uniform(-5, 5, (60, 3)), rng.uniform(0.01, 0.6, (60, 3))
    half[[7, 30]] = 1e18
    return middle - half, middle + half


def test_each_order_has_all_boxes_within_those_of_their_subtrees(boxes):
    found, links = build_hierarchy(*boxes)
    assert found.shape == (N_ORDERS, 2 * 58 - 1 + 2, 6)
    for rows, (after, geom) in zip(found, np.moveaxis(links, -1, 1), strict=True):
        is_leaf = geom >= 0
        assert sorted(geom[is_leaf]) == list(range(60))
        np.testing.assert_allclose(rows[is_leaf, :3], boxes[0][geom[is_leaf]] - BOX_PADDING)
        np.testing.assert_allclose(rows[is_leaf, 3:], boxes[1][geom[is_leaf]] + BOX_PADDING)
        for k, row in enumerate(rows):
            inside = slice(k, after[k])
            assert len(rows[inside]) == 1 if is_leaf[k] else len(rows[inside]) > 2
            assert (rows[inside, :3] >= row[:3]).all()
            assert (rows[inside, 3:] <= row[3:]).all()
            assert (after[inside] <= after[k]).all()


def test_what_is_nearer_along_an_octant_comes_first():
    """Boxes in a row along the diagonal: each order visits them from one end to the other."""
    low = np.arange(20.0)[:, None] * [1.0, 1e-3, 1e-3]
    _, links = build_hierarchy(low, low + 0.5)
    for order, geom in enumerate(links[..., 1]):
        found = geom[geom >= 0]
        np.testing.assert_array_equal(found, np.arange(20)[:: -1 if order & 1 else 1])


def test_equal_boxes_and_none_at_all_have_a_hierarchy():
    assert build_hierarchy(np.zeros((0, 3)), np.zeros((0, 3)))[0].shape == (N_ORDERS, 0, 6)
    geom = build_hierarchy(np.zeros((3000, 3)), np.ones((3000, 3)))[1][3, :, 1]
    assert sorted(geom[geom >= 0]) == list(range(3000))
