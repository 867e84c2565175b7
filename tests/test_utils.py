"""Helpers under the names that users of the peer know."""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Sim
from crazysim.sim.sim import seed_sim
from crazysim.utils import enable_cache, grid_2d, leaf_replace


def test_leaf_replace_changes_the_worlds_of_the_mask_only():
    states = Sim(n_worlds=3, n_drones=2).data.states
    new = leaf_replace(states, jnp.array([True, False, True]), pos=jnp.ones((3, 2, 3)))
    np.testing.assert_array_equal(new.pos[jnp.array([0, 2])], np.ones((2, 2, 3)))
    np.testing.assert_array_equal(new.pos[1], states.pos[1])
    assert new.vel is states.vel


def test_a_shared_value_becomes_one_per_drone_where_the_mask_says():
    params = Sim(n_worlds=2).data.params
    new = leaf_replace(params, jnp.array([False, True]), mass=jnp.full((2, 1, 1), 0.05))
    np.testing.assert_allclose(new.mass[:, 0, 0], [float(params.mass[0]), 0.05], rtol=1e-6)


def test_enable_cache_keeps_programs(tmp_path):
    before = {k: getattr(jax.config, k) for k in ("jax_compilation_cache_dir",)}
    try:
        assert enable_cache(tmp_path) == tmp_path
        assert jax.config.jax_compilation_cache_dir == str(tmp_path)
    finally:
        jax.config.update("jax_compilation_cache_dir", before["jax_compilation_cache_dir"])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def test_grid_is_centred_and_nearest_first():
    grid = grid_2d(9)
    np.testing.assert_allclose(grid.mean(axis=0), 0, atol=1e-12)
    assert np.all(np.diff(np.linalg.norm(grid, axis=1)) >= -1e-12)


def test_seed_sim_is_the_pure_twin_of_seed():
    sim = Sim()
    seeded = seed_sim(sim.data, 7)
    sim.seed(7)
    assert jax.random.key_data(seeded.core.rng_key).tolist() == jax.random.key_data(sim.data.core.rng_key).tolist()
