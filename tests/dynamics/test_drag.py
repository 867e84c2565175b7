"""Air drag: linear in the body frame, and always dissipative."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from crazysim.dynamics.drag import drag_force

pytestmark = pytest.mark.usefixtures("x64")

vectors = arrays(np.float64, 3, elements=st.floats(-30, 30))
quats = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1)
D = np.diag([-0.02, -0.03, -0.05])
"""Drag matrix in the body frame, N s/m."""
force = jax.jit(drag_force)


@given(quat=quats, vel=vectors)
def test_drag_is_the_matrix_in_body_axes(quat, vel):
    quat = quat / np.linalg.norm(quat)
    matrix = Rotation.from_quat(quat).as_matrix()
    np.testing.assert_allclose(force(quat, vel, D), matrix @ D @ matrix.T @ vel, atol=1e-13)


@given(quat=quats, vel=vectors)
def test_law_08_drag_only_dissipates(quat, vel):
    """Law 8: its power is between the powers of the largest and the least coefficient; rounding is 1e-13 of 50 W."""
    power = force(quat / np.linalg.norm(quat), vel, D) @ vel
    assert -0.05 * vel @ vel - 1e-12 <= power <= -0.02 * vel @ vel + 1e-12


def test_drag_by_hand():
    """With the nose up by 90 degrees at 2 m/s upwards, air flows along body x, and the force is 0.02 * 2 N, down."""
    half = np.sqrt(0.5)
    out = force(np.array([0, -half, 0, half]), np.array([0, 0, 2.0]), D)
    np.testing.assert_allclose(out, [0, 0, -0.04], atol=1e-16)
