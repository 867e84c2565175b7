"""Depth images with Crazyflow's functions, against geometry by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, Sim
from crazysim.scene.depth import pixel_directions
from crazysim.sim.sensors.depth import render_depth


@pytest.fixture(scope="module")
def sim():
    sim = Sim(n_worlds=2, n_drones=2, control="attitude")
    pos = jnp.array([[[0, 0, 1.0], [0, -9, 1]], [[0, 0, 2.0], [0, -9, 1]]])
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    return sim


def test_depth_is_along_the_ray_and_minus_one_at_the_sky(sim):
    width, height = 30, 20
    depth = np.asarray(render_depth(sim, "fpv_cam:0", (width, height)))
    assert depth.shape == (2, height, width)
    down = -pixel_directions(70.0, width, height)[..., 1]
    eye = sim.airframe.value("shape.fpv_camera")[2] + np.array([1.0, 2.0])[:, None, None]
    expected = np.where(down > 0, eye / np.where(down > 0, down, 1), -1.0)
    np.testing.assert_allclose(depth, expected, rtol=1e-5)
    assert (depth == -1).mean() == 0.5


def test_camera_0_follows_the_first_drone_and_sees_45_degrees(sim):
    camera = sim.mj_model.camera(0)
    assert camera.name == "track_cam:0"
    assert camera.fovy == 45
    without_drones, with_drones = (
        np.asarray(render_depth(sim, resolution=(64, 64), include_drone=x)) for x in (False, True)
    )
    drone = with_drones != without_drones
    np.testing.assert_array_equal(np.asarray(render_depth(sim, 0, (64, 64))), without_drones)
    assert 10 < drone[0].sum() < 1000
    distance = np.linalg.norm(np.asarray(camera.pos))  # of the camera from the drone
    np.testing.assert_allclose(with_drones[drone], distance, atol=0.1)


def test_law_09_wrong_cameras_and_resolutions_are_refused(sim):
    for call, words in (
        (lambda: render_depth(sim, "nose"), "got 'nose'"),
        (lambda: render_depth(sim, 4), "got 4"),
        (lambda: render_depth(sim, "fpv_cam"), "got 2 for 'fpv_cam'. Use one such as 'fpv_cam:0'"),
        (lambda: render_depth(sim, resolution=64), "expected a resolution of width and height, pixels, got 64"),
        (lambda: render_depth(sim, resolution=(64,)), "got (64,)"),
        (lambda: render_depth(sim, resolution=(0, 4)), "got 0 x 4 pixels"),
    ):
        with pytest.raises(ConfigError) as error:
            call()
        assert words in str(error.value)
