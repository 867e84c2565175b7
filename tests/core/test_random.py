"""Random keys for stages, one per world or drone, equal inside and outside of jit, and the numbers drawn from them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import shared_sim

from crazysim.core.random import drone_keys, normal, uniform


@pytest.fixture(scope="module")
def data():
    return shared_sim(n_worlds=3, n_drones=2, control="rotor_vel").data


def test_numbers_are_uniform_and_uncorrelated(data):
    """Uniform draws over 3,000 steps: mean 1/2 within 4 standard errors, 4 / sqrt(12 * 18,000) = 0.0086."""

    def draw(step):
        later_data = data.replace(core=data.core.replace(steps=data.core.steps + step))
        return jax.vmap(jax.vmap(jax.random.uniform))(drone_keys(later_data, "wind"))

    numbers = jax.jit(jax.vmap(draw))(np.arange(3000, dtype=np.int32))
    assert abs(float(numbers.mean()) - 0.5) < 0.0086
    # Neighbouring steps, drones and worlds are uncorrelated, within 4 standard errors.
    centred = np.asarray(numbers) - 0.5
    for a, b in ((centred[1:], centred[:-1]), (centred[:, 1:], centred[:, :-1]), (centred[..., 1:], centred[..., :-1])):
        assert abs(np.mean(a * b)) * 12 < 4 / np.sqrt(a.size)


def test_both_words_of_a_hash_give_independent_standard_normal_numbers(data):
    """108,000 normal numbers: first four moments, and products of neighbours, within 4 standard errors."""

    def draw(step):
        later_data = data.replace(core=data.core.replace(steps=data.core.steps + step))
        return jax.vmap(jax.vmap(lambda key: normal(key, (6,))))(drone_keys(later_data, "imu"))

    numbers = np.asarray(jax.jit(jax.vmap(draw))(np.arange(3000, dtype=np.int32)), np.float64)
    moments = zip((0, 1, 0, 3), (1, 2, 15, 96), strict=True)  # of z, z^2, z^3, z^4: mean and variance
    for power, (mean, variance) in enumerate(moments, 1):
        assert abs((numbers**power).mean() - mean) < 4 * np.sqrt(variance / numbers.size)
    for a, b in ((numbers[..., ::2], numbers[..., 1::2]), (numbers[..., 2:], numbers[..., :-2])):
        assert abs(np.mean(a * b)) < 4 / np.sqrt(a.size)


def test_numbers_in_float64_have_52_bits_and_run_in_kernels(x64):
    """Moments of 400,000 numbers. The jaxpr contains no 64-bit integers, which kernels do not support."""
    key = jax.random.key(3)
    uniforms, normals = (np.asarray(draw(key, (400_000,), jnp.float64)) for draw in (uniform, normal))
    assert uniforms.dtype == normals.dtype == np.float64
    np.testing.assert_array_equal(uniforms * 2**52 % 1, 0)
    assert np.mean(uniforms * 2**51 % 1 != 0) > 0.49, "the last bit is never set"
    assert 0 <= uniforms.min() < 1e-5 < 1 - 1e-5 < uniforms.max() < 1
    for x, moments in ((uniforms, (1 / 2, 1 / 3, 1 / 4)), (normals, (0, 1, 0))):
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
