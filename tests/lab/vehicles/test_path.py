"""Paths on the ground: geometry, projection, timing, slots, and wrong input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.plugins.vehicles import Path
from crazysim.trajectories import circle, figure_eight, spline

SQUARE = [(0, 0), (2, 0), (2, 2), (0, 2)]


def sample(path, n=200, index=0):
    s = np.linspace(0.0, np.asarray(path.length)[index], n).astype(np.float32)
    return s, jax.tree.map(np.asarray, points_at(path, index, s))


@jax.jit
def points_at(path, index, s):
    return jax.vmap(lambda x: path.point_at(index, x))(s)


def test_a_path_of_a_circle_is_a_circle():
    path = Path.of_trajectory(circle(2.0, speed=1.5, height=0.7))
    s, points = sample(path)
    angle = s / 2
    np.testing.assert_allclose(path.length, 4 * np.pi, rtol=1e-6)
    np.testing.assert_allclose(points.pos, 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=2e-5)
    np.testing.assert_allclose(points.tangent, np.stack([-np.sin(angle), np.cos(angle)], axis=1), atol=5e-5)
    np.testing.assert_allclose(points.curvature[:, 0], 0.5, rtol=1e-3)


def test_curvature_has_a_sign():
    """A figure eight turns both ways; the total change of heading of a circle is one revolution."""
    eight = Path.of_trajectory(figure_eight(4, 1.5, period=8.0))
    curvature = np.asarray(sample(eight)[1].curvature)
    assert curvature.min() < -1 and curvature.max() > 1  # noqa: PT018
    clockwise = Path.of_points([(0, 2), (2, 2), (2, 0), (0, 0)], closed=True)
    s, points = sample(clockwise, 2000)
    assert float(np.trapezoid(points.curvature[:, 0], s)) == pytest.approx(-2 * np.pi, rel=1e-3)


@pytest.mark.parametrize("path", [Path.of_points(SQUARE, closed=True), Path.of_points(SQUARE)], ids=["closed", "open"])
def test_arc_length_is_that_of_the_curve(path):
    s, points = sample(path, 4000)
    chords = np.linalg.norm(np.diff(np.asarray(points.pos, float), axis=0), axis=1)
    np.testing.assert_allclose(np.cumsum(chords), s[1:], rtol=2e-3, atol=1e-4)
    tangent = np.diff(np.asarray(points.pos, float), axis=0) / chords[:, None]
    np.testing.assert_allclose(tangent, points.tangent[1:], atol=0.02)


def test_closed_paths_continue_and_open_ones_end():
    closed, open_ = Path.of_points(SQUARE, closed=True), Path.of_points(SQUARE)
    length = closed.length[0]
    for s in (-0.3, 0.0, 1.7):
        point, later = closed.point_at(0, jnp.float32(s)), closed.point_at(0, jnp.float32(s + 2 * length))
        np.testing.assert_allclose(point.pos, later.pos, atol=1e-4)
    np.testing.assert_allclose(
        closed.point_at(0, jnp.float32(0)).curvature, closed.point_at(0, length - 1e-4).curvature, atol=0.01
    )
    np.testing.assert_allclose(open_.point_at(0, jnp.float32(99.0)).pos, SQUARE[-1], atol=1e-5)
    np.testing.assert_allclose(open_.point_at(0, jnp.float32(-1.0)).pos, SQUARE[0], atol=1e-6)
    assert float(open_.speed_at(0, open_.length[0])[0]) == 0
    assert float(closed.speed_at(0, closed.length[0])[0]) == 1


@pytest.mark.parametrize("trajectory", [circle(1.5, speed=1.0), figure_eight(4, 1.5)], ids=["circle", "eight"])
def test_projection_finds_the_nearest_point(trajectory):
    path, rng = Path.of_trajectory(trajectory), np.random.default_rng(0)
    for _ in range(20):
        s = rng.uniform(0, float(path.length[0]))
        point = path.point_at(0, jnp.float32(s))
        normal = jnp.array([-point.tangent[1], point.tangent[0]])
        pos = point.pos + rng.uniform(-0.1, 0.1) * normal
        assert float(path.project(0, pos, jnp.float32(s + rng.uniform(-0.1, 0.1)))) == pytest.approx(s, abs=2e-3)
        nearest = path.nearest_arc(0, pos)
        assert abs((nearest - s + path.length[0] / 2) % path.length[0] - path.length[0] / 2) < 0.03


def test_timing_is_that_of_the_trajectory():
    trajectory = spline([0, 2, 5], [(0, 0, 0), (1, 1, 0), (3, 0, 0)])
    path = Path.of_trajectory(trajectory)
    for t in (0.5, 2.0, 3.3, 4.9):
        arc, speed = path.time_reference(0, jnp.float32(t))
        setpoint = trajectory.evaluate(t)
        np.testing.assert_allclose(path.point_at(0, arc[0]).pos, setpoint.pos[:2], atol=2e-3)
        np.testing.assert_allclose(speed[0], jnp.linalg.norm(setpoint.vel), atol=5e-3)
    for t, s in ((-1.0, 0.0), (9.0, float(path.length[0]))):
        arc, speed = path.time_reference(0, jnp.float32(t))
        np.testing.assert_allclose([arc[0], speed[0]], [s, 0.0], atol=1e-5)
    lap_path = Path.of_points(SQUARE, speed=2.0, closed=True)
    for n_laps in (3.25, -1.25):
        arc, speed = lap_path.time_reference(0, n_laps * lap_path.duration[0])
        np.testing.assert_allclose([arc[0], speed[0]], [n_laps * lap_path.length[0], 2.0], rtol=1e-4)


def test_backwards_paths_have_negative_speeds():
    path = Path.of_points(SQUARE, speed=-0.5)
    assert path.goes_backwards
    arc, speed = path.time_reference(0, jnp.float32(2.0))
    np.testing.assert_allclose([arc[0], speed[0]], [1.0, -0.5], rtol=1e-5)
    assert Path.of_trajectory(circle(1.0), backwards=True).goes_backwards


def test_slots_hold_paths_of_any_length():
    paths = [Path.of_trajectory(circle(1.0)), Path.of_points(SQUARE, 0.5), Path.of_trajectory(figure_eight(3, 1))]
    slots = Path.stack(paths)
    assert slots.n_paths == 3
    for k, path in enumerate(paths):
        for s in (0.0, 0.7, 2.9, 5.0):
            for a, b in zip(slots.point_at(k, jnp.float32(s)), path.point_at(0, jnp.float32(s)), strict=True):
                np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(slots.speed_at(k, jnp.float32(1.0)), path.speed_at(0, jnp.float32(1.0)))
