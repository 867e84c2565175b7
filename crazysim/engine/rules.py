"""Rules of the reader (``lower``) for indexing by a runtime number, small linear algebra, and random numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from jax.extend.random import threefry_prng_impl
from jax.lax import GatherScatterMode

from crazysim.engine.ir import Element, constant, is_constant
from crazysim.engine.lower import (
    UNROLL,
    Elements,
    NoRuleError,
    Reader,
    constants,
    move_many,
    pack,
    rule,
    run_now,
)

LARGEST_SYSTEM = 6
"""Largest matrix that is factorised; beyond it the written-out arithmetic is longer than a drone's step."""


def known(x: Elements) -> bool:
    """Return whether all elements are constants."""
    return all(map(is_constant, x.reshape(-1)))


def values(x: Elements) -> np.ndarray:
    """Return known elements as numbers."""
    return np.array([int(item) for item in x.reshape(-1)], np.int32).reshape(x.shape)


# Indexing -----------------------------------------------------------------------------------------------------------


@rule("dynamic_slice")
def _dynamic_slice(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    x, sizes = args[0], eqn.params["slice_sizes"]
    for axis, (start, size) in enumerate(zip(args[1:], sizes, strict=True)):
        x = _take(r, x, start[()], size, axis)
    return [x]


def _take(r: Reader, x: Elements, start: Element, size: int, axis: int) -> Elements:
    """Return ``size`` elements along an axis from a start that is kept inside."""
    last = x.shape[axis] - size
    pieces = [np.take(x, range(k, k + size), axis) for k in range(last + 1)]
    if is_constant(start) or last == 0:
        return pieces[int(np.clip(start, 0, last)) if last else 0]
    _check_range(last + 1)
    taken = pieces[last]
    for k in range(last - 1, -1, -1):
        here = pack([r.one("le", start, constant(k, start.dtype), dtype=bool)], ())
        taken = _select(r, here, pieces[k], taken)
    return taken


@rule("dynamic_update_slice")
def _dynamic_update_slice(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    x, update = args[:2]
    starts = [a[()] for a in args[2:]]
    ranges = []
    for start, size, length in zip(starts, update.shape, x.shape, strict=True):
        last = length - size
        ranges.append([int(np.clip(start, 0, last))] if is_constant(start) or not last else list(range(last + 1)))
    _check_range(int(np.prod([len(options) for options in ranges])))
    out = x
    for corner in itertools.product(*ranges):
        here = _all(r, (_at(r, s, k, options[-1]) for s, k, options in zip(starts, corner, ranges, strict=True)
                        if len(options) > 1))  # fmt: skip
        place = tuple(slice(k, k + size) for k, size in zip(corner, update.shape, strict=True))
        out = out.copy()
        out[place] = update if here is None else _select(r, here, update, out[place])
    return [out]


def _at(r: Reader, index: Element, k: int, last: int) -> Elements:
    """Return whether an index, kept inside 0 to ``last``, is ``k``."""
    op = "le" if k == 0 else "ge" if k == last else "eq"
    return pack([r.one(op, index, constant(k, index.dtype), dtype=bool)], ())


def _all(r: Reader, conditions: Iterable[Elements]) -> Elements | None:
    out = None
    for condition in conditions:
        out = condition if out is None else r.each("and", [out, condition], bool)
    return out


def _select(r: Reader, condition: Elements, yes: Elements, no: Elements) -> Elements:
    first = no.reshape(-1)[0] if no.size else constant(0, np.float32)
    dtype = np.uint32 if isinstance(first, tuple) else first.dtype
    return r.each("select_n", [condition, no, yes], dtype)


def _check_range(n: int) -> None:
    if n > UNROLL:
        raise NoRuleError(f"an index that is known at run time only, into {n} places; selected from are up to {UNROLL}")


@rule("gather")
def _gather(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    x, indices = args
    if known(indices):
        p = eqn.params
        if p["mode"] == GatherScatterMode.FILL_OR_DROP:
            return [_gather_filled(eqn, x, values(indices))]
        return move_many(eqn, [x], [values(indices)])
    dims, mode, sizes = eqn.params["dimension_numbers"], eqn.params["mode"], eqn.params["slice_sizes"]
    limits = [x.shape[axis] - sizes[axis] for axis in dims.start_index_map]
    _check_range(int(np.prod([limit + 1 for limit in limits])))
    rows = indices.reshape(-1, indices.shape[-1])
    out = eqn.outvars[0].aval
    # Which row of indices an element of the result belongs to: the axes of the result that are no offsets.
    row_shape = indices.shape[:-1]
    batch_axes = [axis for axis in range(len(out.shape)) if axis not in dims.offset_dims]
    shape = [1] * len(out.shape)
    for axis, size in zip(batch_axes, row_shape, strict=True):
        shape[axis] = size
    row_of = np.broadcast_to(np.arange(len(rows)).reshape(shape), out.shape).reshape(-1)

    result: list[Element] = []
    for corner in itertools.product(*(range(limit + 1) for limit in limits)):
        static = np.broadcast_to(np.array(corner, np.int32), indices.shape)
        here = move_many(eqn, [x], [static])[0].reshape(-1)
        if not result:
            result = list(here)
            continue
        hit = [_all(r, (_at(r, i, k, m) for i, k, m in zip(row, corner, limits, strict=True) if m > 0)) for row in rows]
        for o, item in enumerate(here):
            condition = hit[row_of[o]]
            if condition is not None and item is not result[o]:
                result[o] = _select(r, condition, pack([item], ()), pack([result[o]], ()))[()]
    if mode == GatherScatterMode.FILL_OR_DROP:
        inside = [_inside(r, row, limits) for row in rows]
        fill = eqn.params["fill_value"]
        fill = _fill_value(out.dtype) if fill is None else fill
        result = [_select(r, inside[row_of[o]], pack([item], ()), constants(fill, out.dtype))[()]
                  for o, item in enumerate(result)]  # fmt: skip
    return [pack(result, out.shape)]


def _gather_filled(eqn: Any, x: Elements, indices: np.ndarray) -> Elements:
    """Gather at known places, some of which may lie outside: those are filled."""
    numbers = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    (places,) = run_now(eqn, [numbers, indices], fill_value=-1)
    fill = eqn.params["fill_value"]
    outside = constants(_fill_value(eqn.outvars[0].aval.dtype) if fill is None else fill, eqn.outvars[0].aval.dtype)[()]
    flat = x.reshape(-1)
    return pack([outside if i < 0 else flat[i] for i in places.reshape(-1)], places.shape)


def _fill_value(dtype: Any) -> Any:
    """What JAX fills with: NaN, the least signed or the largest unsigned integer, True."""
    kind = np.dtype(dtype).kind
    return (
        np.nan if kind == "f" else np.iinfo(dtype).min if kind == "i" else np.iinfo(dtype).max if kind == "u" else True
    )


def _inside(r: Reader, row: Elements, limits: list[int]) -> Elements:
    tests = []
    for i, limit in zip(row, limits, strict=True):
        tests.append(pack([r.one("ge", i, constant(0, i.dtype), dtype=bool)], ()))
        tests.append(pack([r.one("le", i, constant(limit, i.dtype), dtype=bool)], ()))
    inside = _all(r, tests)
    return constants(True, bool) if inside is None else inside


@rule("scatter", *(f"scatter{mark}{op}" for mark in "-_" for op in ("add", "sub", "mul", "min", "max")))
def _scatter(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """``x.at[i].set(u)`` and its kin, one row of indices after the other."""
    x, indices, updates = args
    dims, mode = eqn.params["dimension_numbers"], eqn.params["mode"]
    combine = {"add": "add", "sub": "sub", "mul": "mul", "min": "min", "max": "max"}.get(eqn.primitive.name[8:])
    window = [axis for axis in range(updates.ndim) if axis in dims.update_window_dims]
    sizes = [updates.shape[axis] for axis in window]
    operand_axes = [a for a in range(x.ndim) if a not in (*dims.inserted_window_dims, *dims.operand_batching_dims)]
    if dims.operand_batching_dims:
        raise NoRuleError(f"primitive {eqn.primitive.name!r} with batch axes")
    size_of = dict.fromkeys(range(x.ndim), 1) | dict(zip(operand_axes, sizes, strict=True))
    limits = [x.shape[axis] - size_of[axis] for axis in dims.scatter_dims_to_operand_dims]
    rows = indices.reshape(-1, indices.shape[-1])
    order = [axis for axis in range(updates.ndim) if axis not in window] + window
    blocks = updates.transpose(order).reshape(len(rows), *sizes)
    out = x.copy()
    for row, block in zip(rows, blocks, strict=True):
        unknown = [not is_constant(i) for i in row]
        ranges = [range(m + 1) if u else [int(i)] for i, m, u in zip(row, limits, unknown, strict=True)]
        _check_range(int(np.prod([len(options) for options in ranges])))
        for corner in itertools.product(*ranges):
            start = dict.fromkeys(range(x.ndim), 0) | dict(zip(dims.scatter_dims_to_operand_dims, corner, strict=True))
            if mode == GatherScatterMode.CLIP:
                start |= {a: int(np.clip(start[a], 0, m))
                          for a, m in zip(dims.scatter_dims_to_operand_dims, limits, strict=True)}  # fmt: skip
            elif any(not 0 <= k <= m for k, m in zip(corner, limits, strict=True)):
                continue  # dropped
            place = tuple(slice(start[a], start[a] + size_of[a]) for a in range(x.ndim))
            old = out[place]
            new = block.reshape(old.shape)
            if combine is not None:
                new = r.each(combine, [old, new], eqn.outvars[0].aval.dtype)
            clip = mode == GatherScatterMode.CLIP
            tests = [_at(r, i, k, m) if clip else pack([r.one("eq", i, constant(k, i.dtype), dtype=bool)], ())
                     for i, k, m, u in zip(row, corner, limits, unknown, strict=True) if u]  # fmt: skip
            here = _all(r, tests)
            out[place] = new if here is None else _select(r, here, new, old)
    return [out]


# Small linear algebra ------------------------------------------------------------------------------------------------


def _check_size(eqn: Any, n: int) -> None:
    if n > LARGEST_SYSTEM:
        raise NoRuleError(f"primitive {eqn.primitive.name!r} of size {n}; written out are up to {LARGEST_SYSTEM}")


def _matrices(x: Elements) -> list[Elements]:
    return list(x.reshape(-1, *x.shape[-2:]))


@rule("cholesky")
def _cholesky(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    n, dtype = args[0].shape[-1], eqn.outvars[0].aval.dtype
    _check_size(eqn, n)
    zero = constant(0, dtype)
    out = []
    for a in _matrices(args[0]):
        low = np.full((n, n), zero, object)
        for j in range(n):
            for i in range(j, n):
                rest = a[i, j]
                for k in range(j):
                    rest = r.one("sub", rest, r.one("mul", low[i, k], low[j, k]))
                low[i, j] = r.block.add("sqrt", (rest,), dtype) if i == j else r.one("div", rest, low[j, j])
        out.append(low)
    return [pack([x for low in out for x in low.reshape(-1)], args[0].shape)]


@rule("triangular_solve")
def _triangular_solve(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    p = eqn.params
    _check_size(eqn, args[0].shape[-1])
    out = []
    for a, b in zip(_matrices(args[0]), _matrices(args[1]), strict=True):
        a = a.T if p["transpose_a"] else a
        lower = p["lower"] != p["transpose_a"]
        if not p["left_side"]:  # x a = b is a' x' = b'
            a, b, lower = a.T, b.T, not lower
        x = _substitute(r, a, b, lower, p["unit_diagonal"])
        out.append(x if p["left_side"] else x.T)
    return [pack([e for x in out for e in x.reshape(-1)], args[1].shape)]


def _substitute(r: Reader, a: Elements, b: Elements, lower: bool, unit: bool) -> Elements:
    n, x = len(a), np.empty(b.shape, object)
    order = list(range(n)) if lower else list(range(n))[::-1]
    for column in range(b.shape[1]):
        for done, i in enumerate(order):
            rest = b[i, column]
            for k in order[:done]:
                rest = r.one("sub", rest, r.one("mul", a[i, k], x[k, column]))
            x[i, column] = rest if unit else r.one("div", rest, a[i, i])
    return x


@rule("lu")
def _lu(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Gauss with the largest pivot of each column, rows exchanged by selection."""
    n, m = args[0].shape[-2:]
    if n != m:
        raise NoRuleError("primitive 'lu' of a matrix that is not square")
    _check_size(eqn, n)
    factors, all_pivots, permutations = [], [], []
    for a in _matrices(args[0]):
        a = a.copy()
        rows = np.array([constant(i, np.int32) for i in range(n)], object)
        pivots = []
        for j in range(n):
            pivot, largest = constant(j, np.int32), r.one("abs", a[j, j])
            for i in range(j + 1, n):
                size = r.one("abs", a[i, j])
                wins = r.one("gt", size, largest, dtype=bool)
                pivot = r.one("select_n", wins, pivot, constant(i, np.int32))
                largest = r.one("select_n", wins, largest, size)
            pivots.append(pivot)
            for i in range(j + 1, n):
                here = r.one("eq", pivot, constant(i, np.int32), dtype=bool)
                for x in (*a.T, rows):  # every column, and the list of rows
                    x[i], x[j] = r.one("select_n", here, x[i], x[j]), r.one("select_n", here, x[j], x[i])
            for i in range(j + 1, n):
                a[i, j] = r.one("div", a[i, j], a[j, j])
                for k in range(j + 1, n):
                    a[i, k] = r.one("sub", a[i, k], r.one("mul", a[i, j], a[j, k]))
        factors.append(a)
        all_pivots.append(pivots)
        permutations.append(rows)
    shape = args[0].shape
    return [
        pack([x for a in factors for x in a.reshape(-1)], shape),
        pack([x for pivots in all_pivots for x in pivots], shape[:-1]),
        pack([x for rows in permutations for x in rows], shape[:-1]),
    ]


# Random numbers -------------------------------------------------------------------------------------------------------


@rule("random_wrap")
def _random_wrap(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    words = args[0].reshape(-1, 2)
    _check_generator(eqn.params["impl"])
    return [pack([(a, b) for a, b in words], args[0].shape[:-1])]


@rule("random_unwrap")
def _random_unwrap(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [_words(args[0])]


def _words(keys: Elements) -> Elements:
    return pack([word for key in keys.reshape(-1) for word in key], (*keys.shape, 2))


def _check_generator(impl: Any) -> None:
    if getattr(impl, "name", str(impl)) != threefry_prng_impl.name:
        raise NoRuleError(f"a random generator other than JAX's default, {threefry_prng_impl.name}: {impl}")


@rule("random_fold_in", "random_split", "random_bits", "random_seed")
def _random(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Follow what JAX's own generator does with the words of a key: integer arithmetic around one cipher."""
    name, p, impl = eqn.primitive.name, eqn.params, threefry_prng_impl
    keys = name != "random_seed"
    if keys:
        _check_generator(eqn.invars[0].aval.dtype._impl)
    single = {
        "random_fold_in": lambda key, data: impl.fold_in(key, data),
        "random_split": lambda key: impl.split(key, p["shape"]),
        "random_bits": lambda key: impl.random_bits(key, p["bit_width"], p["shape"]),
        "random_seed": lambda seed: impl.seed(seed),
    }[name]
    shape = np.broadcast_shapes(*(x.shape for x in args))
    columns = [np.broadcast_to(x, shape).reshape(-1) for x in args]
    outs = []
    for items in zip(*columns, strict=True):
        inputs = [pack(list(x), (2,)) if isinstance(x, tuple) else pack([x], ()) for x in items]
        avals = [jax.ShapeDtypeStruct(x.shape, x.reshape(-1)[0].dtype) for x in inputs]
        outs.append(r.read(jax.make_jaxpr(single)(*avals), inputs)[0])
    aval = eqn.outvars[0].aval
    flat = [x for out in outs for x in out.reshape(-1)]
    if name == "random_bits":
        return [pack(flat, aval.shape)]
    return [pack(list(zip(flat[::2], flat[1::2], strict=True)), aval.shape)]


@rule("threefry2x32")
def _threefry(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    shape = np.broadcast_shapes(*(x.shape for x in args))
    rows = [np.broadcast_to(x, shape).reshape(-1) for x in args]
    first, second = [], []
    for words in zip(*rows, strict=True):
        if all(map(is_constant, words)):
            a, b = (np.uint32(x) for x in run_now(eqn, [np.asarray(w) for w in words]))
        else:
            both = r.block.add("threefry2x32", words, np.uint32)
            a, b = (r.block.add("item", (both,), np.uint32, (("index", i),)) for i in (0, 1))
        first.append(a)
        second.append(b)
    return [pack(first, shape), pack(second, shape)]
