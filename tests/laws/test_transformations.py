"""Every transformation of JAX can be traced through every engine, with any plugins and objects.

Nothing is compiled: where JAX lacks a rule or has changed one, tracing the derivative fails. The values are compared
elsewhere.
"""

import functools

import jax
import jax.numpy as jnp
import pytest
import sweep
from hypothesis import example, given, settings
from hypothesis import strategies as st

from crazysim import ContactResponse, DroneCollisions, RangeFinder, Sim
from crazysim.engine import Step

PLUGINS = {
    **{effect.__name__: lambda effect=effect: effect(**sweep.EFFECTS[effect]) for effect in sweep.EFFECTS},
    "ContactResponse": ContactResponse,
    "DroneCollisions": DroneCollisions,
    "RangeFinder": RangeFinder,
}
OBJECTS = {
    "wall": {"pos": [1.0, 0.0, 0.0], "length": 4.0, "height": 3.0, "thickness": 0.1},
    "landing_pad": {"pos": [0.0, 0.0, 0.5]},
}


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
def build_sim(names=(), objects=()):
    sim = Sim(n_drones=2, control="rotor_vel")
    for name in objects:
        sim.scene.add(name, **OBJECTS[name])
    for name in names:
        sim.add(PLUGINS[name]())
    return sim


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


@pytest.mark.slow("the test above traces every transformation through every engine, without plugins")
@given(
    names=st.lists(st.sampled_from(sorted(PLUGINS)), max_size=3, unique=True),
    objects=st.lists(st.sampled_from(sorted(OBJECTS)), max_size=2, unique=True),
    field=st.sampled_from(["pos", "vel", "quat", "ang_vel", "rotor_vel"]),
    transformation=st.sampled_from(sorted(TRANSFORMATIONS)),
    engine=st.sampled_from(ENGINES),
)
@example(["ContactResponse"], ["wall"], "vel", "grad", "lanes")
@settings(max_examples=settings.default.max_examples // 30)
def test_a_step_with_any_plugins_can_be_differentiated(names, objects, field, transformation, engine):
    assert_can_be_traced(build_sim(tuple(names), tuple(objects)), transformation, engine, field)
