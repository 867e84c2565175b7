"""Functions that are compiled as a whole when Python calls them, and inlined within compiled code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.eager import jit_eager_calls


@pytest.fixture
def traced():
    argument_types = []

    @jit_eager_calls("is_turned")
    def rotated(x, table, is_turned=False):
        argument_types.append((type(x), type(table)))
        y = x @ table
        return -y if is_turned else y

    return rotated, argument_types


def test_calls_with_arrays_run_one_program(traced):
    rotated, argument_types = traced
    x, table = np.ones(3, np.float32), np.diag([1.0, 2.0, 3.0]).astype(np.float32)
    for scale in (1.0, 2.0, 3.0):
        np.testing.assert_allclose(rotated(scale * x, table), scale * np.array([1, 2, 3]))
    assert len(argument_types) == 1
    assert all(issubclass(kind, jax.core.Tracer) for kind in argument_types[0])
    np.testing.assert_allclose(rotated(x, table, is_turned=True), [-1, -2, -3])
    assert len(argument_types) == 2


def test_within_compiled_code_constants_remain_constants(traced):
    rotated, argument_types = traced
    table = np.eye(3, dtype=np.float32)
    jaxpr = jax.make_jaxpr(lambda x: rotated(x, table))(jnp.ones(3))
    assert argument_types[0][1] is np.ndarray
    assert {eqn.primitive.name for eqn in jaxpr.eqns} == {"dot_general"}
    np.testing.assert_allclose(jax.grad(lambda x: rotated(x, table).sum())(jnp.ones(3)), 1.0)
