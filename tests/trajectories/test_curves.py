"""Shapes against their equations, in float64."""

import jax
import numpy as np
import pytest

from crazysim.trajectories import Trajectory, circle, figure_eight, helix, hover, line, lissajous

pytestmark = pytest.mark.usefixtures("x64")

on_device = jax.jit(jax.vmap(Trajectory.evaluate, in_axes=(None, 0)))


def evaluate(trajectory, t):
    return jax.tree.map(np.asarray, on_device(trajectory, t))


def check_curve(trajectory, curve, duration, scale=1.0):
    np.testing.assert_allclose(trajectory.duration, duration, rtol=1e-12)
    t = np.linspace(0.01, 0.99, 500) * duration
    s = evaluate(trajectory, t)
    result = np.concatenate([s.pos, s.yaw], axis=-1)
    assert np.abs(result - curve(t)).max() < 1e-5
    h = 1e-5 * duration
    np.testing.assert_allclose(s.vel, (curve(t + h) - curve(t - h))[:, :3] / (2 * h), atol=1e-3 * scale)
    h = 1e-3 * duration
    np.testing.assert_allclose(s.acc, (curve(t + h) - 2 * curve(t) + curve(t - h))[:, :3] / h**2, atol=1e-2 * scale)


@pytest.mark.parametrize(
    "width, depth, period", [(2.0, 1.0, 5.0), (40.0, 30.0, 20.0), (0.2, 0.1, 0.5), (0.0, 3.0, 1.0)]
)
def test_a_figure_eight_has_its_equation(width, depth, period):
    w = 2 * np.pi / period
    check_curve(
        figure_eight(width, depth, period, height=1.5),
        lambda t: np.stack([width / 2 * np.sin(w * t), depth / 2 * np.sin(2 * w * t), 1.5 + 0 * t, 0 * t], axis=-1),
        period,
        max(width, depth) * w**2,
    )


def test_a_lissajous_curve_has_its_equation():
    w = 2 * np.pi / 7
    trajectory = lissajous((1, 2, 0.3), (3, 2, 5), (0, 0.5, 1), period=7, center=(1, -1, 2))
    check_curve(
        trajectory,
        lambda t: np.stack(
            [1 + np.sin(3 * w * t), -1 + 2 * np.sin(2 * w * t + 0.5), 2 + 0.3 * np.sin(5 * w * t + 1), 0 * t], axis=-1
        ),
        7,
        10.0,
    )


@pytest.mark.parametrize("along", [False, True])
def test_circle_and_helix_have_their_equations(along):
    w = 2 * np.pi / 4

    def curve(climb, height):
        return lambda t: np.stack(
            [1.5 * np.cos(w * t), 1.5 * np.sin(w * t), height + climb * t / 4, along * (w * t + np.pi / 2)], axis=-1
        )

    check_curve(circle(1.5, 4, height=2, along=along), curve(0, 2), 4, 4.0)
    check_curve(helix(1.5, 0.7, 2.5, 4, along=along), curve(0.7, 0.5), 10, 4.0)
    assert circle().repeats
    assert not helix().repeats


def test_line_goes_from_rest_to_rest():
    trajectory = line([1, 0, 1], [4, 4, 1], duration=3, yaw=0.3)
    s = evaluate(trajectory, np.array([0.0, 1.5, 3.0]))
    np.testing.assert_allclose(s.pos, [[1, 0, 1], [2.5, 2, 1], [4, 4, 1]], atol=1e-12)
    np.testing.assert_allclose(s.yaw, 0.3 * np.ones((3, 1)))
    for name in ("vel", "acc", "jerk"):
        np.testing.assert_allclose(getattr(s, name)[::2], np.zeros((2, 3)), atol=1e-10)


@pytest.mark.parametrize(
    "make", [lambda v: figure_eight(speed=v), lambda v: circle(speed=v), lambda v: helix(speed=v),
             lambda v: line([0, 0, 1], [3, 1, 1], speed=v)]
)  # fmt: skip
def test_the_setting_speed_is_the_largest_speed(make):
    trajectory = make(2.0)
    s = evaluate(trajectory, np.linspace(0, float(trajectory.duration), 2001))
    np.testing.assert_allclose(np.linalg.norm(s.vel, axis=-1).max(), 2.0, rtol=1e-5)


def test_a_hover_stays_at_its_position():
    s = evaluate(hover([1, 2, 3], yaw=0.5), np.array([-1.0, 0.5, 7.0]))
    np.testing.assert_array_equal(s.pos, [[1, 2, 3]] * 3)
    np.testing.assert_array_equal(s.vel, np.zeros((3, 3)))
    np.testing.assert_array_equal(s.yaw, 0.5 * np.ones((3, 1)))


def test_curves_are_as_smooth_as_their_pieces_where_they_repeat():
    trajectory = figure_eight(period=3)
    before, after = evaluate(trajectory, np.array([3 - 1e-9, 3 + 1e-9])), evaluate(trajectory, np.array([1e-9]))
    for name in ("pos", "vel", "acc", "jerk"):
        value = getattr(before, name)
        np.testing.assert_allclose(value[0], value[1], atol=1e-6)
        np.testing.assert_allclose(value[1], getattr(after, name)[0], atol=1e-6)
