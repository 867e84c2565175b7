"""Worlds distributed over two devices: the sharding of each leaf, and the same results as on one device."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from crazysim import ConfigError, Sim
from crazysim.core import functional as F
from crazysim.engine.pytree import scopes
from crazysim.engine.sharding import WORLD_AXIS, shard, shardings_of, world_mesh

SETTINGS = {"n_worlds": 4, "n_drones": 2, "control": "attitude"}
COMMAND = np.broadcast_to([0.05, -0.02, 0.1, 0.45], (4, 2, 4)).astype(np.float32)


COLLECTIVES = ("all-reduce(", "all-gather(", "all-to-all(", "collective-permute(")


@pytest.fixture(scope="module")
def mesh():
    devices = jax.devices("cpu")
    assert len(devices) >= 2, "tests/conftest.py requests four host devices"
    return world_mesh(devices[:2])


@pytest.fixture
def sharded_sim(mesh):
    sim = Sim(**SETTINGS, mesh=mesh)
    sim.data = with_states(sim.data, pos=[0, 0, 1.0])
    return sim


@pytest.fixture(scope="module")
def single_sim():
    sim = Sim(**SETTINGS)
    sim.data = with_states(sim.data, pos=[0, 0, 1.0])
    return sim


def assert_sharded(data, mesh):
    for scope, x in zip(jax.tree.leaves(scopes(data)), jax.tree.leaves(data), strict=True):
        assert set(x.sharding.device_set) == set(mesh.devices.flat)
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            continue
        local = x.addressable_shards[0].data.shape
        assert local == ((2, *x.shape[1:]) if scope in ("drone", "world") else x.shape)


def test_law_02_leaves_go_where_their_scope_says(sharded_sim, single_sim, mesh):
    assert_sharded(sharded_sim.data, mesh)
    assert_sharded(sharded_sim.default_data, mesh)
    assert_sharded(shard(single_sim.data, mesh), mesh)
    randomised = single_sim.data.params.replace(mass=jnp.full((4, 2, 1), 0.04))
    assert_sharded(shard(single_sim.data.replace(params=randomised), mesh), mesh)


def test_steps_commands_and_resets_keep_the_sharding_and_give_the_same_numbers(sharded_sim, single_sim, mesh):
    """XLA may fuse the same arithmetic differently, which leaves rounding of 1e-6 m after 0.1 s."""
    for sim in (sharded_sim, single_sim):
        sim.attitude_control(COMMAND)
        sim.step(30)
        sim.reset(np.array([True, False, False, True]))
        sim.attitude_control(COMMAND)
        sim.step(20)
    assert_sharded(sharded_sim.data, mesh)
    for name in ("pos", "quat", "vel"):
        np.testing.assert_allclose(
            getattr(sharded_sim.data.states, name), getattr(single_sim.data.states, name), rtol=1e-5, atol=1e-6
        )
    np.testing.assert_array_equal(sharded_sim.data.core.steps[:, 0], [20, 50, 50, 20])


def test_a_step_needs_no_communication_between_devices(sharded_sim):
    """Worlds are independent, so the compiled step holds no collective operation."""
    step = sharded_sim.build_step_fn()
    text = step.lower(sharded_sim.data, 2).compile().as_text()
    assert not [word for word in COLLECTIVES if word in text]
    # A program that does combine worlds is recognised.
    text = jax.jit(jnp.sum).lower(sharded_sim.data.states.pos).compile().as_text()
    assert [word for word in COLLECTIVES if word in text]


def test_a_step_built_for_one_device_takes_data_of_several(single_sim, mesh):
    step, reset = single_sim.build_step_fn(), single_sim.build_reset_fn()
    data = F.attitude_control(single_sim.data, COMMAND)
    sharded_data = shard(data, mesh)
    for n_steps in (6, jnp.int32(6)):
        after, expected = step(sharded_data, n_steps), step(data, n_steps)
        assert_sharded(after, mesh)
        for name in ("pos", "quat", "vel"):
            np.testing.assert_allclose(
                getattr(after.states, name), getattr(expected.states, name), rtol=1e-5, atol=1e-6
            )
    assert step.plan(sharded_data).engine == step.plan(data).engine
    text = step.lower(sharded_data, 2).compile().as_text()
    assert not [word for word in COLLECTIVES if word in text]
    assert_sharded(reset(after, sharded_data), mesh)
    again = step(step(sharded_data, jnp.int32(1)), jnp.int32(5))  # the result has the sharding of the data
    np.testing.assert_allclose(again.states.pos, after.states.pos, rtol=1e-5, atol=1e-6)


def test_the_mesh_is_that_of_the_data_whatever_its_axes_are_called(single_sim):
    """Users of plain JAX name their own axes, and may have more than one."""
    mesh = jax.make_mesh((2, 1), ("batch", "model"), axis_types=(AxisType.Auto,) * 2, devices=jax.devices("cpu")[:2])
    data = F.attitude_control(single_sim.data, COMMAND)
    split, shared = PartitionSpec("batch"), PartitionSpec()
    partition_specs = jax.tree.map(lambda s: split if s in ("drone", "world") else shared, scopes(data))
    sharded_data = jax.device_put(data, jax.tree.map(lambda spec: NamedSharding(mesh, spec), partition_specs))
    step = single_sim.build_step_fn()
    after = step(sharded_data, jnp.int32(6))
    assert after.states.pos.addressable_shards[0].data.shape == (2, 2, 3)
    np.testing.assert_allclose(after.states.pos, step(data, jnp.int32(6)).states.pos, rtol=1e-5, atol=1e-6)


def test_sharded_data_gives_the_same_numbers_inside_jit(single_sim, mesh):
    """Inside ``jit`` the step cannot read the devices of the data."""
    step = single_sim.build_step_fn()
    data = F.attitude_control(single_sim.data, COMMAND)
    run = jax.jit(lambda d: step(d, 6).states.pos)
    np.testing.assert_allclose(run(shard(data, mesh)), run(data), rtol=1e-5, atol=1e-6)


def test_a_simulation_can_be_sharded_after_steps(single_sim, mesh):
    sim = Sim(**SETTINGS)
    sim.step(2)
    steps = np.asarray(sim.data.core.steps)
    assert_sharded(sim.shard(mesh), mesh)
    assert_sharded(sim.default_data, mesh)
    np.testing.assert_array_equal(sim.data.core.steps, steps)
    sim.step(2)
    assert_sharded(sim.data, mesh)


def test_law_09_worlds_that_cannot_be_split_evenly_are_refused(mesh):
    with pytest.raises(ConfigError, match="3 worlds cannot be split evenly over 2 devices"):
        Sim(n_worlds=3, mesh=mesh)


def test_law_09_a_mesh_with_another_axis_is_refused(single_sim):
    other = jax.make_mesh((2,), ("batch",), axis_types=(AxisType.Auto,), devices=jax.devices("cpu")[:2])
    with pytest.raises(ConfigError, match=f"an axis '{WORLD_AXIS}', got axes \\('batch',\\)"):
        shardings_of(single_sim.data, other)
    with pytest.raises(ConfigError, match="batch"):
        Sim(**SETTINGS, mesh=other)


def test_a_second_device_holds_all_of_a_simulation():
    sim = Sim(n_worlds=2, control="rotor_vel", device="cpu:1")
    sim.rotor_vel_control(np.full((2, 1, 4), 1e4))
    sim.step(2)
    sim.reset(np.array([True, False]))
    second = jax.devices("cpu")[1]
    assert all(x.devices() == {second} for x in jax.tree.leaves(sim.data))
