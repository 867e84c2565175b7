"""Barriers: a costly value that several others use is computed once, and nothing else changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import rotation
from crazysim.engine import barriers
from crazysim.engine.barriers import choose, compute_once

N = 64
X = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (N, 4)), jnp.float32)


def chosen(fn, like=X, least=N):
    """Return the primitives that get a barrier."""
    jaxpr = jax.make_jaxpr(fn)(like)
    variables = choose(jaxpr, least)
    return [eqn.primitive.name for eqn in jaxpr.jaxpr.eqns if variables & set(eqn.outvars)]


def quaternion(x):
    """Return products of six sines and cosines, each of which all four components use."""
    return rotation.from_rpy(x[:, :3])


@pytest.mark.parametrize(
    "value, users, primitives",
    [
        (lambda x: jnp.sin(x), lambda y, x: [y], []),
        (lambda x: jnp.sin(x), lambda y, x: [y + 1, y * 2], []),  # 8 multiply-adds once more are not worth it
        (lambda x: jnp.sin(x), lambda y, x: [y + 1, y * 2, y * 3], ["sin"]),
        (lambda x: jnp.sin(x * x), lambda y, x: [y + 1, y * 2], ["sin"]),
        (lambda x: x * 2, lambda y, x: [y + 1, y * 2, y * 3, y * y], []),  # to read it costs as much
        (lambda x: rotation.safe_norm(x), lambda y, x: [x / y], ["custom_jvp_call"]),  # one norm for four quotients
        (lambda x: jax.jit(jnp.sin)(x), lambda y, x: [y + 1, y * 2, y * 3], ["jit"]),
        (lambda x: jax.lax.optimization_barrier(jnp.sin(x)), lambda y, x: [y + 1, y * 2, y * 3], []),
        (lambda x: x @ x.T, lambda y, x: [y + 1, y * 2, y * 3, y * y], []),  # not fused
        (lambda x: jnp.stack(list(jnp.sin(x * x).T)), lambda y, x: [y[k % 4] * x[:, 0] for k in range(9)], ["sin"]),
    ],
)  # fmt: skip
def test_only_a_costly_value_with_several_users_gets_a_barrier(value, users, primitives):
    assert chosen(lambda x: users(value(x), x)) == primitives


def test_a_value_that_all_worlds_share_gets_none():
    def fn(x):
        shared = jnp.sin(jnp.ones(3))
        return [shared * x[:, :3], shared + x[:, :3], shared - x[:, :3]]

    assert chosen(fn) == []
    assert chosen(fn, least=1) == ["sin"]


def test_xla_computes_the_angles_of_a_rotation_once():
    """What the barriers are for; without them, XLA computes sines for each of the four components."""

    def n_sines(fn):
        return jax.jit(fn).lower(X).compile().as_text().count(" sine(")

    def error(x):
        return rotation.multiply(rotation.conjugate(quaternion(x)), X)

    assert n_sines(error) > n_sines(compute_once(error, X, N)) == 1


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit, jax.vmap])
def test_values_stay(transform):
    def fn(x):
        return {"quat": quaternion(jnp.atleast_2d(x)), "unit": x / rotation.safe_norm(x), "same": x}

    like = X[0] if transform is jax.vmap else X
    once = compute_once(fn, like, 1)
    for new, old in zip(*(jax.tree.leaves(transform(f)(X)) for f in (once, fn)), strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-6, atol=1e-7)


def test_gradients_stay():
    grads = [jax.grad(lambda x, f=f: jnp.sum(f(x) ** 3))(X) for f in (quaternion, compute_once(quaternion, X, N))]
    np.testing.assert_allclose(grads[0], grads[1], rtol=1e-5, atol=1e-6)


def test_operands_that_are_returned_are_the_very_same():
    """A step finds what a stage wrote by identity."""
    assert compute_once(lambda x: (x, x + 1), X, N)(X)[0] is X


def tangle(seed, n):
    """Return a function of random operations, each on values of some operations before it."""
    rng = np.random.default_rng(seed)
    kinds = rng.integers(0, 6, n)
    behind = [rng.integers(1, 9, 2) for _ in range(n)]

    def fn(x):
        values = [x, x * 2]
        for kind, (i, j) in zip(kinds, behind, strict=True):
            a, b = values[-min(i, len(values))], values[-min(j, len(values))]
            new = [
                lambda a, b: a * b,
                lambda a, b: jnp.sin(a) + b,
                lambda a, b: a / (2 + b),
                lambda a, b: jnp.sum(a, axis=-1, keepdims=True) * b,
                lambda a, b: jnp.concatenate([a[:, :2], b[:, 2:]], axis=-1),
                lambda a, b: a @ jnp.ones((4, 4), a.dtype) - b,
            ][kind](a, b)
            values.append(new)
        return values[-3:]

    return fn


def chosen_anew(jaxpr, least):
    """Return what ``choose`` returns, with the whole estimate made again for each barrier."""
    nodes = [barriers._node(eqn) for eqn in jaxpr.jaxpr.eqns]
    found = set()
    while True:
        count = {}
        for v in jaxpr.jaxpr.outvars:
            count[v] = count.get(v, 0.0) + v.aval.size
        for node in reversed(nodes):
            n_results = sum(count.get(v, 0.0) if node.fused and v not in found else v.aval.size for v in node.results)
            for v, n in node.operands:
                count[v] = count.get(v, 0.0) + n_results * n
        best, most = None, 0.0
        for v, work in barriers._work(nodes, found).items():
            size = v.aval.size
            saved = (count.get(v, 0.0) - size) * work
            if saved > max(most, barriers.WORTH * size) and size >= least and v not in found:
                best, most = v, saved
        if best is None:
            return found
        found.add(best)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("least", [1, 4 * N])
def test_an_estimate_that_is_kept_up_to_date_chooses_as_one_made_anew(seed, least):
    jaxpr = jax.make_jaxpr(tangle(seed, 60))(X)
    expected = chosen_anew(jaxpr, least)
    assert choose(jaxpr, least) == expected
    assert len(expected) > 5


def test_choosing_takes_time_in_proportion_to_the_length(monkeypatch):
    calls = []
    count = barriers._Estimate._count_results
    monkeypatch.setattr(barriers._Estimate, "_count_results", lambda self, k: (calls.append(k), count(self, k)))

    def visits(n):
        calls.clear()
        jaxpr = jax.make_jaxpr(tangle(0, n))(X)
        assert len(choose(jaxpr, N)) > n / 10
        return len(calls)

    assert visits(400) < 3 * visits(200)
