"""The interpreter, against JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import shared_sim

from crazysim import Sim
from crazysim.engine.backends import fused, interpret, lanes, native
from crazysim.engine.ir.program import Segment
from crazysim.engine.lowering.jaxprs import lower_function
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.optimise import optimise
from crazysim.engine.pytree import PyTree, leaf
from crazysim.engine.sharding import Location
from crazysim.engine.stage import stage

SCALAR = jax.ShapeDtypeStruct((), np.float32)


def test_lanes_leave_a_loop_one_by_one():
    def halve(x):
        return jax.lax.while_loop(lambda c: c[0] > 1, lambda c: (0.5 * c[0], c[1] + 1), (x, jnp.float32(0)))

    x = np.float32([0.5, 3.0, 40.0])
    halved, n = interpret.run_block(lower_function(halve, SCALAR), [x], x.shape)
    np.testing.assert_array_equal(halved, [0.5, 0.75, 0.625])
    np.testing.assert_array_equal(n, [0, 2, 6])


def test_outside_of_a_trace_nothing_is_compiled():
    """Results equal those of a traced call, and are on the device of the data."""
    sim = Sim(n_worlds=2, control="rotor_vel", engine="interpret", device="cpu:1")
    sim.rotor_vel_control(np.full((2, 1, 4), 1.7e4))
    result = sim.step_fn(sim.data, jnp.int32(3))
    assert sim.step_fn._cache_size() == 0
    assert result.states.pos.devices() == sim.data.states.pos.devices() == {jax.devices("cpu")[1]}
    inside = jax.jit(lambda data: sim.step_fn(data, jnp.int32(3)))(sim.data)
    for x, y in zip(jax.tree.leaves(result.states), jax.tree.leaves(inside.states), strict=True):
        np.testing.assert_array_equal(x, y)
    assert not np.array_equal(result.states.rotor_vel, sim.data.states.rotor_vel)


# Leaves --------------------------------------------------------------------------------------------------------------


class Draws(PyTree):
    key: jax.Array = leaf("drone", 0)
    """Key of the next draw. ()"""
    drawn: jax.Array = leaf("drone", 0)
    """Last draw. ()"""


@stage("drone")
def draw(data):
    record = data.plugins["own"]
    key, use = jax.random.split(record.key)
    new = record.replace(key=key, drawn=jax.random.uniform(use))
    return data.replace(plugins=data.plugins | {"own": new})


def run_kernel(program, leaves, n_steps):
    return jax.jit(lambda leaves: fused.build(program, Location("cpu"))(leaves, n_steps))(leaves)


@pytest.mark.parametrize(
    "run_steps", [lanes.run_steps, interpret.run_steps, *([run_kernel] if native.compiler() else [])]
)
def test_a_stage_may_write_random_keys(run_steps):
    sim = shared_sim(n_worlds=3, n_drones=2, control="rotor_vel")
    draws = Draws(jax.random.split(jax.random.key(5), (3, 2)), jnp.zeros((3, 2)))
    data = sim.data.replace(plugins={"own": draws})
    program = optimise(lower_stages([draw], data))
    assert isinstance(program.segments[0], Segment)
    written, _ = run_steps(program, jax.tree.leaves(data), 2)
    expected = draw(draw(data)).plugins["own"]
    result = dict(zip((program.leaves[i].name.split(".")[-1] for i in program.written_leaves), written, strict=True))
    assert result["key"].dtype == expected.key.dtype
    np.testing.assert_array_equal(result["drawn"], expected.drawn)
    np.testing.assert_array_equal(jax.random.key_data(result["key"]), jax.random.key_data(expected.key))
