"""Programs mean in NumPy, as the tests interpret them, what they mean compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blocks import program_of
from jax import lax
from jax._src import core
from numpy_jax.program import MissingError, TooLongError, evaluate, prepare
from numpy_jax.table import CLOSE, STRUCTURED
from rule_cases import CASES, RANDOM, agree, given, of_all

from crazysim.engine import native
from crazysim.engine.fused import build
from crazysim.engine.lower import lower_function

WINDOWS = lax.GatherDimensionNumbers((1,), (), (0,))
PICKED = lax.GatherDimensionNumbers((), (1,), (1,), (0,), (0,))
OF_WINDOWS = lax.ScatterDimensionNumbers((1,), (), (0,))
OF_PICKED = lax.ScatterDimensionNumbers((), (1,), (1,), (0,), (0,))
PLACES = np.int32([-3, 1, 9, 2])
MODES = ("clip", "fill")

pytestmark = pytest.mark.skipif(
    not jax.__version__.startswith("0.10."), reason="tests interpret programs on jax 0.10 alone"
)
OPERANDS = [np.linspace(-2, 2, 9, dtype=np.float32), np.zeros(9, np.float32)]

MORE = {
    "gather of windows": lambda g: jnp.stack(
        [lax.gather(g.x[0, 0], PLACES[:, None], WINDOWS, (2,), mode=m, fill_value=7) for m in MODES]
    ),
    "batched gather": lambda g: jnp.stack(
        [lax.gather(g.big[0, 0, :4], PLACES[:, None], PICKED, (1, 1), mode=m) for m in MODES]
    ),
    "scatter of windows": lambda g: jnp.stack(
        [
            fn(g.x[0, 0], PLACES[:, None], g.x[0, 1, :4, None] * jnp.ones(2), OF_WINDOWS, mode=mode)
            for fn in (lax.scatter, lax.scatter_add, lax.scatter_sub, lax.scatter_mul, lax.scatter_min, lax.scatter_max)
            for mode in MODES
        ]
    ),
    "batched scatter": lambda g: jnp.stack(
        [lax.scatter_add(g.big[0, 0, :4], PLACES[:, None], g.x[0, 1, :4], OF_PICKED, mode=m) for m in MODES]
    ),
    "shifted words": lambda g: jnp.stack([lax.shift_left(g.u, g.u), lax.shift_right_logical(g.u, g.u)]),
    "shifted signed words": lambda g: jnp.stack(
        [f(g.i, 40 * (g.i % 2)) for f in (lax.shift_right_arithmetic, lax.shift_right_logical, lax.shift_left)]
    ),
    "division by zero": lambda g: jnp.stack([lax.div(g.i, g.i // 5), lax.rem(g.i, g.i // 5)]),
    "scan with rows from the end": lambda g: lax.scan(lambda c, x: (c + x, c), g.x[0, 0], g.x[0], reverse=True)[1],
    "loops of several lengths": lambda g: jax.vmap(
        lambda n, x: lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, c[1] * 2), (0, x))[1]
    )(jnp.arange(4), g.x[0, 0, :4]),
    "triangular systems": lambda g: jnp.stack(
        [
            lax.linalg.triangular_solve(
                g.big[0, 0] + 9 * jnp.eye(6), g.big[0, 1], left_side=a, lower=b, transpose_a=c, unit_diagonal=d
            )
            for a in (True, False)
            for b in (True, False)
            for c in (True, False)
            for d in (False, True)
        ]
    ),
    "keys of a shape": lambda g: jax.vmap(lambda k: jax.random.normal(k, (2,)))(jax.random.split(jax.random.key(3), 4)),
    "angles": lambda g: jnp.stack([jnp.arctan2(g.x, g.x[..., ::-1]), jnp.tan(g.x), jnp.tanh(g.x)]),
    "more keys": lambda g: lax.scan(
        lambda c, k: (jax.random.fold_in(c, 1), jax.random.bits(jnp.stack([c, k, c])[0], (2,)).view(jnp.int32)),
        jax.random.key(1),
        jnp.concatenate([jnp.broadcast_to(jax.random.key(2), (2,)), jax.random.split(jax.random.key(3))]),
    )[1],
    "orthogonal matrices": lambda g: jnp.concatenate(
        [x.ravel() for full in ("complete", "reduced") for x in jnp.linalg.qr(g.big[..., :4], full)]
    ),
    "a branch": lambda g: lax.switch(g.i[0, 0, 0], [jnp.sin, jnp.cos, jnp.tan], g.x),
    "cases by number": lambda g: lax.select_n(jnp.int32([0, 2, 1, 2, 0, 1]), *g.x[0]),
    "neighbours": lambda g: lax.nextafter(g.nan, g.nan[::-1]),
    "rows": lambda g: lax.optimization_barrier(jnp.unstack(g.x)[1]),
    "wrapped keys": lambda g: jax.random.bits(jax.random.wrap_key_data(g.u[0, 0, :2]), (3,)).view(jnp.int32),
    "a function of the host": lambda g: jax.pure_callback(np.negative, g.x, g.x),
    "a place": lambda g: jax.device_put(g.x, jax.devices()[0]) + 1,
    "a singular system": lambda g: lax.linalg.triangular_solve(
        jnp.float32([[1, 2], [0, 0]]), g.x[0, 0, :4].reshape(2, 2), left_side=True
    ),
    "nothing": lambda g: jnp.stack([jnp.max(g.x[0, 0, :0], initial=-1), jnp.min(g.x[0, 0, :0], initial=1)]),
    "bits of all": lambda g: jnp.stack([lax.reduce_and(g.i, (2,)), lax.reduce_or(g.i, (2,))]),
    "margins inside": lambda g: lax.pad(g.m[0, 0], jnp.float32(2), ((1, -1, 1), (-1, 2, 0))),
}
"""Functions of the arrays of all drones."""


@pytest.mark.parametrize("name", [*CASES, *RANDOM, *MORE])
def test_a_case_gives_what_jax_gives(name):
    fn, g = MORE.get(name) or of_all(name), given()
    (found,) = evaluate(jax.make_jaxpr(fn)(g), jax.tree.leaves(g))
    agree(found, jax.jit(fn).lower(g).compile()(g), name)  # outside of a call nothing is interpreted


def names(jaxpr):
    """Return the names of the operations of a jaxpr and of those in it."""
    return {eqn.primitive.name for eqn in jaxpr.eqns}.union(*map(names, core.subjaxprs(jaxpr)))


def test_every_operation_has_a_case():
    """Those of which NumPy has the same bits are in ``test_small_programs``."""
    assert set(MORE).isdisjoint({*CASES, *RANDOM})  # one of two would not be tested
    g = given()
    found = set().union(*(names(jax.make_jaxpr(MORE.get(k) or of_all(k))(g).jaxpr) for k in [*CASES, *RANDOM, *MORE]))
    elsewhere = {"ffi_call", "iota_2x32_shape", "threefry2x32"}  # below, and within those that draw numbers
    assert set(CLOSE | STRUCTURED) - found == elsewhere


def test_kernels_are_called_as_xla_calls_them():
    if native.compiler() is None:
        pytest.skip("no C++ compiler here")
    one = jax.ShapeDtypeStruct((), np.float32)
    program, leaves = program_of(lower_function(lambda x, y: [jnp.sin(x) + y, x < y], one, one), OPERANDS, 9)
    run = build(program, "cpu")
    jaxpr = jax.make_jaxpr(lambda leaves: run(leaves, 1))(leaves)
    assert "ffi_call" in names(jaxpr.jaxpr)
    for x, y in zip(
        evaluate(jaxpr, jax.tree.leaves(leaves)), jax.tree.leaves(jax.jit(lambda x: run(x, 1))(leaves)), strict=True
    ):
        np.testing.assert_array_equal(x, y)


def test_what_is_missing_or_takes_too_long_is_compiled():
    with pytest.raises(MissingError, match="eigh"):
        prepare(jax.make_jaxpr(jnp.linalg.eigh)(jnp.eye(3)))
    with pytest.raises(MissingError, match="mul"):
        prepare(jax.make_jaxpr(lambda x: x * x)(jnp.bfloat16(3)))
    long = prepare(jax.make_jaxpr(lambda x: lax.fori_loop(0, 1000, lambda _, y: y * y, x))(1.0))
    with pytest.raises(TooLongError):
        long.run_within(500, [np.float32(1)])
