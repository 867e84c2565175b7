"""Signed distance of two convex shapes that have no closed form: a segment or a box, and another shape.

All is about one body, the Minkowski difference ``{x_a - x_b}``: the shapes overlap where the origin lies in it. Along
a unit direction n, from b to a, the gap of the two is ``g(n) = n.pos - r_a(n) - r_b(n)``, with ``r`` how far a shape
reaches. No gap is larger than the signed distance, and the largest is the signed distance itself: where the shapes
are apart, that of their nearest points, and where they overlap, minus the length of the shortest translation that
parts them. So every direction that is tried gives a bound, and the best of them is taken; no test is needed whether
shapes overlap.

Apart, the direction comes from the algorithm of Gilbert, Johnson and Keerthi (1988), here; overlapping, from a search
among the normals that the body can have, in ``overlap``.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from crazysim.geometry import support
from crazysim.geometry.shapes import Shape
from crazysim.geometry.support import end
from crazysim.geometry.triangle import foot, mean, open_foot
from crazysim.geometry.vector import Vector, along, margin, select, stack, unit

Best = tuple[Array, Vector]
"""The largest gap so far, m (...), and its direction."""
Corner = tuple[Vector, list[Array]]
"""A corner of the Minkowski difference, m, and which point of the segment or box it belongs to, in its frame, m."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """A segment or a box, and another convex shape in whose frame everything is."""

    other: Shape
    """The other shape: a box, cylinder, ellipsoid or mesh."""
    half: tuple[float, ...]
    """Half lengths of the box, or that of the segment, m. One or three numbers."""
    edges: list[Vector]
    """Unit directions of these. As many."""
    place: Vector
    """Their middle, m."""

    def gap(self, n: Vector) -> Array:
        """Return the gap of the two along a unit direction from the other to this, m. (...)"""
        out = self.place.dot(n) - support.reach(self.other, n)
        for edge, half in zip(self.edges, self.half, strict=True):
            out = out - half * jnp.abs(edge.dot(n))
        return out

    def ends(self, n: Vector) -> list[Array]:
        """Return which point of the segment or box is nearest along a direction, in its own frame, m. (...) each"""
        return [-end(half, edge.dot(n)) for edge, half in zip(self.edges, self.half, strict=True)]

    def at(self, ends: list[Array]) -> Vector:
        """Return a point of the segment or box by its place in its own frame."""
        point = self.place
        for edge, x in zip(self.edges, ends, strict=True):
            point = point + edge * x
        return point

    def corner(self, n: Vector) -> Corner:
        """Return the corner of the Minkowski difference that is nearest along a direction."""
        ends = self.ends(n)
        return self.at(ends) - support.corner(self.other, n), ends

    def consider(self, n: Vector, best: Best) -> Best:
        """Return the better of a direction and the best so far."""
        return better((self.gap(n), n), best)


def better(new: Best, old: Best) -> Best:
    """Return which of two directions has the larger gap; of two that tie, the old."""
    larger = new[0] > old[0] + margin(old[0].dtype) * jnp.abs(old[0])
    return jnp.where(larger, new[0], old[0]), select(larger, new[1], old[1])


def separate(pair: Pair, n: Vector, steps: int) -> tuple[Best, list[Array]]:
    """Return the direction between the nearest points of two shapes that are apart, and which point of the first it is.

    A triangle of corners of the Minkowski difference moves towards the origin: the next corner is the nearest along
    the direction to the triangle's nearest point, and of the three triangles with it the nearest is kept.

    Args:
        pair: The shapes.
        n: Direction to begin with.
        steps: Number of corners to add.
    """
    up = along(2, pair.place.x)

    def step(_: int, carry: Any) -> Any:
        triangle, nearest, best = carry
        n = unit(nearest, up)
        new = pair.corner(n)
        size = nearest.dot(nearest)
        kept = (triangle, nearest)
        p, q, r = (point for point, _ in triangle)
        b, c = stack([p, q, r]), stack([q, r, p])
        feet = mean(open_foot(new[0], b, c), new[0], b, c)
        squares = feet.dot(feet)
        for k in range(3):
            closer = squares[k] < size * (1 - margin(size.dtype))
            tried = ((new, triangle[k], triangle[(k + 1) % 3]), feet[k])
            kept = jax.tree.map(partial(jnp.where, closer), tried, kept)
            size = jnp.where(closer, squares[k], size)
        return (*kept, pair.consider(n, best))

    first = pair.corner(n)
    triangle, nearest, best = lax.fori_loop(0, steps, step, ((first,) * 3, first[0], (pair.gap(n), n)))
    shares = foot(*(point for point, _ in triangle))
    ends = [
        jnp.asarray(sum(w * x for w, x in zip(shares, xs, strict=True)))
        for xs in zip(*(e for _, e in triangle), strict=True)
    ]
    return pair.consider(unit(nearest, up), best), ends
