"""Splats under the names of Crazyflow, with its shapes and defaults."""

import mujoco
import numpy as np
import pytest
from splat_files import write_splats

from crazysim import ConfigError, Sim
from crazysim.sim.sensors import splat as images
from crazysim.sim.splat import attach_splats


def test_images_have_the_shapes_and_ranges_of_crazyflow(tmp_path):
    sim = Sim(n_worlds=2, n_drones=3)
    with pytest.raises(ConfigError, match="attach_splats"):
        images.render_splat_rgb(sim)
    for options in ({}, {"scene": "a.ply", "drone": "b.ply"}):
        with pytest.raises(ConfigError, match="Pass scene="):
            attach_splats(sim, **options)
    write_splats(tmp_path / "a.ply", n=6, n_colors=1, z=np.zeros(6))
    attach_splats(sim, scene=tmp_path / "a.ply")
    rgb = images.render_splat_rgb(sim, drones=[2, 0], resolution=(12, 8))
    assert rgb.shape == (2, 2, 8, 12, 3)
    rgbd = images.build_render_splat_rgbd_fn(sim, 2, (12, 8), alpha_threshold=0.3, max_range=5.0)(sim.data)
    assert rgbd.shape == (2, 1, 8, 12, 4)
    np.testing.assert_allclose(rgbd[:, 0, ..., :3], rgb[:, 0], atol=1e-5)
    depth = np.asarray(rgbd[..., 3])
    assert depth.max() == 5.0
    assert 0.5 < depth.min() < 4
    with pytest.raises(ConfigError, match="resolution"):
        images.render_splat_rgb(sim, resolution=12)
    with pytest.raises(ConfigError, match="GiB"):
        images.render_splat_rgb(sim, resolution=(10**6, 10**6))


def test_matrices_and_focal_lengths_project_as_mujoco_does():
    sim = Sim(n_worlds=1)
    sim.scene.sync_one(sim.data, 0)
    model, data = sim.mj_model, sim.mj_data
    mujoco.mj_forward(model, data)
    camera = model.cam("fpv_cam:0").id
    rot = data.cam_xmat[camera].reshape(3, 3)
    point = data.cam_xpos[camera] + rot @ [0.4, 0.3, -2.0]  # right, up, back
    view = np.asarray(images.viewmats(np.float32(data.cam_xpos[camera]), np.float32(rot)))
    seen = view @ [*point, 1]
    np.testing.assert_allclose(seen, [0.4, -0.3, 2.0, 1.0], atol=1e-6)
    (fx, fy), centre = images.camera_intrinsics(model, camera, (64, 48))
    assert fx == fy == pytest.approx(24 / np.tan(np.deg2rad(model.cam_fovy[camera]) / 2))
    assert centre == (32, 24)
