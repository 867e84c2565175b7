"""Riccati equations: against SciPy, in both precisions, with gradients, and without a solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from crazysim.errors import ConfigError
from crazysim.lab.control.riccati import check_gain, gain_continuous, gain_discrete, solve_continuous, solve_discrete

SOLVERS = {
    "continuous": (jax.jit(solve_continuous), scipy.linalg.solve_continuous_are),
    "discrete": (jax.jit(solve_discrete), scipy.linalg.solve_discrete_are),
}
GAINS = {gain: jax.jit(gain) for gain in (gain_continuous, gain_discrete)}
SIZES = [(4, 2), (16, 4)]
"""Numbers of states and inputs."""


def random_problem(n, m, seed):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(n, m))
    return A, B, np.diag(rng.uniform(0.01, 10, n)), np.diag(rng.uniform(0.1, 10, m))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("kind", SOLVERS)
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_solutions_equal_those_of_scipy(kind, n, m):
    solve, reference = SOLVERS[kind]
    for seed in range(5):
        expected = reference(*random_problem(n, m, seed))
        np.testing.assert_allclose(solve(*random_problem(n, m, seed)), expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("kind", SOLVERS)
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_solutions_in_float32_are_accurate_to_half_a_percent(kind, n, m):
    """30 doublings of matrices of up to 16 x 16 add up some 1e5 roundings of 6e-8."""
    solve, reference = SOLVERS[kind]
    for seed in range(5):
        matrices = [x.astype(np.float32) for x in random_problem(n, m, seed)]
        expected, result = reference(*random_problem(n, m, seed)), solve(*matrices)
        assert result.dtype == np.float32
        np.testing.assert_allclose(result, expected, atol=5e-3 * np.abs(expected).max())


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("gain", [gain_continuous, gain_discrete])
def test_gradients_of_gains_equal_central_differences(gain):
    """The weights enter through their logarithms, which keeps them positive."""
    A, B, Q, R = random_problem(4, 2, 3)

    def diagonal_gain(A, B, q, r):
        return gain(A, B, jnp.diag(jnp.exp(q)), jnp.diag(jnp.exp(r)))

    args = (A, B, np.log(np.diag(Q)), np.log(np.diag(R)))
    rng = np.random.default_rng(0)
    directions, weights = tuple(rng.normal(size=x.shape) for x in args), rng.normal(size=(2, 4))

    @jax.jit
    def slopes(*args):
        value, forward = jax.jvp(diagonal_gain, args, directions)
        backward = jax.vjp(diagonal_gain, *args)[1](weights)
        return value, forward, sum(jnp.sum(x * y) for x, y in zip(backward, directions, strict=True))

    after, before = (slopes(*(x + h * y for x, y in zip(args, directions, strict=True)))[0] for h in (1e-6, -1e-6))
    central = np.asarray(after - before) / 2e-6
    _, forward, backward = slopes(*args)
    np.testing.assert_allclose(forward, central, atol=1e-6, rtol=1e-6)
    np.testing.assert_allclose(backward, np.sum(weights * central), atol=1e-6, rtol=1e-6)


@pytest.mark.usefixtures("x64")
def test_a_double_integrator_by_hand():
    """Position weight 1, input weight 1: K = (1, sqrt(2)), the damping ratio of 0.707 that every textbook has."""
    A, B = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]])
    K = GAINS[gain_continuous](A, B, np.diag([1.0, 0]), np.eye(1))
    np.testing.assert_allclose(K, [[1, np.sqrt(2)]], rtol=1e-12)


UNSOLVABLE = {
    "unstable mode without input": (np.diag([1.0, -1.0]), np.diag([2.0, 0.5]), np.diag([0.0, 1.0]), np.eye(2)),
    "integrator without input": (np.zeros((2, 2)), np.eye(2), np.diag([0.0, 1.0]), np.eye(2)),
    "integrator without weight": (np.zeros((2, 2)), np.eye(2), np.eye(2), np.diag([0.0, 1.0])),
    "not a number": (np.full((2, 2), np.nan), np.full((2, 2), np.nan), np.eye(2), np.eye(2)),
}


@pytest.mark.parametrize("case", UNSOLVABLE)
def test_a_gain_without_a_solution_is_nan_and_its_check_raises(case):
    continuous, discrete, B, Q = UNSOLVABLE[case]
    for gain, A in ((gain_continuous, continuous), (gain_discrete, discrete)):
        K = GAINS[gain](A, B, Q, np.eye(2))
        assert np.isnan(K).all()
        with pytest.raises(ConfigError, match="stabilising solution"):
            check_gain(K)
