"""Rules for reductions, unrolled: sums, scans, sorts and products of arrays."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from crazysim.engine.ir import Element, constant
from crazysim.engine.lower import MAX_UNROLL, Elements, Lowering, UnsupportedError, as_elements, constants, rule
from crazysim.engine.rules.movement import run_now

COMBINE = {
    "reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min",
    "reduce_and": "and", "reduce_or": "or", "reduce_xor": "xor",
}  # fmt: skip


@rule(*COMBINE)
def _reduce(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    op, dtype, axes = COMBINE[eqn.primitive.name], eqn.outvars[0].aval.dtype, eqn.params["axes"]
    x = np.moveaxis(args[0], axes, range(len(axes)))
    rest = x.shape[len(axes) :]
    rows = list(x.reshape(-1, *rest))
    if not rows:
        return [constants(run_now(eqn, [np.zeros(args[0].shape, dtype)])[0], dtype)]
    return [
        functools.reduce(lambda a, b: ctx.elementwise(op, [a, b], dtype), [np.asarray(row, object) for row in rows])
    ]


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulate(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    op = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}[eqn.primitive.name]
    x = np.moveaxis(args[0], eqn.params["axis"], 0).copy()
    order = range(len(x))[::-1] if eqn.params["reverse"] else range(len(x))
    for last, i in itertools.pairwise(order):
        x[i] = ctx.elementwise(op, [np.asarray(x[last], object), np.asarray(x[i], object)], eqn.outvars[0].aval.dtype)[
            ()
        ]
    return [np.moveaxis(x, 0, eqn.params["axis"])]


@rule("argmax", "argmin")
def _argmax(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    """The first of the best, or the first NaN, as XLA has it."""
    (axis,), index = eqn.params["axes"], eqn.params["index_dtype"]
    better = "gt" if eqn.primitive.name == "argmax" else "lt"
    rows = [np.asarray(row, object) for row in np.moveaxis(args[0], axis, 0)]
    best, where = rows[0], np.broadcast_to(constants(0, index), rows[0].shape)
    for i, row in enumerate(rows[1:], 1):
        best_is_number = ctx.elementwise("eq", [best, best], bool)
        wins = ctx.elementwise(
            "or", [ctx.elementwise(better, [row, best], bool), ctx.elementwise("ne", [row, row], bool)], bool
        )
        wins = ctx.elementwise("and", [wins, best_is_number], bool)
        best = ctx.elementwise("select_n", [wins, best, row], eqn.invars[0].aval.dtype)
        where = ctx.elementwise("select_n", [wins, where, constants(i, index)], index)
    return [where]


@rule("sort")
def _sort(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Odd-even transposition: neighbours change places, which keeps the order of equals. NaN goes last."""
    axis, n_keys = eqn.params["dimension"], eqn.params["num_keys"]
    dtypes = [v.aval.dtype for v in eqn.invars]
    columns = [np.moveaxis(x, axis, 0).copy() for x in args]
    n = len(columns[0])
    if n > MAX_UNROLL:
        raise UnsupportedError(f"primitive 'sort' of {n} elements; at most {MAX_UNROLL} are unrolled")
    for turn in range(n):
        for i in range(turn % 2, n - 1, 2):
            first = [np.asarray(c[i], object) for c in columns]
            second = [np.asarray(c[i + 1], object) for c in columns]
            swap, tied = constants(False, bool), constants(True, bool)
            for a, b, dtype in zip(first[:n_keys], second[:n_keys], dtypes, strict=False):
                above = ctx.elementwise("lt", [b, a], bool)
                equal = ctx.elementwise("eq", [a, b], bool)
                if dtype.kind == "f":
                    a_nan, b_nan = ctx.elementwise("ne", [a, a], bool), ctx.elementwise("ne", [b, b], bool)
                    above = ctx.elementwise(
                        "or",
                        [above, ctx.elementwise("and", [a_nan, ctx.elementwise("not", [b_nan], bool)], bool)],
                        bool,
                    )
                    equal = ctx.elementwise("or", [equal, ctx.elementwise("and", [a_nan, b_nan], bool)], bool)
                swap = ctx.elementwise("or", [swap, ctx.elementwise("and", [tied, above], bool)], bool)
                tied = ctx.elementwise("and", [tied, equal], bool)
            for c, a, b, dtype in zip(columns, first, second, dtypes, strict=True):
                c[i] = ctx.elementwise("select_n", [swap, a, b], dtype)[()]
                c[i + 1] = ctx.elementwise("select_n", [swap, b, a], dtype)[()]
    return [np.moveaxis(c, 0, axis) for c in columns]


@rule("dot_general")
def _dot(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    (lhs_axes, rhs_axes), (lhs_batch, rhs_batch) = eqn.params["dimension_numbers"]
    dtype, (a, b) = eqn.outvars[0].aval.dtype, args

    def arranged(x: Elements, batch: Sequence[int], summed: Sequence[int]) -> tuple[Elements, tuple[int, ...]]:
        free = [i for i in range(x.ndim) if i not in (*batch, *summed)]
        sizes = tuple(x.shape[i] for i in free)
        x = x.transpose(*batch, *free, *summed)
        n_batch, n_free = int(np.prod(x.shape[: len(batch)])), int(np.prod(sizes))
        return x.reshape(n_batch, n_free, -1), sizes

    batch = tuple(a.shape[i] for i in lhs_batch)
    a, a_sizes = arranged(a, lhs_batch, lhs_axes)
    b, b_sizes = arranged(b, rhs_batch, rhs_axes)
    out = []
    for n in range(a.shape[0]):
        for row in a[n]:
            for column in b[n]:
                terms = [
                    ctx.scalar("mul", *(_cast(ctx, x, dtype) for x in pair)) for pair in zip(row, column, strict=True)
                ]
                zero = constant(0, dtype)
                out.append(functools.reduce(lambda s, t: ctx.scalar("add", s, t), terms, zero))
    return [as_elements(out, (*batch, *a_sizes, *b_sizes))]


def _cast(ctx: Lowering, x: Element, dtype: Any) -> Element:
    return ctx.builder.add("convert_element_type", (x,), dtype)
