"""Operators of traced arrays trace to what JAX traces them to."""

import operator
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick_tracing
from jax.extend.core import Literal

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
    """Return what functions give, as numbers; an error as its length."""

    def result(fn):
        try:
            return jnp.asarray(fn(*args), jnp.float32)
        except Exception as error:
            return jnp.full(len(f"{type(error).__name__}: {error}"), 1.0)

    return [result(fn) for fn in functions]


def equations(functions, args):
    """Return what functions are traced to by ``jit``, ``vmap`` and derivatives, with the types of their constants."""

    def write(fn, args):
        jaxpr = jax.make_jaxpr(lambda *x: fn(*x))(*args)  # a function that JAX has not seen
        constants = [x.val for eqn in jaxpr.eqns for x in eqn.invars if isinstance(x, Literal)]
        return f"{jaxpr}\n{[(type(x), repr(x)) for x in constants]}"

    def total(*x):
        return sum(jnp.sum(y) for y in results(functions, *x))

    floats = [i for i, x in enumerate(args) if np.asarray(x).dtype in quick_tracing.FLOATS]
    many = [np.stack([x, x]) for x in args]
    return [
        write(lambda *x: results(functions, *x), args),
        write(jax.vmap(lambda *x: results(functions, *x)), many),
        write(jax.vmap(jax.grad(total, floats)), many),
        write(jax.grad(lambda *x: jnp.sum(jax.vmap(total)(*x)), floats), many),
    ]


def assert_same(functions, args, monkeypatch):
    quickly = equations(functions, args)
    with monkeypatch.context() as patch:
        patch.setattr(quick_tracing, "quick", False)
        slowly = equations(functions, args)
    assert quickly == slowly


@pytest.mark.parametrize("left", ["vector", "matrix", "scalar"])
def test_operators_trace_to_the_equations_of_jax(left, monkeypatch):
    for right in ARRAYS.values():
        assert_same(OPERATORS, (ARRAYS[left], right), monkeypatch)


def test_operators_with_constants_trace_to_the_equations_of_jax(monkeypatch):
    for name in ("vector", "scalar"):
        assert_same([lambda x, f=f, c=c: f(x, c) for f in OPERATORS for c in CONSTANTS], (ARRAYS[name],), monkeypatch)
    assert_same([lambda x, f=f, c=c: f(c, x) for f in OPERATORS for c in CONSTANTS], (ARRAYS[name],), monkeypatch)


def test_operators_trace_to_the_equations_of_jax_in_float64(x64, monkeypatch):
    for kind in (np.float32, np.float64):
        functions = [*OPERATORS, *[lambda x, y, f=f: f(3 * x, 0.1) for f in OPERATORS]]
        assert_same(functions, (np.ones(3, kind), np.ones(3)), monkeypatch)


@pytest.mark.parametrize("name", ["vector", "matrix", "scalar", "column"])
def test_indices_trace_to_the_equations_of_jax(name, monkeypatch):
    assert_same([lambda x, i=i: x[i] for i in INDICES], (ARRAYS[name],), monkeypatch)


@pytest.mark.skipif(not version("jax").startswith("0.10."), reason="releases of JAX from 0.11 on keep their operators")
def test_operators_and_indices_need_no_function_of_jax_numpy(monkeypatch):
    from jax._src.numpy import indexing, ufuncs

    monkeypatch.delattr(ufuncs, "multiply")
    monkeypatch.delattr(indexing, "rewriting_take")

    def fn(x, y):
        return 2 * (x * y) * y[..., :1] * y[0]

    jax.make_jaxpr(lambda x, y: fn(x, y))(jnp.ones(3), jnp.ones(3))
    jax.make_jaxpr(jax.vmap(fn))(jnp.ones((2, 3)), jnp.ones((2, 3)))
    monkeypatch.setattr(quick_tracing, "quick", False)
    with pytest.raises(AttributeError):
        jax.make_jaxpr(lambda x, y: fn(x, y))(jnp.ones(3), jnp.ones(3))
