"""Law 10: same seed, same numbers, independent of the other worlds and of the number of devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import leaf_on_host

from crazysim import Sim
from crazysim.core.pipeline import append_fn
from crazysim.core.random import drone_keys, world_keys
from crazysim.engine.pytree import select_worlds
from crazysim.engine.sharding import world_mesh


def randomise_mass(data, default_data, mask=None):
    """Draw the mass of every drone between 30 and 60 g in the worlds that are reset."""
    draw = jax.vmap(jax.vmap(lambda key: jax.random.uniform(key, (1,), minval=0.03, maxval=0.06)))
    mass = select_worlds(mask, draw(drone_keys(data, "mass")), data.params.mass)
    return data.replace(params=data.params.replace(mass=mass))


def make_sim(n_worlds, seed=7, mesh=None):
    sim = Sim(n_worlds=n_worlds, n_drones=3, rng_key=seed, mesh=mesh)
    sim.data = sim.data.replace(params=sim.data.params.replace(mass=jnp.full((n_worlds, 3, 1), 0.0434)))
    sim.build_default_data()
    append_fn(sim.reset_pipeline, randomise_mass)
    sim.build_reset_fn()
    return sim


@pytest.fixture(scope="module")
def four_world_sim():
    return make_sim(4)


def masses_after_resets(sim, *masks, seed=7):
    sim.data = sim.default_data
    sim.seed(seed)
    for mask in masks:
        sim.reset(None if mask is None else np.array(mask))
    return np.asarray(sim.data.params.mass[..., 0])


def test_a_world_draws_the_same_with_other_numbers_of_worlds(four_world_sim):
    two_world_sim = make_sim(2)
    for n_resets in (1, 2, 3):
        masks = [None] * n_resets
        np.testing.assert_array_equal(
            masses_after_resets(two_world_sim, *masks), masses_after_resets(four_world_sim, *masks)[:2]
        )


def test_a_world_draws_the_same_whichever_other_worlds_are_reset(four_world_sim):
    third_reset = masses_after_resets(four_world_sim, [False, False, True, False])
    others_reset = masses_after_resets(four_world_sim, [True, False, True, True])
    all_worlds = masses_after_resets(four_world_sim, None)
    np.testing.assert_array_equal(third_reset[2], all_worlds[2])
    np.testing.assert_array_equal(others_reset[[0, 2, 3]], all_worlds[[0, 2, 3]])
    # Worlds that the mask leaves out keep their masses.
    np.testing.assert_array_equal(third_reset[[0, 1, 3]], np.float32(0.0434))
    # World 2 in its second episode draws as it does when all worlds are in theirs.
    twice = masses_after_resets(four_world_sim, [False, False, True, False], [False, True, True, False])
    np.testing.assert_array_equal(twice[2], masses_after_resets(four_world_sim, None, None)[2])
    np.testing.assert_array_equal(twice[1], all_worlds[1])


def test_worlds_drones_and_episodes_draw_different_numbers(four_world_sim):
    """Two of 36 draws of 24 bits are equal by chance with a probability of 4e-5, and the seed is fixed."""
    draws = np.stack([masses_after_resets(four_world_sim, *[None] * n) for n in (1, 2, 3)])
    assert draws.shape == (3, 4, 3)
    assert len(np.unique(draws)) == draws.size
    assert 0.03 <= draws.min() < draws.max() <= 0.06


def test_the_seed_of_construction_and_of_seed_are_one(four_world_sim):
    sim = make_sim(4, seed=7)
    sim.reset()
    np.testing.assert_array_equal(sim.data.params.mass[..., 0], masses_after_resets(four_world_sim, None, seed=7))


def key_numbers(data, name="wind"):
    """Return the numbers of the keys of a stage: of worlds (n_worlds, 2) and of drones (n_worlds, n_drones, 2)."""
    return leaf_on_host(world_keys(data, name)), leaf_on_host(drone_keys(data, name))


def test_keys_differ_by_world_drone_stage_name_and_step(four_world_sim):
    data = four_world_sim.default_data
    by_world, by_drone = key_numbers(data)
    assert by_world.shape == (4, 2)
    assert by_drone.shape == (4, 3, 2)
    later = data.replace(core=data.core.replace(steps=data.core.steps + 1))
    next_episode = data.replace(core=data.core.replace(episode=data.core.episode + 1))
    everything = [by_world, by_drone, *key_numbers(data, "gust"), *key_numbers(later), *key_numbers(next_episode)]
    keys = np.concatenate([x.reshape(-1, 2) for x in everything])
    assert len(keys) == 4 * (4 + 12)
    assert len(np.unique(keys, axis=0)) == len(keys)


def test_keys_do_not_depend_on_the_time_of_another_world(four_world_sim):
    data = four_world_sim.default_data
    moved = data.replace(
        core=data.core.replace(steps=data.core.steps.at[1].set(99), episode=data.core.episode.at[2].set(5))
    )
    for before, after in zip(key_numbers(data), key_numbers(moved), strict=True):
        np.testing.assert_array_equal(before[[0, 3]], after[[0, 3]])
        assert not np.any(np.all(before[[1, 2]] == after[[1, 2]], axis=-1))


def test_two_devices_give_the_same_numbers_as_one(four_world_sim):
    assert len(jax.devices()) >= 2, "conftest forces four host devices"
    sharded_sim = make_sim(4, mesh=world_mesh(jax.devices()[:2]))
    for masks in ([None], [None, [True, False, True, False]]):
        np.testing.assert_array_equal(
            masses_after_resets(sharded_sim, *masks), masses_after_resets(four_world_sim, *masks)
        )
    assert len(sharded_sim.data.params.mass.sharding.device_set) == 2
