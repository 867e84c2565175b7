"""Splines through points and Bezier curves, against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicSpline, make_interp_spline

from crazysim.trajectories import Trajectory, of_bezier, spline

RNG = np.random.default_rng(5)
TIMES = np.array([0.0, 0.7, 1.0, 2.5, 3.1, 4.0])
POINTS = RNG.normal(size=(6, 3))


on_device = jax.jit(jax.vmap(Trajectory.evaluate, in_axes=(None, 0)))


def evaluate(trajectory, t):
    return jax.tree.map(np.asarray, on_device(trajectory, t))


def positions(trajectory, times):
    return evaluate(trajectory, times).pos


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_a_spline_at_rest_equals_that_of_scipy(degree, x64):
    rest = [(k, np.zeros(3)) for k in range(1, (degree + 1) // 2)]
    expected = make_interp_spline(TIMES, POINTS, k=degree, bc_type=(rest, rest))
    trajectory = spline(TIMES, POINTS, degree)
    times = np.linspace(0, 4, 23)
    np.testing.assert_allclose(positions(trajectory, times), expected(times), atol=1e-9)
    setpoint = evaluate(trajectory, times)
    for k, value in enumerate([setpoint.vel, setpoint.acc, setpoint.jerk], start=1):
        np.testing.assert_allclose(value[10], expected.derivative(k)(times[10]), rtol=1e-7)


def test_a_natural_spline_equals_that_of_scipy(x64):
    expected = CubicSpline(TIMES, POINTS, bc_type="natural")
    times = np.linspace(0, 4, 23)
    np.testing.assert_allclose(positions(spline(TIMES, POINTS, 3, at_rest=False), times), expected(times), atol=1e-12)


def test_yaw_turns_the_shorter_way(x64):
    trajectory = spline([0.0, 1.0], [[0, 0, 1], [1, 0, 1]], 3, yaw=[3.0, -3.0])
    np.testing.assert_allclose(evaluate(trajectory, np.array([1.0, 0.5])).yaw, [[2 * np.pi - 3.0], [np.pi]])


@given(
    counts=st.lists(st.integers(1, 8), min_size=1, max_size=4),
    n_axes=st.sampled_from([3, 4]),
    seed=st.integers(0, 1000),
)
def test_bezier_curves_equal_those_of_scipy(counts, n_axes, seed):
    rng = np.random.default_rng(seed)
    curves = [rng.uniform(-3, 3, (count, n_axes)) for count in counts]
    ends = np.cumsum(rng.uniform(0.1, 3.0, len(counts)))
    begins = np.concatenate([[0.0], ends[:-1]])
    times = begins + 0.4 * (ends - begins)
    padded = Trajectory.stack([of_bezier(ends, curves), of_bezier(np.arange(1.0, 5.0), [np.ones((8, 4))] * 4)])
    setpoints = evaluate(jax.tree.map(lambda x: x[0], padded), np.resize(times, 4))
    values = np.concatenate([setpoints.pos, setpoints.yaw], axis=1)[:, :n_axes]
    rates = np.concatenate([setpoints.vel, setpoints.yaw_rate], axis=1)[:, :n_axes]
    for k, (curve, begin, end) in enumerate(zip(curves, begins, ends, strict=True)):
        expected = BPoly(curve[:, None], [begin, end])
        np.testing.assert_allclose(values[k], expected(times[k]), atol=2e-5)
        np.testing.assert_allclose(rates[k] * (end - begin), expected(times[k], 1) * (end - begin), atol=5e-4)


def test_bezier_repeats_on_request():
    trajectory = of_bezier([1.0], [[[0, 0, 0], [1, 0, 0]]], repeats=True)
    np.testing.assert_allclose(trajectory.evaluate(2.25).pos, [0.25, 0, 0])
    assert trajectory.coefficients.dtype == jnp.float32
