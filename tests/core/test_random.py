"""Keys for stages: one per world or drone, the same inside and outside of jit."""

import jax
import numpy as np
import pytest
from cases import shared_sim

from crazysim.core.random import drone_keys

pytestmark = pytest.mark.fast


def bits(keys):
    return np.asarray(jax.random.key_data(keys))


@pytest.fixture(scope="module")
def data():
    return shared_sim(n_worlds=3, n_drones=2, control="rotor_vel").data


def test_keys_are_the_same_inside_jit(data):
    np.testing.assert_array_equal(
        bits(jax.jit(drone_keys, static_argnums=1)(data, "wind")), bits(drone_keys(data, "wind"))
    )


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
