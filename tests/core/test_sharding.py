"""Worlds distributed over two devices: the sharding of each leaf, and the same results as on one device."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from crazysim import ConfigError, Sim
from crazysim.core import functional as F
from crazysim.core.pipeline import append_fn
from crazysim.core.sharding import WORLD_AXIS, shard, shardings_of, world_mesh
from crazysim.pytree import scopes

SETTINGS = {"n_worlds": 4, "n_drones": 2, "control": "attitude"}
COMMAND = np.broadcast_to([0.05, -0.02, 0.1, 0.45], (4, 2, 4)).astype(np.float32)


COLLECTIVES = ("all-reduce(", "all-gather(", "all-to-all(", "collective-permute(")


@pytest.fixture(scope="module")
def mesh():
    devices = jax.devices("cpu")
    assert len(devices) >= 2, "tests/conftest.py requests four host devices"
    return world_mesh(devices[:2])


@pytest.fixture
def spread(mesh):
    sim = Sim(**SETTINGS, mesh=mesh)
    sim.data = with_states(sim.data, pos=[0, 0, 1.0])
    return sim


@pytest.fixture(scope="module")
def whole():
    sim = Sim(**SETTINGS)
    sim.data = with_states(sim.data, pos=[0, 0, 1.0])
    return sim


def assert_spread(data, mesh):
    """Assert that each device holds its half of the worlds and a copy of every shared leaf."""
    for scope, x in zip(jax.tree.leaves(scopes(data)), jax.tree.leaves(data), strict=True):
        assert set(x.sharding.device_set) == set(mesh.devices.flat)
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            continue
        local = x.addressable_shards[0].data.shape
        assert local == ((2, *x.shape[1:]) if scope in ("drone", "world") else x.shape)


def test_law_02_leaves_go_where_their_scope_says(spread, whole, mesh):
    assert_spread(spread.data, mesh)
    assert_spread(spread.default_data, mesh)
    assert_spread(shard(whole.data, mesh), mesh)
    randomised = whole.data.params.replace(mass=jnp.full((4, 2, 1), 0.04))
    assert_spread(shard(whole.data.replace(params=randomised), mesh), mesh)


def test_steps_commands_and_resets_keep_it_spread_and_give_the_same_numbers(spread, whole, mesh):
    """The same arithmetic on each half: equal to what fusing differently rounds, 1e-6 of a metre after 0.1 s."""
    for sim in (spread, whole):
        sim.attitude_control(COMMAND)
        sim.step(30)
        sim.reset(np.array([True, False, False, True]))
        sim.attitude_control(COMMAND)
        sim.step(20)
    assert_spread(spread.data, mesh)
    for name in ("pos", "quat", "vel"):
        np.testing.assert_allclose(
            getattr(spread.data.states, name), getattr(whole.data.states, name), rtol=1e-5, atol=1e-6
        )
    np.testing.assert_array_equal(spread.data.core.steps[:, 0], [20, 50, 50, 20])


def test_the_functional_api_keeps_it_spread(spread, mesh):
    step, reset = spread.build_step_fn(), spread.build_reset_fn()

    def rollout(data, command):
        return step(F.attitude_control(data, command), 3)

    out = jax.jit(rollout)(spread.data, jnp.asarray(COMMAND))
    assert_spread(F.attitude_control(spread.data, COMMAND), mesh)
    assert_spread(reset(out, spread.default_data, jnp.array([True, True, False, False])), mesh)
    assert out.states.pos.addressable_shards[0].data.shape == (2, 2, 3)


def test_law_06_sharded_steps_trace_once(spread):
    """Law 6 with a mesh: commands, steps, resets and edits trace no second program."""
    traces = []

    def count(data):
        traces.append(None)
        return data

    append_fn(spread.step_pipeline, count)
    spread.build_step_fn()
    for k in range(3):
        spread.attitude_control(COMMAND if k else COMMAND.tolist())
        spread.step(k + 1)
        spread.reset(np.array([True, False, False, False]))
        spread.data = with_states(spread.data, pos=[0, 0, 1.0])
    assert len(traces) == 1


def test_a_step_needs_no_communication_between_devices(spread):
    """Worlds are independent, so the compiled step holds no collective operation."""
    step = spread.build_step_fn()
    text = step.lower(spread.data, 2).compile().as_text()
    assert not [word for word in COLLECTIVES if word in text]
    # A program that does combine worlds is recognised.
    text = jax.jit(jnp.sum).lower(spread.data.states.pos).compile().as_text()
    assert [word for word in COLLECTIVES if word in text]


def test_a_step_built_for_one_device_takes_data_of_several(whole, mesh):
    """The pattern of the functional guide: build on one device, shard the data, step it; each device its own worlds."""
    step, reset = whole.build_step_fn(), whole.build_reset_fn()
    data = F.attitude_control(whole.data, COMMAND)
    spread = shard(data, mesh)
    for n_steps in (6, jnp.int32(6)):
        after, expected = step(spread, n_steps), step(data, n_steps)
        assert_spread(after, mesh)
        for name in ("pos", "quat", "vel"):
            np.testing.assert_allclose(
                getattr(after.states, name), getattr(expected.states, name), rtol=1e-5, atol=1e-6
            )
    assert step.plan(spread).engine == step.plan(data).engine
    text = step.lower(spread, 2).compile().as_text()
    assert not [word for word in COLLECTIVES if word in text]
    assert_spread(reset(after, spread), mesh)
    again = step(step(spread, jnp.int32(1)), jnp.int32(5))  # what a step returns is where it was
    np.testing.assert_allclose(again.states.pos, after.states.pos, rtol=1e-5, atol=1e-6)


def test_the_mesh_is_that_of_the_data_whatever_its_axes_are_called(whole):
    """Users of plain JAX name their own axes, and may have more than one."""
    mesh = jax.make_mesh((2, 1), ("batch", "model"), axis_types=(AxisType.Auto,) * 2, devices=jax.devices("cpu")[:2])
    data = F.attitude_control(whole.data, COMMAND)
    split, shared = PartitionSpec("batch"), PartitionSpec()
    kinds = jax.tree.map(lambda s: split if s in ("drone", "world") else shared, scopes(data))
    spread = jax.device_put(data, jax.tree.map(lambda spec: NamedSharding(mesh, spec), kinds))
    step = whole.build_step_fn()
    after = step(spread, jnp.int32(6))
    assert after.states.pos.addressable_shards[0].data.shape == (2, 2, 3)
    np.testing.assert_allclose(after.states.pos, step(data, jnp.int32(6)).states.pos, rtol=1e-5, atol=1e-6)


def test_data_copied_to_each_device_is_stepped_on_each(whole, mesh):
    """A sharding that splits no worlds is legal, and every device computes all of them."""
    data = F.attitude_control(whole.data, COMMAND)
    copied = jax.device_put(data, NamedSharding(mesh, PartitionSpec()))
    step = whole.build_step_fn()
    after = step(copied, jnp.int32(6))
    assert after.states.pos.addressable_shards[1].data.shape == (4, 2, 3)
    np.testing.assert_allclose(after.states.pos, step(data, jnp.int32(6)).states.pos, rtol=1e-5, atol=1e-6)


def test_sharded_data_gives_the_same_numbers_inside_jit(whole, mesh):
    """There the devices of the data are unknown to the step: the numbers are the same all the same."""
    step = whole.build_step_fn()
    data = F.attitude_control(whole.data, COMMAND)
    run = jax.jit(lambda d: step(d, 6).states.pos)
    np.testing.assert_allclose(run(shard(data, mesh)), run(data), rtol=1e-5, atol=1e-6)


def test_a_simulation_can_be_sharded_after_steps(whole, mesh):
    sim = Sim(**SETTINGS)
    sim.step(2)
    steps = np.asarray(sim.data.core.steps)
    assert_spread(sim.shard(mesh), mesh)
    assert_spread(sim.default_data, mesh)
    np.testing.assert_array_equal(sim.data.core.steps, steps)
    sim.step(2)
    assert_spread(sim.data, mesh)


def test_law_09_worlds_that_cannot_be_split_evenly_are_refused(mesh):
    with pytest.raises(ConfigError, match="3 worlds cannot be split evenly over 2 devices"):
        Sim(n_worlds=3, mesh=mesh)


def test_law_09_a_mesh_with_another_axis_is_refused(whole):
    other = jax.make_mesh((2,), ("batch",), axis_types=(AxisType.Auto,), devices=jax.devices("cpu")[:2])
    with pytest.raises(ConfigError, match=f"an axis '{WORLD_AXIS}', got axes \\('batch',\\)"):
        shardings_of(whole.data, other)
    with pytest.raises(ConfigError, match="batch"):
        Sim(**SETTINGS, mesh=other)


def test_a_second_device_holds_all_of_a_simulation():
    sim = Sim(n_worlds=2, control="rotor_vel", device="cpu:1")
    sim.rotor_vel_control(np.full((2, 1, 4), 1e4))
    sim.step(2)
    sim.reset(np.array([True, False]))
    second = jax.devices("cpu")[1]
    assert all(x.devices() == {second} for x in jax.tree.leaves(sim.data))
