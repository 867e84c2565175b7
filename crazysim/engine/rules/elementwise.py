"""Rules for what is done to every element alike."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from crazysim.engine.lower import Elements, Lowering, UnsupportedError, constants, rule

ELEMENTWISE: dict[str, tuple[str, ...]] = dict.fromkeys(
    "add sub mul div rem neg sign abs floor ceil is_finite exp exp2 log log1p expm1 tanh sin cos tan asin acos atan "
    "sinh cosh asinh acosh atanh atan2 logistic sqrt rsqrt cbrt square pow max min and or xor not eq ne lt le gt ge "
    "nextafter select_n clamp shift_left shift_right_logical shift_right_arithmetic erf erf_inv erfc lgamma digamma "
    "population_count clz".split(),
    (),
) | {"integer_pow": ("y",), "round": ("rounding_method",), "reduce_precision": ("exponent_bits", "mantissa_bits")}
"""Primitives, and the settings that matter to the result."""


@rule(*ELEMENTWISE)
def _each(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    name = eqn.primitive.name
    params = tuple(sorted((k, eqn.params[k]) for k in ELEMENTWISE[name]))
    return [ctx.elementwise(name, args, eqn.outvars[0].aval.dtype, params)]


def is_floating(dtype: Any) -> bool:
    """Return whether numbers are of floating point, bfloat16 included, which NumPy does not count among them."""
    return jax.dtypes.issubdtype(dtype, np.floating)


@rule("convert_element_type")
def _convert(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [ctx.elementwise("convert_element_type", args, eqn.params["new_dtype"])]


@rule("select_n")
def _select_n(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    """One of two cases by a bool; of more by a number, each against the next."""
    which, *cases = args
    dtype, kind = eqn.outvars[0].aval.dtype, eqn.invars[0].aval.dtype
    if np.dtype(kind).kind == "b":
        return [ctx.elementwise("select_n", args, dtype)]
    taken = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        here = ctx.elementwise("le", [which, constants(k, kind)], bool)
        taken = ctx.elementwise("select_n", [here, taken, cases[k]], dtype)
    return [taken]


@rule("bitcast_convert_type")
def _bitcast(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    before, after = eqn.invars[0].aval.dtype, eqn.params["new_dtype"]
    if before == after:
        return args
    if before.itemsize != np.dtype(after).itemsize:
        raise UnsupportedError(f"primitive 'bitcast_convert_type' from {before} to {after}, of another size")
    return [ctx.elementwise("bitcast_convert_type", args, after)]


@rule("pow")
def _pow(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    """A power, with an integer exponent converted to the type of the base."""
    dtype = eqn.outvars[0].aval.dtype
    return [ctx.elementwise("pow", [ctx.elementwise("convert_element_type", [x], dtype) for x in args], dtype)]


@rule("square")
def _square(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [ctx.elementwise("mul", [args[0], args[0]], eqn.outvars[0].aval.dtype)]


@rule("integer_pow")
def _integer_pow(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    y, dtype = eqn.params["y"], eqn.outvars[0].aval.dtype
    if y not in (2, 3, 4):
        return [ctx.elementwise("integer_pow", args, dtype, (("y", y),))]
    squared = ctx.elementwise("mul", [args[0], args[0]], dtype)
    return [squared if y == 2 else ctx.elementwise("mul", [squared, squared if y == 4 else args[0]], dtype)]


@rule("one_minus_square")
def _one_minus_square(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    dtype = eqn.outvars[0].aval.dtype
    return [ctx.elementwise("sub", [constants(1, dtype), ctx.elementwise("mul", [args[0], args[0]], dtype)], dtype)]


@rule("add_any")
def _add_any(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [ctx.elementwise("add", args, eqn.outvars[0].aval.dtype)]


@rule("lt_to", "le_to", "eq_to")
def _total_order(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Comparisons in which NaN is the largest number, and equal to itself."""
    name = eqn.primitive.name.removesuffix("_to")
    if not is_floating(eqn.invars[0].aval.dtype):
        return [ctx.elementwise(name, args, bool)]
    a_nan, b_nan = (ctx.elementwise("ne", [x, x], bool) for x in args)
    of_nan = {
        "lt": lambda: ctx.elementwise("and", [b_nan, ctx.elementwise("not", [a_nan], bool)], bool),
        "le": lambda: b_nan,
        "eq": lambda: ctx.elementwise("and", [a_nan, b_nan], bool),
    }[name]()
    return [ctx.elementwise("or", [ctx.elementwise(name, args, bool), of_nan], bool)]


@rule("optimization_barrier")
def _barrier(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    ctx.builder.barrier()
    return args


@rule("device_put")
def _device_put(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    if any(device is not None for device in eqn.params["devices"]):
        raise UnsupportedError("primitive 'device_put' to a device that is named")
    return args


@rule("copy", "copy_p", "stop_gradient", "pvary", "random_clone", "name")
def _identity(ctx: Lowering, eqn: Any, args: list[Elements]) -> list[Elements]:
    return args
