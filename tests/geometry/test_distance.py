"""Distances compared with C MuJoCo, their gradients, and degenerate cases."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import (
    DRONES,
    SHAPES,
    check_finite,
    check_pair,
    check_slopes,
    distances,
    normalize,
    overlap_depths,
    poses,
    random_points,
    rotations,
)

from crazysim import ConfigError
from crazysim.geometry import Shape
from crazysim.geometry import distance as eager_distance
from crazysim.geometry import point_distance as eager_point_distance

distance = jax.jit(eager_distance, static_argnums=(0, 1))
point_distance = jax.jit(eager_point_distance, static_argnums=0)

CLOSED_FORM_KINDS = ("plane", "sphere", "capsule", "box", "cylinder")
N = 2000


@functools.cache
def compile_all_points(kind):
    """Return a compiled function from points to distances and gradients, for all points in one call. (N, 3)"""

    def total(points):
        out = eager_point_distance(SHAPES[kind], points)
        return jnp.sum(out), out

    return jax.jit(jax.value_and_grad(total, has_aux=True))


@functools.cache
def compile_each_point(kind):
    """Return a compiled function from points to distances and gradients, mapped over single points. (N, 3)"""
    return jax.jit(jax.vmap(jax.value_and_grad(functools.partial(eager_point_distance, SHAPES[kind]))))


def evaluate_points(kind, points, dtype=np.float64, one_by_one=False):
    """Return distances and gradients at up to ``N`` points, computed at once or one by one."""
    n = len(points)
    with jax.enable_x64(dtype == np.float64):
        padded = np.resize(points, (N, 3)).astype(dtype)
        if one_by_one:
            value, slope = compile_each_point(kind)(padded)
        else:
            (_, value), slope = compile_all_points(kind)(padded)
        assert value.dtype == slope.dtype == dtype
        return np.asarray(value)[:n], np.asarray(slope)[:n]


def assert_same_signs(computed, expected, at_least=100):
    assert np.sum(expected > 0) > at_least
    assert np.sum(expected < 0) > at_least
    np.testing.assert_array_equal(computed > 0, expected > 0)


@pytest.mark.parametrize("kind", [*CLOSED_FORM_KINDS, "ellipsoid", "mesh"])
def test_distance_of_a_sphere_equals_that_of_mujoco(x64, rng, kind):
    drone, (pos, quat) = DRONES["sphere"], poses(rng, N)
    result = np.asarray(distance(drone, SHAPES[kind], pos, rotations(quat)))
    expected = distances(drone, SHAPES[kind], pos, quat)
    assert_same_signs(result, expected)
    is_compared = expected > 0 if kind in ("ellipsoid", "mesh") else slice(None)  # MuJoCo's depths in these are rough
    np.testing.assert_allclose(result[is_compared], expected[is_compared], atol=1e-5)


PAIRS = [
    ("capsule", "plane"), ("capsule", "sphere"), ("capsule", "capsule"), ("capsule", "box"),
    ("box", "plane"), ("box", "sphere"), ("box", "capsule"),
]  # fmt: skip


@pytest.mark.parametrize("a, b", PAIRS)
def test_closed_forms_of_two_shapes(x64, rng, a, b):
    check_pair(DRONES[a], SHAPES[b], rng, N)


@pytest.mark.parametrize("a, b", PAIRS)
def test_law_08_gradients_of_closed_forms_equal_central_differences(x64, rng, a, b):
    by_pos, by_rot = check_slopes(DRONES[a], SHAPES[b], rng, N)
    # Across a crease, differences may have length one by chance; such points are few.
    assert np.mean(by_pos > 1e-4) < 0.005
    assert np.mean(by_rot > 1e-4) < 0.02


@pytest.mark.parametrize("a, b", PAIRS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_law_07_no_nan_in_two_shapes(a, b, dtype):
    check_finite(DRONES[a], SHAPES[b], dtype, N)


@pytest.mark.parametrize("axes", [(0.5, 0.3, 0.15), (0.3, 0.3, 0.3), (0.1, 0.1, 1.0), (1.0, 0.03, 1.0)])
def test_distance_to_an_ellipsoid_is_the_height_above_its_surface(x64, rng, axes):
    """Points are above the surface by any height, or below it by less than the smallest radius of curvature."""
    a = np.asarray(axes)
    foot = a * normalize(rng.normal(size=(N, 3)))
    normal = normalize(foot / a**2)
    lowest = -(a.min() ** 2) / a.max()  # the least radius of curvature: the foot is the nearest point up to there
    height = np.concatenate([rng.uniform(lowest, 0, N // 2), rng.uniform(0, 3, N - N // 2)])
    result = point_distance(Shape("ellipsoid", axes), foot + height[:, None] * normal)
    assert_same_signs(np.asarray(result), height)
    np.testing.assert_allclose(result, height, atol=1e-6)


def test_distance_to_an_ellipsoid_from_its_middle_by_hand(x64):
    """For points of the longest axis up to the centre of curvature, the nearest point is off the axis."""
    a, b, c = 0.5, 0.3, 0.2
    x = np.linspace(0, 0.999 * (a * a - c * c) / a, 20)
    expected = -c * np.sqrt(1 - x**2 / (a * a - c * c))
    result = point_distance(Shape("ellipsoid", (a, b, c)), np.stack([x, 0 * x, 0 * x], axis=-1))
    np.testing.assert_allclose(result, expected, atol=1e-9)


@pytest.mark.parametrize("kind", SHAPES)
def test_float32_errs_by_rounding_only(rng, kind):
    points = random_points(rng, N)
    result, _ = evaluate_points(kind, points, np.float32, one_by_one=True)
    exact, _ = evaluate_points(kind, np.float32(points))
    size = 0.5 + np.linalg.norm(points, axis=1)
    assert np.max(np.abs(result - exact) / size) < 1e-6


@pytest.mark.parametrize("kind", SHAPES)
def test_law_08_gradient_equals_central_differences_and_has_length_one(rng, kind):
    points, h = random_points(rng, N), 1e-6
    _, slope = evaluate_points(kind, points)
    ahead, behind = ([evaluate_points(kind, points + sign * h * axis)[0] for axis in np.eye(3)] for sign in (1, -1))
    differences = (np.array(ahead) - np.array(behind)).T / (2 * h)
    smooth = np.abs(np.linalg.norm(differences, axis=1) - 1) < 1e-4  # across a crease they are a mean of two sides
    assert np.sum(smooth) > 0.95 * N
    np.testing.assert_allclose(slope[smooth], differences[smooth], atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), 1, atol=1e-6)


def test_second_derivatives_of_an_ellipsoid_equal_differences(x64, rng):
    """The gradient is a contact normal, so the derivative of a contact force is a second derivative."""
    points, h = normalize(rng.normal(size=(50, 3))), 1e-5
    gradient = jax.grad(lambda p: point_distance(SHAPES["ellipsoid"], p))
    normal = jax.jit(jax.grad(lambda p: jnp.sum(point_distance(SHAPES["ellipsoid"], p))))
    result = jax.jit(jax.vmap(jax.jacfwd(gradient)))(points)
    steps = h * np.eye(3)[:, None]
    differences = normal(points + steps) - normal(points - steps)
    np.testing.assert_allclose(result, np.moveaxis(np.asarray(differences), 0, -1) / (2 * h), atol=1e-5)


def special_points(shape):
    """Return degenerate points: centre, axes, surface, edges, corners, and far away."""
    x = np.asarray([*shape.size, 0.3, 0.3, 0.3])[:3]
    grid = np.stack(np.meshgrid(*[[-1.0, -0.5, -0.0, 0.0, 0.5, 1.0, 1e5]] * 3), axis=-1).reshape(-1, 3)
    return np.concatenate([grid * x, grid * x[[1, 0, 2]], grid * x[0], grid * 1e-20])


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_law_07_no_nan_at_degenerate_points(kind, dtype):
    value, slope = evaluate_points(kind, special_points(SHAPES[kind]), dtype, one_by_one=True)
    assert np.isfinite(value).all()
    assert np.isfinite(slope).all()
    length = np.linalg.norm(slope, axis=1)
    assert np.all((np.abs(length - 1) < 1e-3) | (length == 0))
    assert np.mean(length == 0) < 0.35  # the middle of a sphere, the axis of a capsule


def test_a_drone_of_an_unsupported_kind_is_an_error():
    with pytest.raises(ConfigError, match="expected a drone shape of kind sphere, capsule, box, got cylinder"):
        distance(SHAPES["cylinder"], SHAPES["box"], np.zeros(3), np.eye(3))


@pytest.mark.parametrize("kind", ["box", "mesh"])
def test_overlaps_of_capsules_are_the_shortest_way_out_of_a_search(kind):
    """Exact in a box, where MuJoCo's are too small; an upper bound in a mesh, which is tight for 98 in 100."""
    rng, n = np.random.default_rng(2), 400
    pos, quat = rng.normal(0, 0.3, (n, 3)), normalize(rng.normal(size=(n, 4)))
    rot, pair = rotations(quat), (SHAPES["capsule"], SHAPES[kind])
    result = np.asarray(distance(*pair, pos, rot))
    is_deep = np.flatnonzero(result < -0.1)[:150]
    excess = -result[is_deep] - overlap_depths(*pair, pos[is_deep], rot[is_deep], rng)
    assert excess.min() > -1e-3  # the search misses the shortest way by less
    assert np.mean(excess < 1e-3) >= (1.0 if kind == "box" else 0.98)
    if kind == "box":
        assert np.max(-result[is_deep] + distances(*pair, pos[is_deep], quat[is_deep])) > 0.1
