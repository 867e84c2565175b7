"""Minimum-derivative interpolation, against integrals and differences.

The cost is the integral of the square of the derivative that is minimised.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from crazysim.trajectories import interpolation

ORDERS = [2, 3, 4]
"""Orders of the minimised derivative."""


def random_problem(order, n_pieces, seed, spread=1.0):
    """Return nodes at rest at both ends and free elsewhere, and durations."""
    rng = np.random.default_rng(seed)
    nodes = np.full((n_pieces + 1, order, 2), np.nan)
    nodes[:, 0], nodes[[0, -1], 1:] = rng.normal(size=(n_pieces + 1, 2)), 0.0
    return nodes, np.exp(rng.uniform(-spread, spread, n_pieces))


@pytest.mark.parametrize("order", ORDERS)
def test_each_basis_polynomial_has_one_derivative(order):
    basis = interpolation.hermite_basis(order)
    for column in range(2 * order):
        p = Polynomial(basis[:, column])
        end_derivatives = [p.deriv(k)(u) if k else p(u) for u in (0.0, 1.0) for k in range(order)]
        np.testing.assert_allclose(end_derivatives, np.eye(2 * order)[column], atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_the_cost_is_the_integral_of_the_square(order):
    nodes, durations = random_problem(order, 3, 0)
    filled = interpolation.fill_derivatives(nodes, durations)
    total = 0.0
    for h, piece in zip(durations, interpolation.unit_coefficients(filled, durations), strict=True):
        for axis in piece:
            derivative = Polynomial(axis / h ** np.arange(2 * order)).deriv(order)
            total += (derivative**2).integ()(h)
    np.testing.assert_allclose(interpolation.derivative_cost(filled, durations), total, rtol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
@given(seed=st.integers(0, 1000))
def test_other_derivatives_cost_more(order, seed):
    nodes, durations = random_problem(order, 5, seed)
    filled = interpolation.fill_derivatives(nodes, durations)
    min_cost = interpolation.derivative_cost(filled, durations)
    change = np.where(np.isnan(nodes), np.random.default_rng(seed).normal(size=nodes.shape), 0.0)
    differences = [
        interpolation.derivative_cost(filled + step * change, durations) - min_cost for step in (-1e-3, 1e-3)
    ]
    assert min(differences) > 0
    np.testing.assert_allclose(differences[0], differences[1], rtol=1e-4)  # a minimum has no slope


@pytest.mark.parametrize("order", ORDERS)
def test_the_gradient_with_respect_to_durations_equals_differences(order):
    nodes, durations = random_problem(order, 4, 3, 0.5)

    def min_cost(lengths):
        return interpolation.derivative_cost(interpolation.fill_derivatives(nodes, lengths), lengths)

    gradient = interpolation.cost_gradient(interpolation.fill_derivatives(nodes, durations), durations)
    for k, step in enumerate(1e-6 * np.eye(4)):
        difference = (min_cost(durations + step) - min_cost(durations - step)) / 2e-6
        np.testing.assert_allclose(gradient[k], difference, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("order", ORDERS)
def test_derivatives_are_continuous_over_many_uneven_pieces(order):
    """Derivatives up to 2 ``order`` - 2 are continuous; the durations of 60 pieces vary by a factor of 50."""
    nodes, durations = random_problem(order, 60, 4, 2.0)
    c = interpolation.unit_coefficients(interpolation.fill_derivatives(nodes, durations), durations)
    for derivative in range(2 * order - 1):
        weights = np.array([np.prod(np.arange(k - derivative + 1, k + 1)) for k in range(2 * order)], float)
        weights[:derivative] = 0.0
        at_end = c @ weights / durations[:, None] ** derivative
        at_begin = c[..., derivative] * weights[derivative] / durations[:, None] ** derivative
        sizes = np.maximum(np.abs(at_end[:-1]), np.abs(at_begin[1:]))
        np.testing.assert_allclose(at_end[:-1], at_begin[1:], atol=1e-7 * sizes.max())


def test_units_of_time_do_not_matter():
    nodes, durations = random_problem(4, 6, 5)
    scale = 1e3 ** np.arange(4)[:, None]
    np.testing.assert_allclose(
        interpolation.fill_derivatives(nodes * scale, durations / 1e3) / scale,
        interpolation.fill_derivatives(nodes, durations),
        rtol=1e-9,
    )


def test_too_few_fixed_derivatives_are_an_error():
    nodes, durations = random_problem(4, 1, 6)
    nodes[:, 1:] = np.nan
    with pytest.raises(np.linalg.LinAlgError):
        interpolation.fill_derivatives(nodes, durations)
