"""Distances from a segment to another segment, and to a box."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from crazysim.geometry.points import Components, magnitude, maximum
from crazysim.rotation import clip, safe_sqrt

MIN_SQUARED_SINE = 1e-12
"""Square of a sine below which two directions are treated as parallel."""


def segment_to_segment(middle: Components, axis: Components, half: float, other_half: float) -> Array:
    """Return the distance from a segment to a segment along z centred at the origin, m. (...)

    The method follows Ericson (2005, section 5.1.9). For parallel or nearly parallel segments, the choice of the
    nearest points does not change the distance.

    Args:
        middle: Components of the centre of the segment, m. (...) each
        axis: Components of the unit direction of the segment. (...) each
        half: Half length of the segment, m.
        other_half: Half length of the other segment, m.
    """
    (cx, cy, cz), (x, y, z) = map(_stop_gradient, (middle, axis))
    squared_sine = x * x + y * y
    s = -(cx * x + cy * y) / jnp.where(squared_sine > MIN_SQUARED_SINE, squared_sine, 1.0)
    s = clip(jnp.where(squared_sine > MIN_SQUARED_SINE, s, 0.0), -half, half)
    t = clip(cz + s * z, -other_half, other_half)
    s = clip(t * z - (cx * x + cy * y + cz * z), -half, half)
    # Moving the nearest points along the segments does not change the distance to first order, so they are held fixed.
    x, y, z = (c + s * a for c, a in zip(middle, axis, strict=True))
    return safe_sqrt(x * x + y * y + (z - t) ** 2)


def segment_to_box(middle: Components, axis: Components, half: Array | float, box: tuple[float, ...]) -> Array:
    """Return the signed distance from a segment to a box, m. (...)

    Outside, the slope of the squared distance along the segment is increasing and piecewise linear, with kinks at the
    planes of the sides. Its root lies between the last kink with a negative slope and the first with a positive slope.
    Inside, the shortest separating translation is along a face normal of the Minkowski difference: a normal of the box,
    or a cross product of one of its edges and the segment (Gottschalk 1996).

    Args:
        middle: Components of the centre of the segment, in the frame of the box, m. (...) each
        axis: Components of the unit direction of the segment. (...) each
        half: Half length of the segment, m.
        box: Half lengths of the box, m.
    """
    c, u = _stop_gradient(middle), _stop_gradient(axis)

    # The squared distance is convex along the segment: find the zero of its slope.
    def slope(t: Array) -> Array:
        point = [p + t * d for p, d in zip(c, u, strict=True)]
        return sum(d * (p - jnp.clip(p, -h, h)) for d, p, h in zip(u, point, box, strict=True))  # type: ignore[return-value]

    low, high = 0 * c[0] - half, 0 * c[0] + half
    low_slope, high_slope = slope(low), slope(high)
    # The slope is linear between the planes of the faces, which narrow the bracket.
    for p, d, h in zip(c, u, box, strict=True):
        is_crossing = d * d > MIN_SQUARED_SINE
        inverse = 1 / jnp.where(is_crossing, d, 1.0)
        for side in (-h, h):
            t = jnp.where(is_crossing, jnp.clip((side - p) * inverse, -half, half), 0.0)
            slope_at_side = slope(t)
            is_before_root, is_after_root = (slope_at_side <= 0) & (t > low), (slope_at_side >= 0) & (t < high)
            low, low_slope = jnp.where(is_before_root, t, low), jnp.where(is_before_root, slope_at_side, low_slope)
            high, high_slope = jnp.where(is_after_root, t, high), jnp.where(is_after_root, slope_at_side, high_slope)
    # Zero of the slope in the bracket, or the nearer end.
    rise = high_slope - low_slope
    is_between = (low_slope < 0) & (high_slope > 0)
    t = low + (high - low) * jnp.where(is_between, -low_slope / jnp.where(is_between, rise, 1.0), 0.0)
    t = jnp.where(high_slope < 0, high, t)
    x, y, z = (maximum(magnitude(p + t * d) - h, 0.0) for p, d, h in zip(middle, axis, box, strict=True))
    return jnp.where((gap := _largest_gap(middle, axis, half, box)) > 0, safe_sqrt(x * x + y * y + z * z), gap)


def _largest_gap(middle: Components, axis: Components, half: Array | float, box: tuple[float, ...]) -> Array:
    c, u = [magnitude(p) for p in middle], [magnitude(d) for d in axis]
    face_gaps = [p - h - half * d for p, h, d in zip(c, box, u, strict=True)]
    largest_gap = maximum(maximum(face_gaps[0], face_gaps[1]), face_gaps[2])
    for i, j in ((1, 2), (2, 0), (0, 1)):
        square = axis[i] * axis[i] + axis[j] * axis[j]
        is_defined = square > MIN_SQUARED_SINE
        gap = magnitude(middle[j] * axis[i] - middle[i] * axis[j]) - box[i] * u[j] - box[j] * u[i]
        gap = gap / safe_sqrt(jnp.where(is_defined, square, 1.0))
        largest_gap = jnp.where(is_defined & (gap > largest_gap), gap, largest_gap)
    return largest_gap


def _stop_gradient(vector: Components) -> Components:
    x, y, z = vector
    return lax.stop_gradient(x), lax.stop_gradient(y), lax.stop_gradient(z)
