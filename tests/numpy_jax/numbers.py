"""Numbers one by one, and their movement."""

import functools
import itertools

import numpy as np
from jax import lax

from numpy_jax.program import MissingError, is_number, shape_of


def each(fn):
    """Return the entry of a function whose operands are the equation's."""
    return lambda eqn: fn


def along(fn):
    """Return the entry of a reduction along ``axes``."""

    def make(eqn):
        axes, dtype = tuple(eqn.params["axes"]), eqn.outvars[0].aval.dtype
        return lambda x: fn(x, axis=axes, dtype=dtype)

    return make


def along_exactly(fn):
    """Return the entry of a reduction along ``axes`` that rounds nothing."""
    return lambda eqn: functools.partial(fn, axis=tuple(eqn.params["axes"]))


def extreme_along(fn):
    """Return the entry of a largest or smallest number along ``axes``, of which there may be none."""

    def make(eqn):
        dtype = eqn.outvars[0].aval.dtype
        if dtype.kind == "b":
            raise MissingError("extremes of bools")
        least, most = (-np.inf, np.inf) if dtype.kind == "f" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        return functools.partial(fn, axis=tuple(eqn.params["axes"]), initial=least if fn is np.max else most)

    return make


def cumulative(fn):
    """Return the entry of a cumulative reduction."""

    def make(eqn):
        axis, reverse, dtype = eqn.params["axis"], eqn.params["reverse"], eqn.outvars[0].aval.dtype
        return lambda x: np.flip(fn(np.flip(x, axis), axis, dtype), axis) if reverse else fn(x, axis, dtype)

    return make


def broadcast_in_dim(eqn):
    """Write an array along axes of a larger one."""
    if len(eqn.invars) > 1:
        raise MissingError("broadcast_in_dim to a shape that is not known")
    shape, (x,) = shape_of(eqn.outvars[0].aval), eqn.invars
    axes = (*eqn.params["broadcast_dimensions"], -1)
    spread = [1] * len(shape)
    for axis, n in zip(axes, shape_of(x.aval), strict=False):
        spread[axis] = n
    return lambda x: np.broadcast_to(np.reshape(x, spread), shape)


def slices(eqn):
    """Return a part."""
    p = eqn.params
    parts = tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or itertools.repeat(1)))
    return lambda x: x[parts]


def iota(eqn):
    """Return the numbers of an axis."""
    p = eqn.params
    if eqn.invars:
        raise MissingError("iota of a shape that is not known")
    shape = [1] * len(p["shape"])
    shape[p["dimension"]] = -1
    out = np.broadcast_to(np.arange(p["shape"][p["dimension"]], dtype=p["dtype"]).reshape(shape), p["shape"])
    return lambda: out


def convert(eqn):
    """Return numbers of another type; a float becomes the nearest integer that there is, and NaN 0."""
    given, dtype = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    if given.kind != "f" or dtype.kind in "fb":
        return lambda x: x.astype(dtype)
    least, most = np.iinfo(dtype).min, np.iinfo(dtype).max

    def fn(x):
        x = np.nan_to_num(np.trunc(np.asarray(x, np.float64)), nan=0.0)
        inside = np.where((x <= least) | (x >= most), 0, x).astype(dtype)
        return np.where(x >= most, dtype.type(most), np.where(x <= least, dtype.type(least), inside))

    return fn


def reshape(eqn):
    """Return an array of another shape."""
    if eqn.params["dimensions"] is not None or len(eqn.invars) > 1:
        raise MissingError("reshape in another order")
    return functools.partial(np.reshape, shape=eqn.params["new_sizes"])


def to_shape(eqn):
    """Return an array in the shape of the result."""
    return functools.partial(np.reshape, shape=shape_of(eqn.outvars[0].aval))


def select_n(eqn):
    """Return for each place the number of the case that is chosen there."""
    if not is_number(eqn.outvars[0].aval):
        if len(eqn.invars) > 3:
            raise MissingError("select_n of several keys")
        return lambda which, no, yes: np.where(which[..., None], yes, no)
    if eqn.invars[0].aval.dtype == bool:
        return lambda which, no, yes: np.where(which, yes, no)
    return lambda which, *cases: np.select([which == k for k in range(len(cases))], cases)


def divide(eqn):
    """Return quotients; of integers towards zero, -1 for one by zero."""
    if eqn.outvars[0].aval.dtype.kind == "f":
        return np.divide

    def fn(x, y):
        safe = np.where(y == 0, 1, y)
        out = np.floor_divide(x, safe)
        return np.where(y == 0, -1, out + ((out < 0) & (out * safe != x)))

    return fn


def remainder(eqn):
    """Return remainders with the sign of the dividend; of an integer by zero the dividend."""
    if eqn.outvars[0].aval.dtype.kind == "f":
        return np.fmod
    return lambda x, y: np.where(y == 0, x, np.fmod(x, np.where(y == 0, 1, y)))


def shift(fn, beyond):
    """Return the entry of a shift; ``beyond`` gives the result where it is as long as the number or longer."""

    def make(eqn):
        bits = eqn.outvars[0].aval.dtype.itemsize * 8
        unsigned = np.dtype(f"u{bits // 8}")

        def shifted(x, y):
            y = np.asarray(y).view(unsigned)
            return np.where(y < bits, fn(x, np.minimum(y, bits - 1).astype(np.asarray(x).dtype)), beyond(x))

        return shifted

    return make


def shift_right_logical(x, y):
    """Return integers shifted to the right, with zeros."""
    unsigned = np.dtype(f"u{x.dtype.itemsize}")
    return np.right_shift(np.asarray(x).view(unsigned), y.astype(unsigned)).view(x.dtype)


def integer_pow(eqn):
    """Return powers."""
    n = eqn.params["y"]
    if n == 2:
        return np.square
    if n < 0:
        return lambda x: 1 / np.power(x, x.dtype.type(-n))
    return lambda x: np.power(x, x.dtype.type(n))


def rounded(eqn):
    """Return nearest integers; halves away from zero, or to even ones."""
    if eqn.params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN:
        return np.rint
    return lambda x: np.trunc(x) + np.copysign(np.abs(x - np.trunc(x)) >= 0.5, x).astype(x.dtype)


def less_in_all(x, y):
    """Compare numbers whose order is that of all: -NaN, -inf, ..., -0, 0, ..., inf, NaN."""

    def rank(x):
        bits = np.asarray(x).view(f"i{x.dtype.itemsize}")
        return np.where(bits < 0, bits ^ np.iinfo(bits.dtype).max, bits)

    return rank(x) < rank(y) if x.dtype.kind == "f" else x < y


def bitcast(eqn):
    """Return the bits as another type of the same size."""
    given, dtype = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    if given.itemsize != dtype.itemsize or bool in (given, dtype):
        raise MissingError("bitcast_convert_type to another size")
    return lambda x: np.asarray(x).view(dtype)


def pad(eqn):
    """Return an array with margins, cut where they are negative."""
    config = eqn.params["padding_config"]
    shape = eqn.outvars[0].aval.shape

    def fn(x, value):
        spread = [(n - 1) * inside + n if n else 0 for n, (_, _, inside) in zip(x.shape, config, strict=True)]
        margins = [(max(low, 0), max(high, 0)) for low, high, _ in config]
        out = np.full([n + a + b for n, (a, b) in zip(spread, margins, strict=True)], value, x.dtype)
        steps = [slice(a, a + n, inside + 1) for n, (a, _), (_, _, inside) in zip(spread, margins, config, strict=True)]
        out[tuple(steps)] = x
        cut = [slice(max(-low, 0), max(-low, 0) + n) for n, (low, _, _) in zip(shape, config, strict=True)]
        return out[tuple(cut)]

    return fn


def concatenate(eqn):
    """Return arrays one after the other."""
    axis = eqn.params["dimension"]
    return lambda *xs: np.concatenate(xs, axis)


def split(eqn):
    """Return parts along an axis."""
    axis, ends = eqn.params["axis"], [int(x) for x in np.cumsum(eqn.params["sizes"])[:-1]]
    return lambda x: np.split(x, ends, axis)


def unstack(eqn):
    """Return the parts of an axis without it."""
    axis = eqn.params["axis"]
    return lambda x: list(np.moveaxis(x, axis, 0))


def stack(eqn):
    """Return arrays along a new axis."""
    axis = eqn.params["axis"]
    return lambda *xs: np.stack(xs, axis)


def ordered(x):
    """Return numbers whose order is that of XLA's sort: zeros are equal, and NaN is last."""
    return np.where(x == 0, np.zeros((), x.dtype), x) if x.dtype.kind == "f" else x


def sort(eqn):
    """Return arrays sorted by the first ones."""
    axis, n = eqn.params["dimension"], eqn.params["num_keys"]

    def fn(*xs):
        order = np.lexsort([ordered(x) for x in xs[:n][::-1]], axis)
        return [np.take_along_axis(x, order, axis) for x in xs]

    return fn


def extreme(fn):
    """Return the entry of ``argmin`` and ``argmax``; the first NaN wins."""

    def make(eqn):
        (axis,) = eqn.params["axes"]
        return lambda x: fn(x, axis)

    return make


def same(eqn):
    """Return the operand."""
    return lambda x: x


def all_same(eqn):
    """Return the operands."""
    return lambda *xs: list(xs)
