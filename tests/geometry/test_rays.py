"""Rays compared with C MuJoCo, their gradients, and degenerate cases."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import SHAPES, cast_rays, normalize, random_points

from crazysim.geometry import ray_distance

N = 4000


@functools.cache
def compile_rays(kind):
    """Return a compiled function from rays to distances, normals and two gradients. (N, 3)

    The first gradient is of the sum of the distances of rays that hit. The second is of that sum plus the sum of the
    cubes of the normals.
    """

    def trace(origin, direction):
        (t, normal), pullback = jax.vjp(functools.partial(ray_distance, SHAPES[kind]), origin, direction)
        hit = jnp.isfinite(t).astype(t.dtype)
        return t, normal, pullback((hit, jnp.zeros_like(normal))), pullback((hit, 3 * normal**2))

    return jax.jit(trace)


def trace_rays(kind, origin, direction, dtype=np.float64):
    """Return the distances, normals and gradients of up to ``N`` rays."""
    n = len(origin)
    with jax.enable_x64(dtype == np.float64):
        result = compile_rays(kind)(*(np.resize(x, (N, 3)).astype(dtype) for x in (origin, direction)))
        assert {x.dtype for x in jax.tree.leaves(result)} == {np.dtype(dtype)}
        return jax.tree.map(lambda x: np.asarray(x)[:n], result)


def draw_rays(rng, n=N):
    origin = random_points(rng, n)
    target = np.where(rng.uniform(size=(n, 1)) < 0.7, rng.uniform(-0.4, 0.4, (n, 3)), 10 * rng.normal(size=(n, 3)))
    direction = target - origin
    direction[: n // 8] = rng.choice([-1.0, 0.0, 1.0], (n // 8, 3))  # along axes and diagonals
    direction[~direction.any(axis=1)] = [0, 0, 1]
    return origin, normalize(direction)


@pytest.mark.parametrize("kind", SHAPES)
def test_rays_hit_where_those_of_mujoco_hit(rng, kind):
    origin, direction = draw_rays(rng)
    t, normal, *_ = trace_rays(kind, origin, direction)
    expected, expected_normal = cast_rays(SHAPES[kind], origin, direction)
    hit = np.isfinite(expected)
    assert np.sum(hit) > 1000
    assert np.sum(~hit) > 300
    np.testing.assert_array_equal(np.isfinite(t), hit)
    np.testing.assert_allclose(t[hit], expected[hit], atol=1e-5)
    np.testing.assert_allclose(normal[hit], normalize(expected_normal[hit]), atol=1e-5)
    np.testing.assert_array_equal(normal[~hit], 0)


@pytest.mark.parametrize("kind", SHAPES)
def test_float32_rays_end_on_the_surface(rng, kind):
    """Rounding of an origin 10 m away is 1e-6 m; it moves the hit of a grazing ray by more."""
    origin, direction = draw_rays(rng)
    exact, normal, *_ = trace_rays(kind, origin, direction)
    t, *_ = trace_rays(kind, origin, direction, np.float32)
    steep = np.abs(np.sum(normal * direction, axis=1)) > 0.05
    assert np.sum(steep) > 1000
    np.testing.assert_allclose(t[steep], exact[steep], atol=1e-4)


@pytest.mark.parametrize("kind", SHAPES)
def test_law_08_gradient_equals_central_differences(rng, kind):
    h = 1e-6
    origin, direction = draw_rays(rng)
    _, normal, (slope, _), _ = trace_rays(kind, origin, direction)
    sides = np.array([[trace_rays(kind, origin + s * h * e, direction)[0] for e in np.eye(3)] for s in (1, -1)])
    is_clear = (np.abs(np.sum(normal * direction, axis=1)) > 0.05) & np.isfinite(sides).all(axis=(0, 1))
    sides = np.moveaxis(sides[:, :, is_clear], 1, -1)
    differences = (sides[0] - sides[1]) / (2 * h)
    smooth = np.max(np.abs(differences), axis=1) < 1e3  # not across an edge
    assert np.sum(smooth) > 1000
    np.testing.assert_allclose(slope[is_clear][smooth], differences[smooth], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", SHAPES)
def test_law_07_no_nan_in_degenerate_cases(kind):
    """From the centre, from edges, along faces, past corners: every value and gradient is finite, or a miss."""
    size = np.asarray([*SHAPES[kind].size, 0.3, 0.3, 0.3])[:3]
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0, 3.0]] * 3), axis=-1).reshape(-1, 3)
    directions = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    directions = np.concatenate([normalize(directions[directions.any(axis=1)]), [[1e-15, 0, 1], [1, 1e-13, 0]]])
    for scale in (size, size[[1, 0, 2]], size[0]):
        origin, direction = np.repeat(grid * scale, len(directions), axis=0), np.tile(directions, (len(grid), 1))
        t, normal, _, slopes = trace_rays(kind, origin, direction, np.float32)
        assert not np.isnan(t).any()
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), np.isfinite(t), atol=1e-5)
        for slope in slopes:
            assert np.isfinite(slope).all()
