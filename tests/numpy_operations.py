"""Operations of JAX in NumPy, for the tests: a jaxpr is prepared once, and then run without a compiler.

Each entry of the tables takes an equation and returns a function of its operands. The functions of ``EXACT`` give the
bits that XLA gives, and those of ``ROUNDED`` do, one at a time; numbers below 1e-38 are the exception, XLA takes them
for zero.
"""

import ctypes
import functools
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.linalg
import scipy.special
from jax import lax
from jax._src import core, prng
from jax.extend.core import Literal

from crazysim.engine import native
from crazysim.engine.interpret import threefry2x32


class MissingError(Exception):
    """An operation has no NumPy function."""


class TooLongError(Exception):
    """More operations would be run than may be."""


class Call(NamedTuple):
    """An operation whose operands and results have places."""

    fn: Callable[..., Any]
    args: list[int]
    result: int | list[int]
    dtype: np.dtype | None
    """Type of its only result."""


class Program:
    """A jaxpr, with those that it calls written out, whose values have places in a list."""

    def __init__(self, jaxpr, consts=()):
        """Prepare a jaxpr with its constants; raise ``MissingError`` if NumPy has not all of its operations."""
        self.values, self.calls, self.cost, self.size = [], [], 0.0, 0
        places = {}
        for v, x in zip(jaxpr.constvars, consts, strict=True):
            places[v] = self.place(data(x))
        self.inputs = [places.setdefault(v, self.place()) for v in jaxpr.invars]
        self.outputs = self.add(jaxpr, places)

    def place(self, value=None):
        """Return the place of a new value."""
        self.values.append(value)
        return len(self.values) - 1

    def add(self, jaxpr, places):
        """Add the operations of a jaxpr; return the places of its results."""

        def read(x):
            return self.place(np.asarray(x.val, x.aval.dtype)) if isinstance(x, Literal) else places[x]

        for eqn in jaxpr.eqns:
            name, args = eqn.primitive.name, [read(x) for x in eqn.invars]
            if name in CALLS:
                inner = eqn.params[CALLS[name]]
                consts = [self.place(data(x)) for x in getattr(inner, "consts", ())]
                inner = getattr(inner, "jaxpr", inner)
                known = dict(zip((*inner.constvars, *inner.invars), (*consts, *args), strict=True))
                places.update(zip(eqn.outvars, self.add(inner, known), strict=True))
                continue
            if name not in OPERATIONS or (
                name not in OF_KEYS and not all(is_number(v.aval) for v in (*eqn.invars, *eqn.outvars))
            ):
                raise MissingError(name)
            fn = OPERATIONS[name](eqn)
            results = [self.place() for _ in eqn.outvars]
            places.update(zip(eqn.outvars, results, strict=True))
            one = not eqn.primitive.multiple_results
            dtype = eqn.outvars[0].aval.dtype if one and is_number(eqn.outvars[0].aval) else None
            self.calls.append(Call(fn, args, results[0] if one else results, dtype))
            self.size += n_operations(eqn)
            self.cost += 1 + sum(math.prod(v.aval.shape) for v in eqn.outvars) / ELEMENTS
        return [read(x) for x in jaxpr.outvars]

    def run_within(self, limit, args) -> tuple[list[Any], float]:
        """Return the results for some operands, and how many operations that took; raise beyond a limit."""
        global _left
        _left = limit
        with np.errstate(all="ignore"):
            return self.run(*args), limit - _left

    def run(self, *args) -> list[Any]:
        """Return the results for some operands."""
        global _left
        _left -= self.cost
        if _left < 0:
            raise TooLongError
        values = self.values.copy()
        for place, x in zip(self.inputs, args, strict=True):
            values[place] = x
        for fn, places, result, dtype in self.calls:
            x = fn(*[values[k] for k in places])
            if isinstance(result, list):
                for place, y in zip(result, x, strict=True):
                    values[place] = y
            else:
                values[result] = x if dtype is None or x.dtype == dtype else np.asarray(x).astype(dtype)
        return [values[k] for k in self.outputs]


_left = math.inf
"""Operations that may still be run."""
ELEMENTS = 500
"""Numbers that take as long as an operation does besides them."""
CALLS = {
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "remat2": "jaxpr",
}
"""Operations that call a jaxpr and do nothing else, and the parameter that has it."""


OF_KEYS = ("broadcast_in_dim", "concatenate", "cond", "scan", "select_n", "slice", "squeeze", "stack", "while") + tuple(
    f"random_{name}" for name in ("bits", "fold_in", "seed", "split", "unwrap", "wrap")
)
"""Operations that take random keys as they are here: their two numbers, along a last axis."""


def is_number(aval):
    """Return whether values of a type are numbers of NumPy."""
    return isinstance(getattr(aval, "dtype", None), np.dtype)


def shape_of(aval):
    """Return the shape of values of a type here."""
    return aval.shape if is_number(aval) else (*aval.shape, 2)


def data(x):
    """Return an array in NumPy; of keys their numbers."""
    is_key = jax.dtypes.issubdtype(getattr(x, "dtype", np.float32), jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x)


def n_operations(eqn) -> int:
    """Return the number of operations of an equation and of the jaxprs in it, as they are written."""
    return 1 + sum(n_operations(inner) for jaxpr in core.jaxprs_in_params(eqn.params) for inner in jaxpr.eqns)


def prepare(closed) -> Program:
    """Return a closed jaxpr as a program."""
    return Program(closed.jaxpr, closed.consts)


def evaluate(closed, args) -> list[Any]:
    """Return the results of a closed jaxpr."""
    return prepare(closed).run_within(math.inf, args)[0]


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


def window(x, sizes, starts):
    """Return the index of a window, which XLA moves inside."""
    begins = [min(max(int(k), 0), n - size) for k, n, size in zip(starts, x.shape, sizes, strict=True)]
    return tuple(slice(k, k + size) for k, size in zip(begins, sizes, strict=True))


def dynamic_slice(eqn):
    """Return a window."""
    sizes = eqn.params["slice_sizes"]
    return lambda x, *starts: x[window(x, sizes, starts)]


def dynamic_update_slice(eqn):
    """Return an array with a window replaced."""

    def fn(x, update, *starts):
        out = np.array(x)
        out[window(x, np.shape(update), starts)] = update
        return out

    return fn


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
        return np.where(x <= least, least, np.where(x >= most, most, np.clip(x, least, most))).astype(dtype)

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


def dot_general(eqn):
    """Return the contraction of two arrays."""
    (left, right), (left_batch, right_batch) = map(lambda x: tuple(map(tuple, x)), eqn.params["dimension_numbers"])
    x, y = (v.aval for v in eqn.invars)
    dtype, shape = eqn.outvars[0].aval.dtype, eqn.outvars[0].aval.shape
    left_free = [k for k in range(x.ndim) if k not in left + left_batch]
    right_free = [k for k in range(y.ndim) if k not in right + right_batch]
    batch = math.prod(x.shape[k] for k in left_batch)
    inner = math.prod(x.shape[k] for k in left)
    m, n = math.prod(x.shape[k] for k in left_free), math.prod(y.shape[k] for k in right_free)

    def fn(x, y):
        x = np.transpose(x, (*left_batch, *left_free, *left)).reshape(batch, m, inner)
        y = np.transpose(y, (*right_batch, *right, *right_free)).reshape(batch, inner, n)
        return np.matmul(x, y, dtype=dtype).reshape(shape)

    return fn


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


def gather(eqn):
    """Return windows at places of an array."""
    p, (operand, indices) = eqn.params, (v.aval for v in eqn.invars)
    d, sizes, mode = p["dimension_numbers"], p["slice_sizes"], p["mode"]
    if mode == lax.GatherScatterMode.ONE_HOT:
        raise MissingError("gather by one-hot")
    fill = p["fill_value"]
    if fill is None:
        kind = operand.dtype.kind
        extremes = {"f": lambda: np.nan, "b": lambda: True, "i": lambda: np.iinfo(operand.dtype).min}
        fill = extremes.get(kind, lambda: np.iinfo(operand.dtype).max)()
    batch = indices.shape[:-1]
    removed = (*d.collapsed_slice_dims, *d.operand_batching_dims)
    kept = [k for k in range(operand.ndim) if k not in removed]
    places = window_places(operand.shape, sizes, batch, kept, d.operand_batching_dims, d.start_indices_batching_dims)
    order = list(range(len(batch)))
    ndim = len(batch) + len(kept)
    axes = iter(order)
    offsets = dict(zip(d.offset_dims, range(len(batch), ndim), strict=True))
    final = [offsets[k] if k in offsets else next(axes) for k in range(ndim)]

    def fn(x, starts):
        index, inside = places(starts, d.start_index_map)
        out = np.asarray(x)[index]
        if mode == lax.GatherScatterMode.FILL_OR_DROP and not inside.all():
            out = np.where(inside.reshape(inside.shape + (1,) * len(kept)), out, np.asarray(fill, out.dtype))
        return np.transpose(out, final)

    return fn


def window_places(shape, sizes, batch, kept, batching, index_batching):
    """Return a function from starts to the index of all windows, moved inside, and which of them were inside."""
    ndim = len(batch) + len(kept)
    offsets = {
        k: np.arange(sizes[k]).reshape([-1 if len(batch) + i == j else 1 for j in range(ndim)])
        for i, k in enumerate(kept)
    }
    for k, axis in zip(batching, index_batching, strict=True):
        offsets[k] = np.arange(shape[k]).reshape([-1 if j == axis else 1 for j in range(ndim)])
    offsets = [offsets.get(k, np.zeros([1] * ndim, int)) for k in range(len(shape))]

    def places(starts, dims):
        index, inside = list(offsets), np.ones(batch, bool)
        for i, k in enumerate(dims):
            start, most = np.asarray(starts)[..., i].astype(np.int64), shape[k] - sizes[k]
            inside &= (start >= 0) & (start <= most)
            start = np.clip(start, 0, most)
            index[k] = index[k] + start.reshape(start.shape + (1,) * len(kept))
        return tuple(index), inside

    return places


def scatter(combine):
    """Return the entry of a scatter; ``combine`` writes updates to an index of an array."""

    def make(eqn):
        p, (operand, indices, updates) = eqn.params, (v.aval for v in eqn.invars)
        d, mode = p["dimension_numbers"], p["mode"]
        if mode == lax.GatherScatterMode.ONE_HOT or (combine is write and not is_assignment(p["update_jaxpr"])):
            raise MissingError("scatter with a function")
        batch = indices.shape[:-1]
        removed = (*d.inserted_window_dims, *d.operand_batching_dims)
        kept = [k for k in range(operand.ndim) if k not in removed]
        sizes = [1] * operand.ndim
        for k, axis in zip(kept, d.update_window_dims, strict=True):
            sizes[k] = updates.shape[axis]
        args = operand.shape, sizes, batch, kept, d.operand_batching_dims, d.scatter_indices_batching_dims
        places = window_places(*args)
        outer = [k for k in range(updates.ndim) if k not in d.update_window_dims]
        order = (*outer, *d.update_window_dims)

        def fn(x, starts, new):
            index, inside = places(starts, d.scatter_dims_to_operand_dims)
            new, out = np.transpose(new, order), np.array(x)
            if mode != lax.GatherScatterMode.CLIP and not inside.all():
                index = tuple(np.broadcast_to(k, new.shape)[inside] for k in index)
                new = new[inside]
            combine(out, index, new)
            return out

        return fn

    return make


def is_assignment(jaxpr):
    """Return whether the function of a scatter returns the update."""
    inner = getattr(jaxpr, "jaxpr", jaxpr)
    return inner is None or (not inner.eqns and inner.outvars == inner.invars[1:])


def write(out, index, new):
    """Replace numbers."""
    out[index] = new


def scan(eqn):
    """Run a jaxpr for each row."""
    p = eqn.params
    body, n_consts, n_carry = prepare(p["jaxpr"]), p["num_consts"], p["num_carry"]
    order = range(p["length"])[::-1] if p["reverse"] else range(p["length"])
    rows = [v.aval for v in eqn.outvars[n_carry:]]
    rows = [(shape_of(x), x.dtype if is_number(x) else np.uint32) for x in rows]

    def fn(*args):
        if p["length"] * body.cost > _left:
            raise TooLongError
        consts, carry, xs = args[:n_consts], args[n_consts : n_consts + n_carry], args[n_consts + n_carry :]
        ys = [np.empty(*row) for row in rows]
        for i in order:
            out = body.run(*consts, *carry, *[x[i] for x in xs])
            carry = out[:n_carry]
            for y, new in zip(ys, out[n_carry:], strict=True):
                y[i] = new
        return [*carry, *ys]

    return fn


def while_loop(eqn):
    """Run a jaxpr as long as another one says; where they are arrays, for the places for which it does."""
    p = eqn.params
    test, body, n, m = prepare(p["cond_jaxpr"]), prepare(p["body_jaxpr"]), p["cond_nconsts"], p["body_nconsts"]
    limits = counted(p["cond_jaxpr"].jaxpr)

    def fn(*args):
        of_test, of_body, carry = args[:n], args[n : n + m], args[n + m :]
        if limits is not None:
            count, end = ((*of_test, *carry)[k] if isinstance(k, int) else k.val for k in limits)
            if (int(end) - int(count)) * body.cost > _left:
                raise TooLongError
        while (going := test.run(*of_test, *carry)[0]).any():
            new = body.run(*of_body, *carry)
            if np.ndim(going):
                spread = [going.reshape(going.shape + (1,) * (np.ndim(x) - going.ndim)) for x in carry]
                new = [np.where(k, x, y) for k, x, y in zip(spread, new, carry, strict=True)]
            carry = new
        return carry

    return fn


def counted(test):
    """Return the counter and its end, as places or literals, of a loop that ends at a number; None for others."""
    if len(test.eqns) != 1 or test.eqns[0].primitive.name != "lt" or test.eqns[0].outvars[0].aval.shape:
        return None
    return [x if isinstance(x, Literal) else test.invars.index(x) for x in test.eqns[0].invars]


def cond(eqn):
    """Run one of several jaxprs."""
    branches = [prepare(x) for x in eqn.params["branches"]]
    return lambda k, *args: branches[min(max(int(k), 0), len(branches) - 1)].run(*args)


def callback(eqn):
    """Call a function of the host."""
    fn = eqn.params["callback"]
    return lambda *xs: [np.asarray(y, v.aval.dtype) for y, v in zip(fn(*xs), eqn.outvars, strict=True)]


class Buffer(ctypes.Structure):
    """``XLA_FFI_Buffer`` of XLA's foreign function interface."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.c_void_p),
    )


class Buffers(ctypes.Structure):
    """``XLA_FFI_Args`` and ``XLA_FFI_Rets``."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(Buffer))),
    )


class Frame(ctypes.Structure):
    """``XLA_FFI_CallFrame`` up to the results: a kernel reads addresses alone."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("api", ctypes.c_void_p),
        ("ctx", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("args", Buffers),
        ("rets", Buffers),
    )


def kernel(eqn):
    """Call a kernel of the fused engine as XLA does."""
    library, aliases = native._LOADED.get(eqn.params["target_name"]), dict(eqn.params["input_output_aliases"])
    if library is None:
        raise MissingError("ffi_call of something else")
    types = [v.aval for v in eqn.outvars]

    def buffers(arrays):
        one = [ctypes.pointer(Buffer(data=x.ctypes.data)) for x in arrays]
        return Buffers(size=len(one), buffers=(ctypes.POINTER(Buffer) * len(one))(*one))

    def fn(*xs):
        out = [np.empty(x.shape, x.dtype) for x in types]
        for k, result in aliases.items():
            out[result][...] = xs[k]
        given = [out[aliases[k]] if k in aliases else np.ascontiguousarray(x) for k, x in enumerate(xs)]
        frame = Frame(args=buffers(given), rets=buffers(out))
        library.crazysim_advance(ctypes.byref(frame))
        return out

    return fn


def lu(eqn):
    """Return a matrix as lower and upper triangle, its pivots, and the permutation that they make."""
    (*_, n, m) = eqn.invars[0].aval.shape

    def fn(x):
        out, pivots = np.empty_like(x), np.empty((*x.shape[:-2], min(n, m)), np.int32)
        orders = np.empty((*x.shape[:-2], n), np.int32)
        for k in np.ndindex(x.shape[:-2]):
            (getrf,) = scipy.linalg.get_lapack_funcs(("getrf",), (x,))
            out[k], pivots[k], _ = getrf(x[k])
            order = list(range(n))
            for i, j in enumerate(pivots[k]):
                order[i], order[j] = order[j], order[i]
            orders[k] = order
        return [out, pivots, orders]

    return fn


def qr(eqn):
    """Return a matrix as an orthogonal one and an upper triangle."""
    if eqn.params["pivoting"]:
        raise MissingError("qr with pivots")
    mode = "complete" if eqn.params["full_matrices"] else "reduced"
    return lambda x: list(np.linalg.qr(x, mode))


def triangular_solve(eqn):
    """Return the solutions of triangular equations."""
    p = eqn.params
    if p["conjugate_a"]:
        raise MissingError("triangular_solve of complex numbers")

    def fn(a, b):
        out = np.empty_like(b)
        for k in np.ndindex(b.shape[:-2]):
            (trtrs,) = scipy.linalg.get_lapack_funcs(("trtrs",), (a,))
            trans = p["transpose_a"] == p["left_side"]
            given = b[k] if p["left_side"] else b[k].T
            x, _ = trtrs(a[k], given, lower=p["lower"], trans=trans, unitdiag=p["unit_diagonal"])
            out[k] = x if p["left_side"] else x.T
        return out

    return fn


def linear_solve(eqn):
    """Solve a linear equation as it says."""
    counts, solve = eqn.params["const_lengths"], prepare(eqn.params["jaxprs"].solve)
    first = counts.matvec + counts.vecmat
    last = sum(counts)
    return lambda *args: solve.run(*args[first : first + counts.solve], *args[last:])


def random(eqn):
    """Make keys or draw numbers from them; a key is its two numbers."""
    name, p, first = eqn.primitive.name, eqn.params, eqn.invars[0].aval
    impl = p["impl"] if name == "random_seed" else first.dtype._impl
    if impl.name != "threefry2x32":
        raise MissingError(f"keys of {impl.name}")
    keys = jax.ShapeDtypeStruct((*first.shape, 2), np.uint32)
    if name == "random_seed":
        program = of(functools.partial(prng.random_seed_impl_base, impl=impl), first)
    elif name == "random_fold_in":
        program = of(lambda x, y: prng.random_fold_in_impl_base(impl, x, y, first.shape), keys, eqn.invars[1].aval)
    elif name == "random_split":
        program = of(lambda x: prng.random_split_impl_base(impl, x, first.ndim, **p), keys)
    else:
        program = of(lambda x: prng.random_bits_impl_base(impl, x, first.ndim, **p), keys)
    return lambda *xs: program.run(*xs)[0]


def of(fn, *types):
    """Return a function as a program."""
    return prepare(jax.make_jaxpr(fn)(*types))


def cholesky(eqn):
    """Return the lower triangle whose square a matrix is, or NaN."""

    def one(x):
        try:
            return np.linalg.cholesky(x)
        except np.linalg.LinAlgError:
            return np.full_like(x, np.nan)

    return lambda x: np.stack([one(a) for a in x.reshape(-1, *x.shape[-2:])]).reshape(x.shape)


def platform_index(eqn):
    """Return the number of the case for the host."""
    platforms = eqn.params["platforms"]
    k = next(k for k, names in enumerate(platforms) if names is None or "cpu" in names)
    return lambda: np.int32(k)


def less_in_all(x, y):
    """Compare numbers whose order is that of all: -NaN, -inf, ..., -0, 0, ..., inf, NaN."""

    def rank(x):
        bits = np.asarray(x).view(f"i{x.dtype.itemsize}")
        return np.where(bits < 0, bits ^ np.iinfo(bits.dtype).max, bits)

    return rank(x) < rank(y) if x.dtype.kind == "f" else x < y


def same(eqn):
    """Return the operand."""
    return lambda x: x


def all_same(eqn):
    """Return the operands."""
    return lambda *xs: list(xs)


def of_words(eqn):
    """Return the two numbers of 32 bits that Threefry makes."""
    return lambda *xs: list(threefry2x32(*xs))


def counts(eqn):
    """Return the high and low words of the numbers of a shape."""
    shape = eqn.params["shape"]
    n = np.arange(math.prod(shape), dtype=np.uint64).reshape(shape)
    words = [(n >> np.uint64(32)).astype(np.uint32), n.astype(np.uint32)]
    return lambda: list(words)


def bitcast(eqn):
    """Return the bits as another type of the same size."""
    given, dtype = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    if given.itemsize != dtype.itemsize or bool in (given, dtype):
        raise MissingError("bitcast_convert_type to another size")
    return lambda x: np.asarray(x).view(dtype)


EXACT: dict[str, Callable[[Any], Callable[..., Any]]] = {
    "and": each(np.bitwise_and),
    "broadcast_in_dim": broadcast_in_dim,
    "concatenate": concatenate,
    "convert_element_type": convert,
    "copy": same,
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "eq": each(np.equal),
    "ge": each(np.greater_equal),
    "gt": each(np.greater),
    "iota": iota,
    "is_finite": each(np.isfinite),
    "le": each(np.less_equal),
    "lt": each(np.less),
    "max": each(np.maximum),
    "min": each(np.minimum),
    "ne": each(np.not_equal),
    "neg": each(np.negative),
    "not": each(np.invert),
    "or": each(np.bitwise_or),
    "reduce_and": along_exactly(np.all),
    "reduce_max": along_exactly(np.max),
    "reduce_min": along_exactly(np.min),
    "reduce_or": along_exactly(np.any),
    "reshape": reshape,
    "rev": lambda eqn: functools.partial(np.flip, axis=eqn.params["dimensions"]),
    "select_n": select_n,
    "slice": slices,
    "squeeze": to_shape,
    "stage": same,
    "transpose": lambda eqn: functools.partial(np.transpose, axes=eqn.params["permutation"]),
    "abs": each(np.abs),
    "argmax": extreme(np.argmax),
    "argmin": extreme(np.argmin),
    "bitcast_convert_type": bitcast,
    "ceil": each(np.ceil),
    "clamp": each(lambda low, x, high: np.minimum(np.maximum(x, low), high)),
    "floor": each(np.floor),
    "gather": gather,
    "layout_constraint": same,
    "nextafter": each(np.nextafter),
    "pad": pad,
    "rem": remainder,
    "round": rounded,
    "scatter": scatter(write),
    "scatter-max": scatter(np.maximum.at),
    "scatter-min": scatter(np.minimum.at),
    "shift_left": shift(np.left_shift, np.zeros_like),
    "shift_right_arithmetic": shift(np.right_shift, lambda x: np.where(np.asarray(x) < 0, -1, 0)),
    "shift_right_logical": shift(shift_right_logical, np.zeros_like),
    "sign": each(lambda x: np.where(x == 0, x, np.sign(x))),
    "stack": stack,
    "stop_gradient": same,
    "tile": lambda eqn: functools.partial(np.tile, reps=eqn.params["reps"]),
    "xor": each(np.bitwise_xor),
}
"""Operations of one result of which NumPy has the same bits."""

ROUNDED = {
    "add": each(np.add),
    "div": divide,
    "mul": each(np.multiply),
    "sqrt": each(np.sqrt),
    "square": each(np.square),
    "sub": each(np.subtract),
}
"""Operations that round as IEEE 754 says."""

CLOSE = {
    "acos": each(np.arccos),
    "acosh": each(np.arccosh),
    "add_any": each(np.add),
    "asin": each(np.arcsin),
    "asinh": each(np.arcsinh),
    "atan": each(np.arctan),
    "atan2": each(np.arctan2),
    "atanh": each(np.arctanh),
    "cbrt": each(np.cbrt),
    "cos": each(np.cos),
    "cosh": each(np.cosh),
    "cholesky": cholesky,
    "cummax": cumulative(np.maximum.accumulate),
    "cummin": cumulative(np.minimum.accumulate),
    "cumprod": cumulative(np.cumprod),
    "cumsum": cumulative(np.cumsum),
    "dot_general": dot_general,
    "erf": each(scipy.special.erf),
    "erf_inv": each(scipy.special.erfinv),
    "exp": each(np.exp),
    "exp2": each(np.exp2),
    "expm1": each(np.expm1),
    "integer_pow": integer_pow,
    "log": each(np.log),
    "log1p": each(np.log1p),
    "lt_to": each(less_in_all),
    "logistic": each(scipy.special.expit),
    "pow": each(np.power),
    "reduce_prod": along(np.prod),
    "reduce_sum": along(np.sum),
    "rsqrt": each(lambda x: 1 / np.sqrt(x)),
    "scatter-add": scatter(np.add.at),
    "scatter-mul": scatter(np.multiply.at),
    "scatter-sub": scatter(np.subtract.at),
    "sin": each(np.sin),
    "sinh": each(np.sinh),
    "tan": each(np.tan),
    "tanh": each(np.tanh),
    "triangular_solve": triangular_solve,
}
"""Operations that round in another order, or differ by some units in the last place."""

STRUCTURED = {
    "cond": cond,
    "custom_linear_solve": linear_solve,
    "device_put": all_same,
    "ffi_call": kernel,
    "iota_2x32_shape": counts,
    "lu": lu,
    "optimization_barrier": all_same,
    "platform_index": platform_index,
    "pure_callback": callback,
    "qr": qr,
    "random_bits": random,
    "random_fold_in": random,
    "random_seed": random,
    "random_split": random,
    "random_unwrap": same,
    "random_wrap": same,
    "scan": scan,
    "sort": sort,
    "split": split,
    "threefry2x32": of_words,
    "unstack": unstack,
    "while": while_loop,
}
"""Operations that run jaxprs, draw numbers, or have several results."""

OPERATIONS = EXACT | ROUNDED | CLOSE | STRUCTURED
