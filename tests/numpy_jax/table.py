"""The table of operations: for each a function from an equation to a function of its operands.

The functions of ``EXACT`` give the bits that XLA gives, and those of ``ROUNDED`` do, one at a time. Numbers below 1e-38
are the exception, which XLA flushes to zero, and the sign of the larger of two zeros.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.special

from numpy_jax import indexing, matrices, numbers, program, structured
from numpy_jax.numbers import along, along_exactly, cumulative, each, extreme, same, shift

EXACT: dict[str, Callable[[Any], Callable[..., Any]]] = {
    "abs": each(np.abs),
    "and": each(np.bitwise_and),
    "argmax": extreme(np.argmax),
    "argmin": extreme(np.argmin),
    "bitcast_convert_type": numbers.bitcast,
    "broadcast_in_dim": numbers.broadcast_in_dim,
    "ceil": each(np.ceil),
    "clamp": each(lambda low, x, high: np.minimum(np.maximum(x, low), high)),
    "concatenate": numbers.concatenate,
    "convert_element_type": numbers.convert,
    "copy": same,
    "dynamic_slice": indexing.dynamic_slice,
    "dynamic_update_slice": indexing.dynamic_update_slice,
    "eq": each(np.equal),
    "floor": each(np.floor),
    "gather": indexing.gather,
    "ge": each(np.greater_equal),
    "gt": each(np.greater),
    "iota": numbers.iota,
    "is_finite": each(np.isfinite),
    "layout_constraint": same,
    "le": each(np.less_equal),
    "lt": each(np.less),
    "max": each(np.maximum),
    "min": each(np.minimum),
    "ne": each(np.not_equal),
    "neg": each(np.negative),
    "nextafter": each(np.nextafter),
    "not": each(np.invert),
    "or": each(np.bitwise_or),
    "pad": numbers.pad,
    "reduce_and": along_exactly(np.bitwise_and.reduce),
    "reduce_max": numbers.extreme_along(np.max),
    "reduce_min": numbers.extreme_along(np.min),
    "reduce_or": along_exactly(np.bitwise_or.reduce),
    "rem": numbers.remainder,
    "reshape": numbers.reshape,
    "rev": lambda eqn: functools.partial(np.flip, axis=eqn.params["dimensions"]),
    "round": numbers.rounded,
    "scatter": indexing.scatter(indexing.write),
    "scatter-max": indexing.scatter(np.maximum.at),
    "scatter-min": indexing.scatter(np.minimum.at),
    "select_n": numbers.select_n,
    "shift_left": shift(np.left_shift, np.zeros_like),
    "shift_right_arithmetic": shift(np.right_shift, lambda x: np.where(np.asarray(x) < 0, -1, 0)),
    "shift_right_logical": shift(numbers.shift_right_logical, np.zeros_like),
    "sign": each(lambda x: np.where(x == 0, x, np.sign(x))),
    "slice": numbers.slices,
    "squeeze": numbers.to_shape,
    "stack": numbers.stack,
    "stage": same,
    "stop_gradient": same,
    "tile": lambda eqn: functools.partial(np.tile, reps=eqn.params["reps"]),
    "transpose": lambda eqn: functools.partial(np.transpose, axes=eqn.params["permutation"]),
    "xor": each(np.bitwise_xor),
}
"""Operations of one result of which NumPy has the same bits."""

ROUNDED = {
    "add": each(np.add),
    "div": numbers.divide,
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
    "cholesky": matrices.cholesky,
    "cos": each(np.cos),
    "cosh": each(np.cosh),
    "cummax": cumulative(np.maximum.accumulate),
    "cummin": cumulative(np.minimum.accumulate),
    "cumprod": cumulative(np.cumprod),
    "cumsum": cumulative(np.cumsum),
    "dot_general": matrices.dot_general,
    "erf": each(scipy.special.erf),
    "erf_inv": each(scipy.special.erfinv),
    "exp": each(np.exp),
    "exp2": each(np.exp2),
    "expm1": each(np.expm1),
    "integer_pow": numbers.integer_pow,
    "log": each(np.log),
    "log1p": each(np.log1p),
    "logistic": each(scipy.special.expit),
    "lt_to": each(numbers.less_in_all),
    "pow": each(np.power),
    "reduce_prod": along(np.prod),
    "reduce_sum": along(np.sum),
    "rsqrt": each(lambda x: 1 / np.sqrt(x)),
    "scatter-add": indexing.scatter(np.add.at),
    "scatter-mul": indexing.scatter(np.multiply.at),
    "scatter-sub": indexing.scatter(np.subtract.at),
    "sin": each(np.sin),
    "sinh": each(np.sinh),
    "tan": each(np.tan),
    "tanh": each(np.tanh),
    "triangular_solve": matrices.triangular_solve,
}
"""Operations that round in another order, or differ by some units in the last place."""

STRUCTURED = {
    "cond": structured.cond,
    "custom_linear_solve": matrices.linear_solve,
    "device_put": numbers.all_same,
    "ffi_call": structured.kernel,
    "iota_2x32_shape": structured.iota_2x32,
    "lu": matrices.lu,
    "optimization_barrier": numbers.all_same,
    "platform_index": structured.platform_index,
    "pure_callback": structured.callback,
    "qr": matrices.qr,
    "random_bits": structured.random,
    "random_fold_in": structured.random,
    "random_seed": structured.random,
    "random_split": structured.random,
    "random_unwrap": same,
    "random_wrap": same,
    "scan": structured.scan,
    "sort": numbers.sort,
    "split": numbers.split,
    "threefry2x32": structured.threefry,
    "unstack": numbers.unstack,
    "while": structured.while_loop,
}
"""Operations that run jaxprs, draw numbers, or have several results."""

program.OPERATIONS.update(EXACT | ROUNDED | CLOSE | STRUCTURED)
