"""Conventions of motion capture systems."""

import itertools

import numpy as np
import pytest

from crazysim.errors import ConfigError
from crazysim.lab.live.attitude import rotate
from crazysim.lab.live.mocap import Convention, Frame

CONVENTIONS = [Convention(*c) for c in itertools.product("yz", ("xyzw", "wxyz"), (1.0, 0.001))]
SQRT_HALF = np.sqrt(0.5)


def test_y_up_by_hand():
    """A body 1 m up and 2 m along the source's z, turned by 90 degrees about the vertical."""
    pos, quat = Convention("y", "wxyz", 0.001).to_world([0, 1000, 2000], [SQRT_HALF, 0, SQRT_HALF, 0])
    np.testing.assert_allclose(pos, [0, -2, 1])
    np.testing.assert_allclose(quat, [0, 0, SQRT_HALF, SQRT_HALF])


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_points_turn_alike_in_both_frames(convention):
    """A point of the body has the same position, whichever frame its rotation is computed in."""
    rng = np.random.default_rng(0)
    quat, point = rng.normal(size=(20, 4)), rng.normal(size=(20, 3))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    sent = quat if convention.quat == "xyzw" else quat[:, [3, 0, 1, 2]]
    pos, attitude = convention.to_world(point, sent)
    np.testing.assert_allclose(rotate(attitude, pos), convention.to_world(rotate(quat, point), sent)[0], atol=1e-9)


@pytest.mark.parametrize("wrong", [{"up": "x"}, {"quat": "wyxz"}, {"unit": 0.0}, {"unit": float("nan")}])
def test_wrong_conventions(wrong):
    with pytest.raises(ConfigError, match="expected up as"):
        Convention(**wrong)


def test_a_pose_of_wrong_shape_is_refused():
    with pytest.raises(ConfigError, match="expected a position of 3"):
        Frame.of(0.0, {"a": ([0, 0], [0, 0, 0, 1])})
