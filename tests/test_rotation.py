"""Quaternion algebra: group laws, comparison with SciPy, and finite gradients."""

import functools

import cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from crazysim import rotation as rot
from crazysim.lab.live import attitude

# All tests run in float64, whose rounding is 1.1e-16.
ROUNDING = {"rtol": 1e-12, "atol": 1e-12}


pytestmark = pytest.mark.usefixtures("x64")

vectors = functools.partial(cases.vectors, allow_subnormal=False)
unit_quats = cases.unit_quats(allow_subnormal=False)
angles = st.floats(-3.1, 3.1)


def assert_same_rotation(p, q):
    np.testing.assert_allclose(np.abs(np.sum(np.asarray(p) * np.asarray(q), axis=-1)), 1.0, atol=1e-14)


@given(a=vectors(), b=vectors(), m=arrays(np.float64, (2, 3), elements=st.floats(-5, 5)))
def test_products_of_vectors_are_those_of_numpy(a, b, m):
    np.testing.assert_allclose(rot.cross(a, b), np.cross(a, b), **ROUNDING)
    np.testing.assert_allclose(rot.dot(a, b), [a @ b], **ROUNDING)
    np.testing.assert_allclose(rot.matvec(m, a), m @ a, **ROUNDING)
    np.testing.assert_allclose(rot.safe_norm(jnp.asarray(a)), [np.linalg.norm(a)], **ROUNDING)


@given(p=unit_quats, q=unit_quats, r=unit_quats)
def test_multiplication_is_a_group(p, q, r):
    left, right = rot.multiply(rot.multiply(p, q), r), rot.multiply(p, rot.multiply(q, r))
    np.testing.assert_allclose(left, right, **ROUNDING)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(rot.multiply(q, rot.conjugate(q)), identity, **ROUNDING)
    np.testing.assert_allclose(rot.multiply(q, identity), q, **ROUNDING)
    np.testing.assert_allclose(np.linalg.norm(rot.multiply(p, q)), 1.0, **ROUNDING)


@given(p=unit_quats, q=unit_quats, v=vectors())
def test_rotations_act_on_vectors(p, q, v):
    """A product applies one rotation after the other, keeps lengths, and has an inverse, as in SciPy."""
    np.testing.assert_allclose(rot.rotate(rot.multiply(p, q), v), rot.rotate(p, rot.rotate(q, v)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(rot.rotate(q, v)), np.linalg.norm(v), **ROUNDING)
    np.testing.assert_allclose(rot.rotate_inverse(q, rot.rotate(q, v)), v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rot.rotate(q, v), Rotation.from_quat(q).apply(v), rtol=0, atol=1e-12)
    np.testing.assert_allclose(rot.z_axis(q), Rotation.from_quat(q).apply([0, 0, 1]), **ROUNDING)


@given(q=unit_quats, rotvec=vectors(3, np.pi / np.sqrt(3)))
def test_integrated_attitude_is_a_rotation_about_a_body_axis(q, rotvec):
    """Up to half a revolution the approximations are exact to rounding, normalised or not, whatever the duration."""
    out = rot.integrate_attitude(jnp.asarray(q), jnp.asarray(rotvec) * 500, 1 / 500)
    bare = rot.integrate_attitude(jnp.asarray(q), jnp.asarray(rotvec), 1.0, normalize=False)
    np.testing.assert_allclose(bare, out, rtol=0, atol=1e-15)
    angle = np.linalg.norm(rotvec)
    by_hand = np.array([*(0.5 * rotvec * np.sinc(angle / 2 / np.pi)), np.cos(angle / 2)])
    np.testing.assert_allclose(out, rot.multiply(q, by_hand), rtol=0, atol=1e-15)
    expected = (Rotation.from_quat(q) * Rotation.from_rotvec(rotvec)).as_quat()
    assert_same_rotation(out, expected)


@given(v=vectors(), w=vectors(), offset=vectors())
def test_offsets_are_added(v, w, offset):
    q = np.array([0.1, -0.5, 0.7, 0.5])
    np.testing.assert_allclose(rot.add_cross(offset, v, w), offset + np.cross(v, w), rtol=0, atol=1e-13)
    np.testing.assert_allclose(rot.rotate(q, v, offset), rot.rotate(q, v) + offset, rtol=0, atol=1e-13)
    np.testing.assert_allclose(rot.rotate_inverse(q, v, offset), rot.rotate_inverse(q, v) + offset, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(rot.along_z(v), np.stack([0 * v, 0 * v, v], axis=-1))


@given(roll=angles, pitch=st.floats(-1.57, 1.57), yaw=angles)
def test_from_rpy_and_to_rpy_are_inverses(roll, pitch, yaw):
    """Up to 1e-3 rad short of 90 degrees of pitch; there 1/cos(pitch) magnifies the rounding to 1e-12."""
    rpy = np.array([roll, pitch, yaw])
    q = rot.from_rpy(jnp.asarray(rpy))
    assert_same_rotation(q, Rotation.from_euler("ZYX", rpy[::-1]).as_quat())
    np.testing.assert_allclose(rot.to_rpy(q), rpy, rtol=0, atol=1e-11)
    axes = [rot.rotate(q, axis) for axis in jnp.eye(3)]
    np.testing.assert_allclose(rot.rpy_from_axes(*axes), rpy, rtol=0, atol=1e-11)


@given(q=unit_quats)
@example(q=np.sqrt([0.5, 0, 0.5, 0]))
@example(q=np.array([1, 2, -1, 2]) / np.sqrt(10))
def test_to_rpy_gives_the_same_rotation_back(q):
    """At a pitch of 90 degrees too, where roll and yaw are not unique."""
    rpy = rot.to_rpy(jnp.asarray(q))
    assert np.all(np.abs(rpy) <= np.array([1, 0.5, 1]) * np.pi)
    assert_same_rotation(rot.from_rpy(rpy), q)
    assert_same_rotation(rot.from_rpy(jnp.asarray(attitude.to_rpy(q))), q)


@given(q=unit_quats, scale=st.floats(0.1, 10))
def test_yaw_is_that_of_to_rpy_for_any_length(q, scale):
    yaw, pitch = rot.to_rpy(jnp.asarray(q))[2], rot.to_rpy(jnp.asarray(q))[1]
    assume(abs(pitch) < 1.5)
    difference = float(rot.yaw(jnp.asarray(q * scale)) - yaw)
    assert abs(np.angle(np.exp(1j * difference))) < 1e-12


@given(q=unit_quats, scale=st.floats(1e-3, 1e3))
def test_heading_is_along_the_yaw(q, scale):
    q = jnp.asarray(q * scale)
    yaw = rot.yaw(q)
    x, y, z, w = q / scale
    assume(np.hypot(x * x + w * w - y * y - z * z, 2 * (x * y + w * z)) > 1e-3)  # it has a heading
    ahead, left = rot.heading(q)
    np.testing.assert_allclose(ahead, [np.cos(yaw), np.sin(yaw), 0], atol=1e-12)
    np.testing.assert_allclose(left, [-np.sin(yaw), np.cos(yaw), 0], atol=1e-12)


@jax.jit
def heading_and_gradient(q):
    return rot.heading(q)[0], jax.jacobian(lambda q: rot.heading(q)[0])(q)


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-12, 2e-6, 1.0])
def test_law_07_heading_has_finite_gradients(length):
    ahead, gradient = heading_and_gradient(np.float32(length * np.array([0.1, -0.2, 0.3, 0.9])))
    assert np.all(np.isfinite(gradient))
    if length < 1e-6:
        np.testing.assert_array_equal(ahead, [1, 0, 0])


def test_yaw_of_the_zero_quaternion_is_zero():
    assert rot.yaw(jnp.zeros(4)) == 0
    np.testing.assert_array_equal(jax.grad(rot.yaw)(jnp.zeros(4)), np.zeros(4))


def test_law_07_safe_functions_have_gradient_zero_at_zero():
    fallback = np.array([0.0, 0.0, 1.0])

    @jax.jit
    def values_and_gradients(x, fallback, y):
        return (
            (rot.safe_norm(x), rot.safe_normalize(x, fallback), rot.safe_arctan2(y, y)),
            jax.grad(lambda x: rot.safe_norm(x)[0])(x),
            jax.jacobian(rot.safe_normalize)(x, fallback),
            jax.grad(rot.safe_arctan2, argnums=(0, 1))(y, y),
        )

    (norm, direction, angle), norm_gradient, direction_jacobian, angle_gradients = values_and_gradients(
        np.zeros(3), fallback, 0.0
    )
    assert norm == angle == 0
    np.testing.assert_array_equal(direction, fallback)
    np.testing.assert_array_equal(norm_gradient, np.zeros(3))
    np.testing.assert_array_equal(direction_jacobian, np.zeros((3, 3)))
    assert angle_gradients == (0, 0)


@jax.jit
@jax.vmap
def values_and_jacobians(q):
    return {fn.__name__: (fn(q), jax.jacobian(fn)(q)) for fn in (rot.to_rpy, rot.yaw, rot.z_axis)}


@jax.jit
def jacobians_of_small_turns(rpy, quat, rotvec):
    return jax.jacobian(rot.from_rpy)(rpy), *jax.jacobian(rot.integrate_attitude, (0, 1))(quat, rotvec, 1.0)


TINY = (0.0, 1e-45, 1e-22, 1e-19, 1e-4)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("tiny", TINY)
def test_law_07_jacobians_are_finite_at_and_next_to_90_degrees_of_pitch(tiny, dtype):
    """Law 7: squares of numbers below 1e-19 underflow in float32, and 0/0 is near."""
    half = np.sqrt(0.5)
    quats = np.array([[0, half, 0, half], [0, -half, 0, half], [half, 0, half, 0], [0.5] * 4, [1, 0, 0, 0]], dtype)
    everywhere = quats[:, None] + np.eye(4, dtype=dtype) * np.asarray(tiny, dtype)
    for name, result in values_and_jacobians(everywhere.reshape(-1, 4)).items():
        for x in result:
            assert x.dtype == dtype
            assert len(x) == 20
            assert np.all(np.isfinite(x)), name


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("tiny", TINY)
def test_law_07_yaw_of_a_quaternion_next_to_zero_has_finite_gradients(tiny, dtype):
    """A setpoint's quaternion may have any length, and its products underflow before it does."""
    quats = np.array([[0, 0, 1, 0], [0, 0, 1, 2], [1, -1, 1, 1], [0, 0, 0, 1]], dtype)
    for x in values_and_jacobians(np.resize(np.asarray(tiny, dtype) * quats, (20, 4)))["yaw"]:
        assert np.all(np.isfinite(x))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("tiny", TINY)
def test_law_07_jacobians_are_finite_for_tiny_rotations(tiny, dtype):
    small = np.full(3, tiny, dtype)
    rpy_jacobian, *turn_jacobians = jacobians_of_small_turns(small, np.array([0.0, 0.0, 0.0, 1.0], dtype), small)
    np.testing.assert_allclose(rpy_jacobian[:3], 0.5 * np.eye(3), rtol=0, atol=1e-3)
    for jacobian in turn_jacobians:
        assert np.all(np.isfinite(jacobian))


@given(q=unit_quats)
def test_quaternion_of_axes_gives_the_same_rotation_back(q):
    assert_same_rotation(rot.quat_from_axes(*np.swapaxes(rot.matrix(q), -1, -2)), q)


@jax.jit
def quaternion_of_turned_axes(q, rotvec):
    def there_and_back(rotvec):
        axes = jnp.moveaxis(rot.matrix(rot.multiply(q, rot.integrate_attitude(jnp.eye(4)[3], rotvec, 1.0))), -1, 0)
        return rot.quat_from_axes(*axes)

    return there_and_back(rotvec), jax.jacfwd(there_and_back)(rotvec)


@pytest.mark.parametrize("q", [*np.eye(4), [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, 0.5, 0.0], [0.7, 0.7, 0.0, 1e-9]])
def test_quaternion_of_axes_is_accurate_at_half_turns(q):
    q = np.asarray(q) / np.linalg.norm(q)
    back, slope = quaternion_of_turned_axes(q, np.zeros(3))
    assert_same_rotation(back, q)
    expected = np.stack([rot.multiply(back, np.append(0.5 * axis, 0.0)) for axis in np.eye(3)], axis=-1)
    np.testing.assert_allclose(slope, expected, atol=1e-12)
