"""Law 6: ten calls, one trace, for any kind of input array."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep

from crazysim import Sim
from crazysim.sim import pipeline


@pytest.fixture(scope="module")
def traced_sim():
    sim, traces = Sim(2, 2), []

    def count(data):
        traces.append(1)
        return data

    pipeline.append_fn(sim.step_pipeline, count)
    sim.build_step_fn()
    return sim, traces


def n_programs(fn):
    """Return the number of compiled programs of a jitted function.

    JAX counts those that it can call without Python, so that after thousands of programs the number may be too small.
    """
    return fn._cache_size()


COMMAND = [[[0.0, 0.0, 0.0, 1.0]] * 2] * 2
INPUTS = {
    "float32": np.asarray(COMMAND, np.float32),
    "float64": np.asarray(COMMAND, np.float64),
    "int": np.asarray(COMMAND, np.int64),
    "list": COMMAND,
    "tuple": tuple(map(tuple, COMMAND)),
    "jax": jnp.asarray(COMMAND),
    "jax int": jnp.asarray(COMMAND, jnp.int32),
    "jax half": jnp.asarray(COMMAND, jnp.bfloat16),
    "not contiguous": np.asarray(COMMAND, np.float64)[::-1, :, ::-1][..., ::-1],
    "committed": jax.device_put(np.asarray(COMMAND, np.float32), jax.devices()[0]),
}


def test_commands_resets_and_edits_between_steps_one_trace(traced_sim):
    sim, traces = traced_sim
    sim.reset()
    for i, (name, command) in enumerate(INPUTS.items()):
        sim.step(2)
        sim.attitude_control(command)
        staged = sim.data.controls.attitude.staged_cmd
        np.testing.assert_array_equal(staged, np.asarray(COMMAND, np.float32), err_msg=name)
        assert staged.dtype == sim.data.states.pos.dtype
        if i % 4 == 1:
            sim.reset(np.asarray([True, False]))
        if i % 4 == 2:
            sim.data = sim.data.replace(states=sim.data.states.replace(vel=np.zeros((2, 2, 3))))
            sim.attitude_control(command)
        sim.step()
        assert (len(traces), n_programs(sim.step_fn)) == (1, 1), name


def test_any_number_of_steps_any_edit_any_reset_one_program(traced_sim):
    sim, traces = traced_sim
    program, n_steps = sim.step_fn, 0
    sim.reset()

    def check(n, change):
        nonlocal n_steps
        sim.step(n)
        n_steps += int(n)
        assert (len(traces), n_programs(program)) == (1, 1), change
        assert int(sim.data.core.steps[0, 0]) == n_steps, change

    for n in (1, 5, 7, np.int64(3)):
        check(n, f"step({n!r})")
    states = sim.data.states
    edits = {
        "a new array of JAX": {"pos": jnp.ones_like(states.pos)},
        "NumPy": {"vel": np.zeros(states.vel.shape, np.float32)},
        "an update": {"quat": states.quat.at[0].set(jnp.asarray([0.0, 0.0, 0.0, 1.0]))},
        "a result of jit": {"force": jax.jit(lambda x: x + 0.0)(jnp.zeros(states.force.shape))},
        "another device": {"torque": jax.device_put(np.zeros(states.torque.shape, np.float32), jax.devices()[1])},
    }
    for change, changes in edits.items():
        sim.data = sim.data.replace(states=sim.data.states.replace(**changes))
        check(2, change)
    sim.data = sim.data.replace(core=sim.data.core.replace(steps=sim.data.core.steps + jnp.int32(0)))
    check(1, "another step count")
    sim.seed(7)
    check(1, "another seed")
    sim.build_default_data()
    sim.reset(np.array([False, True]))
    check(1, "a masked reset")
    sim.reset(jnp.asarray([False, True]))
    check(1, "a masked reset from the device")
    sim.reset()
    n_steps = int(sim.data.core.steps[0, 0])
    check(1, "a reset")


def test_resets_have_one_program_each_way(traced_sim):
    sim, _ = traced_sim
    traces = []
    sim.reset_pipeline["count"] = lambda data, default_data, mask: (traces.append(1), data)[1]
    for mask in ([True, False], [False, False], [True, True]):
        sim.reset(np.array(mask))
        sim.step()
        sim.reset(jnp.asarray(mask))
        sim.reset(mask)
        sim.reset()
    assert len(traces) == 2  # one with a mask, one without
    assert n_programs(sim.reset_fn) <= 2
    del sim.reset_pipeline["count"]


def test_a_rollout_in_jit_traces_once(traced_sim):
    sim, traces = traced_sim
    step = sim.build_step_fn()
    rollout = jax.jit(lambda data: step(data, 4))
    data, before = sim.data, len(traces)
    for _ in range(10):
        data = rollout(data)
    assert len(traces) - before == 1
    assert n_programs(rollout) <= 1


@pytest.mark.parametrize("name", [name for name in sweep.CASES if name not in [*sweep.STEPS][1:]])
def test_simulations_made_alike_have_data_of_one_structure(name):
    one, other = sweep.CASES[name](), sweep.CASES[name]()
    assert jax.tree.structure(one.data) == jax.tree.structure(other.data)
    assert jax.tree.structure(one.default_data) == jax.tree.structure(other.default_data)
