"""Functions of one world as functions of all worlds."""

import jax
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.engine.pytree import PyTree, leaf
from crazysim.engine.stage import vmap_worlds


class Numbers(PyTree):
    of_drone: jax.Array = leaf("drone", 1)
    of_world: jax.Array = leaf("world", 1)
    batched: jax.Array = leaf("batch")
    shared: jax.Array = leaf("shared", 1)
    opaque: jax.Array = leaf("opaque")


def numbers(n_worlds, n_drones):
    rng = np.random.default_rng(0)
    shapes = ((n_worlds, n_drones, 2), (n_worlds, 1, 2), (n_worlds, 5), (2,), (n_worlds,))
    return Numbers(*(np.float32(rng.normal(size=shape)) for shape in shapes))


@pytest.mark.parametrize(("n_worlds", "n_drones"), [(1, 1), (2, 2), (2, 3), (3, 2)])
def test_the_function_is_applied_to_every_world(n_worlds, n_drones):
    """Law 2: axes are the declared ones, also where worlds and drones are equally many."""
    record, factor = numbers(n_worlds, n_drones), np.arange(1, n_worlds + 1, dtype=np.float32)

    def fn(world, factor):
        assert [x.shape for x in jax.tree.leaves(world)] == [(n_drones, 2), (2,), (5,), (2,), (n_worlds,)]
        assert factor.shape == ()
        new = world.replace(
            of_drone=factor * world.of_drone + world.of_world,
            of_world=world.of_world + world.shared,
            batched=world.batched[::-1],
        )
        return new, world.of_drone.sum(), world.of_world

    after, total, ours = vmap_worlds(fn)(record, factor)
    np.testing.assert_allclose(after.of_drone, factor[:, None, None] * record.of_drone + record.of_world, rtol=1e-6)
    np.testing.assert_allclose(after.of_world, record.of_world + record.shared, rtol=1e-6)
    np.testing.assert_array_equal(after.batched, record.batched[:, ::-1])
    np.testing.assert_allclose(total, record.of_drone.sum(axis=(1, 2)), rtol=1e-5)
    np.testing.assert_array_equal(ours, record.of_world[:, 0])
    assert after.shared is record.shared
    assert after.opaque is record.opaque


@pytest.mark.parametrize("name", ["shared", "opaque"])
def test_leaves_that_all_worlds_share_cannot_be_changed(name):
    def greedy(world):
        return world.replace(**{name: getattr(world, name) + 1})

    with pytest.raises(ConfigError, match=f"'greedy' is written for one world and changes {name}, which all worlds"):
        vmap_worlds(greedy)(numbers(2, 2))
