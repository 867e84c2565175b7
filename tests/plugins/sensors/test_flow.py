"""Optical flow of cameras: closed forms, image velocity, moving bodies, occlusion, and images in a sequence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import Camera, ConfigError, Lidar, Sim, SlungLoad, rotation
from crazysim.envs import CameraImages, make
from crazysim.plugins.sensors import Distortion

WIDTH, HEIGHT = 24, 18
OUTPUTS = ("flow", "flow_valid", "depth", "distance", "segmentation")
TOLERANCE = 2e-3
"""Rounding of float32 to pixels: 1e-6 m at 1 m times a focal length of 13 pixels, through three rotations."""


def view(**settings):
    return Camera(WIDTH, HEIGHT, outputs=OUTPUTS, pos=(0, 0, 0), max_depth=100.0, **settings)


@pytest.fixture(scope="module")
def scene():
    """Return a simulation of a wall 4 m ahead, a ball and a box that move, and a function of two datas."""
    sim = Sim(2, 2, control="attitude")
    sim.scene.add("wall", pos=[4, 0, 0], length=5, height=3, mocap=False)
    ball = sim.scene.add("sphere", pos=[2.0, 0.3, 1.2], radius=0.3)
    box = sim.scene.add("box", pos=[1.7, -0.6, 0.7], size=(0.5, 0.5, 0.5))
    camera = view()
    sim.data = with_states(sim.data, pos=[[0.0, 0, 1], [0.4, 0.1, 1.1]], quat=[0, 0, 0, 1.0])
    take_images = jax.jit(camera.image_fn(sim))
    return sim, camera, ball, box, take_images


def place(camera, points):
    """Return columns and rows of points in the frame of the camera (x ahead, y left, z up), in NumPy."""
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    return np.stack([(WIDTH - 1) / 2 - camera.focal * y / x, (HEIGHT - 1) / 2 - camera.focal * z / x], axis=-1)


def test_flow_of_a_pure_rotation_and_of_motion_towards_a_wall(scene):
    """A turn moves every point, also of the sky, by its angle; an approach by t moves points by t / (Z + t) of x."""
    sim, camera, *_, take_images = scene
    yaw = np.array([0, 0, np.sin(0.05), np.cos(0.05)])
    before, after = (with_states(sim.data, quat=np.array([q, [0, 0, 0, 1]])) for q in (yaw * [1, 1, -1, 1], yaw))
    flow = np.asarray(take_images(after, before)["flow"])[0, 0]
    turned = np.asarray(rotation.rotate(rotation.multiply(yaw, yaw), jnp.asarray(camera.rays)))
    np.testing.assert_allclose(flow, place(camera, camera.rays) - place(camera, turned), atol=TOLERANCE)
    assert (np.asarray(take_images(after, before)["segmentation"]) == -1).any()
    assert flow[HEIGHT // 2, WIDTH // 2, 0] > 2, "a turn to the left moves the image to the right"
    shift = 0.2
    images = take_images(sim.data, with_states(sim.data, pos=np.asarray(sim.data.states.pos) - [shift, 0, 0]))
    images = jax.device_get({k: x[0, 0] for k, x in images.items()})
    is_fixed = np.isin(images["segmentation"], [0, 1])
    offset = place(camera, camera.rays) - [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]
    expected = offset * (shift / (images["depth"] + shift))[..., None]
    np.testing.assert_allclose(images["flow"][is_fixed], expected[is_fixed], atol=TOLERANCE)
    np.testing.assert_allclose(images["flow"][images["segmentation"] == -1], 0, atol=TOLERANCE)


def test_flow_per_time_is_the_image_velocity_of_a_flying_and_turning_camera(scene):
    """Longuet-Higgins and Prazdny (1980): velocities of image points from depth, velocity and angular velocity."""
    sim, camera, *_, take_images = scene
    rng, dt = np.random.default_rng(3), 0.01
    quat = rng.normal(size=4) * 0.1 + [0, 0, 0, 1]
    quat /= np.linalg.norm(quat)
    vel, ang_vel = np.array([0.7, -0.4, 0.3]), np.array([0.5, -0.8, 1.1])
    pos = np.array([[0.0, 0, 1], [-1, 2, 1]])
    # Central differences: errors of order dt^2.
    ends = [
        with_states(
            sim.data,
            pos=pos + sign * dt / 2 * vel,
            quat=rotation.integrate_attitude(jnp.asarray(quat), jnp.asarray(ang_vel), sign * dt / 2),
        )
        for sign in (-1, 1)
    ]
    images = jax.device_get({k: x[0, 0] for k, x in take_images(ends[1], ends[0]).items()})
    is_fixed = images["segmentation"] <= 1
    depth = np.where(images["segmentation"] < 0, np.inf, images["depth"])[..., None]
    body_vel = np.asarray(rotation.rotate_inverse(jnp.asarray(quat), jnp.asarray(vel)))
    x, y = np.moveaxis(camera.rays[..., 1:] / camera.rays[..., :1], -1, 0)  # left and up at distance 1
    points = camera.rays / camera.rays[..., :1]
    rate = -body_vel / depth - np.cross(ang_vel, points)
    expected = -camera.focal * np.stack([rate[..., 1] - x * rate[..., 0], rate[..., 2] - y * rate[..., 0]], axis=-1)
    error = np.abs(images["flow"] / dt - expected)[is_fixed]
    assert is_fixed.mean() > 0.5
    assert error.max() < 0.03 * np.abs(expected).max()


def test_flow_of_moving_and_turning_bodies(scene):
    """Each point moves with its body: the poses then and now give its place then."""
    sim, camera, ball, box, take_images = scene
    turn = np.array([0.1, -0.2, 0.3, 0.9])
    turn /= np.linalg.norm(turn)
    before = ball.set_pose(sim.data, [2.1, 0.2, 1.15])
    before = box.set_pose(before, [1.8, -0.5, 0.6], turn)
    pos = np.asarray(sim.data.states.pos)
    before = before.replace(states=before.states.replace(pos=pos - np.float32([[0.1, 0.2, 0], [0, 0.3, 0.1]])))
    after = sim.data.replace(states=sim.data.states.replace(pos=pos))
    images = jax.device_get({k: x[1, 0] for k, x in take_images(after, before).items()})
    names = camera.segment_names(sim)
    eye, eye_before = pos[1, 0], pos[1, 0] - [0.1, 0.2, 0]
    points = eye + camera.rays * np.where(images["segmentation"] < 0, 1e9, images["distance"])[..., None]
    poses = {
        "sphere:0": ([2.0, 0.3, 1.2], [2.1, 0.2, 1.15], np.eye(3)),
        "box:0": ([1.7, -0.6, 0.7], [1.8, -0.5, 0.6], np.asarray(rotation.matrix(jnp.asarray(turn)))),
        "drone:1": (pos[1, 1], pos[1, 1] - [0, 0.3, 0.1], np.eye(3)),
    }
    for name, (now, then, rot) in poses.items():
        mask = images["segmentation"] == names.index(name)
        assert mask.sum() > 2, name
        points[mask] = then + (points[mask] - now) @ rot.T
    expected = place(camera, camera.rays) - place(camera, points - eye_before)
    np.testing.assert_allclose(images["flow"], expected, atol=TOLERANCE)
    assert np.abs(expected[images["segmentation"] == names.index("box:0")]).max() > 2


@pytest.mark.parametrize("distortion", [None, Distortion(k1=-0.2, k2=0.03, p1=0.01)])
def test_a_lens_maps_its_own_pixels_to_themselves(distortion):
    camera = view(distortion=distortion)
    forward, left, up = np.moveaxis(camera.rays, -1, 0)
    places, is_shown = camera.project(jnp.stack([-left, up, -forward], axis=-1))
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    np.testing.assert_allclose(places, np.stack([columns, rows], axis=-1), atol=1e-4)
    assert np.asarray(is_shown).all()
    _, is_shown = camera.project(jnp.asarray([[0, 0, 1.0], [5, 0, -1], [-30, 40, -1], [1, 0, 0], [0, 0, 0]]))
    assert not np.asarray(is_shown).any()


def test_pixels_are_valid_that_the_image_before_shows(scene):
    """Points hidden before are nearer in the depth image before than they were: the reprojected depth, off edges."""
    sim, camera, ball, _, take_images = scene
    after = with_states(sim.data, pos=[[0.0, 0.0, 1], [9, 9, 1]])
    before = ball.set_pose(with_states(sim.data, pos=[[0.0, 0.5, 1], [9, 9, 1]]), [2.0, -0.3, 1.2])
    images, earlier = (
        jax.device_get({k: x[0, 0] for k, x in image.items()})
        for image in (take_images(after, before), take_images(before, before))
    )
    points = camera.rays * images["distance"][..., None]
    is_ball = images["segmentation"] == camera.segment_names(sim).index("sphere:0")
    points = points + [0, -0.5, 0] + np.where(is_ball[..., None], [0, -0.6, 0], 0)
    columns, rows = np.moveaxis(np.rint(place(camera, points)).astype(int), -1, 0)
    is_inside = (columns >= 0) & (columns < WIDTH) & (rows >= 0) & (rows < HEIGHT) & (images["segmentation"] >= 0)
    valid = images["flow_valid"]
    assert not valid[~is_inside & (images["segmentation"] >= 0)].any()
    shown = earlier["distance"][np.clip(rows, 0, HEIGHT - 1), np.clip(columns, 0, WIDTH - 1)]
    is_hidden = shown < 0.9 * np.linalg.norm(points, axis=-1)
    assert (is_inside & is_hidden).sum() > 10
    assert (valid == ~is_hidden)[is_inside].mean() > 0.95
    still = take_images(before, before)
    np.testing.assert_allclose(still["flow"], 0, atol=TOLERANCE)
    # Without motion, edges of 0.1 % of the distance alone can hide a point.
    assert np.asarray(still["flow_valid"]).mean() > 0.98


def test_a_load_that_moves_with_the_drone_has_no_flow():
    sim = Sim(1, control="attitude")
    load = sim.add(SlungLoad(mass=0.005, length=0.3))
    camera = Camera(WIDTH, HEIGHT, outputs=OUTPUTS, pos=(0.1, 0, 0), rpy=(0, np.pi / 2, 0))
    take_images, names = jax.jit(camera.image_fn(sim)), camera.segment_names(sim)
    data = load.hang(with_states(sim.data, pos=[[0.0, 0, 1]]))
    before = load.hang(with_states(sim.data, pos=[[0.1, 0, 1]]))
    images = jax.device_get(take_images(data, before))
    is_floor = images["segmentation"] == names.index("floor")
    assert np.abs(images["flow"][is_floor]).max() > 1
    assert (~is_floor).sum() > 5
    np.testing.assert_allclose(images["flow"][~is_floor], 0, atol=10 * TOLERANCE)


def test_images_of_a_flight_are_compared_with_the_image_before():
    """25 images/s in 100 steps/s; an object that is added later takes part, and a reset begins anew."""
    sim = Sim(2, control="attitude", freq=100, engine="interpret")
    camera = sim.add(view(freq=25, latency=0.02))
    ball = sim.scene.add("sphere", pos=[1.4, 0.1, 0.9], radius=0.3)
    take_images, seen, records = jax.jit(camera.image_fn(sim)), [], []
    sim.data = with_states(sim.data, pos=[[0.0, 0, 1]], vel=[1.0, 0.5, 0])
    for step in range(12):
        sim.data = ball.set_pose(sim.data, [1.4, 0.1, 0.9 + 0.02 * step])
        sim.step()
        seen.append(sim.data)
        records.append(jax.device_get(camera.read(sim.data)))
    for step, record in enumerate(records):
        taken = max((step - 2) // 4 * 4, 0)
        if taken:
            expected = take_images(seen[taken], seen[taken - 4])
            np.testing.assert_allclose(record.images["flow"], expected["flow"], atol=TOLERANCE)
            np.testing.assert_array_equal(record.images["flow_valid"], expected["flow_valid"])
            assert np.abs(expected["flow"]).max() > 0.5
        else:
            assert not record.images["flow"].any()
            assert not record.images["flow_valid"].any()
    sim.reset(np.array([True, False]))
    sim.step()
    valid = np.asarray(camera.read(sim.data).images["flow_valid"])
    assert not valid[0].any()
    assert valid[1].any()


def test_a_camera_that_is_added_in_flight_has_no_image_before():
    sim = Sim(1, control="attitude", freq=100, engine="interpret")
    sim.step(20)
    camera = sim.add(view())
    sim.step()
    assert not np.asarray(camera.read(sim.data).images["flow_valid"]).any()
    assert not np.asarray(camera.read(sim.data).images["flow"]).any()
    sim.step()
    assert np.asarray(camera.read(sim.data).images["flow_valid"]).any()


def test_flow_is_observed():
    env = CameraImages(make("avoid", 2, n_boxes=1, n_poles=3, engine="interpret"), view())
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(3))
    assert not np.asarray(state.obs["camera.flow_valid"]).any()
    for _ in range(2):
        state = step(state, jnp.full((2, 1, 4), 0.3))
    assert state.obs["camera.flow"].shape == (2, 1, WIDTH * HEIGHT * 2)
    assert np.asarray(state.obs["camera.flow_valid"]).mean() > 0.8
    flow = np.asarray(state.obs["camera.flow"])
    assert 1e-3 < np.abs(flow).max() < 10
    assert env.image_formats()["camera.flow"]["unit"] == "pixel"


def test_law_09_a_lidar_has_no_flow():
    with pytest.raises(ConfigError, match=r"lidar without .* flow"):
        Lidar(outputs=("flow",))
