"""From a function written for one drone to a program on single numbers.

The function is traced by JAX, and its jaxpr read operation by operation. An array is a NumPy object array of
elements (``ir``). What a primitive means for elements is a rule; there are four kinds, and most primitives need no
rule of their own:

- element-wise: the same operation for every element;
- movement: nothing is computed, so the primitive is run once on the numbers of the elements;
- reduction: unrolled;
- structure: calls are followed, branches become selections, loops stay loops.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from crazysim.engine.ir import Block, Element, constant, is_constant

Elements = np.ndarray
"""An array of elements: of type object, whatever the elements are."""

LOGIC = {
    "lt": ("and", 0),
    "gt": ("and", 1),
    "le": ("or", 0),
    "ge": ("or", 1),
    "max": ("or", None),
    "min": ("and", None),
}
"""Order of truth values as logic, and which operand is negated for it."""

Rule = Callable[["Reader", Any, list[Elements]], Sequence[Elements]]
RULES: dict[str, Rule] = {}

UNROLL = 64
"""Longest loop with inputs or outputs for each turn, and largest index range, that is written out."""


class NoRuleError(Exception):
    """A primitive, or a use of one, that cannot be read; the message names it."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a function as the rule of primitives."""

    def register(fn: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, fn))
        return fn

    return register


class Reader:
    """Reads jaxprs into a block."""

    def __init__(self, block: Block):
        """Write to a block."""
        self.block = block

    def read(self, jaxpr: core.ClosedJaxpr, args: Sequence[Elements]) -> list[Elements]:
        """Return the results of a jaxpr for arrays of elements.

        Raises:
            NoRuleError: If it has a primitive without a rule.
        """
        env: dict[Any, Elements] = {}

        def value(v: Any) -> Elements:
            return constants(v.val, v.aval.dtype) if isinstance(v, core.Literal) else env[v]

        inner = jaxpr.jaxpr
        env.update(zip(inner.constvars, (constants(x, x.dtype) for x in jaxpr.consts), strict=True))
        env.update(zip(inner.invars, args, strict=True))
        for eqn in inner.eqns:
            outs = self.apply(eqn, [value(v) for v in eqn.invars])
            env.update(zip(eqn.outvars, outs, strict=True))
        return [value(v) for v in inner.outvars]

    def apply(self, eqn: Any, args: list[Elements]) -> Sequence[Elements]:
        """Return the results of one operation."""
        name = eqn.primitive.name
        if name in RULES:
            return RULES[name](self, eqn, args)
        if name in ELEMENTWISE:
            params = tuple(sorted((k, eqn.params[k]) for k in ELEMENTWISE[name]))
            return [self.each(name, args, eqn.outvars[0].aval.dtype, params)]
        if name in MOVEMENT:
            return [move(eqn, args)] if not eqn.primitive.multiple_results else list(move_many(eqn, args))
        raise NoRuleError(f"primitive {name!r} has no rule")

    def each(self, op: str, args: Sequence[Elements], dtype: Any, params: tuple = ()) -> Elements:
        """Return an operation on every element; scalars stand for arrays of any shape."""
        if op in LOGIC and args[0].size and args[0].reshape(-1)[0].dtype == bool:
            op, negated = LOGIC[op]
            args = [self.each("not", [x], bool) if k == negated else x for k, x in enumerate(args)]
        shape = np.broadcast_shapes(*(x.shape for x in args))
        rows = [np.broadcast_to(x, shape).reshape(-1) for x in args]
        if args[-1].size and isinstance(rows[-1][0], tuple):  # keys: both words alike
            pairs = [[self.one(op, c[0], *(k[i] for k in c[1:])) for i in (0, 1)] for c in zip(*rows, strict=True)]
            return pack([(a, b) for a, b in pairs], shape)
        return pack([self.block.add(op, column, dtype, params) for column in zip(*rows, strict=True)], shape)

    def one(self, op: str, *args: Element, dtype: Any = None) -> Element:
        """Return an operation on single elements; of the last operand's type, if no other is given."""
        return self.block.add(op, args, args[-1].dtype if dtype is None else dtype)

    def inner(self) -> Reader:
        """Return a reader into a new block inside this one."""
        return Reader(Block(self.block))


def pack(items: Sequence[Element], shape: tuple[int, ...]) -> Elements:
    """Return a flat sequence of elements as an array; NumPy must not look into them."""
    out = np.empty(len(items), dtype=object)
    for i, item in enumerate(items):
        out[i] = item
    return out.reshape(shape)


def constants(x: Any, dtype: Any) -> Elements:
    """Return an array of numbers, or of random keys, as elements."""
    if jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key):
        words = np.asarray(jax.random.key_data(x))
        return pack([(constant(a, np.uint32), constant(b, np.uint32)) for a, b in words.reshape(-1, 2)], np.shape(x))
    array = np.asarray(x)
    return pack([constant(item, dtype) for item in array.reshape(-1)], array.shape)


# Element-wise: names of primitives, and the settings that matter to the result -----------------------------------

ELEMENTWISE: dict[str, tuple[str, ...]] = dict.fromkeys(
    "add sub mul div rem neg sign abs floor ceil is_finite exp exp2 log log1p expm1 tanh sin cos tan asin acos atan "
    "sinh cosh asinh acosh atanh atan2 logistic sqrt rsqrt cbrt square pow max min and or xor not eq ne lt le gt ge "
    "nextafter select_n clamp shift_left shift_right_logical shift_right_arithmetic erf erf_inv erfc lgamma digamma "
    "population_count clz".split(),
    (),
) | {"integer_pow": ("y",), "round": ("rounding_method",), "reduce_precision": ("exponent_bits", "mantissa_bits")}


@rule("convert_element_type")
def _convert(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [r.each("convert_element_type", args, eqn.params["new_dtype"])]


@rule("select_n")
def _select_n(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """One of two cases by a bool; of more by a number, each against the next."""
    which, *cases = args
    dtype, kind = eqn.outvars[0].aval.dtype, eqn.invars[0].aval.dtype
    if np.dtype(kind).kind == "b":
        return [r.each("select_n", args, dtype)]
    taken = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        here = r.each("le", [which, constants(k, kind)], bool)
        taken = r.each("select_n", [here, taken, cases[k]], dtype)
    return [taken]


@rule("bitcast_convert_type")
def _bitcast(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    before, after = eqn.invars[0].aval.dtype, eqn.params["new_dtype"]
    if before.itemsize != np.dtype(after).itemsize:
        raise NoRuleError(f"primitive 'bitcast_convert_type' from {before} to {after}, of another size")
    return [r.each("bitcast_convert_type", args, after)]


@rule("square")
def _square(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [r.each("mul", [args[0], args[0]], eqn.outvars[0].aval.dtype)]


@rule("integer_pow")
def _integer_pow(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    y, dtype = eqn.params["y"], eqn.outvars[0].aval.dtype
    if y not in (2, 3, 4):
        return [r.each("integer_pow", args, dtype, (("y", y),))]
    squared = r.each("mul", [args[0], args[0]], dtype)
    return [squared if y == 2 else r.each("mul", [squared, squared if y == 4 else args[0]], dtype)]


@rule("one_minus_square")
def _one_minus_square(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    dtype = eqn.outvars[0].aval.dtype
    return [r.each("sub", [constants(1, dtype), r.each("mul", [args[0], args[0]], dtype)], dtype)]


@rule("add_any")
def _add_any(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [r.each("add", args, eqn.outvars[0].aval.dtype)]


@rule("lt_to", "le_to", "eq_to")
def _total_order(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Comparisons in which NaN is the largest number, and equal to itself."""
    name = eqn.primitive.name.removesuffix("_to")
    if eqn.invars[0].aval.dtype.kind != "f":
        return [r.each(name, args, bool)]
    a_nan, b_nan = (r.each("ne", [x, x], bool) for x in args)
    of_nan = {
        "lt": lambda: r.each("and", [b_nan, r.each("not", [a_nan], bool)], bool),
        "le": lambda: b_nan,
        "eq": lambda: r.each("and", [a_nan, b_nan], bool),
    }[name]()
    return [r.each("or", [r.each(name, args, bool), of_nan], bool)]


@rule("optimization_barrier")
def _barrier(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    r.block.mark()
    return args


@rule("copy", "copy_p", "stop_gradient", "pvary", "random_clone", "name")
def _identity(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return args


# Movement ---------------------------------------------------------------------------------------------------------

MOVEMENT = {
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "rev", "slice", "split", "unstack",
    "concatenate", "stack", "pad", "tile",
}  # fmt: skip


def move(eqn: Any, args: list[Elements]) -> Elements:
    """Return what a primitive that only moves elements makes of them."""
    p, x = eqn.params, args[0]
    match eqn.primitive.name:
        case "reshape" if p.get("dimensions") is None:
            return x.reshape(eqn.outvars[0].aval.shape)
        case "squeeze" | "expand_dims":
            return x.reshape(eqn.outvars[0].aval.shape)
        case "transpose":
            return x.transpose(p["permutation"])
        case "slice":
            strides = p["strides"] or (1,) * x.ndim
            return x[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]
        case "broadcast_in_dim":
            shape = [1] * len(p["shape"])
            for size, axis in zip(x.shape, p["broadcast_dimensions"], strict=True):
                shape[axis] = size
            return np.broadcast_to(x.reshape(shape), p["shape"])
        case "concatenate":
            return np.concatenate(args, axis=p["dimension"])
        case "stack":
            return np.stack(args, axis=p["axis"])
    return move_many(eqn, args)[0]


def move_many(eqn: Any, args: list[Elements], fixed: Sequence[Any] = ()) -> list[Elements]:
    """Return what a primitive that only moves elements makes of them, by running it on their numbers.

    Args:
        eqn: The operation.
        args: The arrays that are moved.
        fixed: Operands behind them that say where to: indices that are known.
    """
    numbers, elements = [], []
    for x in args:
        numbers.append(np.arange(len(elements), len(elements) + x.size, dtype=np.int32).reshape(x.shape))
        elements.extend(x.reshape(-1))
    params = {"fill_value": 0} if eqn.primitive.name == "gather" else {}  # never used: all places are inside
    places = run_now(eqn, [*numbers, *fixed], **params)
    return [pack([elements[i] for i in p.reshape(-1)], p.shape) for p in places]


def run_now(eqn: Any, args: Sequence[Any], **params: Any) -> list[np.ndarray]:
    """Return the results of an operation on known numbers."""
    with jax.ensure_compile_time_eval(), jax.default_device(jax.local_devices(backend="cpu")[0]):
        out = eqn.primitive.bind(*(jax.numpy.asarray(x) for x in args), **(eqn.params | params))
        return [np.asarray(x) for x in (out if eqn.primitive.multiple_results else [out])]


@rule("iota", "iota_2x32_shape")
def _iota(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    outs = run_now(eqn, [])
    return [constants(x, x.dtype) for x in outs]


# Reductions --------------------------------------------------------------------------------------------------------

COMBINE = {
    "reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min",
    "reduce_and": "and", "reduce_or": "or", "reduce_xor": "xor",
}  # fmt: skip


@rule(*COMBINE)
def _reduce(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    op, dtype, axes = COMBINE[eqn.primitive.name], eqn.outvars[0].aval.dtype, eqn.params["axes"]
    x = np.moveaxis(args[0], axes, range(len(axes)))
    rest = x.shape[len(axes) :]
    rows = list(x.reshape(-1, *rest))
    if not rows:
        return [constants(run_now(eqn, [np.zeros(args[0].shape, dtype)])[0], dtype)]
    return [functools.reduce(lambda a, b: r.each(op, [a, b], dtype), [np.asarray(row, object) for row in rows])]


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulate(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    op = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}[eqn.primitive.name]
    x = np.moveaxis(args[0], eqn.params["axis"], 0).copy()
    order = range(len(x))[::-1] if eqn.params["reverse"] else range(len(x))
    for last, i in itertools.pairwise(order):
        x[i] = r.each(op, [np.asarray(x[last], object), np.asarray(x[i], object)], eqn.outvars[0].aval.dtype)[()]
    return [np.moveaxis(x, 0, eqn.params["axis"])]


@rule("argmax", "argmin")
def _argmax(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """The first of the best, or the first NaN, as XLA has it."""
    (axis,), index = eqn.params["axes"], eqn.params["index_dtype"]
    better = "gt" if eqn.primitive.name == "argmax" else "lt"
    rows = [np.asarray(row, object) for row in np.moveaxis(args[0], axis, 0)]
    best, where = rows[0], np.broadcast_to(constants(0, index), rows[0].shape)
    for i, row in enumerate(rows[1:], 1):
        best_is_number = r.each("eq", [best, best], bool)
        wins = r.each("or", [r.each(better, [row, best], bool), r.each("ne", [row, row], bool)], bool)
        wins = r.each("and", [wins, best_is_number], bool)
        best = r.each("select_n", [wins, best, row], eqn.invars[0].aval.dtype)
        where = r.each("select_n", [wins, where, constants(i, index)], index)
    return [where]


@rule("sort")
def _sort(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Odd-even transposition: neighbours change places, which keeps the order of equals. NaN goes last."""
    axis, n_keys = eqn.params["dimension"], eqn.params["num_keys"]
    dtypes = [v.aval.dtype for v in eqn.invars]
    columns = [np.moveaxis(x, axis, 0).copy() for x in args]
    n = len(columns[0])
    if n > UNROLL:
        raise NoRuleError(f"primitive 'sort' of {n} elements; written out are up to {UNROLL}")
    for turn in range(n):
        for i in range(turn % 2, n - 1, 2):
            first = [np.asarray(c[i], object) for c in columns]
            second = [np.asarray(c[i + 1], object) for c in columns]
            swap, tied = constants(False, bool), constants(True, bool)
            for a, b, dtype in zip(first[:n_keys], second[:n_keys], dtypes, strict=False):
                above = r.each("lt", [b, a], bool)
                equal = r.each("eq", [a, b], bool)
                if dtype.kind == "f":
                    a_nan, b_nan = r.each("ne", [a, a], bool), r.each("ne", [b, b], bool)
                    above = r.each("or", [above, r.each("and", [a_nan, r.each("not", [b_nan], bool)], bool)], bool)
                    equal = r.each("or", [equal, r.each("and", [a_nan, b_nan], bool)], bool)
                swap = r.each("or", [swap, r.each("and", [tied, above], bool)], bool)
                tied = r.each("and", [tied, equal], bool)
            for c, a, b, dtype in zip(columns, first, second, dtypes, strict=True):
                c[i] = r.each("select_n", [swap, a, b], dtype)[()]
                c[i + 1] = r.each("select_n", [swap, b, a], dtype)[()]
    return [np.moveaxis(c, 0, axis) for c in columns]


@rule("dot_general")
def _dot(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
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
                terms = [r.one("mul", *(_cast(r, x, dtype) for x in pair)) for pair in zip(row, column, strict=True)]
                zero = constant(0, dtype)
                out.append(functools.reduce(lambda s, t: r.one("add", s, t), terms, zero))
    return [pack(out, (*batch, *a_sizes, *b_sizes))]


def _cast(r: Reader, x: Element, dtype: Any) -> Element:
    return r.block.add("convert_element_type", (x,), dtype)


# Calls, branches, loops ---------------------------------------------------------------------------------------------


@rule("jit", "pjit", "closed_call", "core_call", "remat2", "checkpoint", "custom_lin", "run_state")
def _call(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return r.read(closed(eqn.params.get("jaxpr") or eqn.params["call_jaxpr"]), args)


@rule("custom_jvp_call")
def _custom_jvp(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return _with_derivative(r, eqn, args, closed(eqn.params["call_jaxpr"]))


@rule("call_hi_primitive")
def _high_level(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """A primitive that is written in terms of others, from JAX 0.12 on."""
    primitive = eqn.params["_prim"]

    def expanded(*args: Any) -> list[Any]:
        return jax.tree.leaves(primitive.expand(*jax.tree.unflatten(primitive.in_tree, args)))

    avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
    return _with_derivative(r, eqn, args, jax.make_jaxpr(expanded)(*avals))


def _with_derivative(r: Reader, eqn: Any, args: list[Elements], called: core.ClosedJaxpr) -> list[Elements]:
    """Read a call that brings a derivative of its own, which is read when somebody asks for it."""
    body = r.inner()
    body.block.outputs = _flat(body.read(called, [_inputs(body, x) for x in args]))

    @functools.cache
    def slope() -> Block:
        """Return the program from operands and their changes to the changes of the results."""
        single = _as_function(eqn)
        avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        traced = jax.make_jaxpr(lambda x, dx: jax.jvp(single, x, dx)[1])(avals, avals)
        reader = Reader(Block())
        inputs = [_inputs(reader, x) for x in (*args, *args)]
        reader.block.outputs = _flat(reader.read(traced, inputs))
        return reader.block

    return _results(r, "custom_jvp", eqn, _flat(args), (body.block,), (("slope", slope),))


@rule("custom_linear_solve")
def _linear_solve(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    n_before = lengths.matvec + lengths.vecmat
    solve = args[n_before : n_before + lengths.solve]
    n_all = n_before + lengths.solve + lengths.transpose_solve
    return r.read(closed(jaxprs.solve), [*solve, *args[n_all:]])


@rule("cond")
def _cond(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Both branches are computed, and one is taken: lanes differ in which."""
    which, *operands = args
    branches = [closed(b) for b in eqn.params["branches"]]
    index = which[()]
    if is_constant(index):
        return r.read(branches[int(np.clip(index, 0, len(branches) - 1))], operands)
    outs = [r.read(b, operands) for b in branches]
    results = []
    for k, v in enumerate(eqn.outvars):
        taken = outs[-1][k]
        for i in range(len(branches) - 2, -1, -1):
            here = r.one("le", index, constant(i, index.dtype), dtype=bool)
            taken = r.each("select_n", [pack([here], ()), taken, outs[i][k]], v.aval.dtype)
        results.append(taken)
    return results


@rule("platform_index")
def _platform_index(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Of code that is written for several platforms, what serves all of them, else what serves the CPU."""
    platforms = list(eqn.params["platforms"])
    cpu = next((k for k, names in enumerate(platforms) if names is not None and "cpu" in names), 0)
    return [constants(platforms.index(None) if None in platforms else cpu, np.int32)]


@rule("scan")
def _scan(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    p, length = eqn.params, eqn.params["length"]
    body = closed(p["jaxpr"])
    # Versions of JAX name the groups differently; what is stacked over turns has one axis more outside.
    n_carry = sum(o.aval.ndim == v.aval.ndim for o, v in zip(eqn.outvars, body.jaxpr.outvars, strict=True))
    n_stacked = sum(o.aval.ndim > v.aval.ndim for o, v in zip(eqn.invars, body.jaxpr.invars, strict=True))
    n_consts = len(eqn.invars) - n_carry - n_stacked
    fixed, carry, xs = args[:n_consts], args[n_consts : n_consts + n_carry], args[n_consts + n_carry :]
    if len(body.jaxpr.outvars) == n_carry and not xs and length > 1:
        inner = r.inner()
        inputs = [_inputs(inner, x) for x in carry]
        inner.block.outputs = _flat(inner.read(body, [*fixed, *inputs]))
        return _results(r, "loop", eqn, _flat(carry), (inner.block,), (("length", length),))
    if length > UNROLL:
        raise NoRuleError(
            f"primitive 'scan' with inputs or outputs for each of {length} turns; written out are {UNROLL}"
        )
    stacked: list[list[Elements]] = []
    for i in range(length)[::-1] if p["reverse"] else range(length):
        outs = r.read(body, [*fixed, *carry, *(np.asarray(x[i], object) for x in xs)])
        carry = outs[:n_carry]
        stacked.append(outs[n_carry:])
    if p["reverse"]:
        stacked.reverse()
    ys = [np.stack([turn[k] for turn in stacked]) for k in range(len(body.jaxpr.outvars) - n_carry)]
    return [*carry, *ys]


@rule("while")
def _while(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    p = eqn.params
    n_cond, n_body = p["cond_nconsts"], p["body_nconsts"]
    cond_fixed, body_fixed, carry = args[:n_cond], args[n_cond : n_cond + n_body], args[n_cond + n_body :]
    test, body = r.inner(), r.inner()
    test.block.outputs = _flat(test.read(closed(p["cond_jaxpr"]), [*cond_fixed, *(_inputs(test, x) for x in carry)]))
    body.block.outputs = _flat(body.read(closed(p["body_jaxpr"]), [*body_fixed, *(_inputs(body, x) for x in carry)]))
    return _results(r, "while", eqn, _flat(carry), (test.block, body.block))


def closed(jaxpr: Any) -> core.ClosedJaxpr:
    """Return a jaxpr in closed form, whichever form it has."""
    return jaxpr if isinstance(jaxpr, core.ClosedJaxpr) else core.ClosedJaxpr(jaxpr, ())


def _as_function(eqn: Any) -> Callable[..., Any]:
    """Return an operation as a function of arrays."""
    return lambda *args: eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(eqn.params))


def _inputs(r: Reader, like: Elements) -> Elements:
    def new(x: Any) -> Any:
        return tuple(map(new, x)) if isinstance(x, tuple) else r.block.input(x.dtype)

    return pack([new(x) for x in like.reshape(-1)], like.shape)


def _flat(arrays: Sequence[Elements]) -> list[Element]:
    """Return single elements in a row; a key is two words."""
    items = [x for array in arrays for x in array.reshape(-1)]
    return [word for x in items for word in (x if isinstance(x, tuple) else (x,))]


def _results(
    r: Reader, op: str, eqn: Any, args: list[Element], blocks: tuple[Block, ...], params: tuple = ()
) -> list[Elements]:
    """Return the results of an operation that has many."""
    whole = r.block.add(op, tuple(args), bool, params, blocks)
    out, k = [], 0
    for v in eqn.outvars:
        is_key = jax.dtypes.issubdtype(v.aval.dtype, jax.dtypes.prng_key)
        size = int(np.prod(v.aval.shape)) * (2 if is_key else 1)
        dtype = np.uint32 if is_key else v.aval.dtype
        items = [r.block.add("item", (whole,), dtype, (("index", k + i),)) for i in range(size)]
        out.append(pack(list(zip(items[::2], items[1::2], strict=True)) if is_key else items, v.aval.shape))
        k += size
    return out
