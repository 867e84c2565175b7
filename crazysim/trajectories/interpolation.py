"""Piecewise polynomials through waypoints that minimise the integral of a squared derivative, in float64 on the host.

This integral, of the squared k-th derivative, is called the cost. A piece of degree 2k - 1 is determined by the values
of its first k derivatives, the zeroth included, at both ends (Hermite form). The cost is then a quadratic form of the
derivatives at the waypoints, its matrix is banded, and its minimum over the free derivatives needs one Cholesky
factorisation (Bry, Richter, Bachrach and Roy, "Aggressive flight of fixed-wing and quadrotor aircraft in dense indoor
environments", IJRR 2015, section 5). Continuity up to derivative k - 1 holds by construction; at the minimum,
derivatives up to 2k - 2 are continuous wherever derivative k - 1 and those below are free.
"""

from __future__ import annotations

import functools
import math
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@functools.cache
def hermite_basis(order: int) -> Floats:
    """Return the polynomials on [0, 1] with one of the first k derivatives at the ends equal to 1 and all others zero.

    For derivative j at 0 it is ``u^j / j! (1 - u)^k sum_i C(k - 1 + i, i) u^i`` with i < k - j; at 1, its mirror image.

    Args:
        order: Number k of derivatives at each end, the zeroth included.

    Returns:
        Coefficients, constant term in the first row. Each column is a polynomial: first for derivatives 0 to k - 1 at
        0, then for derivatives 0 to k - 1 at 1. (2k, 2k)
    """
    return np.array(_exact_basis(order), float)


@functools.cache
def _exact_basis(order: int) -> list[list[Fraction]]:
    k = order
    columns = []
    for j in range(k):
        coefficients = [Fraction(0)] * (2 * k)
        for i in range(k - j):
            for m in range(k + 1):
                sign_and_size = (-1) ** m * math.comb(k, m) * math.comb(k - 1 + i, i)
                coefficients[j + i + m] += Fraction(sign_and_size, math.factorial(j))
        columns.append(coefficients)
    for j in range(k):  # p(1 - u), with the sign that keeps the derivative
        mirrored_coefficients = [Fraction(0)] * (2 * k)
        for power, value in enumerate(columns[j]):
            for m in range(power + 1):
                mirrored_coefficients[m] += (-1) ** (m + j) * math.comb(power, m) * value
        columns.append(mirrored_coefficients)
    return [list(row) for row in zip(*columns, strict=True)]


@functools.cache
def unit_cost(order: int) -> Floats:
    """Return the matrix of the cost of a piece on [0, 1], a quadratic form of its end derivatives. (2k, 2k)"""
    k, size = order, 2 * order
    basis = np.array(_exact_basis(order), dtype=object)
    monomials = np.full((size, size), Fraction(0), dtype=object)
    for m in range(k, size):
        for n in range(k, size):
            monomials[m, n] = Fraction(math.perm(m, k) * math.perm(n, k), m + n - 2 * k + 1)
    return (basis.T @ monomials @ basis).astype(float)


def _duration_exponents(order: int) -> NDArray[np.int64]:
    j = np.tile(np.arange(order), 2)
    return 1 - 2 * order + j[:, None] + j


def cost_matrices(durations: Floats, order: int) -> Floats:
    """Return the matrix of the cost of each piece, for derivatives with respect to time. (n_pieces, 2k, 2k)"""
    return unit_cost(order) * durations[:, None, None] ** _duration_exponents(order)


def fill_derivatives(nodes: Floats, durations: Floats) -> Floats:
    """Return the derivatives at all waypoints that minimise the cost.

    Each axis is solved separately, since different derivatives may be free on each axis. Times are scaled by the
    mean duration. A Cholesky factorisation needs no further scaling: its error does not depend on the scaling of rows
    and columns (Higham, *Accuracy and Stability of Numerical Algorithms*, section 10.1).

    Args:
        nodes: Derivatives 0 to k - 1 at each waypoint, NaN where free. (n_pieces + 1, k, n_axes)
        durations: Length of each piece, s. (n_pieces,)

    Returns:
        Derivatives, as ``nodes`` but without NaN. (n_pieces + 1, k, n_axes)

    Raises:
        numpy.linalg.LinAlgError: If too little is fixed for a unique minimum.
    """
    order = nodes.shape[1]
    time_unit = float(np.mean(durations))
    powers = time_unit ** np.arange(order)[:, None]
    scaled_nodes = nodes * powers
    blocks = cost_matrices(durations / time_unit, order)
    return np.stack([_fill_axis(scaled_nodes[..., axis], blocks) for axis in range(nodes.shape[2])], axis=-1) / powers


def _fill_axis(nodes: Floats, blocks: Floats) -> Floats:
    from scipy.linalg import solveh_banded  # a fifth of a second to import

    order = nodes.shape[1]
    values = nodes.ravel().copy()
    is_free = np.isnan(values)
    if not np.any(is_free):
        return nodes
    free_index = np.cumsum(is_free) - 1
    node_entries = order * np.arange(len(blocks))[:, None] + np.arange(2 * order)
    rows, columns = np.broadcast_arrays(node_entries[:, :, None], node_entries[:, None, :])
    is_lower_free = is_free[rows] & is_free[columns] & (rows >= columns)
    is_fixed_column = is_free[rows] & ~is_free[columns]
    matrix = np.zeros((2 * order, int(np.sum(is_free))))  # lower diagonals
    np.add.at(
        matrix,
        (free_index[rows[is_lower_free]] - free_index[columns[is_lower_free]], free_index[columns[is_lower_free]]),
        blocks[is_lower_free],
    )
    right_side = np.zeros(matrix.shape[1])
    np.add.at(
        right_side, free_index[rows[is_fixed_column]], -blocks[is_fixed_column] * values[columns[is_fixed_column]]
    )
    values[is_free] = solveh_banded(matrix[: min(2 * order, len(right_side))], right_side, lower=True)
    return values.reshape(nodes.shape)


def derivative_cost(nodes: Floats, durations: Floats) -> float:
    """Return the cost: the integral of the squared k-th derivative, summed over the axes."""
    ends = end_derivatives(nodes)
    return float(np.einsum("pia,pij,pja->", ends, cost_matrices(durations, nodes.shape[1]), ends))


def cost_gradient(nodes: Floats, durations: Floats) -> Floats:
    """Return the gradient of the minimum of the cost with respect to the durations. (n_pieces,)

    At the minimum it equals the partial derivative for constant ``nodes`` (envelope theorem).

    Args:
        nodes: Derivatives at the minimum, as from ``fill_derivatives``. (n_pieces + 1, k, n_axes)
        durations: Length of each piece, s. (n_pieces,)
    """
    order = nodes.shape[1]
    slopes = cost_matrices(durations, order) * _duration_exponents(order) / durations[:, None, None]
    ends = end_derivatives(nodes)
    return np.einsum("pia,pij,pja->p", ends, slopes, ends)


def end_derivatives(nodes: Floats) -> Floats:
    """Return the derivatives at both ends of each piece. (n_pieces, 2k, n_axes)"""
    return np.concatenate([nodes[:-1], nodes[1:]], axis=1)


def unit_coefficients(nodes: Floats, durations: Floats) -> Floats:
    """Return the coefficients of the polynomials in u in [0, 1], the time in each piece divided by its length.

    Args:
        nodes: Derivatives at the waypoints, without NaN. (n_pieces + 1, k, n_axes)
        durations: Length of each piece, s. (n_pieces,)

    Returns:
        Coefficients, constant term first. (n_pieces, n_axes, 2k)
    """
    order = nodes.shape[1]
    powers = durations[:, None] ** np.tile(np.arange(order), 2)
    return np.einsum("cj,pj,pja->pac", hermite_basis(order), powers, end_derivatives(nodes))


def pad_degree(coefficients: ArrayLike, degree: int) -> Floats:
    """Return coefficients with zeros appended up to a degree. (..., degree + 1)"""
    c = np.asarray(coefficients, float)
    return np.concatenate([c, np.zeros((*c.shape[:-1], degree + 1 - c.shape[-1]))], axis=-1)
