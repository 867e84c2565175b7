"""Exposure blur and rolling shutter of cameras, against images of single instants and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import Camera, ConfigError, Sim

SIZE = 24, 16
VEL, ANG_VEL = np.array([[1.0, -2.0, 0.5], [0.0, 1.0, 0]]), np.array([[2.0, -3.0, 4.0], [0, 0, 1.0]])


@pytest.fixture(scope="module")
def sim():
    sim = Sim(2, 2, control="attitude")
    sim.scene.add("wall", pos=[3, 0, 0], length=4, height=3, mocap=False)
    sim.scene.add("box", pos=[1.6, -0.3, 0.8], size=(0.4, 0.4, 0.4), rgba=(1, 0.5, 0, 1), mocap=False)
    ball = sim.scene.add("sphere", pos=[1.5, 0.3, 1.1], radius=0.25, rgba=(0, 0, 1, 1))
    sim.data = ball.set_pose(sim.data, [1.5, 0.3, 1.1], vel=[0, 0, 8.0])
    sim.data = with_states(sim.data, pos=[[0, 0, 1], [0.6, -0.2, 1.1]], quat=[0, 0, 0, 1.0], vel=VEL, ang_vel=ANG_VEL)
    return sim


def at_time(data, time):
    """Return the data at another time, by the formulas of constant velocities, in NumPy."""
    angle = np.linalg.norm(ANG_VEL, axis=-1, keepdims=True) * time
    axis = ANG_VEL / np.linalg.norm(ANG_VEL, axis=-1, keepdims=True)
    quat = np.concatenate([np.sin(angle / 2) * axis, np.cos(angle / 2)], axis=-1)
    moved = with_states(data, pos=np.asarray(data.states.pos[0]) + time * VEL, quat=quat, vel=VEL, ang_vel=ANG_VEL)
    return moved.replace(objects=data.objects.replace(pos=data.objects.pos + np.float32([0, 0, 8.0]) * time))


def images_of(sim, camera, *datas):
    take_images = jax.jit(camera.image_fn(sim))
    images = [jax.device_get(take_images(data)) for data in datas]
    return {name: np.stack([image[name] for image in images]) for name in images[0]}


def test_a_rolling_shutter_reads_each_row_at_its_time(sim):
    """The row r of 16 is read (15 - r) / 15 of the readout before the image; the camera moves, and the scene stays."""
    outputs, readout = ("depth", "normal", "segmentation", "rgb"), 0.03
    rolling = images_of(sim, Camera(*SIZE, outputs=outputs, drones=False, readout=readout), sim.data)
    times = np.linspace(-readout, 0, SIZE[1])
    instants = [at_time(sim.data, time).replace(objects=sim.data.objects) for time in times]
    still = images_of(sim, Camera(*SIZE, outputs=outputs, drones=False), *instants)
    row = np.arange(SIZE[1])
    for name, tolerance in (("depth", 1e-4), ("normal", 1e-4), ("segmentation", 0), ("rgb", 2)):
        expected = np.moveaxis(still[name][row, :, :, row], 0, 2)
        is_equal = np.abs(rolling[name][0].astype(float) - expected) <= tolerance
        # Rounding moves rays at edges.
        assert is_equal.mean() > 0.99, name
    difference = np.abs(rolling["depth"][0] - still["depth"][-1])
    assert difference[:, :, -1].max() < 1e-4
    assert difference[:, 0, 0].max() > 0.02
    assert (rolling["segmentation"][0] != still["segmentation"][-1]).mean() > 0.02


def test_an_exposure_is_the_mean_of_its_instants(sim):
    """Samples are in the middles of equal parts of the exposure before the image; drones and objects move in it."""
    n, exposure = 4, 0.02
    outputs = "rgb", "gray", "depth"
    blurred = images_of(sim, Camera(*SIZE, outputs=outputs, exposure=exposure, blur_samples=n), sim.data)
    instants = [at_time(sim.data, -exposure * (k + 0.5) / n) for k in range(n)]
    sharp = images_of(sim, Camera(*SIZE, outputs=outputs), *instants, sim.data)
    error = np.abs(blurred["rgb"][0] - sharp["rgb"][:n].mean(axis=0))
    assert (error <= 1.01).mean() > 0.995
    np.testing.assert_allclose(blurred["depth"][0], sharp["depth"][n])
    np.testing.assert_allclose(blurred["gray"][0], blurred["rgb"][0] @ [0.299, 0.587, 0.114], atol=0.51)
    difference = np.abs(blurred["rgb"][0] - sharp["rgb"][n].astype(int)).max(axis=-1)
    assert (difference > 20).mean() > 0.02
    # The ball moves, too: without its velocity it would be sharper.
    still = sim.data.replace(objects=sim.data.objects.replace(vel=jnp.zeros_like(sim.data.objects.vel)))
    blurred_ball = images_of(sim, Camera(*SIZE, outputs=outputs, exposure=exposure, blur_samples=n), still)
    assert np.abs(blurred_ball["rgb"][0] - blurred["rgb"][0].astype(int)).max() > 20


def test_the_edge_of_a_wall_is_blurred_by_the_motion_in_pixels(tmp_path):
    """Velocity v across the view, exposure T, distance Z, focal length f: a ramp of f v T / Z pixels."""
    path = tmp_path / "scene.xml"
    path.write_text("""<mujoco><visual><headlight active="0"/></visual>
        <asset><material name="white" rgba="1 1 1 1" emission="1"/></asset>
        <worldbody><geom type="box" size=".05 5 5" pos="2.05 -5 0" material="white"/></worldbody></mujoco>""")
    sim = Sim(1, control="attitude", xml_path=path)
    camera = Camera(64, 4, fovy=10, pos=(0, 0, 0), outputs=("gray",), exposure=0.1, blur_samples=50)
    data = with_states(sim.data, pos=[[0.0, 0, 0]], quat=[0, 0, 0, 1.0], vel=[0.0, 10.0, 0])
    image = jax.jit(camera.image_fn(sim))(data)["gray"][0, 0]
    # The edge at y = 0 is in the middle now, and was to the left of it, since the camera was farther to the right.
    length = camera.focal * 10 * 0.1 / 2
    column = np.arange(64) - 31.5
    assert 5 < length < 20
    expected = 255 * np.clip((column + length) / length, 0, 1)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=255 * (1 / 50 + 0.01))


def test_law_09_settings_that_exclude_each_other():
    with pytest.raises(ConfigError, match=r"global shutter.*readout=0"):
        Camera(outputs=("flow",), readout=0.01)
    with pytest.raises(ConfigError, match="exposure"):
        Camera(exposure=1.0)
    with pytest.raises(ConfigError, match=r"a colour among the outputs.*color_gradients.*rgb"):
        Camera(color_gradients=True)
