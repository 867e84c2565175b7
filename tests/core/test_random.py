"""Keys for stages: one per world or drone, the same inside and outside of jit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import shared_sim

from crazysim.core.random import drone_keys, normal, uniform


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


def test_both_words_of_a_hash_give_independent_standard_numbers(data):
    """108,000 normal numbers: first four moments, and products of neighbours, within 4 standard errors."""

    def draw(step):
        at = data.replace(core=data.core.replace(steps=data.core.steps + step))
        return jax.vmap(jax.vmap(lambda key: normal(key, (6,))))(drone_keys(at, "imu"))

    numbers = np.asarray(jax.jit(jax.vmap(draw))(np.arange(3000, dtype=np.int32)), np.float64)
    moments = zip((0, 1, 0, 3), (1, 2, 15, 96), strict=True)  # of z, z^2, z^3, z^4: mean and variance
    for power, (mean, variance) in enumerate(moments, 1):
        assert abs((numbers**power).mean() - mean) < 4 * np.sqrt(variance / numbers.size)
    for a, b in ((numbers[..., ::2], numbers[..., 1::2]), (numbers[..., 2:], numbers[..., :-2])):
        assert abs(np.mean(a * b)) < 4 / np.sqrt(a.size)


def test_numbers_in_float64_have_52_bits_and_a_kernel(x64):
    """Moments of 400,000 of them; and no 64-bit integers, which kernels do not have."""
    key = jax.random.key(3)
    share, drawn = (np.asarray(draw(key, (400_000,), jnp.float64)) for draw in (uniform, normal))
    assert share.dtype == drawn.dtype == np.float64
    np.testing.assert_array_equal(share * 2**52 % 1, 0)
    assert np.mean(share * 2**51 % 1 != 0) > 0.49, "the last bit is drawn"
    assert 0 <= share.min() < 1e-5 < 1 - 1e-5 < share.max() < 1
    for x, moments in ((share, (1 / 2, 1 / 3, 1 / 4)), (drawn, (0, 1, 0))):
        np.testing.assert_allclose([np.mean(x**k) for k in (1, 2, 3)], moments, atol=0.02)
    jaxpr = str(jax.make_jaxpr(lambda key: normal(key, (3,), jnp.float64))(key))
    assert "u64" not in jaxpr


def test_numbers_of_other_types_and_generators_equal_those_of_jax():
    for key in (jax.random.key(1, impl="rbg"), jax.random.key(1)):
        dtype = jnp.float32 if key.dtype != jax.random.key(0).dtype else jnp.float16
        np.testing.assert_array_equal(normal(key, (3,), dtype), jax.random.normal(key, (3,), dtype))
        np.testing.assert_array_equal(uniform(key, (3,), dtype), jax.random.uniform(key, (3,), dtype))
    numbers = np.asarray(uniform(jax.random.key(1), (1000,)))
    assert 0 <= numbers.min() < 0.01
    assert 0.99 < numbers.max() < 1
