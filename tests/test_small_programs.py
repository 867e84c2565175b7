"""Small programs mean in NumPy, as the tests run them, what they mean compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_programs
from jax import lax
from numpy_jax.program import evaluate
from numpy_jax.table import EXACT, ROUNDED

SIGNED = np.float32([[-2.5, -0.0, 0.0, 1.5], [np.nan, np.inf, -np.inf, 3e38]])
OTHER = np.float32([[0.3, 7.0, 0.0, -1.5], [1.0, -np.inf, -np.inf, 3e38]])
COUNTS = np.int32([[3, -7, 0, 2147483647], [1, 2, -2147483648, 5]])
FLAGS = SIGNED > 0

CASES = {
    "and": (lax.bitwise_and, COUNTS, COUNTS.T.reshape(2, 4)),
    "broadcast_in_dim": (lambda x: lax.broadcast_in_dim(x, (2, 3, 4), (0, 2)), SIGNED),
    "concatenate": (lambda x, y: lax.concatenate([x, y], 1), SIGNED, OTHER),
    "convert_element_type": (lambda x: lax.convert_element_type(x, np.float32), COUNTS),
    "convert_element_type to integers": (lambda x: lax.convert_element_type(x, np.int32), SIGNED),
    "copy": (jnp.copy, SIGNED),
    "dynamic_slice": (lambda x, k: lax.dynamic_slice(x, (k, 1), (1, 2)), SIGNED, np.int32(9)),
    "dynamic_update_slice": (lambda x, y: lax.dynamic_update_slice(x, y, (-3, 3)), SIGNED, OTHER[:, :2]),
    "eq": (lax.eq, SIGNED, OTHER),
    "ge": (lax.ge, SIGNED, OTHER),
    "gt": (lax.gt, SIGNED, OTHER),
    "iota": (lambda: lax.broadcasted_iota(np.int32, (2, 3), 1),),
    "is_finite": (lax.is_finite, SIGNED),
    "le": (lax.le, SIGNED, OTHER),
    "lt": (lax.lt, SIGNED, OTHER),
    "max": (lax.max, SIGNED, OTHER),
    "min": (lax.min, SIGNED, OTHER),
    "ne": (lax.ne, SIGNED, OTHER),
    "neg": (lax.neg, SIGNED),
    "not": (lax.bitwise_not, FLAGS),
    "or": (lax.bitwise_or, FLAGS, ~FLAGS),
    "reduce_and": (lambda x: jnp.all(x, 0), FLAGS),
    "reduce_max": (lambda x: jnp.max(x, 1), SIGNED),
    "reduce_min": (lambda x: jnp.min(x), COUNTS),
    "reduce_or": (lambda x: jnp.any(x, (0, 1)), FLAGS),
    "reshape": (lambda x: lax.reshape(x, (4, 2)), SIGNED),
    "rev": (lambda x: lax.rev(x, (1,)), SIGNED),
    "select_n": (lambda c, x, y: lax.select(c, x, y), FLAGS, SIGNED, OTHER),
    "slice": (lambda x: lax.slice(x, (0, 1), (2, 4), (1, 2)), SIGNED),
    "squeeze": (lambda x: lax.squeeze(x[:, :1], (1,)), SIGNED),
    "transpose": (lambda x: lax.transpose(x, (1, 0)), SIGNED),
    "abs": (lax.abs, SIGNED),
    "argmax": (lambda x: lax.argmax(x, 1, np.int32), SIGNED),
    "argmin": (lambda x: lax.argmin(x, 0, np.int32), SIGNED),
    "bitcast_convert_type": (lambda x: lax.bitcast_convert_type(x, np.int32), SIGNED),
    "ceil": (lax.ceil, SIGNED),
    "clamp": (lambda x: lax.clamp(np.float32(-1), x, np.float32(2)), SIGNED),
    "floor": (lax.floor, SIGNED),
    "gather": (lambda x, k: x.at[:, k].get(mode="fill"), SIGNED, COUNTS[0]),
    "nextafter": (lax.nextafter, OTHER[:, ::-1], OTHER),
    "pad": (lambda x: lax.pad(x, np.float32(2), ((1, -1, 0), (-1, 2, 1))), SIGNED),
    "rem": (lax.rem, COUNTS, COUNTS[::-1] // 2),
    "round": (lambda x: jnp.stack([lax.round(x), jnp.round(x)]), np.float32([-2.5, -0.5, 0.49999997, 0.5, 8388609])),
    "scatter": (lambda x, k: x.at[:, k].set(1, mode="drop"), SIGNED, COUNTS[0]),
    "scatter-max": (lambda x, k: x.at[:, k].max(1, mode="clip"), SIGNED, COUNTS[0]),
    "scatter-min": (lambda x, k: x.at[:, k].min(1, mode="drop"), SIGNED, COUNTS[0]),
    "shift_left": (lax.shift_left, COUNTS, COUNTS[::-1]),
    "shift_right_arithmetic": (lax.shift_right_arithmetic, COUNTS, COUNTS[::-1]),
    "shift_right_logical": (lax.shift_right_logical, COUNTS, COUNTS[::-1]),
    "sign": (lax.sign, SIGNED),
    "stack": (lambda x, y: jnp.stack([x, y], 1), SIGNED, OTHER),
    "stop_gradient": (jax.jit(lax.stop_gradient), SIGNED),
    "tile": (lambda x: jnp.tile(x, (2, 1)), SIGNED),
    "xor": (lax.bitwise_xor, COUNTS, COUNTS[::-1]),
    "add": (lax.add, SIGNED, OTHER),
    "div": (lax.div, SIGNED, OTHER),
    "mul": (lax.mul, COUNTS, COUNTS[::-1]),
    "sqrt": (lax.sqrt, SIGNED),
    "square": (lax.square, SIGNED),
    "sub": (lax.sub, SIGNED, OTHER),
}
"""A function for each operation, and its arguments."""


@pytest.mark.parametrize("name", CASES)
def test_numpy_has_the_bits_of_the_compiled_program(name):
    fn, *args = CASES[name]
    jaxpr = jax.make_jaxpr(fn)(*args)
    assert name.split(" ")[0] in str(jaxpr)
    (compiled,) = jax.tree.leaves(jax.jit(fn).lower(*args).compile()(*args))
    assert small_programs.is_exact(jaxpr.jaxpr)
    (interpreted,) = evaluate(jaxpr, args)
    assert interpreted.dtype == compiled.dtype
    assert interpreted.tobytes() == np.asarray(compiled).tobytes()


def test_every_operation_has_a_case():
    identity = {"layout_constraint", "stage"}  # cannot be written here
    assert {name.split(" ")[0] for name in CASES} == set(EXACT | ROUNDED) - identity


@pytest.mark.parametrize(
    "fn",
    [
        lambda x: x * x + x,  # XLA may round once
        lambda x: x / 3,  # and multiplies by the reciprocal
        lambda x: x + 0.0,  # and returns -0.0
        jnp.sin,
        lambda x: jnp.sum(x),
        lambda x: lax.fori_loop(0, 3, lambda _, y: y, x),
        lambda x: jax.random.key_data(jax.random.key(x.size)),
    ],
)
def test_what_numpy_rounds_otherwise_is_compiled(fn):
    assert not small_programs.is_exact(jax.make_jaxpr(fn)(SIGNED).jaxpr)


def test_results_are_where_compiled_ones_would_be():
    first, second = jax.devices()[:2]
    free, bound = jnp.ones(3), jax.device_put(np.ones(3, np.float32), second)
    assert not (free + free).committed
    assert (free + free).devices() == {first}
    assert (free + bound).committed
    assert (free + bound).devices() == {second}
