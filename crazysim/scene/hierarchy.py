"""Bounding volume hierarchy of geoms, as a table that a ray walks without a stack.

Nodes are in depth-first order. Each node has the index of the node after its subtree; a ray that misses the box of the
node continues there. Each of the eight octants of directions has its own order, in which nearer boxes come first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from crazysim.geometry.shapes import UNBOUNDED_LENGTH

N_ORDERS = 8
"""Number of orders of the nodes: one for each octant of directions."""
BOX_PADDING = 1e-4
"""Enlargement of boxes on all sides, m, so that no ray misses the box of a geom because of rounding. It exceeds the
spacing of float32 numbers up to 1 km, 6e-5 m."""


@dataclasses.dataclass
class _Node:
    low: np.ndarray
    """Lower corner of the box, m. (3,)"""
    high: np.ndarray
    """Upper corner of the box, m. (3,)"""
    axis: int = 0
    """Axis along which the children are sorted."""
    children: tuple[_Node, _Node] | None = None
    """Subtrees, in ascending order along ``axis``; None for a leaf."""
    geom: int = -1
    """Index of the geom of a leaf; -1 for other nodes."""


def build_hierarchy(low: np.ndarray, high: np.ndarray, n_orders: int = N_ORDERS) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of a hierarchy of boxes, in all orders.

    Bit k of an order's number is set where directions along axis k are negative.

    Args:
        low: Lower corners of the boxes, m. (n, 3)
        high: Upper corners, m. (n, 3)
        n_orders: Number of orders; 1 for a search that has no direction.

    Returns:
        Lower and upper corner of the box of each node, m. (n_orders, n_nodes, 6)
        Index of the node after its subtree, and index of the geom of a leaf or -1. (n_orders, n_nodes, 2)
    """
    low, high = low - BOX_PADDING, high + BOX_PADDING
    is_bounded = np.all(high - low < UNBOUNDED_LENGTH, axis=1)
    roots = [_Node(low[k], high[k], geom=int(k)) for k in np.flatnonzero(~is_bounded)]
    if is_bounded.any():
        roots.append(_build_tree(low, high, np.flatnonzero(is_bounded)))
    rows = np.array([_node_rows(roots, order) for order in range(n_orders)]).reshape(n_orders, -1, 8)
    return rows[..., :6], rows[..., 6:].astype(np.int32)


def build_hierarchies(
    low: np.ndarray, high: np.ndarray, groups: Sequence[np.ndarray], n_orders: int = N_ORDERS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return hierarchies of groups of boxes, one after the other in every order; see ``build_hierarchy``.

    Args:
        low: Lower corners of all boxes, m. (n, 3)
        high: Upper corners, m. (n, 3)
        groups: Indices of the boxes of each group.
        n_orders: As in ``build_hierarchy``.

    Returns:
        Boxes of the nodes. (n_orders, n_nodes, 6)
        Links, in which nodes are counted from the first node of their group. (n_orders, n_nodes, 2)
        First node and number of nodes of each group. (n_groups, 2)
    """
    boxes, links, counts = [np.zeros((n_orders, 0, 6))], [np.zeros((n_orders, 0, 2), np.int32)], []
    for group in groups:
        group_boxes, group_links = build_hierarchy(low[group], high[group], n_orders)
        is_leaf = group_links[..., 1] >= 0
        group_links[..., 1][is_leaf] = group[group_links[..., 1][is_leaf]]
        boxes.append(group_boxes)
        links.append(group_links)
        counts.append(group_boxes.shape[1])
    ranges = np.stack([np.cumsum([0, *counts[:-1]]), counts], axis=-1).astype(np.int32)
    return np.concatenate(boxes, axis=1), np.concatenate(links, axis=1), ranges


def _build_tree(low: np.ndarray, high: np.ndarray, geoms: np.ndarray) -> _Node:
    # Each split minimises the sum over both parts of surface area times number of boxes. Each part has more than an
    # eighth of the boxes, which bounds the depth.
    node = _Node(low[geoms].min(axis=0), high[geoms].max(axis=0), geom=int(geoms[0]))
    n = len(geoms)
    if n == 1:
        return node
    ranking = np.argsort(low[geoms] + high[geoms], axis=0, kind="stable")  # along each axis
    lows, highs = low[geoms][ranking], high[geoms][ranking]  # (n, 3, 3): rank, axis of the ranking, component

    def half_surface_areas(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(high - low, -1, 0)
        return x * y + y * z + z * x

    first_area = half_surface_areas(np.minimum.accumulate(lows), np.maximum.accumulate(highs))[:-1]
    second_area = half_surface_areas(np.minimum.accumulate(lows[::-1]), np.maximum.accumulate(highs[::-1]))[::-1][1:]
    count = np.arange(1, n)[:, None]
    cost = first_area * count + second_area * (n - count)
    min_count = n // 8
    cost = cost[min_count : n - 1 - min_count]
    split, axis = np.unravel_index(int(np.argmin(cost)), cost.shape)
    parts = np.split(geoms[ranking[:, axis]], [int(split) + min_count + 1])
    node.axis, node.geom = int(axis), -1
    node.children = _build_tree(low, high, parts[0]), _build_tree(low, high, parts[1])
    return node


def _node_rows(roots: list[_Node], order: int) -> list[list[float]]:
    rows: list[list[float]] = []

    def visit(node: _Node) -> None:
        index = len(rows)
        rows.append([])
        if node.children is not None:
            for child in node.children[:: -1 if order >> node.axis & 1 else 1]:
                visit(child)
        rows[index] = [*node.low, *node.high, len(rows), node.geom]

    for root in roots:
        visit(root)
    return rows
