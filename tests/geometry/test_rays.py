"""Rays compared with C MuJoCo, their gradients, and degenerate cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import SHAPES, places, rays, unit

from crazysim.geometry import ray_distance as eager_ray_distance

ray_distance = jax.jit(eager_ray_distance, static_argnums=0)

N = 4000


def some_rays(rng, n=N):
    """Return rays from outside, aimed at the shape or past it, and rays from inside."""
    origin = places(rng, n)
    target = np.where(rng.uniform(size=(n, 1)) < 0.7, rng.uniform(-0.4, 0.4, (n, 3)), 10 * rng.normal(size=(n, 3)))
    direction = target - origin
    direction[: n // 8] = rng.choice([-1.0, 0.0, 1.0], (n // 8, 3))  # along axes and diagonals
    direction[~direction.any(axis=1)] = [0, 0, 1]
    return origin, unit(direction)


@pytest.mark.parametrize("kind", SHAPES)
def test_rays_end_where_mujoco_has_it(x64, rng, kind):
    origin, direction = some_rays(rng)
    t, normal = map(np.asarray, ray_distance(SHAPES[kind], origin, direction))
    expected, expected_normal = rays(SHAPES[kind], origin, direction)
    hit = np.isfinite(expected)
    assert np.sum(hit) > 1000
    assert np.sum(~hit) > 300
    np.testing.assert_array_equal(np.isfinite(t), hit)
    np.testing.assert_allclose(t[hit], expected[hit], atol=1e-5)
    np.testing.assert_allclose(normal[hit], unit(expected_normal[hit]), atol=1e-5)
    np.testing.assert_array_equal(normal[~hit], 0)


@pytest.mark.parametrize("kind", SHAPES)
def test_float32_rays_end_on_the_surface(rng, kind):
    """Rounding of an origin 10 m away is 1e-6 m; it moves the hit of a grazing ray by more."""
    origin, direction = some_rays(rng)
    with jax.enable_x64(True):
        exact, normal = map(np.asarray, ray_distance(SHAPES[kind], origin, direction))
    t = np.asarray(ray_distance(SHAPES[kind], np.float32(origin), np.float32(direction))[0])
    steep = np.abs(np.sum(normal * direction, axis=1)) > 0.05
    assert np.sum(steep) > 1000
    np.testing.assert_allclose(t[steep], exact[steep], atol=1e-4)


@pytest.mark.parametrize("kind", SHAPES)
def test_law_01_one_ray_then_many(x64, rng, kind):
    origin, direction = (x.reshape(3, 4, 3) for x in some_rays(rng, 12))
    many = ray_distance(SHAPES[kind], origin, direction)
    assert many[0].shape == (3, 4)
    for i in range(3):
        for j in range(4):
            one = ray_distance(SHAPES[kind], origin[i, j], direction[i, j])
            for x, y in zip(many, one, strict=True):
                np.testing.assert_allclose(x[i, j], y, atol=1e-12)


@pytest.mark.parametrize("kind", SHAPES)
def test_law_08_gradient_equals_central_differences(x64, rng, kind):
    shape, h = SHAPES[kind], 1e-6
    origin, direction = some_rays(rng)
    t, normal = map(np.asarray, ray_distance(shape, origin, direction))
    total = lambda o: jnp.sum(jnp.where(t < np.inf, ray_distance(shape, o, direction)[0], 0))  # noqa: E731
    slope = np.asarray(jax.grad(total)(origin))
    sides = np.array([[ray_distance(shape, origin + s * h * e, direction)[0] for e in np.eye(3)] for s in (1, -1)])
    clear = (np.abs(np.sum(normal * direction, axis=1)) > 0.05) & np.isfinite(sides).all(axis=(0, 1))
    sides = np.moveaxis(sides[:, :, clear], 1, -1)
    differences = (sides[0] - sides[1]) / (2 * h)
    smooth = np.max(np.abs(differences), axis=1) < 1e3  # not across an edge
    assert np.sum(smooth) > 1000
    np.testing.assert_allclose(slope[clear][smooth], differences[smooth], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", SHAPES)
def test_law_07_no_nan_in_degenerate_cases(kind):
    """From the centre, from edges, along faces, past corners: every value and gradient is finite, or a miss."""
    size = np.asarray([*SHAPES[kind].size, 0.3, 0.3, 0.3])[:3]
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0, 3.0]] * 3), axis=-1).reshape(-1, 3)
    ways = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    ways = np.concatenate([unit(ways[ways.any(axis=1)]), [[1e-15, 0, 1], [1, 1e-13, 0]]])

    def total(origin, direction):
        t, normal = ray_distance(SHAPES[kind], origin, direction)
        return jnp.sum(jnp.where(jnp.isfinite(t), t, 0.0)) + jnp.sum(normal**3)

    slopes = jax.jit(jax.grad(total, (0, 1)))
    for scale in (size, size[[1, 0, 2]], size[0]):
        origin, direction = jnp.asarray(grid * scale)[:, None], jnp.asarray(ways)[None]
        t, normal = ray_distance(SHAPES[kind], origin, direction)
        assert not np.isnan(t).any()
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), np.isfinite(t), atol=1e-5)
        for slope in slopes(origin, direction):
            assert slope.dtype == np.float32
            assert np.isfinite(slope).all()
