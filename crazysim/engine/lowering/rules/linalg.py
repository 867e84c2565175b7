"""Rules for small linear algebra, unrolled."""

from __future__ import annotations

import itertools

import numpy as np

from crazysim.engine.ir.blocks import constant
from crazysim.engine.jaxcompat import JaxprEqn
from crazysim.engine.lowering.jaxprs import ElementArray, Lowering, UnsupportedError, as_elements, rule

MAX_SYSTEM_SIZE = 6
"""Maximum number of rows of a matrix. The unrolled arithmetic of a larger matrix is longer than a whole step."""


def _check_size(eqn: JaxprEqn, n: int) -> None:
    if n > MAX_SYSTEM_SIZE:
        raise UnsupportedError(f"primitive {eqn.primitive.name!r} of size {n}; at most {MAX_SYSTEM_SIZE} is supported")


def _matrices(x: ElementArray) -> list[ElementArray]:
    return list(x.reshape(-1, *x.shape[-2:]))


@rule("cholesky")
def _cholesky(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    n, dtype = args[0].shape[-1], eqn.outvars[0].aval.dtype
    _check_size(eqn, n)
    zero = constant(0, dtype)
    out = []
    for a in _matrices(args[0]):
        factor, has_failed = np.full((n, n), zero, object), constant(False, bool)
        for j in range(n):
            for i in range(j, n):
                remainder = a[i, j]
                for k in range(j):
                    remainder = ctx.scalar("sub", remainder, ctx.scalar("mul", factor[i, k], factor[j, k]))
                factor[i, j] = (
                    ctx.builder.add("sqrt", (remainder,), dtype)
                    if i == j
                    else ctx.scalar("div", remainder, factor[j, j])
                )
                if i == j:
                    has_failed = ctx.scalar("or", has_failed, ctx.scalar("le", remainder, zero, dtype=bool))
        for j, i in itertools.combinations_with_replacement(range(n), 2):
            factor[i, j] = ctx.scalar("select_n", has_failed, factor[i, j], constant(np.nan, dtype))
        out.append(factor)
    return [as_elements([x for factor in out for x in factor.reshape(-1)], args[0].shape)]


@rule("triangular_solve")
def _triangular_solve(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    params = eqn.params
    _check_size(eqn, args[0].shape[-1])
    out = []
    for a, b in zip(_matrices(args[0]), _matrices(args[1]), strict=True):
        a = a.T if params["transpose_a"] else a
        is_lower = params["lower"] != params["transpose_a"]
        if not params["left_side"]:  # x a = b is a' x' = b'
            a, b, is_lower = a.T, b.T, not is_lower
        x = _substitute(ctx, a, b, is_lower, params["unit_diagonal"])
        out.append(x if params["left_side"] else x.T)
    return [as_elements([e for x in out for e in x.reshape(-1)], args[1].shape)]


def _substitute(
    ctx: Lowering, a: ElementArray, b: ElementArray, is_lower: bool, has_unit_diagonal: bool
) -> ElementArray:
    n, x = len(a), np.empty(b.shape, object)
    order = list(range(n)) if is_lower else list(range(n))[::-1]
    for column in range(b.shape[1]):
        for n_done, i in enumerate(order):
            remainder = b[i, column]
            for k in order[:n_done]:
                remainder = ctx.scalar("sub", remainder, ctx.scalar("mul", a[i, k], x[k, column]))
            x[i, column] = remainder if has_unit_diagonal else ctx.scalar("div", remainder, a[i, i])
    return x


@rule("lu")
def _lu(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    n, m = args[0].shape[-2:]
    if n != m:
        raise UnsupportedError("primitive 'lu' of a matrix that is not square")
    _check_size(eqn, n)
    zero = constant(0, eqn.outvars[0].aval.dtype)
    factors, all_pivots, permutations = [], [], []
    for a in _matrices(args[0]):
        a = a.copy()
        rows = np.array([constant(i, np.int32) for i in range(n)], object)
        pivots = []
        for j in range(n):
            pivot, largest = constant(j, np.int32), ctx.scalar("abs", a[j, j])
            for i in range(j + 1, n):
                magnitude = ctx.scalar("abs", a[i, j])
                is_larger = ctx.scalar("gt", magnitude, largest, dtype=bool)
                pivot = ctx.scalar("select_n", is_larger, pivot, constant(i, np.int32))
                largest = ctx.scalar("select_n", is_larger, largest, magnitude)
            pivots.append(pivot)
            for i in range(j + 1, n):
                is_pivot = ctx.scalar("eq", pivot, constant(i, np.int32), dtype=bool)
                for x in (*a.T, rows):  # every column, and the row numbers
                    x[i], x[j] = (
                        ctx.scalar("select_n", is_pivot, x[i], x[j]),
                        ctx.scalar("select_n", is_pivot, x[j], x[i]),
                    )
            is_zero = ctx.scalar("eq", a[j, j], zero, dtype=bool)  # the column is zero and stays unchanged
            divisor = ctx.scalar("select_n", is_zero, a[j, j], constant(1, a[j, j].dtype))
            for i in range(j + 1, n):
                a[i, j] = ctx.scalar("div", a[i, j], divisor)
                for k in range(j + 1, n):
                    a[i, k] = ctx.scalar("sub", a[i, k], ctx.scalar("mul", a[i, j], a[j, k]))
        factors.append(a)
        all_pivots.append(pivots)
        permutations.append(rows)
    shape = args[0].shape
    return [
        as_elements([x for a in factors for x in a.reshape(-1)], shape),
        as_elements([x for pivots in all_pivots for x in pivots], shape[:-1]),
        as_elements([x for rows in permutations for x in rows], shape[:-1]),
    ]
