"""Cameras as plugins: rate, latency and mounting; their outputs against C MuJoCo's rays."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import with_states

from crazysim import Camera, ConfigError, RangeFinder, Sim, Terrain, rotation
from crazysim.scene.ray_casting import MIN_COSINE

SIZE = {"width": 9, "height": 6}


@pytest.fixture(scope="module")
def flight():
    sim = Sim(2, 2, control="attitude", freq=200)
    sim.scene.add("wall", pos=[3, 0, 0], length=20, height=20, mocap=False)
    outputs = ("depth", "distance", "normal", "segmentation")
    camera = sim.add(
        Camera(**SIZE, fovy=60.0, rpy=(0.1, 0.4, -0.2), outputs=outputs, freq=50, latency=0.03, drones=False)
    )
    sim.scene.add("sphere", pos=[1.4, 0.1, 0.9], radius=0.3, mocap=False)
    sim.data = with_states(sim.data, pos=[[0.0, 0, 1], [0.5, -0.4, 1.2]])
    take_image, images, records = jax.jit(camera.image_fn(sim)), [], []
    for _ in range(15):
        sim.step()
        images.append(jax.device_get(take_image(sim.data)))
        records.append((jax.device_get(camera.read(sim.data)), np.asarray(camera.age(sim.data))))
    return sim, camera, images, records


def test_images_are_taken_at_a_rate_and_delivered_late(flight):
    """50 images/s in 200 steps/s, 6 steps late: images of steps 0, 4, 8; the first one is delivered at once."""
    _, _, images, records = flight
    for step, (record, age) in enumerate(records):
        taken_step = max((step - 6) // 4 * 4, 0)
        assert (record.taken_step == taken_step).all()
        np.testing.assert_allclose(age, (step - taken_step) / 200, rtol=1e-6)
        for name, image in record.images.items():
            np.testing.assert_allclose(image, images[taken_step][name], rtol=1e-5, atol=1e-6, err_msg=f"{name} {step}")
    assert np.ptp([x["depth"] for x in images], axis=0).max() > 1e-4


def test_a_range_of_latency_is_drawn_in_every_world_and_episode():
    """Images of 200 Hz, 4 to 12 steps late: 200 draws of nine values miss one in 5e-10 of all seeds."""
    sim = Sim(200, control="attitude", freq=200, rng_key=1)
    camera = sim.add(Camera(1, 1, latency=(0.02, 0.06)))
    episodes = []
    for _ in range(2):
        sim.step(20)
        ages = [np.asarray(camera.age(sim.data)) * 200]
        sim.step(7)
        ages.append(np.asarray(camera.age(sim.data)) * 200)
        np.testing.assert_allclose(*ages, atol=1e-3)
        np.testing.assert_array_equal(np.unique(ages[0].round(3)), np.arange(4, 13))
        episodes.append(ages[0])
        sim.reset()
    assert np.mean(np.abs(episodes[0] - episodes[1]) < 0.5) < 0.3  # 1/9 expected
    with pytest.raises(ConfigError, match="shortest first"):
        Camera(1, 1, latency=(0.06, 0.02))


def test_law_10_an_image_arrives_after_the_latency_of_the_episode_whatever_other_worlds_drew():
    """Images of 10 Hz in 100 steps/s, 0 to 9 steps late: image 10 is held from step 10 plus the latency on."""
    arrivals = {}
    for n in (1, 12):
        sim = Sim(n, control="attitude", freq=100, rng_key=3)
        camera = sim.add(Camera(1, 1, freq=10, latency=(0.0, 0.09)))
        arrivals[n] = []
        for _ in range(4):
            sim.reset()
            taken = []
            for _ in range(20):
                sim.step()
                taken.append(np.asarray(camera.read(sim.data).taken_step)[0, 0])
            arrivals[n].append(int(np.argmax(np.array(taken) == 10)))
    assert arrivals[1] == arrivals[12]
    assert all(10 <= step <= 19 for step in arrivals[1])
    assert len(set(arrivals[1])) > 1


def test_outputs_agree_with_rays_of_c_mujoco_in_the_frame_of_the_camera(flight):
    sim, camera, images_of_steps, _ = flight
    images, names = images_of_steps[-1], camera.segment_names(sim)
    assert names == ("floor", "wall:0", "sphere:0")
    sim.scene.sync_one(sim.data, 1)
    mount = np.asarray(rotation.matrix(rotation.from_rpy(jnp.array([0.1, 0.4, -0.2]))))
    group, geom, hit_names = np.array([1, 1, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32), set()
    for drone in range(2):
        body = np.asarray(rotation.matrix(sim.data.states.quat[1, drone]))
        eye = np.asarray(sim.data.states.pos[1, drone]) + body @ sim.airframe.value("shape.fpv_camera")
        for row, column in np.ndindex(6, 9):
            ray, normal = camera.rays[row, column], np.zeros(3)
            assert ray[0] == pytest.approx(1 / np.sqrt(1 + (ray[1] / ray[0]) ** 2 + (ray[2] / ray[0]) ** 2))
            direction = body @ mount @ ray
            distance = mujoco.mj_ray(sim.mj_model, sim.mj_data, eye, direction, group, 1, -1, geom, normal)
            distance = distance if distance >= 0 else np.inf
            assert images["distance"][1, drone, row, column] == pytest.approx(min(distance, 10.0), rel=1e-5)
            assert images["depth"][1, drone, row, column] == pytest.approx(min(distance * ray[0], 10.0), rel=1e-5)
            root = sim.mj_model.body(sim.mj_model.body_rootid[sim.mj_model.geom_bodyid[geom[0]]]).name
            hit_names.add(name := "nothing" if distance == np.inf else root if root != "world" else "floor")
            index = images["segmentation"][1, drone, row, column]
            assert (names[index] if index >= 0 else "nothing") == name
            np.testing.assert_allclose(images["normal"][1, drone, row, column], (body @ mount).T @ normal, atol=1e-4)
    assert hit_names >= {"floor", "wall:0", "sphere:0"}
    # A pixel on the left of the image is on the left of the camera, a pixel in the upper row above it.
    assert camera.rays[0, 0, 1] > 0 > camera.rays[0, -1, 1]
    assert camera.rays[0, 0, 2] > 0 > camera.rays[-1, 0, 2]
    assert np.degrees(2 * np.arctan2(camera.rays[0, 4, 2] * 6 / 5, camera.rays[0, 4, 0])) == pytest.approx(60)


@pytest.mark.parametrize("ground", ["floor", "terrain"])
def test_sensors_of_landed_drones_see_the_ground(ground):
    """Drones land 1 mm below the floor, and a rolled one has its camera deeper: rays begin at the ground."""
    sim = Sim(2, control="attitude")
    if ground == "terrain":
        sim.add(Terrain(np.full((5, 5), 0.4), (8.0, 8.0)))
    height = {"floor": -0.001, "terrain": 0.399}[ground]
    roll = np.sqrt(0.5)
    quat = jnp.float32([[[0, 0, 0, 1]], [[roll, 0, 0, roll]]])
    states = sim.data.states.replace(pos=jnp.full((2, 1, 3), jnp.float32([0, 0, height])), quat=quat)
    sim.data = sim.data.replace(states=states)
    for pos in ((0, 0, 0), (0, -0.05, -0.02)):
        camera = Camera(4, 4, pos=pos, outputs=("depth", "segmentation"))
        images = jax.device_get(jax.jit(camera.image_fn(sim))(sim.data))
        assert (images["segmentation"][0, 0] == [[-1]] * 2 + [[0]] * 2).all()
        assert images["depth"][0, 0, 2:].max() < 1e-3
        assert (images["segmentation"][1, 0] == [-1, -1, 0, 0]).all()  # rolled to the right
    ranges = sim.add(RangeFinder([[0, 0, -1], [1, 0, 0], [0, 0, 1], [0, -1, 0]]))
    sim.step()
    distance = np.asarray(ranges.read(sim.data).distance)[:, 0]
    np.testing.assert_allclose(distance[0], [0, 4, 4, 4], atol=2e-3)
    assert distance[1, 3] < 2e-3


KINDS = {
    "ball": 'type="sphere" size=".25"', "brick": 'type="box" size=".2 .3 .25" euler="20 0 40"',
    "pill": 'type="capsule" size=".15 .2"', "can": 'type="cylinder" size=".2 .25"',
    "egg": 'type="ellipsoid" size=".15 .2 .3"', "tip": 'type="mesh" mesh="wedge"',
}  # fmt: skip
WEDGE = '<asset><mesh name="wedge" vertex="-.2 -.2 -.2 .4 0 0 0 .5 0 0 0 .6"/></asset>'


@pytest.mark.long("compiles a step with images in float64, and its derivatives")
def test_derivatives_of_images_are_central_differences(x64, rng):
    """Depths after three steps, away from edges: moving drones in random scenes of movable objects of all kinds."""
    n = 16
    sim = Sim(n, 2, control="attitude", freq=100)
    for name, geom in KINDS.items():
        sim.scene.add(f"<mujoco>{WEDGE}<worldbody><geom {geom}/></worldbody></mujoco>", name, pos=[0, 0, -9])
    camera = Camera(16, 12, fovy=50.0, outputs=("depth", "normal", "segmentation"), max_depth=4.0)
    as_float64 = lambda x: jnp.asarray(x, np.float64) if x.dtype == np.float32 else x  # noqa: E731
    data = jax.tree.map(as_float64, sim.data)
    take_images, step = camera.image_fn(sim), sim.build_step_fn()
    # Drones face each other, and the objects are between and around them.
    pos = rng.uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 1.8], (n, 2, 3)) + [[-0.4, 0, 0], [0.4, 0, 0]]
    object_pos = rng.uniform([-1, -1.2, 0.6], [1, 1.2, 2.4], (n, 1, len(KINDS), 3))
    quat = 0.1 * rng.normal(size=(n, 2, 4)) + [[0, 0, 0, 1.0], [0, 0, 1.0, 0]]
    args = pos, quat, rng.normal(size=(n, 2, 3)), object_pos, rng.normal(size=(n, 1, len(KINDS), 4))

    def fly(pos, quat, vel, object_pos, object_quat):
        quat, object_quat = (q / jnp.linalg.norm(q, axis=-1, keepdims=True) for q in (quat, object_quat))
        states = data.states.replace(pos=pos, quat=quat, vel=vel)
        moved = data.objects.replace(pos=object_pos, quat=object_quat)
        data_after = step(data.replace(states=states, objects=moved), 3)
        return take_images(data_after)["depth"], (take_images(data_after), data_after.states.quat)

    shifts = tuple(rng.normal(size=x.shape) for x in args)
    h, fly = 1e-6, jax.jit(fly)
    (low, (images, quat_after)), (high, (images_high, _)) = (
        jax.device_get(fly(*(x + sign * h * shift for x, shift in zip(args, shifts, strict=True)))) for sign in (-1, 1)
    )
    # No edge passes a pixel, and no ray grazes a surface.
    rays = np.asarray(rotation.rotate(quat_after[:, :, None, None], camera.rays))
    normals = np.asarray(rotation.rotate(quat_after[:, :, None, None], images["normal"]))
    is_smooth = (images["segmentation"] == images_high["segmentation"]) & (low < 4) & (high < 4)
    is_smooth &= np.abs(images["normal"] - images_high["normal"]).max(axis=-1) < 1e-3
    is_smooth &= np.abs(np.sum(normals * rays, axis=-1)) > MIN_COSINE
    names = {camera.segment_names(sim)[k].partition(":")[0] for k in np.unique(images["segmentation"][is_smooth])}
    assert names == {"floor", "drone", *KINDS}
    # Forward mode by pixel, and reverse mode of a weighted sum.
    depth = lambda *args: fly(*args)[0]  # noqa: E731
    tangent = jax.device_get(jax.jit(lambda *args: jax.jvp(depth, args, shifts)[1])(*args))
    np.testing.assert_allclose(tangent[is_smooth], ((high - low) / (2 * h))[is_smooth], rtol=1e-3, atol=1e-5)
    assert not tangent[(low == 4) & (high == 4)].any()
    weight = rng.normal(size=low.shape)
    gradients = jax.jit(jax.grad(lambda *args: jnp.sum(weight * depth(*args)), range(5)))(*args)
    slope = sum(np.sum(g * shift) for g, shift in zip(gradients, shifts, strict=True))
    np.testing.assert_allclose(slope, np.sum(weight * tangent), rtol=1e-9)


def test_law_09_images_have_no_second_derivative():
    sim = Sim(control="attitude")
    take_images = Camera(2, 2).image_fn(sim)

    def depth(height):
        pos = sim.data.states.pos.at[..., 2].set(height)
        return jnp.sum(take_images(sim.data.replace(states=sim.data.states.replace(pos=pos)))["depth"])

    with pytest.raises(ConfigError, match=r"second one. Use central differences of the first"):
        jax.grad(jax.grad(depth))(1.0)
