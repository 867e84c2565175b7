"""Full and masked resets: which leaves return to the default data, and which stay."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import PyTree, Sim, leaf
from crazysim.core.pipeline import insert_fn_before
from crazysim.engine.pytree import scopes
from crazysim.errors import ConfigError
from crazysim.utils import CORE_NDIM_KEY

N_WORLDS, N_DRONES = 3, 2
MASK = np.array([False, True, False])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Counter:
    """A record as code for Crazyflow declares it: by metadata, without the base class of this project."""

    count: jax.Array = dataclasses.field(metadata={CORE_NDIM_KEY: 0})
    """Steps. (n_worlds, 1)"""
    table: jax.Array = dataclasses.field(metadata={CORE_NDIM_KEY: 1})
    """Shared values. (3,)"""
    history: dict = dataclasses.field(metadata={CORE_NDIM_KEY: 2})
    """Arrays of each world. (n_worlds, 2, 2)"""
    note: jax.Array
    """An array without a declaration. (n_worlds,)"""

    @staticmethod
    def create():
        zeros = jnp.zeros((N_WORLDS, 2, 2))
        return Counter(jnp.zeros((N_WORLDS, 1)), jnp.zeros(3), {"one": zeros}, jnp.zeros(N_WORLDS))


class NativeRecord(PyTree):
    count: jax.Array = leaf("world")
    """Steps. (n_worlds, 1)"""


def count(data):
    return data.replace(plugins=jax.tree.map(lambda x: x + 1, data.plugins))


@pytest.fixture(scope="module")
def counting_sim():
    """Return a simulation whose plugins count steps: records of both kinds, a tuple, and arrays."""
    sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES, engine="plain")
    plugins = {"foreign": Counter.create(), "own": NativeRecord(jnp.zeros((N_WORLDS, 1))), "bare": jnp.zeros(2)}
    sim.data = sim.data.replace(plugins=plugins | {"nested": (Counter.create(), jnp.zeros(()))})
    sim.build_default_data()
    insert_fn_before(sim.step_pipeline, "increment_steps", count)
    sim.build_step_fn()
    return sim


def test_a_masked_reset_restores_the_declared_leaves_of_its_worlds_and_a_full_one_all(counting_sim):
    """Crazyflow's metadata declare an axis over worlds as ``leaf`` does; undeclared and shared arrays stay."""
    counting_sim.step(5)
    counting_sim.reset(MASK)
    plugins = jax.device_get(counting_sim.data.plugins)
    expected = np.where(MASK, 0, 5)
    for record in (plugins["foreign"], plugins["nested"][0]):
        np.testing.assert_array_equal(record.count[:, 0], expected)
        np.testing.assert_array_equal(record.history["one"][:, 1, 1], expected)
        np.testing.assert_array_equal(record.table, 5)
        np.testing.assert_array_equal(record.note, 5)
    np.testing.assert_array_equal(plugins["own"].count[:, 0], expected)
    np.testing.assert_array_equal(plugins["bare"], 5)
    counting_sim.reset()
    for x in jax.tree.leaves(counting_sim.data.plugins):
        np.testing.assert_array_equal(x, 0)


def test_a_declared_axis_that_is_not_over_worlds_is_refused(counting_sim):
    data = counting_sim.data
    wrong = dataclasses.replace(Counter.create(), count=jnp.zeros((N_WORLDS + 1, 1)))
    counting_sim.data = data.replace(plugins=data.plugins | {"foreign": wrong})
    with pytest.raises(ConfigError, match=r"data.plugins\['foreign'\].count .* got shape \(4, 1\)"):
        counting_sim.step()
    counting_sim.data = data


def test_metadata_on_a_field_that_holds_a_record_are_refused(counting_sim):
    nested = dataclasses.replace(Counter.create(), count=Counter.create())
    with pytest.raises(ConfigError, match=r"\['foreign'\].count, whose metadata have 'core_ndim', got a Counter"):
        scopes(counting_sim.data.replace(plugins={"foreign": nested}))


def test_a_parameter_of_each_drone_returns_to_the_shared_default_and_stays_of_each_drone():
    sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES)
    mass = sim.data.params.mass
    mass_of_each = jnp.broadcast_to(2 * mass, (N_WORLDS, N_DRONES, 1))
    sim.data = sim.data.replace(params=sim.data.params.replace(mass=mass_of_each))
    sim.reset(MASK)
    np.testing.assert_allclose(np.asarray(sim.data.params.mass)[:, 0, 0], np.where(MASK, 1, 2) * mass)
    sim.reset()
    np.testing.assert_array_equal(sim.data.params.mass, np.broadcast_to(mass, mass_of_each.shape))


def test_the_default_data_outlive_a_flight_that_began_from_them():
    """Law 11: a full reset copies the buffers of the default data, since a rollout may donate those of its data."""
    sim = Sim(control="rotor_vel")
    sim.data = sim.data.replace(plugins={"bare": jnp.ones(2)})
    sim.build_default_data()
    sim.reset()
    sim.rollout(lambda params, data: params, sim.data.controls.rotor_vel, 2)
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(sim.default_data.plugins))
    sim.reset()
    assert float(sim.data.plugins["bare"].sum()) == 2
