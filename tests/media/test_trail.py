"""Trails keep positions for their duration, and start again when a world is reset."""

import numpy as np
import pytest

from crazysim.errors import ConfigError
from crazysim.media import Trail
from crazysim.scene.overlays import Overlays


def add_positions(trail, times, n_worlds=2, n_drones=1):
    for time in times:
        pos = np.zeros((n_worlds, n_drones, 3))
        pos[:, :, 0] = time
        trail.add(np.full(n_worlds, time), pos)


def test_a_trail_keeps_positions_for_its_duration():
    trail = Trail(1.0)
    add_positions(trail, 0.25 * np.arange(9))
    np.testing.assert_allclose(trail.path(0)[:, 0, 0], [1.0, 1.25, 1.5, 1.75, 2.0])
    assert len(trail) == 5


def test_a_reset_clears_the_trail_of_its_world_only():
    trail = Trail(5.0)
    add_positions(trail, [0.0, 1.0, 2.0])
    trail.add([0.0, 3.0], [[[7, 0, 0]], [[3, 0, 0]]])
    trail.add([1.0, 4.0], [[[8, 0, 0]], [[4, 0, 0]]])
    np.testing.assert_allclose(trail.path(0)[:, 0, 0], [7, 8])
    np.testing.assert_allclose(trail.path(1)[:, 0, 0], [0, 1, 2, 3, 4])


def test_a_second_call_at_one_time_replaces_the_first():
    trail = Trail(5.0)
    add_positions(trail, [0.0, 1.0])
    trail.add([1.0, 1.0], np.full((2, 1, 3), 9.0))
    np.testing.assert_allclose(trail.path(1)[:, 0, 0], [0, 9])


def test_lines_fade_towards_their_beginning():
    trail, overlays = Trail(5.0), Overlays()
    add_positions(trail, np.arange(5.0), n_drones=2)
    trail.draw(overlays, 1, rgba=[[1, 0, 0, 1], [0, 0, 1, 0.5]])
    assert len(overlays) == 8
    alphas = np.array([rgba[3] for *_, rgba, _ in overlays._geoms]).reshape(2, 4)
    np.testing.assert_allclose(alphas[:, -1], [1.0, 0.5])
    assert (np.diff(alphas) > 0.05).all()


@pytest.mark.parametrize("seconds", [0, -1.0, np.nan, np.inf])
def test_a_duration_that_is_not_positive_is_refused(seconds):
    with pytest.raises(ConfigError, match="positive duration"):
        Trail(seconds)


@pytest.mark.parametrize(
    ("time", "pos", "message"),
    [
        ([0.0], np.zeros((2, 1, 3)), r"got \(1,\) and \(2, 1, 3\)"),
        ([0.0, 0.0], np.zeros((2, 3)), r"got \(2,\) and \(2, 3\)"),
        ([0.0] * 3, np.zeros((3, 1, 3)), r"positions of shape \(2, 1, 3\), as before, got \(3, 1, 3\)"),
    ],
)
def test_positions_of_another_shape_are_refused(time, pos, message):
    trail = Trail(1.0)
    add_positions(trail, [0.0])
    with pytest.raises(ConfigError, match=message):
        trail.add(time, pos)
