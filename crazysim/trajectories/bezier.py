"""Conversions of polynomials between Bernstein and power form, on the host in float64."""

from __future__ import annotations

from functools import lru_cache
from math import comb

import numpy as np
from numpy.typing import NDArray


@lru_cache
def _power_matrix(degree: int) -> NDArray:
    orders = range(degree + 1)
    return np.array([[(-1) ** (j + i) * comb(degree, j) * comb(j, i) for i in orders] for j in orders], float)


@lru_cache
def bernstein_matrix(degree: int) -> NDArray:
    """Return the matrix that converts power coefficients to control points. (degree + 1, degree + 1)"""
    orders = range(degree + 1)
    return np.array([[comb(i, j) / comb(degree, j) for j in orders] for i in orders])


def power_coefficients(points: NDArray) -> NDArray:
    """Return the coefficients of a Bezier curve of u in [0, 1], constant term first. (k, degree + 1)

    Args:
        points: Control points. (degree + 1, k)
    """
    return (_power_matrix(len(points) - 1) @ points).T


def control_points(coefficients: NDArray, degree: int | None = None) -> NDArray:
    """Return the control points of polynomials of u in [0, 1], whose degree may be raised. (degree + 1, k)

    Args:
        coefficients: Constant term first. (k, n)
        degree: Degree of the curve, at least ``n - 1``; None for ``n - 1``.
    """
    n = coefficients.shape[1]
    new_degree = n - 1 if degree is None else degree
    padded_coefficients = np.pad(coefficients, ((0, 0), (0, new_degree + 1 - n)))
    return bernstein_matrix(new_degree) @ padded_coefficients.T


def restrict_interval(coefficients: NDArray, start: float, end: float) -> NDArray:
    """Return polynomials restricted to the interval from ``start`` to ``end``, which is rescaled to [0, 1]. (k, n)

    Args:
        coefficients: Constant term first. (k, n)
    """
    orders = range(coefficients.shape[1])
    scales = [(end - start) ** i for i in orders]
    return coefficients @ [[comb(j, i) * start ** max(j - i, 0) * scales[i] for i in orders] for j in orders]


def significant_degree(coefficients: NDArray, tolerance: float) -> int:
    """Return the smallest degree that reproduces polynomials of u in [0, 1] within a tolerance.

    Args:
        coefficients: Constant term first. (k, n)
        tolerance: Largest sum of the magnitudes of the omitted coefficients.
    """
    tail_sums = np.cumsum(np.abs(coefficients)[:, ::-1], axis=1)[:, ::-1].max(axis=0)
    significant_orders = np.flatnonzero(tail_sums[1:] > tolerance)
    return int(significant_orders[-1]) + 1 if len(significant_orders) else 0
