"""Cases for every rule of lowering: functions of one drone's arrays.

A rule translates a primitive of JAX into operations of the engine (``crazysim.engine.lowering``).
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim.core.branches import any_lane, compute_where
from crazysim.engine.pytree import PyTree, leaf

N_WORLDS, N_DRONES = 7, 3  # 21 lanes: not a multiple of any vector's or block's length
N_LANES = N_WORLDS * N_DRONES


class Inputs(PyTree):
    x: jax.Array = leaf("drone", 1)
    """Numbers of both signs, two of them equal. (6,)"""
    m: jax.Array = leaf("drone", 2)
    """A matrix. (3, 3)"""
    big: jax.Array = leaf("drone", 2)
    """A matrix. (6, 6)"""
    i: jax.Array = leaf("drone", 1)
    """Integers from -2 to 8. (4,)"""
    u: jax.Array = leaf("drone", 1)
    """Any 32 bits. (3,)"""
    table: jax.Array = leaf("shared", 1)
    """Numbers that all drones share. (8,)"""
    nan: jax.Array = leaf("drone", 1)
    """Numbers, NaN and infinities. (6,)"""


CASES = {}


def case(fn):
    """Add a function of ``Inputs`` to the cases."""
    CASES[fn.__name__] = fn
    return fn


def make_positive_definite(m):
    return m @ m.T + 2.0 * jnp.eye(len(m))


# Element-wise
@case
def arithmetic(g):
    x, y = g.x, g.x[::-1] + 0.3
    return jnp.stack([x + y, x - y, x * y, x / y, -x, jnp.abs(x), jnp.sign(x), jnp.maximum(x, y), jnp.minimum(x, y)])


@case
def functions(g):
    x, p = g.x, jnp.abs(g.x) + 0.1
    first = [jnp.sin(x), jnp.cos(x), jnp.tan(x), jnp.exp(x), jnp.log(p), jnp.sqrt(p), jnp.tanh(x), jax.lax.rsqrt(p)]
    second = [jnp.arctan2(x, x[::-1]), jnp.arcsin(x / 4), jnp.arccos(x / 4), jnp.arctan(x), jnp.sinh(x), jnp.cosh(x)]
    third = [jnp.expm1(x), jnp.log1p(p), jnp.cbrt(x), jnp.exp2(x), p**x, x**3, p**-2, jax.nn.sigmoid(x)]
    fourth = [jax.lax.erf(x), jax.lax.erf_inv(x / 4), jnp.arcsinh(x), jnp.arctanh(x / 4), jnp.arccosh(p + 1)]
    return jnp.stack(first + second + third + fourth)


@case
def large_angles(g):
    return jnp.stack([jnp.sin(1e3 * g.x), jnp.cos(1e3 * g.x), jnp.sin(1e5 * g.x), jnp.cos(1e5 * g.x)])


@case
def rounding(g):
    x = 3 * g.x
    return jnp.stack([jnp.floor(x), jnp.ceil(x), jnp.round(x), jax.lax.round(x), jnp.fmod(x, 0.7), x % 0.7, x // 0.7])


@case
def comparisons(g):
    x, y = g.x, g.x[::-1]
    return jnp.stack([x < y, x <= y, x > y, x >= y, x == y, x != y, (x > 0) & (y > 0), (x > 0) | (y > 0), ~(x > 0)])


@case
def not_finite(g):
    x, y = g.nan, g.nan[::-1]
    limits = [jnp.maximum(x, y), jnp.minimum(x, 0.5), jnp.clip(x, -1, 1), jnp.where(x < 0, 0, x), jnp.sign(x)]
    return jnp.stack([jnp.isfinite(x), jnp.isnan(x), *limits, jnp.where(x > 1, 1.0, x)])


@case
def integers(g):
    a, b = g.i, g.i[::-1]
    return jnp.stack([a + b, a - b, a * b, a // b, a % b, jax.lax.div(a, b), jax.lax.rem(a, b), abs(a), a & b, a | b,
                      ~a, a ^ b, a << 3, a >> 1, jnp.sign(a), -a])  # fmt: skip


@case
def unsigned_integers(g):
    u, n = g.u, jnp.uint32([0, 5, 31])
    out = jnp.stack([u << n, u >> n, u + u[::-1], u * jnp.uint32(2654435761), ~u, u ^ n])
    return jax.lax.bitcast_convert_type(out, jnp.int32)


@case
def conversions(g):
    x = jnp.concatenate([g.x * 1e3, jnp.stack([g.x[0] * 1e12, jnp.nan + g.x[0]])])
    return jnp.concatenate([
        x.astype(jnp.int32), g.i, (g.x > 0).astype(jnp.int32), jax.lax.bitcast_convert_type(g.x, jnp.int32),
        g.i.astype(jnp.float32).astype(jnp.int32), g.i.astype(bool).astype(jnp.int32),
    ])  # fmt: skip


# Movement
@case
def movement(g):
    m = g.m
    return jnp.concatenate([
        m.T.ravel(), m[::-1].ravel(), jnp.pad(m, ((1, 0), (0, 2)), constant_values=2.0).ravel(), jnp.tile(m[0], 2),
        jnp.roll(g.x, 2), g.big[1:5:2, ::3].ravel(), jnp.repeat(m[:, 0], 2), jnp.diag(m), jnp.rot90(m).ravel(),
        jnp.stack(jnp.split(g.x, 3)).ravel(), m[jnp.array([2, 0, 2])].ravel(), m.at[1].set(7.0).ravel(),
        m.at[:, 0].add(g.x[:3]).ravel(), jax.lax.pad(m, 3.0, ((-1, 2, 1), (2, -1, 0))).ravel(),
        jnp.broadcast_to(g.x[:1], (4,)), jnp.concatenate([g.x, m[0]])[2:5],
    ])  # fmt: skip


# Reductions
@case
def reductions(g):
    m, t = g.m, g.x > 0
    return jnp.concatenate([m.sum(0), m.prod(1), m.max(0), m.min(1), jnp.stack([t.any(), t.all()]), m.mean()[None],
                            jnp.linalg.norm(m, axis=0), m.std(1), jnp.array([]).sum()[None]])  # fmt: skip


@case
def argmin_and_sort(g):
    m, x = g.m, g.x
    return jnp.concatenate([jnp.argmin(m, 0), jnp.argmax(x)[None], jnp.argmax(g.nan)[None], jnp.sort(x), jnp.argsort(x),
                            jnp.argsort(jnp.round(x), stable=True), jnp.sort(g.i), jnp.median(x)[None]])  # fmt: skip


@case
def sort_not_finite(g):
    return jnp.sort(g.nan)


@case
def cumulative(g):
    return jnp.stack([jnp.cumsum(g.x), jnp.cumprod(g.x), jax.lax.cummax(g.x), jax.lax.cummin(g.x, reverse=True)])


@case
def products(g):
    batch = jnp.einsum("bij,bjk->bik", jnp.stack([g.m, g.m.T]), jnp.stack([g.m, g.m]))
    return jnp.concatenate([(g.m @ g.m).ravel(), g.big @ g.x, jnp.vdot(g.x, g.x)[None], batch.ravel(),
                            jnp.outer(g.x, g.x).ravel(), jnp.cross(g.m[0], g.m[1])])  # fmt: skip


@case
def inner_vmap(g):
    return jax.vmap(lambda row, s: s * jnp.linalg.norm(row) + row)(g.m, g.x[:3])


# Structure
@case
def cond(g):
    two = jax.lax.cond(g.x[0] > 0, lambda x: jnp.sin(x), lambda x: x * x, g.x)
    three = jax.lax.switch(g.i[0], [lambda x: x, lambda x: 2 * x, lambda x: -x], g.x)
    return jnp.stack([two, three, jnp.select([g.x > 1, g.x < -1], [g.x, -g.x], 0.0)])


@case
def loops(g):
    fixed = jax.lax.fori_loop(0, 5, lambda k, x: x * 0.9 + 0.1 * k, g.x)
    last, each = jax.lax.scan(lambda c, y: (c + y, c * y), g.x[0], g.x)
    back, _ = jax.lax.scan(lambda c, y: (0.5 * c + y, None), g.x[0], g.x, reverse=True)
    return jnp.concatenate([fixed, last[None], each, back[None]])


@case
def uniform_loop(g):
    """Loop over pairs of a table, in the same iterations in all lanes; skipped pairs would add nothing."""

    def iterate(carry):
        k, total = carry
        pair = [g.table[k], g.table[k + 1]]
        is_needed = (pair[0] < g.x[0]) | (pair[1] < g.x[0])
        total = compute_where(
            any_lane(is_needed), lambda x: x + sum(jnp.where(t < g.x[0], t, 0.0) for t in pair), total
        )
        return k + 2, total

    return jax.lax.while_loop(lambda carry: carry[0] < 8, iterate, (0, 0 * g.x[0]))[1]


@case
def while_loops(g):
    x, n = jax.lax.while_loop(
        lambda c: (jnp.abs(c[0]) > 0.1) & (c[1] < 40), lambda c: (0.7 * c[0], c[1] + 1), (g.x[0], 0)
    )
    count = jax.lax.fori_loop(0, g.i[1], lambda k, c: c + k, 0)
    return jnp.stack([x, n, count])


@case
def batches_of_while_loops(g):
    def shrink(x):
        return jax.lax.while_loop(
            lambda c: (jnp.abs(c[0]) > 0.1) & (c[1] < 40), lambda c: (0.7 * c[0], c[1] + 1), (x, 0)
        )

    return jnp.concatenate(jax.vmap(shrink)(g.x))


@case
def computed_indices(g):
    k = g.i[0]
    clipped = jnp.clip(k, 0, 5)
    return jnp.concatenate([
        g.x[clipped][None], g.table[clipped][None], g.m[jnp.clip(k, 0, 2)], jax.lax.dynamic_slice(g.x, (k,), (2,)),
        g.x.at[clipped].set(9.0), g.x.at[clipped].add(1.0), g.x.at[k].set(5.0, mode="drop"),
        g.big[jnp.clip(g.i[1], 0, 5), jnp.clip(g.i[2], 0, 5)][None], g.x.at[k].multiply(2.0, mode="clip"),
        jnp.take(g.x, jnp.clip(g.i, 0, 5)), jnp.take(g.table, g.i, mode="clip"), g.x.at[g.i].max(0.5, mode="drop"),
        jax.lax.dynamic_update_slice(g.x, g.m[0], (k,)), g.x.at[g.i].get(mode="fill", fill_value=-1.0),
        jax.lax.dynamic_update_slice(g.m, g.m[:1, :2], (k, g.i[1])).ravel(), g.x[jnp.array([1, -1])],
    ])  # fmt: skip


@case
def interpolation(g):
    return jnp.interp(g.x, jnp.linspace(-2, 2, 8), g.table)


@case
def small_systems(g):
    a, b = make_positive_definite(g.m), make_positive_definite(g.big)
    low = jnp.linalg.cholesky(a)
    return jnp.concatenate([
        low.ravel(), jax.scipy.linalg.cho_solve((low, True), g.x[:3]), jnp.linalg.solve(a, g.m[0]),
        jax.scipy.linalg.solve_triangular(b, g.x, lower=False), jnp.linalg.inv(a).ravel(), jnp.linalg.det(a)[None],
        jnp.linalg.solve(jnp.roll(b, 1, 0), g.x), jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(b), g.x),
    ])  # fmt: skip


@case
def nested_calls(g):
    inner = jax.jit(lambda x: jax.checkpoint(lambda y: jnp.sin(y) * y)(x))
    return jnp.concatenate(
        [inner(g.x), jax.nn.relu(g.x), jax.nn.softplus(g.x), jnp.linalg.norm(jax.jacfwd(inner)(g.x), axis=1)]
    )


@case
def gradient(g):
    return jax.grad(lambda x: jnp.sum(jnp.tanh(g.big @ x) * g.x))(g.x)


def random_bits(key, g):
    """Bits must equal the bits of JAX's own generator exactly."""
    a, b = jax.random.split(jax.random.fold_in(key, g.i[0]))
    c = jax.random.key(g.i[1])
    bits = [jax.random.bits(a, (5,)), jax.random.bits(c, (2,)), jax.random.key_data(jnp.where(g.x[0] > 0, a, b))]
    return jax.lax.bitcast_convert_type(jnp.concatenate(bits), jnp.int32)


def random_numbers(key, g):
    a, b, c = jax.random.split(jax.random.fold_in(key, g.u[0]), 3)
    numbers = [jax.random.uniform(a, (4,)), jax.random.normal(b, (3,)), jax.random.randint(c, (2,), 0, 100)]
    return jnp.concatenate([*numbers, jax.random.bernoulli(a, 0.3)[None], jax.random.permutation(b, g.x)])


RANDOM_CASES = {"random_bits": random_bits, "random_numbers": random_numbers}


def make_inputs():
    rng = np.random.default_rng(0)
    shape = (N_WORLDS, N_DRONES)
    x = rng.uniform(-3, 3, (*shape, 6))
    x[..., 3] = x[..., 1]
    special = rng.choice([np.nan, np.inf, -np.inf, 0.5, -2.0, 0.0], (*shape, 6))
    return Inputs(
        x=np.float32(x),
        m=np.float32(rng.normal(size=(*shape, 3, 3))),
        big=np.float32(rng.normal(size=(*shape, 6, 6))),
        i=rng.integers(-2, 9, (*shape, 4)).astype(np.int32),
        u=rng.integers(0, 2**32, (*shape, 3), dtype=np.uint32),
        table=np.float32(rng.normal(size=8)),
        nan=np.float32(special),
    )


def drone_shapes(g):
    scope_letters = Inputs("d", "d", "d", "d", "d", "shared", "d")
    n_batch_axes = {"d": 2, "shared": 0}
    return jax.tree.map(lambda s, x: jax.ShapeDtypeStruct(x.shape[n_batch_axes[s] :], x.dtype), scope_letters, g)


def case_function(name):
    """Return a case as a function of one drone's arrays, to a flat array."""
    fn = (lambda g: RANDOM_CASES[name](jax.random.key(3), g)) if name in RANDOM_CASES else CASES[name]
    return lambda g: jnp.ravel(fn(g))


def map_over_drones(name):
    """Return a case as a function of the arrays of all drones, to rows. (n_lanes, k)"""
    axes = Inputs(0, 0, 0, 0, 0, None, 0)
    return lambda g: jax.vmap(jax.vmap(case_function(name), (axes,)), (axes,))(g).reshape(N_LANES, -1)


# Library functions of XLA and NumPy differ by a few units in the last place, and a solve multiplies this by the
# condition number of the system, here below 1e2. Everything else is the same arithmetic.
ULP = 2.0**-23
TOLERANCE = {"functions": 16 * ULP, "small_systems": 1e3 * ULP, "large_angles": 8 * ULP, "interpolation": 1e2 * ULP}
TOLERANCE |= dict.fromkeys(["lanes", "fused"], 32 * ULP)  # sums of products that cancel, contracted or not


def assert_agree(actual, expected, name):
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.dtype == expected.dtype
    if expected.dtype.kind != "f":
        np.testing.assert_array_equal(actual, expected, err_msg=name)
        return
    tolerance = TOLERANCE.get(name, 8 * ULP)
    scale = np.max(np.abs(np.where(np.isfinite(expected), expected, 0)))
    np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance * min(scale, 1e2), err_msg=name)
