"""Search for the nearest of many geoms that do not move, in their hierarchy, for one drone in a stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim.core.branches import any_lane, compute_where, table_rows
from crazysim.rotation import safe_sqrt
from crazysim.scene.hierarchy import build_hierarchies


def nearest_geom(
    low: np.ndarray,
    high: np.ndarray,
    point: Sequence[Array],
    reach: float,
    distance: Callable[[Array], Array],
    groups: Sequence[np.ndarray],
    group: Array,
) -> Array:
    """Return the index of the geom with the smallest distance, int32, -1 if there is none, without a derivative. ()

    Nodes are visited in depth-first order. If the box of a node is no nearer than the best geom so far, its
    subtree is skipped.

    Args:
        low: Lower corners of boxes around the geoms, m. (n, 3)
        high: Upper corners, m. (n, 3)
        point: Coordinates of the position of a body, m. () each
        reach: Radius of the ball around the position that contains the body, m.
        distance: Function from the index of a geom to the signed distance of the body to it, m. () -> ()
        groups: Indices of the geoms of each group.
        group: Index of the group that is searched. ()
    """
    dtype = point[0].dtype
    node_boxes, node_links, ranges = build_hierarchies(low, high, groups, n_orders=1)
    first_node, n_nodes = table_rows(jnp.asarray(ranges), group)
    boxes, links = jnp.asarray(node_boxes[0], dtype), jnp.asarray(node_links[0])
    point = [lax.stop_gradient(x) for x in point]

    def check_node(carry: tuple[Array, tuple[Array, Array]]) -> tuple[Array, tuple[Array, Array]]:
        node, best = carry
        row = jnp.minimum(first_node + node, len(links) - 1)  # lanes that have ended read a row, too, which must exist
        (next_node, geom), box = table_rows(links, row), table_rows(boxes, row)
        is_near = _box_distance(box[:3], box[3:], point) - reach < best[0]

        def compare_geom(best: tuple[Array, Array]) -> tuple[Array, Array]:
            gap = lax.stop_gradient(distance(jnp.maximum(geom, 0)))
            is_nearer = gap < best[0]
            return jnp.where(is_nearer, gap, best[0]), jnp.where(is_nearer, geom, best[1])

        def descend(carry: tuple[Array, tuple[Array, Array]]) -> tuple[Array, tuple[Array, Array]]:
            return node + 1, compute_where(geom >= 0, compare_geom, carry[1])

        # Lanes that search the same group visit the same nodes, and read them once.
        return compute_where(is_near if len(groups) > 1 else any_lane(is_near), descend, (next_node, best))

    start = jnp.int32(0), (jnp.full_like(point[0], jnp.inf), jnp.int32(-1))
    return lax.while_loop(lambda carry: carry[0] < n_nodes, check_node, start)[1][1]


def _box_distance(low: Sequence[Array], high: Sequence[Array], point: Sequence[Array]) -> Array:
    gaps = [jnp.maximum(a - p, p - b) for a, b, p in zip(low, high, point, strict=True)]
    max_gap = jnp.maximum(jnp.maximum(gaps[0], gaps[1]), gaps[2])
    outside = safe_sqrt(sum(jnp.maximum(gap, 0.0) ** 2 for gap in gaps))  # type: ignore[arg-type]
    return jnp.where(max_gap > 0, outside, max_gap)
