"""Every rule of lowering in CasADi: expressions have the same values as JAX in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rule_cases import CASES, drone_shapes, make_inputs

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.lowering.jaxprs import lower_function
from crazysim.engine.tools import symbolic

pytestmark = pytest.mark.usefixtures("casadi", "x64")

REFUSED_CASES = {
    "integers": "'and' on int32",
    "unsigned_integers": "'shift_left' on uint32",
    "while_loops": "until a condition fails",
    "batches_of_while_loops": "until a condition fails",
    "uniform_loop": "until a condition fails",
}
UNCOMPARED_CASES = {"not_finite", "sort_not_finite", "argmin_and_sort", "conversions"}
"""Cases with NaN or infinity, which CasADi's simplifications do not keep, and cases that need float32."""


@pytest.fixture(scope="module")
def g():
    """Return the inputs of the cases in float64."""
    with jax.enable_x64(True):
        return jax.tree.map(lambda x: x.astype(float) if x.dtype == np.float32 else x, make_inputs())


def casadi_function(fn, *avals):
    import casadi

    block = lower_function(lambda *args: jnp.ravel(fn(*args)), *avals)
    symbolic.require_casadi(block)
    vectors = [casadi.SX.sym(f"x{k}", int(np.prod(x.shape))) for k, x in enumerate(jax.tree.leaves(avals))]
    outputs = symbolic.run_block(block, [x[k] for x in vectors for k in range(x.numel())])
    return casadi.Function("case", vectors, [casadi.vertcat(*outputs)])


def call(function, *args):
    return np.asarray(function(*(np.asarray(x, float).ravel() for x in args))).ravel()


@pytest.mark.parametrize("name", [name for name in CASES if name not in {*REFUSED_CASES, *UNCOMPARED_CASES}])
def test_a_case_gives_the_results_of_jax(g, name):
    function, compiled = casadi_function(CASES[name], drone_shapes(g)), jax.jit(CASES[name])
    for world, drone in ((0, 0), (3, 1), (6, 2)):
        drone_inputs = jax.tree.map(lambda x, w=world, d=drone: x[w, d], g.replace(table=np.tile(g.table, (7, 3, 1))))
        expected = np.asarray(compiled(drone_inputs), float).ravel()
        assert expected.size
        # Solves multiply rounding by the condition number of the system, which is below 1e3.
        np.testing.assert_allclose(call(function, *jax.tree.leaves(drone_inputs)), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", REFUSED_CASES)
def test_unsupported_operations_are_named(g, name):
    with pytest.raises(UnsupportedError, match=REFUSED_CASES[name]):
        casadi_function(CASES[name], drone_shapes(g))


def vector(n, dtype=float):
    return jax.ShapeDtypeStruct((n,), dtype)


def test_whole_numbers_divide_as_in_jax():
    three = np.int32(3)
    function = casadi_function(
        lambda i: jnp.stack([jax.lax.div(i, 0 * i + 3), i // three, i % three, -i]), vector(4, np.int32)
    )
    i = np.array([-7, -3, 0, 8])
    np.testing.assert_array_equal(call(function, i), np.ravel([np.trunc(i / 3), i // 3, i % 3, -i]))


def test_conversions_truncate_saturate_and_wrap_as_in_jax():
    def convert(x, i):
        words = (x > 0).astype(jnp.uint32) - i[:1].astype(jnp.uint32)
        return jnp.concatenate([(1e3 * x).astype(jnp.int32), i.astype(bool), words, (1e10 * x).astype(jnp.uint32)])

    x, i = np.array([-2.5, -0.0017, 0.0, 0.0017, 1.0, 3.1]), np.array([5, -1, 0, 7])
    result = call(casadi_function(convert, vector(6), vector(4, np.int32)), x, i)
    np.testing.assert_array_equal(result, np.asarray(jax.jit(convert)(x, np.int32(i)), float))


def test_a_norm_has_slope_zero_at_zero():
    import casadi

    from crazysim import rotation

    function = casadi_function(rotation.safe_norm, vector(6))
    slope = casadi.Function("slope", [x := casadi.SX.sym("x", 6)], [casadi.jacobian(function(x), x)])
    np.testing.assert_array_equal(np.asarray(slope(np.zeros(6))), np.zeros((1, 6)))
    np.testing.assert_allclose(np.asarray(slope([3, 0, 4, 0, 0, 0])), [[0.6, 0, 0.8, 0, 0, 0]], rtol=1e-15)
