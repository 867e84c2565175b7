"""The hierarchy of bounding boxes, and its eight orders of nodes, one for each octant of directions of rays."""

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


def test_boxes_of_nodes_contain_the_boxes_of_their_subtrees(boxes):
    node_boxes, links = build_hierarchy(*boxes)
    assert node_boxes.shape == (N_ORDERS, 2 * 58 - 1 + 2, 6)
    for rows, (next_node, geom) in zip(node_boxes, np.moveaxis(links, -1, 1), strict=True):
        is_leaf = geom >= 0
        assert sorted(geom[is_leaf]) == list(range(60))
        np.testing.assert_allclose(rows[is_leaf, :3], boxes[0][geom[is_leaf]] - BOX_PADDING)
        np.testing.assert_allclose(rows[is_leaf, 3:], boxes[1][geom[is_leaf]] + BOX_PADDING)
        for k, row in enumerate(rows):
            subtree = slice(k, next_node[k])
            assert len(rows[subtree]) == 1 if is_leaf[k] else len(rows[subtree]) > 2
            assert (rows[subtree, :3] >= row[:3]).all()
            assert (rows[subtree, 3:] <= row[3:]).all()
            assert (next_node[subtree] <= next_node[k]).all()


def test_nearer_boxes_of_an_octant_come_first():
    """Boxes in a row along x: orders of rays towards negative x visit them from the far end, others from the near."""
    low = np.arange(20.0)[:, None] * [1.0, 1e-3, 1e-3]
    _, links = build_hierarchy(low, low + 0.5)
    for order, geom in enumerate(links[..., 1]):
        visited_geoms = geom[geom >= 0]
        np.testing.assert_array_equal(visited_geoms, np.arange(20)[:: -1 if order & 1 else 1])


def test_equal_boxes_and_no_boxes_have_a_hierarchy():
    assert build_hierarchy(np.zeros((0, 3)), np.zeros((0, 3)))[0].shape == (N_ORDERS, 0, 6)
    geom = build_hierarchy(np.zeros((3000, 3)), np.ones((3000, 3)))[1][3, :, 1]
    assert sorted(geom[geom >= 0]) == list(range(3000))


def test_one_order_is_the_first_of_all(boxes):
    for first, orders in zip(build_hierarchy(*boxes, n_orders=1), build_hierarchy(*boxes), strict=True):
        np.testing.assert_array_equal(first, orders[:1])
