"""Rules for reductions, unrolled: sums, scans, sorts and products of arrays."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import DTypeLike

from crazysim.engine.ir.blocks import Element, constant
from crazysim.engine.jaxcompat import JaxprEqn
from crazysim.engine.lowering.jaxprs import (
    MAX_UNROLL,
    ElementArray,
    Lowering,
    UnsupportedError,
    as_elements,
    constants,
    rule,
)
from crazysim.engine.lowering.rules.movement import evaluate

OPERATION_OF_REDUCTION = {
    "reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min",
    "reduce_and": "and", "reduce_or": "or", "reduce_xor": "xor",
}  # fmt: skip


@rule(*OPERATION_OF_REDUCTION)
def _reduce(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    op, dtype, axes = OPERATION_OF_REDUCTION[eqn.primitive.name], eqn.outvars[0].aval.dtype, eqn.params["axes"]
    x = np.moveaxis(args[0], axes, range(len(axes)))
    result_shape = x.shape[len(axes) :]
    rows = list(x.reshape(math.prod(x.shape[: len(axes)]), *result_shape))
    if not rows:
        return [constants(evaluate(eqn, [np.zeros(args[0].shape, dtype)])[0], dtype)]
    return [
        functools.reduce(lambda a, b: ctx.elementwise(op, [a, b], dtype), [np.asarray(row, object) for row in rows])
    ]


@rule("reduce")
def _reduce_by(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    axes, n = eqn.params["dimensions"], len(args) // 2
    arrays = [np.moveaxis(x, axes, range(len(axes))) for x in args[:n]]
    result_shape = arrays[0].shape[len(axes) :]
    rows = [x.reshape(math.prod(x.shape[: len(axes)]), *result_shape) for x in arrays]
    results = [np.empty(result_shape, object) for _ in arrays]
    for result_index in np.ndindex(result_shape):
        accumulators = args[n:]
        for k in range(len(rows[0])):
            accumulators = ctx.lower(eqn.params["jaxpr"], [*accumulators, *(x[(k, *result_index, ...)] for x in rows)])
        for result, value in zip(results, accumulators, strict=True):
            result[result_index] = value[()]
    return results


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulate(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    op = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}[eqn.primitive.name]
    x = np.moveaxis(args[0], eqn.params["axis"], 0).copy()
    order = range(len(x))[::-1] if eqn.params["reverse"] else range(len(x))
    for previous, i in itertools.pairwise(order):
        x[i, ...] = ctx.elementwise(op, [x[previous, ...], x[i, ...]], eqn.outvars[0].aval.dtype)
    return [np.moveaxis(x, 0, eqn.params["axis"])]


@rule("argmax", "argmin")
def _argmax(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    (axis,), index_dtype = eqn.params["axes"], eqn.params["index_dtype"]
    comparison = "gt" if eqn.primitive.name == "argmax" else "lt"
    rows = [np.asarray(row, object) for row in np.moveaxis(args[0], axis, 0)]
    best, best_index = rows[0], np.broadcast_to(constants(0, index_dtype), rows[0].shape)
    for i, row in enumerate(rows[1:], 1):
        best_is_number = ctx.elementwise("eq", [best, best], bool)
        is_better = ctx.elementwise(
            "or", [ctx.elementwise(comparison, [row, best], bool), ctx.elementwise("ne", [row, row], bool)], bool
        )
        is_better = ctx.elementwise("and", [is_better, best_is_number], bool)
        best = ctx.elementwise("select_n", [is_better, best, row], eqn.invars[0].aval.dtype)
        best_index = ctx.elementwise("select_n", [is_better, best_index, constants(i, index_dtype)], index_dtype)
    return [best_index]


@rule("sort")
def _sort(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return _sort_rows(ctx, eqn, args, eqn.params["dimension"], eqn.params["num_keys"])


@rule("top_k")
def _top_k(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    # XLA orders floats by their bits: -NaN, -inf, ..., -0, 0, ..., inf, NaN.
    (x,), k, axis, dtype = args, eqn.params["k"], eqn.params["axis"], eqn.invars[0].aval.dtype
    numbers = np.arange(x.shape[axis]).reshape([-1 if i == axis else 1 for i in range(x.ndim)])
    positions = constants(np.broadcast_to(numbers, x.shape), np.int32)
    key = x
    if dtype.kind == "f":  # bits as integers are in the order of the floats, negative floats in reverse
        ctx.builder.barrier()  # without it, XLA may recompute a NaN for each exchange, with different signs
        integer = np.dtype(f"i{dtype.itemsize}")
        key = ctx.elementwise("bitcast_convert_type", [x], integer)
        flipped = ctx.elementwise("xor", [key, constants(np.iinfo(integer).max, integer)], integer)
        is_negative = ctx.elementwise("lt", [key, constants(0, integer)], bool)
        key = ctx.elementwise("select_n", [is_negative, key, flipped], integer)
    columns = _sort_rows(ctx, eqn, [key, x, positions], axis, 1, descending=True)
    return [np.take(y, range(k), axis) for y in columns[1:]]


def _sort_rows(
    ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray], axis: int, n_keys: int, descending: bool = False
) -> list[ElementArray]:
    columns = [np.moveaxis(x, axis, 0).copy() for x in args]
    n = len(columns[0])
    if n > MAX_UNROLL:
        raise UnsupportedError(f"primitive {eqn.primitive.name!r} of {n} elements; at most {MAX_UNROLL} are unrolled")
    for pass_number in range(n):
        for i in range(pass_number % 2, n - 1, 2):
            first = [c[i, ...].copy() for c in columns]
            second = [c[i + 1, ...].copy() for c in columns]
            low, high = (first, second) if descending else (second, first)
            must_swap = _precedes(ctx, low[:n_keys], high[:n_keys]) if first[0].size else constants(False, bool)
            for c, a, b in zip(columns, first, second, strict=True):
                if a.size:
                    dtype = a.reshape(-1)[0].dtype
                    c[i, ...] = ctx.elementwise("select_n", [must_swap, a, b], dtype)
                    c[i + 1, ...] = ctx.elementwise("select_n", [must_swap, b, a], dtype)
    return [np.moveaxis(c, 0, axis) for c in columns]


def _precedes(ctx: Lowering, first: Sequence[ElementArray], second: Sequence[ElementArray]) -> ElementArray:
    precedes, is_tied = constants(False, bool), constants(True, bool)
    for a, b in zip(first, second, strict=True):
        is_less, is_equal = ctx.elementwise("lt", [a, b], bool), ctx.elementwise("eq", [a, b], bool)
        if a.reshape(-1)[0].dtype.kind == "f":
            a_is_nan, b_is_nan = ctx.elementwise("ne", [a, a], bool), ctx.elementwise("ne", [b, b], bool)
            is_only_b_nan = ctx.elementwise("and", [b_is_nan, ctx.elementwise("not", [a_is_nan], bool)], bool)
            is_less = ctx.elementwise("or", [is_less, is_only_b_nan], bool)
            is_equal = ctx.elementwise("or", [is_equal, ctx.elementwise("and", [a_is_nan, b_is_nan], bool)], bool)
        precedes = ctx.elementwise("or", [precedes, ctx.elementwise("and", [is_tied, is_less], bool)], bool)
        is_tied = ctx.elementwise("and", [is_tied, is_equal], bool)
    return precedes


@rule("dot_general")
def _dot(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    (lhs_axes, rhs_axes), (lhs_batch, rhs_batch) = eqn.params["dimension_numbers"]
    dtype, (a, b) = eqn.outvars[0].aval.dtype, args
    if any(v.aval.dtype.kind == "f" for v in eqn.invars) and dtype.kind != "f":
        raise UnsupportedError(f"primitive 'dot_general' of floating-point numbers with a result of type {dtype}")

    def as_matrices(
        x: ElementArray, batch: Sequence[int], contracted_axes: Sequence[int]
    ) -> tuple[ElementArray, tuple[int, ...]]:
        free_axes = [i for i in range(x.ndim) if i not in (*batch, *contracted_axes)]
        sizes = tuple(x.shape[i] for i in free_axes)
        x = x.transpose(*batch, *free_axes, *contracted_axes)
        n_batch, n_free = int(np.prod(x.shape[: len(batch)])), int(np.prod(sizes))
        return x.reshape(n_batch, n_free, -1), sizes

    batch = tuple(a.shape[i] for i in lhs_batch)
    a, a_sizes = as_matrices(a, lhs_batch, lhs_axes)
    b, b_sizes = as_matrices(b, rhs_batch, rhs_axes)
    multiply, add = ("and", "or") if dtype.kind == "b" else ("mul", "add")
    out = []
    for n in range(a.shape[0]):
        for row in a[n]:
            for column in b[n]:
                terms = [
                    ctx.scalar(multiply, *(_cast(ctx, x, dtype) for x in pair))
                    for pair in zip(row, column, strict=True)
                ]
                out.append(functools.reduce(lambda s, t: ctx.scalar(add, s, t), terms, constant(0, dtype)))
    return [as_elements(out, (*batch, *a_sizes, *b_sizes))]


def _cast(ctx: Lowering, x: Element, dtype: DTypeLike) -> Element:
    return ctx.builder.add("convert_element_type", (x,), dtype)
