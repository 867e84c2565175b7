"""The track task's trajectory, and the functions of time that it took before."""

import jax
import numpy as np
import pytest

from crazysim.envs import trajectories
from crazysim.envs.tasks.track import TrackTrajectory
from crazysim.errors import ConfigError
from crazysim.trajectories import circle

TIMES = np.linspace(0.0, 23.0, 60, dtype=np.float32).reshape(20, 3)


def test_the_default_is_the_figure_eight_that_it_always_was():
    w = 2 * np.pi / 5
    pos, vel = jax.jit(TrackTrajectory().motion)(TIMES)
    expected = np.stack([np.sin(w * TIMES), 0.5 * np.sin(2 * w * TIMES), np.ones_like(TIMES)], axis=-1)
    slope = np.stack([w * np.cos(w * TIMES), w * np.cos(2 * w * TIMES), np.zeros_like(TIMES)], axis=-1)
    np.testing.assert_allclose(pos, expected, atol=2e-5)
    np.testing.assert_allclose(vel, slope, atol=2e-4)


def test_another_trajectory():
    pos, _ = jax.jit(TrackTrajectory(trajectory=circle(2.0, 4.0)).motion)(np.float32(1.0))
    np.testing.assert_allclose(pos, [0, 2, 1], atol=1e-5)


def test_functions_of_time_still_work_and_say_what_replaces_them():
    with pytest.warns(DeprecationWarning, match=r"use crazysim\.trajectories\.figure_eight"):
        function = trajectories.figure_eight(period=3.0, width=4.0)
    w = 2 * np.pi / 3
    pos, _ = jax.jit(function)(TIMES)
    np.testing.assert_allclose(np.asarray(pos)[..., 0], 2 * np.sin(w * TIMES), atol=5e-5)
    with pytest.warns(DeprecationWarning, match="TrackTrajectory"):
        task = TrackTrajectory(trajectory=function)
    found, expected = jax.jit(lambda t: (task.motion(t), function(t)))(np.float32(1.0))
    np.testing.assert_array_equal(found[1], expected[1])


def test_polynomials_still_repeat():
    with pytest.warns(DeprecationWarning, match="of_pieces"):
        function = trajectories.polynomial([[[0, 1], [1, 0], [0, 0]], [[2, -2], [1, 0], [0, 0]]], [2.0, 1.0])
    pos, vel = jax.jit(function)(np.float32([0.5, 2.5, 3.5]))
    np.testing.assert_allclose(pos, [[0.5, 1, 0], [1, 1, 0], [0.5, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(np.asarray(vel)[:, 0], [1, -2, 1], atol=1e-6)
    with pytest.warns(DeprecationWarning, match="of_pieces"), pytest.raises(ConfigError):
        trajectories.polynomial(np.zeros((2, 3, 2)), [1.0, -1.0])
