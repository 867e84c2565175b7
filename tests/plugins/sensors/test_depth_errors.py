"""Errors of cameras and lidars: noise and holes against their formulas, lenses against OpenCV's, patterns of lidars."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from crazysim import Camera, Lidar, Sim, rotation
from crazysim.plugins.sensors import Distortion, StereoNoise

LENS = {"k1": -0.12, "k2": 0.03, "p1": 0.004, "p2": -0.006, "k3": 0.01}
"""Coefficients of a lens, as in OpenCV."""


@pytest.fixture(scope="module")
def wall_images():
    """Return drones at 1 to 6 m from a wall in 6 worlds, cameras and a lidar with errors, and their images."""
    sim = Sim(6, control="attitude", rng_key=2)
    sim.scene.add("wall", pos=[6.055, 0, -20], length=80, height=80, mocap=False)
    pos = np.stack([np.arange(6.0)[::-1], np.zeros(6), np.full(6, 5.0)], axis=-1)[:, None]
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.float32(pos)))
    sensors = [
        Camera(32, 24, fovy=40.0, outputs=("distance", "depth"), noise=StereoNoise(resolution=0.0)),
        Camera(4, 3, fovy=10.0, noise=StereoNoise(disparity_noise=0.0, resolution=0.05, min_depth=1.2), name="coarse"),
        Lidar(
            np.arange(-2, 2, 0.2), np.arange(-2, 2, 0.1), max_range=9.0, noise=0.02, relative_noise=0.01, dropout=0.25,
        ),
    ]  # fmt: skip
    return sim, sensors, jax.device_get([jax.jit(sensor.image_fn(sim))(sim.data) for sensor in sensors])


def test_stereo_noise_grows_with_the_square_of_the_distance(wall_images):
    """The standard deviation z^2 s / (f b) of a D435: 0.4% at 1 m, 2.3% at 6 m, and no bias."""
    _, (camera, *_), (images, *_) = wall_images
    depth = np.arange(1.0, 7.0)
    expected = depth**2 * 0.08 / (424 * 0.05)
    errors = images["depth"][:, 0] - depth[:, None, None]
    n = errors[0].size
    np.testing.assert_allclose(errors.std(axis=(1, 2)), expected, rtol=4 / np.sqrt(2 * n))
    assert np.all(np.abs(errors.mean(axis=(1, 2))) < 4 * expected / np.sqrt(n))
    np.testing.assert_allclose(images["distance"] * camera.rays[..., 0], images["depth"], rtol=1e-5)
    normalised = errors / expected[:, None, None]
    assert len(np.unique(normalised.round(5))) > 0.95 * normalised.size, (
        "worlds and pixels have different random numbers"
    )


def test_depth_has_a_resolution_and_a_smallest_value(wall_images):
    _, _, (_, images, _) = wall_images
    depth = images["depth"][:, 0]
    assert (depth[0] == 0).all()
    np.testing.assert_allclose(depth[1:], np.broadcast_to(np.arange(2.0, 7.0)[:, None, None], (5, 3, 4)), atol=0.026)
    np.testing.assert_allclose(depth / 0.05, np.round(depth / 0.05), atol=1e-3)


@pytest.mark.parametrize("width", [20, 80])
def test_holes_are_the_pixels_that_rays_of_c_mujoco_from_the_second_imager_do_not_reach(width):
    sim = Sim(2, control="attitude")
    rng = np.random.default_rng(0)
    sim.scene.add("wall", pos=[3.5, 0, 0], length=20, height=20, mocap=False)
    for k in range(16):
        kind, size = [("sphere", {"radius": 0.15}), ("box", {"size": [0.2, 0.1, 0.4]})][k % 2]
        pos = [rng.uniform(0.7, 3), *rng.uniform(-1, 1, 2) + [0, 1]]
        sim.scene.add(kind, f"object_{k}", pos=pos, **size, mocap=bool(k % 3))
    quat = np.array([0.1, 0.05, 0.1, 1]) / np.linalg.norm([0.1, 0.05, 0.1, 1])
    states = sim.data.states.replace(
        pos=jnp.float32([[[0, 0, 1]], [[-0.2, 0.1, 0.9]]]), quat=jnp.broadcast_to(jnp.float32(quat), (2, 1, 4))
    )
    sim.data = sim.data.replace(states=states)
    noise = StereoNoise(baseline=0.1, disparity_noise=0.0, resolution=0.0, min_depth=0.0)
    camera = Camera(width, width // 4, fovy=35.0, pos=(0.03, 0, 0.01), noise=noise, outputs=("distance",))
    true = dataclasses.replace(camera, noise=None)
    take_images = jax.jit(lambda data: [c.image_fn(sim)(data)["distance"] for c in (camera, true)])
    measured, distance = (np.asarray(x)[1, 0] for x in take_images(sim.data))
    sim.scene.sync_one(sim.data, 1)
    rot = np.asarray(rotation.matrix(jnp.asarray(quat)))
    left = np.array([-0.2, 0.1, 0.9]) + rot @ [0.03, 0, 0.01]
    right = left - 0.1 * rot[:, 1]
    own = sim.mj_model.body("drone:0").id
    n_holes = n_wrong = n_seen = 0
    for row, column in np.ndindex(distance.shape):
        if distance[row, column] >= camera.far:
            continue
        to_point = left + distance[row, column] * rot @ camera.rays[row, column] - right
        length, n_seen = np.linalg.norm(to_point), n_seen + 1
        hit = mujoco.mj_ray(
            sim.mj_model, sim.mj_data, right, to_point / length, None, 1, own, np.zeros(1, np.int32), None
        )
        is_hidden = 0 <= hit < 0.999 * length
        n_holes, n_wrong = n_holes + is_hidden, n_wrong + (is_hidden != (measured[row, column] == 0))
    assert n_holes > 0.005 * n_seen
    assert n_wrong <= 1e-3 * n_seen  # points at an edge, where rounding decides


def test_a_lidar_has_noise_and_lost_returns(wall_images):
    _, (*_, lidar), (*_, images) = wall_images
    distance, true = images["distance"][:, 0], np.arange(1.0, 7.0)[:, None, None] / lidar.rays[..., 0]
    lost = distance == 9.0
    assert abs(lost.mean() - 0.25) < 4 * np.sqrt(0.25 * 0.75 / lost.size)
    normalised = ((distance - true) / (0.02 + 0.01 * true))[~lost]
    assert abs(normalised.mean()) < 4 / np.sqrt(normalised.size)
    assert normalised.std() == pytest.approx(1.0, rel=4 / np.sqrt(2 * normalised.size))


def test_noise_of_a_world_does_not_depend_on_other_worlds_and_changes_with_the_step(wall_images):
    sim, (camera, *_), (images, *_) = wall_images
    steps = sim.data.core.steps + 1
    take_image = jax.jit(camera.image_fn(sim))
    later = take_image(sim.data.replace(core=sim.data.core.replace(steps=steps)))
    assert np.mean(later["depth"] == images["depth"]) < 0.01
    smaller_sim = Sim(2, control="attitude", rng_key=2)
    smaller_sim.scene.add("wall", pos=[6.055, 0, -20], length=80, height=80, mocap=False)
    pos = sim.data.states.pos[:2]
    smaller_sim.data = smaller_sim.data.replace(states=smaller_sim.data.states.replace(pos=pos))
    np.testing.assert_allclose(
        jax.jit(camera.image_fn(smaller_sim))(smaller_sim.data)["depth"], images["depth"][:2], rtol=1e-6
    )


def test_a_lens_maps_rays_to_pixels_by_the_formula_of_opencv():
    """x'' = x' (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x' y' + p2 (r^2 + 2 x'^2), and y'' alike, y down."""
    camera = Camera(20, 14, fovy=75.0, distortion=Distortion(**LENS))
    ahead, left, up = np.moveaxis(camera.rays, -1, 0)
    x, y = -left / ahead, -up / ahead
    k1, k2, p1, p2, k3 = LENS.values()
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    column = 10 - 0.5 + camera.focal * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
    row = 7 - 0.5 + camera.focal * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    np.testing.assert_allclose(column, np.broadcast_to(np.arange(20), (14, 20)), atol=1e-8)
    np.testing.assert_allclose(row, np.broadcast_to(np.arange(14)[:, None], (14, 20)), atol=1e-8)
    assert np.abs(camera.rays - Camera(20, 14, fovy=75.0).rays).max() > 0.02
    np.testing.assert_allclose(np.linalg.norm(camera.rays, axis=-1), 1)
    plain = Camera(20, 14, distortion=Distortion())
    np.testing.assert_allclose(plain.rays, Camera(20, 14).rays, atol=1e-12)


def test_patterns_of_lidars_agree_with_their_data_sheets():
    lidar, zones = Lidar.vlp16(90), Lidar.vl53l5cx()
    assert (lidar.image_size, zones.image_size) == ((16, 90), (8, 8))
    elevation = np.degrees(np.arcsin(lidar.rays[..., 2]))
    np.testing.assert_allclose(elevation, np.broadcast_to(np.arange(15, -16, -2.0)[:, None], (16, 90)), atol=1e-9)
    azimuth = np.degrees(np.arctan2(lidar.rays[0, :, 1], lidar.rays[0, :, 0]))
    np.testing.assert_allclose(np.diff(azimuth), -4)
    np.testing.assert_allclose(
        np.degrees(np.arctan2(zones.rays[0, :, 1], zones.rays[0, :, 0]))[[0, 7]], [19.6875, -19.6875]
    )
    assert zones.rays[0, 0, 2] > 0 > zones.rays[7, 7, 2]
    assert (zones.far, lidar.far, lidar.noise) == (4.0, 100.0, 0.03)


def test_engines_agree_on_the_images_of_a_step():
    result = []
    for engine in ("auto", "plain"):
        sim = Sim(2, control="attitude", engine=engine, rng_key=3)
        sim.scene.add("sphere", pos=[1.4, 0.1, 0.9], radius=0.3, mocap=False)
        camera = sim.add(Camera(8, 6, freq=250, noise=StereoNoise(), outputs=("depth", "segmentation")))
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos + jnp.array([0.0, 0, 1])))
        sim.step(3)
        result.append(jax.device_get(camera.read(sim.data).images))
    np.testing.assert_array_equal(result[0]["segmentation"], result[1]["segmentation"])
    np.testing.assert_allclose(result[0]["depth"], result[1]["depth"], atol=1e-3)  # a step of the resolution
    assert np.mean(result[0]["depth"] == result[1]["depth"]) > 0.9
