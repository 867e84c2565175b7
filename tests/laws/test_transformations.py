"""Every transformation of JAX can be traced through every engine.

Nothing is compiled: where JAX lacks a rule or has changed one, tracing the derivative fails. The values are compared
elsewhere.
"""

import functools

import jax
import jax.numpy as jnp
import pytest

from crazysim import Sim
from crazysim.engine import Step


def along(fn, x):
    return jax.jvp(fn, (x,), (jnp.ones_like(x),))[1]


TRANSFORMATIONS = {
    "grad": jax.grad,
    "jvp": lambda fn: lambda x: along(fn, x),
    "grad of jvp": lambda fn: jax.grad(lambda x: along(fn, x)),
    "jvp of grad": lambda fn: lambda x: along(jax.grad(fn), x),
    "vmap of grad": lambda fn: lambda x: jax.vmap(jax.grad(fn))(jnp.stack([x, x])),
    "grad of vmap": lambda fn: jax.grad(lambda x: jnp.sum(jax.vmap(fn)(jnp.stack([x, 2 * x])))),
    "grad of checkpoint": lambda fn: jax.grad(jax.checkpoint(fn)),
}
ENGINES = ("plain", "lanes")
"""Engines whose steps JAX differentiates itself. ``fused`` without a kernel of a derivative takes that of ``lanes``."""


@functools.cache
def build_sim():
    return Sim(n_drones=2, control="rotor_vel")


def assert_can_be_traced(sim, transformation, engine, field="vel"):
    step, x = Step(sim.step_pipeline, engine), getattr(sim.data.states, field)

    def loss(x):
        after = step(sim.data.replace(states=sim.data.states.replace(**{field: x})), 2).states
        return jnp.sum(after.pos**2) + jnp.sum(after.ang_vel**2)

    result = jax.eval_shape(TRANSFORMATIONS[transformation](loss), x)
    assert result.shape in (x.shape, (2, *x.shape), ())
    assert result.dtype == x.dtype


@pytest.mark.parametrize("transformation", TRANSFORMATIONS)
def test_a_step_can_be_differentiated(transformation):
    for engine in ENGINES:
        assert_can_be_traced(build_sim(), transformation, engine)
