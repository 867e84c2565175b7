"""Handlers of XLA's foreign function interface in Python; tests/gpu has those that launch kernels."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine.backends import ffi_handlers


@pytest.fixture(scope="module")
def scaled():
    def handle(call):
        n, factor = call.attribute("n"), call.attribute("factor")
        if factor < 0:
            raise ValueError("negative factor")
        x, out = (
            np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(ctypes.c_float)), (n,))
            for address in (*call.operands, *call.results)
        )
        out[:] = factor * x + len(call.attribute("text"))

    ffi_handlers.register("crazysim_test_scaled", "cpu", handle)

    def scaled(x, factor, text):
        call = jax.ffi.ffi_call("crazysim_test_scaled", jax.ShapeDtypeStruct(x.shape, x.dtype))
        return call(x, n=np.int32(x.size), factor=np.int32(factor), text=text)

    return jax.jit(scaled, static_argnames=("factor", "text"))


def test_a_handler_reads_operands_results_and_attributes(scaled):
    np.testing.assert_array_equal(scaled(jnp.arange(3.0), 2, "metre"), [5.0, 7.0, 9.0])


def test_an_exception_of_a_handler_is_an_error_of_the_program(scaled):
    with pytest.raises(RuntimeError, match="ValueError: negative factor"):
        jax.block_until_ready(scaled(jnp.arange(3.0), -1, ""))


def test_a_missing_attribute_is_named():
    ffi_handlers.register("crazysim_test_missing", "cpu", lambda call: call.attribute("grid_x"))
    call = jax.ffi.ffi_call("crazysim_test_missing", jax.ShapeDtypeStruct((), jnp.float32))
    with pytest.raises(RuntimeError, match="no attribute 'grid_x'"):
        jax.block_until_ready(jax.jit(lambda: call(grid_y=np.int32(1)))())
