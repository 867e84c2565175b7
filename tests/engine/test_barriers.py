"""Barriers: a costly value that several others use is computed once, and nothing else changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import rotation
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
