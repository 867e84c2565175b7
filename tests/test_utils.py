"""Helpers and names under the paths of Crazyflow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim
from crazysim.sim.data import SimStateDeriv
from crazysim.sim.dynamics import first_principles_dynamics, so_rpy_rotor_dynamics
from crazysim.sim.sim import seed_sim
from crazysim.utils import enable_cache, leaf_replace, pytree_replace, world_mask


def test_leaf_replace_changes_the_worlds_of_the_mask_only():
    states = Sim(n_worlds=3, n_drones=2).data.states
    new = leaf_replace(states, np.array([True, False, True]), pos=np.ones((3, 2, 3), np.float32))
    pos = np.asarray(new.pos)
    np.testing.assert_array_equal(pos[[0, 2]], np.ones((2, 2, 3)))
    np.testing.assert_array_equal(pos[1], np.asarray(states.pos)[1])
    assert new.vel is states.vel


def test_a_shared_value_becomes_one_per_drone_where_the_mask_says():
    params = Sim(n_worlds=2).data.params
    new = leaf_replace(params, jnp.array([False, True]), mass=jnp.full((2, 1, 1), 0.05))
    np.testing.assert_allclose(new.mass[:, 0, 0], [float(params.mass[0]), 0.05], rtol=1e-6)


@pytest.fixture
def cache_settings():
    """Return the names of JAX's cache settings, which are restored after the test."""
    names = ("min_entry_size_bytes", "min_compile_time_secs", "enable_xla_caches")
    names = ("jax_compilation_cache_dir", *(f"jax_persistent_cache_{name}" for name in names))
    before = {name: getattr(jax.config, name) for name in names}
    yield names
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.parametrize("enable_xla_caches", [True, False])
def test_enable_cache_takes_the_settings_of_crazyflow(tmp_path, cache_settings, enable_xla_caches):
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    returned = enable_cache(
        cache_path=str(tmp_path),
        min_entry_size_bytes=1000,
        min_compile_time_secs=2,
        enable_xla_caches=enable_xla_caches,
    )
    assert returned == tmp_path
    result = [getattr(jax.config, name) for name in cache_settings]
    assert result == [str(tmp_path), 1000, 2, "all" if enable_xla_caches else "none"]


def test_world_mask_names_the_leaves_of_worlds_and_pytree_replace_writes_them():
    sim = Sim(n_worlds=3, n_drones=2)
    data = sim.data
    mask = world_mask(data)
    assert mask.states.pos
    assert mask.core.steps
    assert not mask.params.mass
    assert not mask.core.rng_key
    other = data.replace(states=data.states.replace(pos=data.states.pos + 1), params=data.params.replace(mass=[9.0]))
    new = pytree_replace(data, other, mask, jnp.array([True, False, True]))
    np.testing.assert_array_equal(new.states.pos[:, 0, 0] - data.states.pos[:, 0, 0], [1, 0, 1])
    np.testing.assert_array_equal(new.params.mass, data.params.mass)


def test_seed_sim_is_the_pure_twin_of_seed():
    sim = Sim()
    device = jax.devices()[1]
    assert seed_sim(sim.data, 7, device).core.rng_key.devices() == {device}
    seeded = seed_sim(sim.data, 7)
    sim.seed(7)
    assert jax.random.key_data(seeded.core.rng_key).tolist() == jax.random.key_data(sim.data.core.rng_key).tolist()


def test_derivatives_under_the_names_of_crazyflow():
    """A drone at rest in the air falls with g; a derivative of zeros has the same structure and shapes."""
    sim = Sim(n_worlds=2, n_drones=3)
    deriv = jax.jit(first_principles_dynamics)(sim.data)
    np.testing.assert_allclose(deriv.acc, np.broadcast_to([0, 0, -9.81], (2, 3, 3)), atol=1e-5)
    zeros = SimStateDeriv.create(2, 3, sim.device)
    assert [x.shape for x in jax.tree.leaves(zeros)] == [x.shape for x in jax.tree.leaves(deriv)]
    assert not any(np.any(x) for x in jax.tree.leaves(zeros))
    fitted = Sim(n_worlds=2, dynamics="so_rpy_rotor").data
    acc = np.asarray(jax.jit(so_rpy_rotor_dynamics)(fitted).acc)
    np.testing.assert_allclose(acc[..., 2], -9.81, atol=1e-5)
