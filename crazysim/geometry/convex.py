"""Signed distance of two convex shapes that have no closed form: a segment or a box, and another shape.

The computation is on the Minkowski difference ``{x_a - x_b}``, which contains the origin if and only if the shapes
overlap. Along a unit direction n, from b to a, the gap between the shapes is ``g(n) = n.pos - h_a(n) - h_b(n)``, with
the support function ``h``. The signed distance is the maximum of the gap over all directions: the distance of the
nearest points of separated shapes, or minus the length of the shortest translation that separates overlapping ones.
Every direction gives a lower bound, and the best bound is returned, so overlap needs no separate test.

For separated shapes the direction comes from the algorithm of Gilbert, Johnson and Keerthi (1988), in this module; for
overlapping shapes from a search over the normals of the Minkowski difference, in ``overlap``.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.engine.jaxcompat import fori_loop
from crazysim.geometry import support
from crazysim.geometry.shapes import Shape
from crazysim.geometry.support import segment_support_point
from crazysim.geometry.triangle import closest_point, closest_point_off_bc, from_barycentric
from crazysim.geometry.vector import Vector, axis_vector, normalize, rounding_margin, select_vector, stack_vectors

BestDirection = tuple[Array, Vector]
"""Largest gap so far, m (...), and its direction."""
SupportPoint = tuple[Vector, list[Array]]
"""Support point of the Minkowski difference, m, and the support point of the segment or box in its own frame, m."""


@dataclasses.dataclass(frozen=True)
class ShapePair:
    """Segment or box, and another convex shape. All vectors are in the frame of the other shape."""

    other: Shape
    """Other shape: a box, cylinder, ellipsoid or mesh."""
    half: tuple[float, ...]
    """Half lengths of the box, or half length of the segment, m. One or three numbers."""
    edges: list[Vector]
    """Unit directions of the edges of the box, or of the segment. One or three vectors."""
    centre: Vector
    """Position of the centre of the box or segment, m."""

    def gap(self, n: Vector) -> Array:
        """Return the gap between the shapes along a unit direction from the other shape to this one, m. (...)"""
        gap = self.centre.dot(n) - support.support_function(self.other, n)
        for edge, half in zip(self.edges, self.half, strict=True):
            gap = gap - half * jnp.abs(edge.dot(n))
        return gap

    def support_coordinates(self, n: Vector) -> list[Array]:
        """Return the support point of the segment or box opposite to a direction, in its own frame, m. (...) each"""
        return [-segment_support_point(half, edge.dot(n)) for edge, half in zip(self.edges, self.half, strict=True)]

    def point_at(self, coordinates: list[Array]) -> Vector:
        """Return a point of the segment or box, given in its own frame, in the frame of the other shape, m."""
        point = self.centre
        for edge, x in zip(self.edges, coordinates, strict=True):
            point = point + edge * x
        return point

    def support_point(self, n: Vector) -> SupportPoint:
        """Return the support point of the Minkowski difference opposite to a direction."""
        coordinates = self.support_coordinates(n)
        return self.point_at(coordinates) - support.support_point(self.other, n), coordinates

    def with_candidate(self, n: Vector, best: BestDirection) -> BestDirection:
        """Return the direction with the larger gap: ``n`` or the best direction so far."""
        return larger_gap((self.gap(n), n), best)


def larger_gap(candidate: BestDirection, best: BestDirection) -> BestDirection:
    """Return the direction with the larger gap; on a tie, ``best``."""
    is_larger = candidate[0] > best[0] + rounding_margin(best[0].dtype) * jnp.abs(best[0])
    return jnp.where(is_larger, candidate[0], best[0]), select_vector(is_larger, candidate[1], best[1])


def find_separation(pair: ShapePair, n: Vector, steps: int) -> tuple[BestDirection, list[Array]]:
    """Return the direction between the nearest points of separated shapes, and the nearest point of the first shape.

    A triangle of support points of the Minkowski difference moves towards the origin. Each step adds the support point
    opposite to the direction of the triangle's nearest point. The new triangle is the nearest of the three that join it
    with two of the corners.

    Args:
        n: Initial direction.
        steps: Number of support points to add.
    """
    fallback = axis_vector(2, pair.centre.x)

    def step(_: int, carry: Any) -> Any:
        triangle, nearest, best = carry
        n = normalize(nearest, fallback)
        new_point = pair.support_point(n)
        squared_distance = nearest.dot(nearest)
        simplex = (triangle, nearest)
        p, q, r = (point for point, _ in triangle)
        b, c = stack_vectors([p, q, r]), stack_vectors([q, r, p])
        points = from_barycentric(closest_point_off_bc(new_point[0], b, c), new_point[0], b, c)
        squares = points.dot(points)
        # Replace one corner of the triangle, where that comes nearer to the origin.
        for k in range(3):
            is_closer = squares[k] < squared_distance * (1 - rounding_margin(squared_distance.dtype))
            candidate = ((new_point, triangle[k], triangle[(k + 1) % 3]), points[k])
            simplex = jax.tree.map(partial(jnp.where, is_closer), candidate, simplex)
            squared_distance = jnp.where(is_closer, squares[k], squared_distance)
        return (*simplex, pair.with_candidate(n, best))

    # All corners begin at the same support point.
    first_point = pair.support_point(n)
    triangle, nearest, best = fori_loop(steps, step, ((first_point,) * 3, first_point[0], (pair.gap(n), n)))
    weights = closest_point(*(point for point, _ in triangle))
    coordinates = [
        jnp.asarray(sum(w * x for w, x in zip(weights, xs, strict=True)))
        for xs in zip(*(e for _, e in triangle), strict=True)
    ]
    return pair.with_candidate(normalize(nearest, fallback), best), coordinates
