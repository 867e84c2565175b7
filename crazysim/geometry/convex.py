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

import jax.numpy as jnp
from jax import Array, lax

from crazysim.geometry.shapes import Shape
from crazysim.geometry.support import corner, end, reach
from crazysim.geometry.triangle import open_foot
from crazysim.geometry.vector import Vector, along, margin, select, unit

SEPARATION_STEPS = 24
"""Steps towards the nearest points of shapes apart: corners, of which polytopes need few and curved shapes more."""
Best = tuple[Array, Vector]
"""The largest gap so far, m (...), and its direction."""


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
        out = self.place.dot(n) - reach(self.other, n)
        for edge, half in zip(self.edges, self.half, strict=True):
            out = out - half * jnp.abs(edge.dot(n))
        return out

    def corner(self, n: Vector) -> Vector:
        """Return the corner of the Minkowski difference that is nearest along a direction."""
        point = self.place - corner(self.other, n)
        for edge, half in zip(self.edges, self.half, strict=True):
            point = point - edge * end(half, edge.dot(n))
        return point

    def consider(self, n: Vector, best: Best) -> Best:
        """Return the better of a direction and the best so far."""
        return better((self.gap(n), n), best)


def better(new: Best, old: Best) -> Best:
    """Return which of two directions has the larger gap; of two that tie, the old."""
    larger = new[0] > old[0] + margin(old[0].dtype) * jnp.abs(old[0])
    return jnp.where(larger, new[0], old[0]), select(larger, new[1], old[1])


def separate(pair: Pair) -> Best:
    """Return the direction between the nearest points of two shapes, if they are apart.

    A triangle of corners moves towards the origin: the next corner is the one nearest along the direction to the
    triangle's nearest point, and of the three triangles with it the nearest is kept.
    """
    up = along(2, pair.place.x)
    n = unit(pair.place, up)
    first = pair.corner(n)

    def step(_: int, carry: tuple[Vector, ...]) -> tuple[Vector, ...]:
        p, q, r, nearest, best = carry
        n = unit(nearest, up)
        new = pair.corner(n)
        size, kept = nearest.dot(nearest), (p, q, r, nearest)
        for b, c in ((p, q), (q, r), (r, p)):
            foot = open_foot(new, b, c)
            square = foot.dot(foot)
            closer = square < size * (1 - margin(size.dtype))
            kept = tuple(select(closer, x, y) for x, y in zip((new, b, c, foot), kept, strict=True))
            size = jnp.where(closer, square, size)
        return (*kept, pair.consider(n, best))  # type: ignore[return-value]

    start = (first, first, first, first, (pair.gap(n), n))
    *_, nearest, best = lax.fori_loop(0, SEPARATION_STEPS, step, start)  # type: ignore[arg-type]
    return pair.consider(unit(nearest, up), best)
