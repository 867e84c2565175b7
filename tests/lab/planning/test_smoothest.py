"""The differentiable function ``smoothest``, against planning in float64 on the host and against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from crazysim.trajectories import interpolation, minimum_jerk, minimum_snap, smoothest

RNG = np.random.default_rng(3)
WAYPOINTS, DURATIONS = RNG.uniform(-2, 2, (6, 3)), RNG.uniform(0.6, 2.0, 5)
METHODS = {4: minimum_snap, 3: minimum_jerk}
"""Planner on the host for each order of the minimised derivative."""


@pytest.mark.parametrize("order", METHODS)
def test_trajectory_and_cost_equal_those_of_the_host(order, x64):
    trajectory, cost = jax.jit(smoothest, static_argnums=2)(WAYPOINTS, DURATIONS, order)
    expected = METHODS[order](WAYPOINTS, DURATIONS)
    nodes = np.full((6, order, 3), np.nan)
    nodes[:, 0], nodes[[0, -1], 1:] = WAYPOINTS, 0.0
    np.testing.assert_allclose(
        cost, interpolation.derivative_cost(interpolation.fill_derivatives(nodes, DURATIONS), DURATIONS), rtol=1e-9
    )
    np.testing.assert_allclose(trajectory.ends, expected.ends)
    np.testing.assert_allclose(trajectory.coefficients, expected.coefficients, atol=1e-9)


@pytest.mark.parametrize("n", [2, 3, 11])
def test_float32_is_as_accurate_as_documented(n):
    rng = np.random.default_rng(n)
    waypoints, durations = rng.uniform(-2, 2, (n, 3)), rng.uniform(0.4, 2.0, n - 1)
    trajectory, _ = jax.jit(smoothest)(jnp.float32(waypoints), jnp.float32(durations))
    expected = minimum_snap(waypoints, durations)
    u = np.linspace(0, 1, 21)[:, None] ** np.arange(8)
    result, exact = (np.asarray(t.coefficients) @ u.T for t in (trajectory, expected))
    np.testing.assert_allclose(result, exact, atol=4e-3)  # 1e-3 of 4 m


def test_gradients_equal_differences(x64):
    def objective(waypoints, durations):
        trajectory, cost = smoothest(waypoints, durations)
        setpoint = trajectory.evaluate(2.3)
        return jnp.log(cost) + jnp.sum(setpoint.pos) + jnp.sum(setpoint.acc)

    check_grads(jax.jit(objective), (jnp.array(WAYPOINTS), jnp.array(DURATIONS)), 1, modes=["rev"], eps=1e-6)


def test_smoothest_can_be_mapped():
    trajectories, costs = jax.jit(jax.vmap(smoothest))(
        np.stack([WAYPOINTS, 2 * WAYPOINTS]), np.stack([DURATIONS, DURATIONS])
    )
    np.testing.assert_allclose(costs[1], 4 * np.asarray(costs[0]), rtol=1e-4)
    assert trajectories.coefficients.shape == (2, 5, 4, 8)
