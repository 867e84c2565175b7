"""Rules for indexing: a known index moves elements, and a computed index looks up a table or selects an element."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode
from numpy.typing import DTypeLike

from crazysim.engine.ir.blocks import Element, constant, is_constant
from crazysim.engine.jaxcompat import ClosedJaxpr, JaxprEqn
from crazysim.engine.lowering.jaxprs import (
    MAX_UNROLL,
    ElementArray,
    Lowering,
    TableRows,
    UnsupportedError,
    as_elements,
    constants,
    rule,
)
from crazysim.engine.lowering.rules import tables
from crazysim.engine.lowering.rules.movement import evaluate, move_by_indices


@rule("dynamic_slice")
def _dynamic_slice(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    x, sizes = args[0], eqn.params["slice_sizes"]
    if isinstance(x, TableRows):
        return [x.row(ctx, args[1][()], sizes)]
    for axis, (start, size) in enumerate(zip(args[1:], sizes, strict=True)):
        x = _take(ctx, x, start[()], size, axis)
    return [x]


def _take(ctx: Lowering, x: ElementArray, start: Element, size: int, axis: int) -> ElementArray:
    max_start = x.shape[axis] - size
    if is_constant(start) or max_start == 0:
        k = int(np.clip(start, 0, max_start)) if max_start else 0
        return np.take(x, range(k, k + size), axis)
    table = tables.find_table(ctx, x, (axis,), max_start + 1)
    if table is not None:
        offsets = np.take(table.offsets, range(size), axis)
        return table.look_up(offsets, [table.get_base([start], [max_start])] * offsets.size)
    _check_range(max_start + 1)
    pieces = [np.take(x, range(k, k + size), axis) for k in range(max_start + 1)]
    selected = pieces[max_start]
    for k in range(max_start - 1, -1, -1):
        is_start = as_elements([ctx.scalar("le", start, constant(k, start.dtype), dtype=bool)], ())
        selected = _select(ctx, is_start, pieces[k], selected)
    return selected


@rule("dynamic_update_slice")
def _dynamic_update_slice(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    x, update = args[:2]
    starts = [a[()] for a in args[2:]]
    ranges = []
    for start, size, length in zip(starts, update.shape, x.shape, strict=True):
        max_start = length - size
        if max_start and not is_constant(start):
            ranges.append(range(max_start + 1))
        else:
            ranges.append([int(np.clip(start, 0, max_start)) if max_start else 0])
    _check_range(int(np.prod([len(positions) for positions in ranges])))
    out = x
    for corner in itertools.product(*ranges):
        axes = zip(starts, corner, ranges, strict=True)
        is_here = _conjunction(
            ctx,
            (_is_at(ctx, start, k, positions[-1]) for start, k, positions in axes if len(positions) > 1),
        )
        window_index = tuple(slice(k, k + size) for k, size in zip(corner, update.shape, strict=True))
        out = out.copy()
        out[window_index] = update if is_here is None else _select(ctx, is_here, update, out[window_index])
    return [out]


def _is_at(ctx: Lowering, index: Element, k: int, last: int) -> ElementArray:
    op = "le" if k == 0 else "ge" if k == last else "eq"
    return as_elements([ctx.scalar(op, index, constant(k, index.dtype), dtype=bool)], ())


def _conjunction(ctx: Lowering, conditions: Iterable[ElementArray]) -> ElementArray | None:
    result = None
    for condition in conditions:
        result = condition if result is None else ctx.elementwise("and", [result, condition], bool)
    return result


def _select(ctx: Lowering, condition: ElementArray, yes: ElementArray, no: ElementArray) -> ElementArray:
    first = no.reshape(-1)[0] if no.size else constant(0, np.float32)
    dtype = np.uint32 if isinstance(first, tuple) else first.dtype
    return ctx.elementwise("select_n", [condition, no, yes], dtype)


def _check_range(n: int) -> None:
    if n > MAX_UNROLL:
        raise UnsupportedError(
            f"an index that is computed at run time and has {n} possible values; at most {MAX_UNROLL} are supported"
        )


@rule("gather")
def _gather(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    x, indices = args
    if is_known(indices):
        if eqn.params["mode"] == GatherScatterMode.FILL_OR_DROP:
            return [_gather_filled(eqn, x, known_values(indices))]
        return move_by_indices(eqn, [x], [known_values(indices)])
    dims, mode, sizes = eqn.params["dimension_numbers"], eqn.params["mode"], eqn.params["slice_sizes"]
    limits = [x.shape[axis] - sizes[axis] for axis in dims.start_index_map]
    n_window_positions = int(np.prod([limit + 1 for limit in limits]))
    rows = indices.reshape(-1, indices.shape[-1])
    out = eqn.outvars[0].aval
    # For each element of the result, the row of indices that selects it: the batch axes of the result number the rows.
    row_shape = indices.shape[:-1]
    batch_axes = [axis for axis in range(len(out.shape)) if axis not in dims.offset_dims]
    shape = [1] * len(out.shape)
    for axis, size in zip(batch_axes, row_shape, strict=True):
        shape[axis] = size
    row_by_element = np.broadcast_to(np.arange(len(rows)).reshape(shape), out.shape).reshape(-1)

    table = tables.find_table(ctx, x, dims.start_index_map, n_window_positions)
    if table is not None:
        zeros = np.zeros(indices.shape, np.int32)
        offsets = move_by_indices(eqn, [table.offsets.astype(object)], [zeros])[0].reshape(-1)
        bases = [table.get_base(list(row), limits) for row in rows]
        result = list(table.look_up(offsets, [bases[k] for k in row_by_element]))
    else:
        result = _select_windows(ctx, eqn, x, indices.shape, rows, row_by_element, limits)
    if mode == GatherScatterMode.FILL_OR_DROP:
        is_inside = [_is_inside(ctx, row, limits) for row in rows]
        fill = eqn.params["fill_value"]
        fill = _fill_value(out.dtype) if fill is None else fill
        fill_element = constants(fill, out.dtype)
        result = [
            _select(ctx, is_inside[row_by_element[position]], as_elements([item], ()), fill_element)[()]
            for position, item in enumerate(result)
        ]
    return [as_elements(result, out.shape)]


def _select_windows(
    ctx: Lowering,
    eqn: JaxprEqn,
    x: ElementArray,
    shape: tuple[int, ...],
    rows: ElementArray,
    row_by_element: np.ndarray,
    limits: Sequence[int],
) -> list[Element]:
    _check_range(int(np.prod([limit + 1 for limit in limits])))
    result: list[Element] = []
    for corner in itertools.product(*(range(limit + 1) for limit in limits)):
        corner_indices = np.broadcast_to(np.array(corner, np.int32), shape)
        window = move_by_indices(eqn, [x], [corner_indices])[0].reshape(-1)
        if not result:
            result = list(window)
            continue
        is_window = [
            _conjunction(ctx, (_is_at(ctx, i, k, m) for i, k, m in zip(row, corner, limits, strict=True) if m > 0))
            for row in rows
        ]
        for position, item in enumerate(window):
            condition = is_window[row_by_element[position]]
            if condition is not None and item is not result[position]:
                result[position] = _select(
                    ctx, condition, as_elements([item], ()), as_elements([result[position]], ())
                )[()]
    return result


def _gather_filled(eqn: JaxprEqn, x: ElementArray, indices: np.ndarray) -> ElementArray:
    numbers = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    (positions,) = evaluate(eqn, [numbers, indices], fill_value=-1)
    fill = eqn.params["fill_value"]
    fill_element = constants(
        _fill_value(eqn.outvars[0].aval.dtype) if fill is None else fill, eqn.outvars[0].aval.dtype
    )[()]
    elements = x.reshape(-1)
    return as_elements([fill_element if i < 0 else elements[i] for i in positions.reshape(-1)], positions.shape)


def _fill_value(dtype: DTypeLike) -> Any:
    kind = np.dtype(dtype).kind
    if kind == "f":
        return np.nan
    return np.iinfo(dtype).min if kind == "i" else np.iinfo(dtype).max if kind == "u" else True


def _is_inside(ctx: Lowering, row: ElementArray, limits: list[int]) -> ElementArray:
    tests = []
    for i, limit in zip(row, limits, strict=True):
        tests.append(as_elements([ctx.scalar("ge", i, constant(0, i.dtype), dtype=bool)], ()))
        tests.append(as_elements([ctx.scalar("le", i, constant(limit, i.dtype), dtype=bool)], ()))
    is_inside = _conjunction(ctx, tests)
    return constants(True, bool) if is_inside is None else is_inside


@rule("scatter", *(f"scatter{mark}{op}" for mark in "-_" for op in ("add", "sub", "mul", "min", "max")))
def _scatter(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    # A window whose position is computed at run time is compared with every position that it may have. A window that is
    # partly outside is dropped as a whole, or moved inside in mode ``clip``, as XLA does.
    x, indices, updates = args
    # Axes of rows and of windows.
    dims, is_clipped = eqn.params["dimension_numbers"], eqn.params["mode"] == GatherScatterMode.CLIP
    window_axes = dims.update_window_dims
    row_axes = [axis for axis in range(updates.ndim) if axis not in window_axes]
    collapsed = {*dims.inserted_window_dims, *dims.operand_batching_dims}
    sizes = iter(updates.shape[axis] for axis in window_axes)
    window_shape = [1 if axis in collapsed else next(sizes) for axis in range(x.ndim)]
    start_axes = dims.scatter_dims_to_operand_dims
    limits = [x.shape[axis] - window_shape[axis] for axis in start_axes]
    window_updates = updates.transpose(*row_axes, *window_axes)
    out = x.copy()
    # Each row updates its window at every position that it may have.
    for row in np.ndindex(indices.shape[:-1]):
        start, window_update = indices[row], window_updates[(*row, ...)]
        positions_by_axis = [_window_positions(i, limit, is_clipped) for i, limit in zip(start, limits, strict=True)]
        _check_range(int(np.prod([len(positions) for positions in positions_by_axis])))
        corner = [0] * x.ndim
        for axis, batch_axis in zip(dims.operand_batching_dims, dims.scatter_indices_batching_dims, strict=True):
            corner[axis] = row[batch_axis]
        for positions in itertools.product(*positions_by_axis):
            for axis, k in zip(start_axes, positions, strict=True):
                corner[axis] = k
            # Indices that are traced are compared with this position.
            is_here = _conjunction(
                ctx,
                (
                    _is_at(ctx, i, k, limit)
                    if is_clipped
                    else as_elements([ctx.scalar("eq", i, constant(k, i.dtype), dtype=bool)], ())
                    for i, k, limit in zip(start, positions, limits, strict=True)
                    if not is_constant(i) and not (is_clipped and limit == 0)
                ),
            )
            window_index = tuple(slice(k, k + size) for k, size in zip(corner, window_shape, strict=True))
            old = out[window_index]
            new = _combine(ctx, eqn, old, window_update.reshape(old.shape))
            out[window_index] = new if is_here is None else _select(ctx, is_here, new, old)
    return [out]


def _window_positions(index: Element, limit: int, is_clipped: bool) -> Sequence[int]:
    if not is_constant(index):
        return range(limit + 1)
    if is_clipped:
        return [int(np.clip(int(index), 0, limit))]
    return [int(index)] if 0 <= index <= limit else []


def _combine(ctx: Lowering, eqn: JaxprEqn, old: ElementArray, new: ElementArray) -> ElementArray:
    combination = eqn.params["update_jaxpr"]
    if combination is None:
        return new
    called_jaxpr = ClosedJaxpr(combination, eqn.params["update_consts"])
    pairs = zip(old.reshape(-1), new.reshape(-1), strict=True)
    return as_elements(
        [ctx.lower(called_jaxpr, [as_elements([a], ()), as_elements([b], ())])[0][()] for a, b in pairs], old.shape
    )


def is_known(x: ElementArray) -> bool:
    """Whether all elements are constants."""
    return all(map(is_constant, x.reshape(-1)))


def known_values(x: ElementArray) -> np.ndarray:
    return np.array(x.reshape(-1).tolist(), x.reshape(-1)[0].dtype if x.size else np.int32).reshape(x.shape)
