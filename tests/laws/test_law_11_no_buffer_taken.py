"""Law 11: no buffer is taken from a caller; arguments stay readable and unchanged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_command, leaf_on_host, repeat_command

from crazysim import Sim
from crazysim.core import functional as F


@pytest.fixture(scope="module")
def sim():
    return Sim(n_worlds=2, n_drones=2)


def snapshot(tree):
    """Return host copies of all leaves, which no device can change any more."""
    return [np.array(leaf_on_host(x)) for x in jax.tree.leaves(tree)]


def assert_unchanged(tree, before):
    leaves = jax.tree.leaves(tree)
    assert len(leaves) == len(before) > 20
    for x, host_copy in zip(leaves, before, strict=True):
        assert not x.is_deleted()
        np.testing.assert_array_equal(leaf_on_host(x), host_copy)


@pytest.mark.parametrize(
    "operation",
    [
        lambda sim: sim.step(),
        lambda sim: sim.step(20),
        lambda sim: sim.reset(),
        lambda sim: sim.reset(np.array([True, False])),
        lambda sim: sim.build_step_fn()(sim.data, 3),
        lambda sim: sim.build_step_fn()(sim.data, jnp.int32(3)),
        lambda sim: sim.build_reset_fn()(sim.data, sim.default_data),
        lambda sim: jax.jit(F.attitude_control)(sim.data, jnp.zeros((2, 2, 4))),
        lambda sim: sim.contacts(),
    ],
    ids=["step", "steps", "reset", "masked-reset", "pure-steps", "pure-step", "pure-reset", "command", "contacts"],
)
def test_held_data_stays_readable_and_unchanged(sim, operation):
    sim.attitude_control(repeat_command(sim.data, hover_command(sim.data)))
    sim.step(5)
    data, default = sim.data, sim.default_data
    copies, default_copies = snapshot(data), snapshot(default)
    operation(sim)
    assert_unchanged(data, copies)
    assert_unchanged(default, default_copies)
    assert sim.default_data is default


def test_a_command_array_stays_its_callers(sim):
    """The simulation keeps no view of host memory, so later changes of the array have no effect."""
    memory = np.zeros(128, np.uint8)
    start = -memory.ctypes.data % 64  # JAX takes over memory with this alignment
    command = memory[start : start + 64].view(np.float32).reshape(2, 2, 4)
    on_device = jnp.full((2, 2, 4), 0.25)
    sim.attitude_control(on_device)
    sim.step()
    np.testing.assert_array_equal(on_device, 0.25)
    sim.attitude_control(command)
    command[:] = 9.0
    np.testing.assert_array_equal(sim.data.controls.attitude.staged_cmd, 0.0)
    sim.step()
    command[:] = 0.5
    sim.attitude_control(command)
    command[:] = 9.0
    sim.step()
    np.testing.assert_array_equal(sim.data.controls.attitude.staged_cmd, 0.5)


def test_nothing_is_donated_in_the_compiled_programs(sim):
    """On CPU a donated buffer may survive, so the compiled programs are examined."""
    step, reset = sim.build_step_fn(), sim.build_reset_fn()
    programs = [
        step.lower(sim.data, jnp.int32(1)),
        step.lower(sim.data, 2),
        reset.lower(sim.data, sim.default_data, jnp.ones(2, bool)),
    ]
    for program in programs:
        text = program.as_text()
        assert "func.func public @main" in text
        for mark in ("donated", "tf.aliasing_output", "jax.buffer_donor"):
            assert mark not in text
    # Positive control: a program that does donate a buffer has one of the marks.
    donating = jax.jit(lambda x: x + 1, donate_argnums=0).lower(jnp.ones(3)).as_text()
    assert "tf.aliasing_output" in donating or "jax.buffer_donor" in donating
