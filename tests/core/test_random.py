"""Keys for stages: one per world or drone, the same inside and outside of jit."""

import jax
import numpy as np
import pytest
from cases import shared_sim
from hypothesis import given
from hypothesis import strategies as st

from crazysim.core.random import drone_keys, world_keys

pytestmark = pytest.mark.fast


def bits(keys):
    return np.asarray(jax.random.key_data(keys))


@pytest.fixture(scope="module")
def data():
    return shared_sim(n_worlds=3, n_drones=2, control="rotor_vel").data


def test_one_key_per_world_or_drone(data):
    assert world_keys(data, "wind").shape == (3,)
    assert drone_keys(data, "wind").shape == (3, 2)
    assert len(np.unique(bits(world_keys(data, "wind")), axis=0)) == 3
    assert len(np.unique(bits(drone_keys(data, "wind")).reshape(6, -1), axis=0)) == 6
    assert not np.any(np.all(bits(drone_keys(data, "wind")) == bits(world_keys(data, "wind"))[:, None], axis=-1))


def test_keys_are_the_same_inside_jit(data):
    np.testing.assert_array_equal(
        bits(jax.jit(drone_keys, static_argnums=1)(data, "wind")), bits(drone_keys(data, "wind"))
    )


@given(step=st.integers(0, 10**6), episode=st.integers(0, 10**6), world=st.integers(0, 2))
def test_law_10_only_the_world_whose_time_changes_draws_other_numbers(data, step, episode, world):
    """Law 10: another world's episode and step change nothing."""
    core = data.core.replace(
        steps=data.core.steps.at[world].set(step), episode=data.core.episode.at[world].set(episode)
    )
    before, after = bits(world_keys(data, "wind")), bits(world_keys(data.replace(core=core), "wind"))
    changed = np.any(before != after, axis=-1)
    expected = np.arange(3) == world
    if (step, episode) == (0, 0):
        expected[:] = False
    np.testing.assert_array_equal(changed, expected)


def test_numbers_are_uniform_and_uncorrelated(data):
    """Uniform draws over 3,000 steps: mean 1/2 within 4 standard errors, 4 / sqrt(12 * 18,000) = 0.0086."""

    def draw(step):
        at = data.replace(core=data.core.replace(steps=data.core.steps + step))
        return jax.vmap(jax.vmap(jax.random.uniform))(drone_keys(at, "wind"))

    numbers = jax.jit(jax.vmap(draw))(np.arange(3000, dtype=np.int32))
    assert abs(float(numbers.mean()) - 0.5) < 0.0086
    # Neighbouring steps, drones and worlds are uncorrelated, within 4 / sqrt(18,000).
    centred = np.asarray(numbers) - 0.5
    for a, b in ((centred[1:], centred[:-1]), (centred[:, 1:], centred[:, :-1]), (centred[..., 1:], centred[..., :-1])):
        assert abs(np.mean(a * b)) * 12 < 4 / np.sqrt(a.size)
