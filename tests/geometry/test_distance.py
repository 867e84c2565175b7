"""Distances compared with C MuJoCo, their gradients, and degenerate cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracle import DRONES, SHAPES, check_finite, check_pair, check_slopes, distances, places, poses, rotations, unit

from crazysim import ConfigError
from crazysim.geometry import Shape
from crazysim.geometry import distance as eager_distance
from crazysim.geometry import point_distance as eager_point_distance

distance = jax.jit(eager_distance, static_argnums=(0, 1))
point_distance = jax.jit(eager_point_distance, static_argnums=0)

CLOSED = ("plane", "sphere", "capsule", "box", "cylinder")
N = 2000


def both_ways(found, expected, at_least=100):
    """Check the signs, with enough separated and enough overlapping samples."""
    assert np.sum(expected > 0) > at_least
    assert np.sum(expected < 0) > at_least
    np.testing.assert_array_equal(found > 0, expected > 0)


@pytest.mark.parametrize("kind", [*CLOSED, "ellipsoid", "mesh"])
def test_distance_of_a_sphere_equals_that_of_mujoco(x64, rng, kind):
    drone, (pos, quat) = DRONES["sphere"], poses(rng, N)
    found = np.asarray(distance(drone, SHAPES[kind], pos, rotations(quat)))
    expected = distances(drone, SHAPES[kind], pos, quat)
    both_ways(found, expected)
    known = expected > 0 if kind in ("ellipsoid", "mesh") else slice(None)  # MuJoCo's depths in these are rough
    np.testing.assert_allclose(found[known], expected[known], atol=1e-5)


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
    # Across a crease, a difference may look like a distance's; there are few.
    assert np.mean(by_pos > 1e-4) < 0.005
    assert np.mean(by_rot > 1e-4) < 0.02


@pytest.mark.parametrize("a, b", PAIRS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_law_07_no_nan_in_two_shapes(a, b, dtype):
    check_finite(DRONES[a], SHAPES[b], dtype, N)


@pytest.mark.parametrize("axes", [(0.5, 0.3, 0.15), (0.3, 0.3, 0.3), (0.1, 0.1, 1.0), (1.0, 0.03, 1.0)])
def test_distance_to_an_ellipsoid_is_that_of_where_the_point_was_lifted_from(x64, rng, axes):
    """Points are lifted by any height outside, and by less than the smallest radius of curvature inside."""
    a = np.asarray(axes)
    foot = a * unit(rng.normal(size=(N, 3)))
    normal = unit(foot / a**2)
    lowest = -(a.min() ** 2) / a.max()  # the least radius of curvature: the foot is the nearest point up to there
    height = np.concatenate([rng.uniform(lowest, 0, N // 2), rng.uniform(0, 3, N - N // 2)])
    found = point_distance(Shape("ellipsoid", axes), foot + height[:, None] * normal)
    both_ways(np.asarray(found), height)
    np.testing.assert_allclose(found, height, atol=1e-6)


def test_distance_to_an_ellipsoid_from_its_middle_by_hand(x64):
    """For points of the longest axis up to the centre of curvature, the nearest point is off the axis."""
    a, b, c = 0.5, 0.3, 0.2
    x = np.linspace(0, 0.999 * (a * a - c * c) / a, 20)
    expected = -c * np.sqrt(1 - x**2 / (a * a - c * c))
    found = point_distance(Shape("ellipsoid", (a, b, c)), np.stack([x, 0 * x, 0 * x], axis=-1))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("kind", SHAPES)
def test_float32_errs_by_rounding_only(rng, kind):
    points = places(rng, N)
    found = point_distance(SHAPES[kind], jnp.asarray(points, jnp.float32))
    assert found.dtype == jnp.float32
    with jax.enable_x64(True):
        exact = np.asarray(point_distance(SHAPES[kind], np.float64(np.float32(points))))
    size = 0.5 + np.linalg.norm(points, axis=1)
    assert np.max(np.abs(found - exact) / size) < 1e-6


@pytest.mark.parametrize("kind", SHAPES)
def test_law_01_one_drone_then_many(x64, rng, kind):
    points = (0.5 * rng.uniform(-1, 1, (3, 4, 3))).astype(np.float32).astype(float)
    many = point_distance(SHAPES[kind], points)
    assert many.shape == (3, 4)
    one = [[point_distance(SHAPES[kind], points[i, j]) for j in range(4)] for i in range(3)]
    np.testing.assert_allclose(many, one, rtol=1e-12, atol=1e-14)
    slope = jax.grad(lambda p: point_distance(SHAPES[kind], p))
    mapped = jax.jit(jax.vmap(jax.vmap(slope)))(jnp.asarray(points, jnp.float32))
    np.testing.assert_allclose(mapped, jax.vmap(jax.vmap(slope))(points), atol=1e-4)


@pytest.mark.parametrize("kind", SHAPES)
def test_law_08_gradient_equals_central_differences_and_has_length_one(x64, rng, kind):
    shape, points, h = SHAPES[kind], places(rng, N), 1e-6
    value = lambda p: point_distance(shape, p)  # noqa: E731
    slope = np.asarray(jax.grad(lambda p: jnp.sum(value(p)))(points))
    steps = h * np.eye(3)[:, None]
    differences = np.moveaxis(np.asarray(value(points + steps) - value(points - steps)) / (2 * h), 0, -1)
    smooth = np.abs(np.linalg.norm(differences, axis=1) - 1) < 1e-4  # across a crease they are a mean of two sides
    assert np.sum(smooth) > 0.95 * N
    np.testing.assert_allclose(slope[smooth], differences[smooth], atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), 1, atol=1e-6)


def test_curvature_of_an_ellipsoid_is_right_too(x64, rng):
    """The gradient is a contact normal, so the derivative of a contact force is a second derivative."""
    points, h = unit(rng.normal(size=(50, 3))), 1e-5
    one = jax.grad(lambda p: point_distance(SHAPES["ellipsoid"], p))
    normal = jax.jit(jax.grad(lambda p: jnp.sum(point_distance(SHAPES["ellipsoid"], p))))
    found = jax.jit(jax.vmap(jax.jacfwd(one)))(points)
    steps = h * np.eye(3)[:, None]
    differences = normal(points + steps) - normal(points - steps)
    np.testing.assert_allclose(found, np.moveaxis(np.asarray(differences), 0, -1) / (2 * h), atol=1e-5)


def special_points(shape):
    """Return degenerate points: centre, axes, surface, edges, corners, and far away."""
    x = np.asarray([*shape.size, 0.3, 0.3, 0.3])[:3]
    grid = np.stack(np.meshgrid(*[[-1.0, -0.5, -0.0, 0.0, 0.5, 1.0, 1e5]] * 3), axis=-1).reshape(-1, 3)
    return np.concatenate([grid * x, grid * x[[1, 0, 2]], grid * x[0], grid * 1e-20])


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_law_07_no_nan_at_degenerate_points(kind, dtype):
    with jax.enable_x64(dtype == np.float64):
        points = jnp.asarray(special_points(SHAPES[kind]), dtype)
        value, slope = jax.vmap(jax.value_and_grad(lambda p: point_distance(SHAPES[kind], p)))(points)
        assert np.isfinite(value).all()
        assert np.isfinite(slope).all()
        length = np.linalg.norm(slope, axis=1)
        assert np.all((np.abs(length - 1) < 1e-3) | (length == 0))
        assert np.mean(length == 0) < 0.35  # the middle of a sphere, the axis of a capsule


@given(
    kind=st.sampled_from(CLOSED),
    a=st.tuples(*[st.floats(-1, 1)] * 3),
    b=st.tuples(*[st.floats(-1, 1)] * 3),
)
def test_no_distance_changes_faster_than_its_point(kind, a, b):
    a, b = np.float32(a), np.float32(b)
    change = abs(float(point_distance(SHAPES[kind], a) - point_distance(SHAPES[kind], b)))
    assert change <= np.linalg.norm(a - b) * (1 + 1e-5) + 1e-6


def test_a_drone_of_an_unsupported_kind_is_an_error():
    with pytest.raises(ConfigError, match="expected a drone shape of kind sphere, capsule, box, got cylinder"):
        distance(SHAPES["cylinder"], SHAPES["box"], np.zeros(3), np.eye(3))
