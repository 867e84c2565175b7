"""Attitudes on the host equal those of the compiled step."""

import numpy as np
import pytest

from crazysim import rotation
from crazysim.lab.live.attitude import from_rpy, from_yaw, multiply, rotate, to_rpy, yaw_from_quat


def test_rotations_on_the_host_equal_those_of_the_step():
    rng = np.random.default_rng(1)
    p, q, v = rng.normal(size=(8, 4)), rng.normal(size=(8, 4)), rng.normal(size=(8, 3))
    p, q = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (p, q))
    np.testing.assert_allclose(rotate(q, v), rotation.rotate(q, v), atol=1e-5)
    np.testing.assert_allclose(multiply(p, q), rotation.multiply(p, q), atol=1e-5)
    rpy = rng.uniform(-1.4, 1.4, (8, 3))
    np.testing.assert_allclose(from_rpy(rpy), rotation.from_rpy(rpy), atol=1e-5)
    np.testing.assert_allclose(to_rpy(from_rpy(rpy)), rpy, atol=1e-9)


@pytest.mark.parametrize("yaw", [-3.0, -0.4, 0.0, 2.0])
def test_yaw_is_that_of_roll_pitch_and_yaw(yaw):
    np.testing.assert_allclose(from_yaw(yaw), from_rpy([0.0, 0.0, yaw]), atol=1e-15)
    assert yaw_from_quat(from_rpy([0.3, -0.7, yaw])) == pytest.approx(yaw, abs=1e-12)
