"""Mountings of cameras that differ on every drone, in every world and episode."""

import jax
import numpy as np
import pytest
from cases import with_states

from crazysim import Camera, ConfigError, Sim
from crazysim.plugins.sensors import RandomPose
from crazysim.scene import depth

OUTPUTS = "depth", "normal"
DOWN = {"pos": (0, 0, 0), "rpy": (0, np.pi / 2, 0), "drones": False}


@pytest.fixture(scope="module")
def sim():
    sim = Sim(4, 2, control="attitude")
    sim.data = with_states(sim.data, pos=[[0.0, 0, 1], [1, 0, 2]], quat=[0, 0, 0, 1.0])
    return sim


def floor_seen(sim, data, random_pose, **settings):
    """Return height above the floor, m (4, 2), and its normal in the frame of the camera (4, 2, 3)."""
    camera = Camera(3, 3, outputs=OUTPUTS, random_pose=random_pose, **DOWN, **settings)
    images = jax.device_get(jax.jit(camera.image_fn(sim))(data))
    normal = images["normal"][:, :, 1, 1]
    # The middle ray is along the axis of the camera, x, which looks down.
    return images["depth"][:, :, 1, 1] * -normal[..., 0], normal


def test_positions_and_attitudes_are_drawn_within_their_limits(sim):
    flat = np.broadcast_to([-1.0, 0, 0], (4, 2, 3))
    height, normal = floor_seen(sim, sim.data, RandomPose(pos=0.1, angle=0))
    change = height - [1, 2]
    np.testing.assert_allclose(normal, flat, atol=1e-6)
    assert np.abs(change).max() <= 0.1
    assert np.unique(change.round(4)).size == 8, "drones and worlds differ"
    assert np.ptp(change) > 0.05
    height, normal = floor_seen(sim, sim.data, RandomPose(pos=0, angle=10))
    np.testing.assert_allclose(height, np.broadcast_to([1, 2], (4, 2)), rtol=1e-5)
    tilt = np.degrees(np.arccos(-normal[..., 0]))
    assert np.unique(tilt.round(3)).size == 8
    assert 3 < tilt.max() <= 10 * np.sqrt(2), "of roll and pitch, since a turn about the vertical is no tilt"
    height, normal = floor_seen(sim, sim.data, RandomPose(0, 0), readout=0.01)
    np.testing.assert_allclose(height, np.broadcast_to([1, 2], (4, 2)), rtol=1e-5)


def test_a_mounting_stays_for_an_episode(sim, monkeypatch):
    random_pose = RandomPose(pos=0.05, angle=5)
    first = floor_seen(sim, sim.data, random_pose)
    later = sim.data.replace(core=sim.data.core.replace(steps=sim.data.core.steps + 7))
    for x, y in zip(floor_seen(sim, later, random_pose), first, strict=True):
        np.testing.assert_array_equal(x, y)
    episode = sim.data.core.episode.at[2].add(1)
    height, _ = floor_seen(sim, sim.data.replace(core=sim.data.core.replace(episode=episode)), random_pose)
    assert (np.abs(height - first[0])[2] > 1e-4).all()
    np.testing.assert_array_equal(np.delete(height, 2, 0), np.delete(first[0], 2, 0))
    other, _ = floor_seen(sim, sim.data, random_pose, name="other")
    assert (np.abs(other - first[0]) > 1e-5).all(), "cameras of other names have other mountings"
    # Worlds that do not fit into memory together have the same mountings.
    monkeypatch.setattr(depth, "MAX_RAYS_OF_KERNEL", 9)
    for x, y in zip(floor_seen(sim, sim.data, random_pose), first, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-6)


def test_law_09_wrong_random_poses_are_refused():
    with pytest.raises(ConfigError, match="angle"):
        RandomPose(angle=180)
    with pytest.raises(ConfigError, match="random_pose"):
        Camera(random_pose=0.1)  # type: ignore[arg-type]
