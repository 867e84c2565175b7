"""Every rule of the reader once more, in CasADi: what a stage gives in float64 is what its expressions give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_rules import CASES, Results, given, random_numbers

from crazysim import Sim
from crazysim.core.stage import stage
from crazysim.engine import symbolic
from crazysim.engine.lower import UnsupportedError
from crazysim.engine.lower_stages import lower_stages
from crazysim.engine.passes import fuse

pytestmark = pytest.mark.usefixtures("casadi", "x64")

REFUSED = {
    "integers": "'and' on int32",
    "words": "'shift_left' on uint32",
    "loop_until": "until a condition fails",
}
OTHER = {"not_finite", "sort_not_finite", "argmin_and_sort", "conversions"}
"""Cases that are given NaN and infinity, which CasADi's simplifications do not know, or take float32 apart."""


@pytest.fixture(scope="module")
def data():
    """Return the data of drones, with what the cases are given as a plugin, in float64."""
    with jax.enable_x64(True):
        g = jax.tree.map(lambda x: x.astype(float) if x.dtype == np.float32 else x, given())
        sim = Sim(n_worlds=7, n_drones=3, control="rotor_vel", rng_key=3)
        return sim.data.replace(plugins={"given": g})


def read(data, fn):
    """Return a case's program of one drone, and the data it is of."""
    one = jax.tree.map(lambda x: x[0, 0], data.plugins["given"].replace(table=data.plugins["given"].table[None, None]))
    out = jax.eval_shape(lambda g: jnp.ravel(fn(g)), one)
    data = data.replace(plugins=data.plugins | {"results": Results({"out": jnp.zeros((7, 3, *out.shape), out.dtype)})})

    @stage("drone")
    def case(data):
        out = jnp.ravel(fn(data.plugins["given"]))
        return data.replace(plugins=data.plugins | {"results": Results({"out": out})})

    program = fuse(lower_stages([case], data))
    assert program.fused, program.unfused_stages
    return program, data


def expressions(program, data):
    """Return a CasADi function from what the drone reads to the case's results, and the leaves that it reads."""
    import casadi

    symbols = {leaf: casadi.SX.sym(f"x{leaf}", program.leaves[leaf].size) for leaf in program.read}
    (segment,) = program.segments
    after = symbolic.step(segment, lambda slot: symbols[slot[0]][slot[1]])
    (written,) = program.written
    outs = casadi.vertcat(*(after.get((written, k), 0) for k in range(program.leaves[written].size)))
    return casadi.Function("case", list(symbols.values()), [outs]), list(symbols)


@pytest.mark.parametrize("name", [name for name in CASES if name not in {*REFUSED, *OTHER}])
def test_a_case_gives_what_jax_gives(data, name):
    program, data = read(data, CASES[name])
    function, leaves = expressions(program, data)
    g = data.plugins["given"]
    numbers = jax.tree.leaves(data)
    for world, drone in ((0, 0), (3, 1), (6, 2)):
        one = jax.tree.map(lambda x, w=world, d=drone: x[w, d], g.replace(table=jnp.tile(g.table, (7, 3, 1))))
        expected = np.asarray(CASES[name](one), float).ravel()
        inputs = [numbers[i] if program.leaves[i].scope == "shared" else numbers[i][world, drone] for i in leaves]
        found = np.asarray(function(*(np.asarray(x, float).ravel() for x in inputs))).ravel()
        assert expected.size
        # Solves multiply the rounding by the condition of the system, below 1e3; what else there is, is rounding.
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", REFUSED)
def test_what_casadi_has_no_form_for_is_told(data, name):
    program, data = read(data, CASES[name])
    with pytest.raises(UnsupportedError, match=REFUSED[name]):
        expressions(program, data)


def test_random_numbers_are_refused(data):
    key = jax.random.key(0)
    program, data = read(data, lambda g: random_numbers(key, g))
    with pytest.raises(UnsupportedError, match="random numbers"):
        expressions(program, data)


def test_whole_numbers_divide_as_in_jax(data):
    three = np.int32(3)
    program, data = read(data, lambda g: jnp.stack([jax.lax.div(g.i, 0 * g.i + 3), g.i // three, g.i % three, -g.i]))
    function, _ = expressions(program, data)
    i = np.array([-7, -3, 0, 8])
    np.testing.assert_array_equal(np.asarray(function(i)).ravel(), np.ravel([np.trunc(i / 3), i // 3, i % 3, -i]))


def test_conversions_cut_and_wrap_as_in_jax(data):
    def convert(g):
        words = (g.x > 0).astype(jnp.uint32) - g.i[:1].astype(jnp.uint32)
        return jnp.concatenate([(1e3 * g.x).astype(jnp.int32), g.i.astype(bool), words])

    program, data = read(data, convert)
    function, _ = expressions(program, data)
    x, i = np.array([-2.5, -0.0017, 0.0, 0.0017, 1.0, 3.1]), np.array([5, -1, 0, 7])
    words = ((x > 0) - 5.0) % 2**32
    expected = np.concatenate([np.trunc(1e3 * x), i != 0, words])
    np.testing.assert_array_equal(np.asarray(function(x, i)).ravel(), expected)


def test_a_long_loop_is_refused(data):
    program, data = read(data, lambda g: jax.lax.fori_loop(0, 257, lambda k, x: 0.99 * x, g.x))
    with pytest.raises(UnsupportedError, match="257 iterations is too long; at most 256"):
        expressions(program, data)


def test_a_norm_has_slope_zero_at_zero(data):
    import casadi

    from crazysim import rotation

    program, data = read(data, lambda g: rotation.safe_norm(g.x))
    function, _ = expressions(program, data)
    slope = casadi.Function("slope", [x := casadi.SX.sym("x", 6)], [casadi.jacobian(function(x), x)])
    np.testing.assert_array_equal(np.asarray(slope(np.zeros(6))), np.zeros((1, 6)))
    np.testing.assert_allclose(np.asarray(slope([3, 0, 4, 0, 0, 0])), [[0.6, 0, 0.8, 0, 0, 0]], rtol=1e-15)
