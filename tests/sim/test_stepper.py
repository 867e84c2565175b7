"""``Stepper`` keeps data flattened between calls of the compiled step, and creates a record when the data is read."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import shared_sim, trees_equal

from crazysim import Sim
from crazysim.core import functional as F
from crazysim.engine.sharding import world_mesh
from crazysim.sim import stepper as stepper_module
from crazysim.sim.stepper import Stepper


@pytest.fixture
def sim():
    return shared_sim(n_worlds=3, n_drones=2, control="rotor_vel")


@pytest.fixture
def stepper(sim):
    stepper = Stepper(sim.device, None, "auto", strict=True)
    stepper.build(sim.step_pipeline)
    stepper.assign(sim.default_data)
    return stepper


def test_a_step_that_compiles_for_long_is_announced_once(sim, stepper, monkeypatch):
    """The first step of a pipeline compiles, which takes most of a minute with a filter of many states."""
    announced = []

    def announce(work, *_):
        announced.append(work)
        return contextlib.nullcontext()

    monkeypatch.setattr(stepper_module, "announce_if_slow", announce)
    for _ in range(3):
        stepper.advance(1)
    assert announced == ["compiling the step"]
    stepper.build(sim.step_pipeline)
    stepper.advance(1)
    assert len(announced) == 2


COMMAND_LEVELS = [
    {"control": "rotor_vel"},
    {"control": "force_torque"},
    {"control": "attitude"},
    {"control": "state"},
    {"control": "state", "controller": "geometric"},
]


@pytest.mark.parametrize("settings", COMMAND_LEVELS, ids=lambda s: "-".join(s.values()))
def test_a_command_is_staged_in_flattened_data(settings):
    """The data equals that of the pure function, and records that were read before do not change."""
    sim = Sim(3, 2, **settings)
    shape = F.command_shape(sim.data, sim.control)
    command = np.random.default_rng(0).uniform(0.1, 0.4, shape).astype(np.float32)
    send = getattr(F, f"{sim.control.value}_control")
    sim.step(2)
    before, values_before = sim.data, [np.array(x) for x in jax.tree.leaves(sim.data.controls)]
    for _ in range(2):
        getattr(sim, f"{sim.control.value}_control")(command)
    assert trees_equal(sim.data, send(before, command))
    sim.step(3)
    assert trees_equal(sim.data, sim.step_fn(send(before, command), jnp.int32(3)))
    for x, y in zip(jax.tree.leaves(before.controls), values_before, strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_feedforward_is_staged_in_flattened_data():
    sim = Sim(control="state", controller="geometric")
    sim.step()
    before = sim.data
    command, feedforward = np.zeros((1, 1, 16)), np.arange(8.0).reshape(1, 1, 8)
    command[..., 12] = 1.0
    sim.state_control(command, feedforward=feedforward)
    assert trees_equal(sim.data, F.state_control(before, command, feedforward=feedforward))
    np.testing.assert_array_equal(sim.data.controls.state.staged_feedforward, feedforward)


def test_commands_to_flattened_data_are_checked_and_placed():
    for device in jax.devices("cpu")[:2]:
        sim = Sim(2, control="attitude", device=device)
        sim.step()
        for _ in range(2):
            sim.attitude_control(np.full((2, 1, 4), 0.3))
            assert sim.data.controls.attitude.staged_cmd.devices() == {device}
        with pytest.raises(ValueError, match=r"expected \(2, 1, 4\)"):
            sim.attitude_control(np.zeros((1, 1, 4)))
        with pytest.raises(ValueError, match="takes 'attitude' commands"):
            sim.body_rate_control(np.zeros((2, 1, 4)))


def test_a_new_step_takes_over_the_data(stepper, sim):
    stepper.advance(3)
    step = stepper.build(sim.step_pipeline)
    assert stepper.step is step
    stepper.advance(1)
    assert stepper.data.core.steps[0, 0] == 4
    assert step._cache_size() == 1


def test_assigned_data_is_moved_to_the_device_and_marked_as_unsynced(stepper):
    other_device = jax.devices("cpu")[1]
    states = stepper.data.states.replace(pos=jax.device_put(np.ones((3, 2, 3), np.float32), other_device))
    stepper.assign(stepper.data.replace(states=states, core=stepper.data.core.replace(mjx_synced=np.True_)))
    assert stepper.data.states.pos.devices() == {stepper.device}
    assert not stepper.data.core.mjx_synced
    flag = stepper.data.core.mjx_synced
    stepper.assign(stepper.data.replace(states=states))
    assert stepper.data.core.mjx_synced is flag  # known to be false: nothing is transferred


def test_commands_to_data_that_was_sharded_since_are_sharded():
    sim = Sim(2, control="attitude")
    command = np.full((2, 1, 4), 0.3)
    for mesh in (None, world_mesh(jax.devices("cpu")[:2])):
        if mesh is not None:
            sim.shard(mesh)
        sim.step()
        sim.attitude_control(command)
        assert sim.data.controls.attitude.staged_cmd.sharding == sim.data.states.pos.sharding
        np.testing.assert_array_equal(sim.data.controls.attitude.staged_cmd, np.float32(0.3))
