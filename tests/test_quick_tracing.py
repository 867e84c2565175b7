"""Operators and indices that call ``lax`` directly produce the equations of JAX's own."""

import operator
import zlib
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick_tracing
from jax.extend.core import Literal

pytestmark = pytest.mark.skipif(
    not version("jax").startswith("0.10."), reason="releases of JAX from 0.11 on keep their operators"
)

OPERATORS = [getattr(operator, name) for name in (*quick_tracing.OPERATORS, "eq", "pow")]
ARRAYS = {
    "vector": np.ones(3, np.float32),
    "matrix": np.ones((3, 3), np.float32),
    "column": np.ones(1, np.float32),
    "scalar": np.float32(2),
    "half": np.ones(3, np.float16),
    "integers": np.arange(3),
    "mask": np.ones(3, bool),
}
EMPTY = np.ones((0, 3), np.float32)
CONSTANTS = [
    3.0, 3, 2**24 + 1, -(2**40), 1e-50, 1e50, float("nan"), float("-inf"), True, np.float32(3), np.float64(3),
    np.int64(3), np.ones(3, np.float32), np.ones(3), np.arange(3),
]  # fmt: skip
INDICES = [
    0, -1, 2, 7, -4, np.int64(1), slice(None), slice(1), slice(1, None), slice(-2, None), slice(2, 1), slice(9),
    slice(None, None, 2), slice(None, None, -1), slice(np.int64(0), 2), ..., None, (), (..., 0), (..., slice(1, 2)),
    (0, ...), (0, 1), (0, slice(1, 3)), (slice(None), 0), (slice(None), 1, ...), (..., None), (None, 0), (..., 5),
    (..., ...), (..., 0, slice(None)), (slice(None, 2), slice(2, None)), [0, 2], np.array([True, False, True]), True,
    (0, 1, 2),
]  # fmt: skip


def results(functions, *args):
    """Return what functions give in float32; an error gives a number that depends on its message."""

    def result(fn):
        try:
            return jnp.asarray(fn(*args), jnp.float32)
        except Exception as error:
            return jnp.float32(zlib.crc32(f"{type(error).__name__}: {error}".encode()))

    return [result(fn) for fn in functions]


def equations(functions, args):
    """Return what functions are traced to by ``jit``, ``vmap`` and derivatives, with the types of their constants."""

    def describe(fn, args):
        jaxpr = jax.make_jaxpr(lambda *x: fn(*x))(*args)  # a function that JAX has not seen
        constants = [x.val for eqn in jaxpr.eqns for x in eqn.invars if isinstance(x, Literal)]
        return f"{jaxpr}\n{[(type(x), repr(x)) for x in constants]}"

    def each(*x):
        return results(functions, *x)

    def total(*x):
        return sum(jnp.sum(y) for y in each(*x))

    floats = [i for i, x in enumerate(args) if np.asarray(x).dtype in quick_tracing.FLOATS]
    many = [np.stack([x, x]) for x in args]
    more = [np.stack([x, x, x]) for x in many]
    return [
        describe(each, args),
        describe(jax.vmap(jax.vmap(each), in_axes=1, out_axes=1), more),
        describe(jax.vmap(jax.grad(total, floats)), many),
        describe(jax.grad(lambda *x: jnp.sum(jax.vmap(jax.vmap(total))(*x)), floats), more),
    ]


def assert_same(functions, args, primitive, monkeypatch):
    """Assert that functions trace to the equations of JAX, of which one is of this primitive."""
    found = equations(functions, args)
    with monkeypatch.context() as patch:
        patch.setattr(quick_tracing, "enabled", False)
        expected = equations(functions, args)
    assert found == expected
    assert all(f" {primitive}" in text for text in expected)


@pytest.mark.parametrize("left", ["vector", "matrix", "scalar"])
def test_operators_of_two_arrays(left, monkeypatch):
    for right in ARRAYS.values():
        assert_same(OPERATORS, (ARRAYS[left], right), "mul ", monkeypatch)


def test_weakly_typed_numbers_keep_the_types_of_jax(monkeypatch):
    def types(enabled):
        monkeypatch.setattr(quick_tracing, "enabled", enabled)
        functions = [*OPERATORS, *[lambda x, y, f=f: f(x, 2) for f in OPERATORS], lambda x, y: x[()]]
        jaxprs = [jax.make_jaxpr(lambda x, y, f=f: f(x, y))(2.0, array) for f in functions for array in ARRAYS.values()]
        return [(str(jaxpr), [(x, x.weak_type) for x in jaxpr.out_avals]) for jaxpr in jaxprs]

    found = types(True)
    assert found == types(False)
    assert any(weak for _, out in found for _, weak in out)


def test_lengths_that_do_not_match_are_the_error_of_jax(monkeypatch):
    def message(enabled):
        monkeypatch.setattr(quick_tracing, "enabled", enabled)
        with pytest.raises(TypeError) as error:
            jax.make_jaxpr(lambda x, y: x * y)(ARRAYS["vector"], np.ones(4, np.float32))
        return str(error.value)

    assert message(True) == message(False)


def test_operators_of_an_array_and_a_constant(monkeypatch):
    functions = [lambda x, f=f, c=c: f(x, c) for f in OPERATORS for c in CONSTANTS]
    reflected = [lambda x, f=f, c=c: f(c, x) for f in OPERATORS for c in CONSTANTS]
    assert_same(functions + reflected, (ARRAYS["vector"],), "mul ", monkeypatch)


def test_operators_in_float64(x64, monkeypatch):
    functions = [*OPERATORS, *[lambda x, y, f=f: f(3 * x, 0.1) for f in OPERATORS]]
    for kind in (np.float32, np.float64):
        assert_same(functions, (np.ones(3, kind), np.ones(3)), "mul ", monkeypatch)


@pytest.mark.parametrize("name", ["vector", "matrix", "scalar", "column", "empty"])
def test_indices(name, monkeypatch):
    array = ARRAYS.get(name, EMPTY)
    primitive = "squeeze" if array.shape else "broadcast_in_dim"
    assert_same([lambda x, i=i: x[i] for i in INDICES], (array,), primitive, monkeypatch)


def test_lengths_may_be_symbols():
    shape = jax.ShapeDtypeStruct(jax.export.symbolic_shape("n, 3"), np.float32)
    jaxpr = jax.make_jaxpr(lambda x: (x[0], x[1], x[:, 0] * x[:, 1], x[:2]))(shape)
    assert [str(x.shape) for x in jaxpr.out_avals] == ["(3,)", "(3,)", "(n,)", "(min(n, 2), 3)"]


def test_no_function_of_jax_numpy_is_called(monkeypatch):
    from jax._src.numpy import indexing, ufuncs

    names = "multiply add subtract true_divide less less_equal greater greater_equal"
    functions = [getattr(operator, name) for name in quick_tracing.OPERATORS]
    for name in names.split():
        monkeypatch.delattr(ufuncs, name)
    monkeypatch.delattr(indexing, "rewriting_take")

    def fn(x, y):
        arrays = [f(x, other) for f in functions for other in (y, 2.0)]
        return arrays + [f(2, x) for f in functions] + [x[..., :1], y[0]]

    args = np.ones((2, 4, 3), np.float32)
    for f in (fn, jax.vmap(fn), jax.vmap(jax.vmap(fn))):
        jax.make_jaxpr(f)(args, args)
    monkeypatch.setattr(quick_tracing, "enabled", False)
    for f in functions:
        with pytest.raises(AttributeError, match="has no attribute"):
            jax.make_jaxpr(lambda x, f=f: f(x, x))(args)


def test_messages_name_the_line_of_the_operator():
    from jax._src import source_info_util

    jaxpr = jax.make_jaxpr(lambda x: x[0] * 2)(np.ones(3, np.float32))
    lines = [source_info_util.summarize(eqn.source_info) for eqn in jaxpr.eqns]
    assert all(line.startswith(__file__) for line in lines), lines
