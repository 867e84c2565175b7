"""Conventions of motion capture systems, both ways."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazysim import rotation
from crazysim.errors import ConfigError
from crazysim.live.mocap import Convention, Frame
from crazysim.live.mocap.frames import from_rpy, multiply, rotate, to_rpy

CONVENTIONS = [Convention(*c) for c in itertools.product("yz", ("xyzw", "wxyz"), (1.0, 0.001))]
HALF = np.sqrt(0.5)
numbers = st.floats(-1, 1, width=32)


def test_y_up_by_hand():
    """A body 1 m up and 2 m along the source's z, turned by 90 degrees about the vertical."""
    pos, quat = Convention("y", "wxyz", 0.001).to_world([0, 1000, 2000], [HALF, 0, HALF, 0])
    np.testing.assert_allclose(pos, [0, -2, 1])
    np.testing.assert_allclose(quat, [0, 0, HALF, HALF])


@pytest.mark.parametrize("convention", CONVENTIONS)
@given(pos=st.tuples(numbers, numbers, numbers), quat=st.tuples(numbers, numbers, numbers, numbers))
def test_to_world_and_back(convention, pos, quat):
    there = convention.to_world(pos, quat)
    back = convention.from_world(*there)
    np.testing.assert_allclose(back[0], pos, atol=1e-12)
    np.testing.assert_array_equal(back[1], quat)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_turned_points_agree(convention):
    """A point of the body has the same place, whichever frame the turn is computed in."""
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(20, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    point = rng.normal(size=(20, 3))
    world = rotate(quat, point)
    p_source, q_source = convention.from_world(point, quat)
    xyzw = q_source if convention.quat == "xyzw" else q_source[:, [1, 2, 3, 0]]
    np.testing.assert_allclose(rotate(xyzw, p_source), convention.from_world(world, quat)[0], atol=1e-9)


def test_rotations_on_the_host_equal_those_of_the_step():
    rng = np.random.default_rng(1)
    p, q, v = rng.normal(size=(8, 4)), rng.normal(size=(8, 4)), rng.normal(size=(8, 3))
    p, q = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (p, q))
    np.testing.assert_allclose(rotate(q, v), rotation.rotate(q, v), atol=1e-5)
    np.testing.assert_allclose(multiply(p, q), rotation.multiply(p, q), atol=1e-5)
    rpy = rng.uniform(-1.4, 1.4, (8, 3))
    np.testing.assert_allclose(from_rpy(rpy), rotation.from_rpy(rpy), atol=1e-5)
    np.testing.assert_allclose(to_rpy(from_rpy(rpy)), rpy, atol=1e-9)


@pytest.mark.parametrize("wrong", [{"up": "x"}, {"quat": "wyxz"}, {"unit": 0.0}, {"unit": float("nan")}])
def test_wrong_conventions(wrong):
    with pytest.raises(ConfigError, match="expected up as"):
        Convention(**wrong)


def test_wrong_pose():
    with pytest.raises(ConfigError, match="expected a position of 3"):
        Frame.of(0.0, {"a": ([0, 0], [0, 0, 0, 1])})
