"""Rules for element-wise primitives."""

from __future__ import annotations

import numpy as np
from jax.lax import RoundingMethod
from numpy.typing import DTypeLike

from crazysim.engine import jaxcompat
from crazysim.engine.ir import ops
from crazysim.engine.jaxcompat import JaxprEqn
from crazysim.engine.lowering.jaxprs import ElementArray, Lowering, UnsupportedError, constants, rule

PRIMITIVES_WITH_RULES = frozenset(
    "convert_element_type bitcast_convert_type select_n integer_pow pow round_even round_away digamma".split()
)
"""Operations whose primitives have separate rules, or that have no primitive of the same name."""


@rule(*(name for name, row in ops.TABLE.items() if not row.structured and name not in PRIMITIVES_WITH_RULES))
def _elementwise(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return [ctx.elementwise(eqn.primitive.name, args, eqn.outvars[0].aval.dtype)]


@rule("pow")
def _pow(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    dtype = eqn.outvars[0].aval.dtype
    return [ctx.elementwise("pow", [args[0], ctx.elementwise("convert_element_type", [args[1]], dtype)], dtype)]


@rule("digamma")
def _digamma(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    dtype = eqn.outvars[0].aval.dtype
    is_zero = ctx.elementwise("eq", [args[0], constants(0, dtype)], bool)
    regular = ctx.elementwise("digamma", args, dtype)
    return [ctx.elementwise("select_n", [is_zero, regular, constants(jaxcompat.DIGAMMA_AT_ZERO, dtype)], dtype)]


@rule("round")
def _round(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    to_even = RoundingMethod(eqn.params["rounding_method"]) == RoundingMethod.TO_NEAREST_EVEN
    return [ctx.elementwise("round_even" if to_even else "round_away", args, eqn.outvars[0].aval.dtype)]


@rule("convert_element_type")
def _convert(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return [ctx.elementwise("convert_element_type", args, eqn.params["new_dtype"])]


@rule("select_n")
def _select_n(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    which, *cases = args
    dtype, which_dtype = eqn.outvars[0].aval.dtype, eqn.invars[0].aval.dtype
    if np.dtype(which_dtype).kind == "b":
        return [ctx.elementwise("select_n", args, dtype)]
    selected = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        is_case = ctx.elementwise("le", [which, constants(k, which_dtype)], bool)
        selected = ctx.elementwise("select_n", [is_case, selected, cases[k]], dtype)
    return [selected]


@rule("bitcast_convert_type")
def _bitcast(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    old_dtype, new_dtype = eqn.invars[0].aval.dtype, eqn.params["new_dtype"]
    if old_dtype == new_dtype:
        return args
    if old_dtype.itemsize != np.dtype(new_dtype).itemsize:
        raise UnsupportedError(f"primitive 'bitcast_convert_type' from {old_dtype} to {new_dtype}, of another size")
    return [ctx.elementwise("bitcast_convert_type", args, new_dtype)]


@rule("square")
def _square(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return [ctx.elementwise("mul", [args[0], args[0]], eqn.outvars[0].aval.dtype)]


@rule("integer_pow")
def _integer_pow(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    y, dtype = eqn.params["y"], eqn.outvars[0].aval.dtype
    if y not in (2, 3, 4):
        return [ctx.elementwise("integer_pow", args, dtype, (("y", y),))]
    squared = ctx.elementwise("mul", [args[0], args[0]], dtype)
    return [squared if y == 2 else ctx.elementwise("mul", [squared, squared if y == 4 else args[0]], dtype)]


@rule("one_minus_square")
def _one_minus_square(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    dtype = eqn.outvars[0].aval.dtype
    return [ctx.elementwise("sub", [constants(1, dtype), ctx.elementwise("mul", [args[0], args[0]], dtype)], dtype)]


@rule("add_any")
def _add_any(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return [ctx.elementwise("add", args, eqn.outvars[0].aval.dtype)]


@rule("lt_to", "le_to", "eq_to")
def _total_order(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    name = eqn.primitive.name.removesuffix("_to")
    if eqn.invars[0].aval.dtype.kind != "f":
        return [ctx.elementwise(name, args, bool)]
    a_is_nan, b_is_nan = (ctx.elementwise("ne", [x, x], bool) for x in args)
    result_for_nan = {
        "lt": lambda: ctx.elementwise("and", [b_is_nan, ctx.elementwise("not", [a_is_nan], bool)], bool),
        "le": lambda: b_is_nan,
        "eq": lambda: ctx.elementwise("and", [a_is_nan, b_is_nan], bool),
    }[name]()
    return [ctx.elementwise("or", [ctx.elementwise(name, args, bool), result_for_nan], bool)]


@rule("optimization_barrier")
def _barrier(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    ctx.builder.barrier()
    return args


@rule("device_put")
def _device_put(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    if any(device is not None for device in eqn.params["devices"]):
        raise UnsupportedError("primitive 'device_put' to a device that is named")
    return args


@rule("copy", "copy_p", "pvary", "reshard", "random_clone", "name")
def _identity(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return args


class _Bits:
    """Arithmetic on the bits of numbers, as unsigned integers of their size."""

    def __init__(self, ctx: Lowering, dtype: DTypeLike):
        self.ctx, self.dtype = ctx, np.dtype(f"u{np.dtype(dtype).itemsize}")
        self.n_bits = 8 * self.dtype.itemsize

    def from_number(self, x: ElementArray) -> ElementArray:
        return self.ctx.elementwise("bitcast_convert_type", [x], self.dtype)

    def apply(self, op: str, a: ElementArray, b: ElementArray | int) -> ElementArray:
        b = constants(b, self.dtype) if isinstance(b, int) else b
        return self.ctx.elementwise(op, [a, b], self.dtype)

    def count(self, x: ElementArray) -> ElementArray:
        # Adds the set bits up in pairs, fours and bytes, and sums the bytes by a product.
        pairs, fours, eights, ones = (self.repeat_byte(byte) for byte in (0x55, 0x33, 0x0F, 0x01))
        x = self.apply("sub", x, self.apply("and", self.apply("shift_right_logical", x, 1), pairs))
        x = self.apply(
            "add", self.apply("and", x, fours), self.apply("and", self.apply("shift_right_logical", x, 2), fours)
        )
        x = self.apply("and", self.apply("add", x, self.apply("shift_right_logical", x, 4)), eights)
        return self.apply("shift_right_logical", self.apply("mul", x, ones), self.n_bits - 8)

    def repeat_byte(self, byte: int) -> int:
        return int.from_bytes(bytes([byte] * self.dtype.itemsize), "little")


@rule("population_count")
def _population_count(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    dtype = eqn.outvars[0].aval.dtype
    bits = _Bits(ctx, dtype)
    return [ctx.elementwise("bitcast_convert_type", [bits.count(bits.from_number(args[0]))], dtype)]


@rule("clz")
def _leading_zeros(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    dtype = eqn.outvars[0].aval.dtype
    bits = _Bits(ctx, dtype)
    x, shift = bits.from_number(args[0]), 1
    while shift < bits.n_bits:
        x = bits.apply("or", x, bits.apply("shift_right_logical", x, shift))
        shift *= 2
    n_zeros = bits.apply("sub", constants(bits.n_bits, bits.dtype), bits.count(x))
    return [ctx.elementwise("bitcast_convert_type", [n_zeros], dtype)]


@rule("reduce_precision")
def _reduce_precision(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    dtype, exponent, mantissa = eqn.outvars[0].aval.dtype, eqn.params["exponent_bits"], eqn.params["mantissa_bits"]
    if dtype not in ops.DTYPES:
        raise UnsupportedError(f"numbers of type {dtype.name}")
    info, bits = np.finfo(dtype), _Bits(ctx, dtype)
    x = bits.from_number(args[0])
    n_dropped = info.nmant - mantissa
    if n_dropped > 0:
        last_bit = bits.apply("and", bits.apply("shift_right_logical", x, n_dropped), 1)
        x = bits.apply("add", x, bits.apply("add", last_bit, (1 << (n_dropped - 1)) - 1))
        x = bits.apply("and", x, (1 << bits.n_bits) - (1 << n_dropped))
    if exponent < info.nexp:
        bias, largest = (1 << (info.nexp - 1)) - 1, (1 << (exponent - 1)) - 1
        infinity = ((1 << info.nexp) - 1) << info.nmant
        sign = bits.apply("and", x, 1 << (bits.n_bits - 1))
        magnitude = bits.apply("and", x, infinity)
        is_overflow = ctx.elementwise("gt", [magnitude, constants((bias + largest) << info.nmant, bits.dtype)], bool)
        is_underflow = ctx.elementwise("le", [magnitude, constants((bias - largest) << info.nmant, bits.dtype)], bool)
        x = ctx.elementwise("select_n", [is_overflow, x, bits.apply("or", sign, infinity)], bits.dtype)
        x = ctx.elementwise("select_n", [is_underflow, x, sign], bits.dtype)
    rounded = ctx.elementwise("bitcast_convert_type", [x], dtype)
    is_nan = ctx.elementwise("ne", [args[0], args[0]], bool)
    return [ctx.elementwise("select_n", [is_nan, rounded, args[0]], dtype)]
