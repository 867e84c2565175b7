"""Colours of rays against the images of MuJoCo's renderer, in random scenes."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from crazysim import Camera, ConfigError, Sim
from crazysim.plugins.sensors import RandomColors
from crazysim.scene import depth
from crazysim.scene.ray_casting import RayKernels

WIDTH, HEIGHT = 96, 72
KINDS = ("box", "sphere", "capsule", "cylinder", "ellipsoid")


def text(*numbers):
    return " ".join(f"{x:.4f}" for x in np.concatenate([np.ravel(x) for x in numbers]))


def random_light(rng, has_shadows):
    kind = rng.choice(["directional", "spot"])
    return f"""<light type="{kind}" pos="{text(rng.uniform([0, -4, 5], [8, 4, 7]))}"
        castshadow="{str(has_shadows).lower()}"
        dir="{text(0.4 * rng.normal(size=2), -1)}" diffuse="{text(rng.uniform(0.1, 0.6, 3))}"
        specular="{text(rng.uniform(0, 0.5, 3))}" ambient="{text(rng.uniform(0, 0.1, 3) * (not has_shadows))}"
        cutoff="{text(rng.uniform(30, 80))}" exponent="{text(rng.uniform(0, 10))}"
        attenuation="{text(1, rng.uniform(0, 0.2), rng.uniform(0, 0.05))}"/>"""


def textured_box(rng):
    """Return a mesh of MJCF in the shape of a box, whose sides have vertices and random coordinates of their own."""
    sides = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    sides = np.concatenate([sides[sides[:, k] == side][[0, 1, 3, 2]] for k in range(3) for side in (-0.5, 0.5)])
    faces = []
    for k in range(0, 24, 4):
        a, b, c = sides[k : k + 3]
        order = [0, 1, 2, 0, 2, 3] if np.cross(b - a, c - a) @ a > 0 else [2, 1, 0, 3, 2, 0]
        faces += [k + i for i in order]
    corners = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (6, 1)) + rng.uniform(-0.1, 0.1, (24, 2))
    return f"""<mesh name="carton" vertex="{text(sides.ravel())}" texcoord="{text(corners.ravel())}"
        face="{" ".join(map(str, faces))}"/>"""


def textured_icosphere():
    """Return a mesh of MJCF of 80 triangles, whose coordinates are continuous, but not linear over several of them."""
    points = [np.roll([0, a, b * (1 + 5**0.5) / 2], k) for k in range(3) for a in (-1, 1) for b in (-1, 1)]
    triangles = np.array(list(itertools.combinations(points, 3)))
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1)
    triangles = triangles[np.isclose(edges, 2).all(axis=1)]
    middles = triangles + np.roll(triangles, -1, axis=1)
    parts = [np.stack([2 * triangles[:, k], middles[:, k], middles[:, k - 1]], axis=1) for k in range(3)]
    triangles = np.concatenate([middles, *parts])
    triangles[np.linalg.det(triangles) < 0] = triangles[np.linalg.det(triangles) < 0, ::-1]
    corners = triangles.reshape(-1, 3) / np.linalg.norm(triangles.reshape(-1, 3), axis=-1, keepdims=True)
    return f"""<mesh name="icosphere" vertex="{text(0.7 * corners)}" texcoord="{text(np.sin(2 * corners[:, :2]))}"
        face="{" ".join(map(str, range(len(corners))))}"/>"""


def random_scene(rng, has_textures, has_shadows):
    """Return MJCF of 20 objects above a floor, with two lights and a camera.

    Lights are above all objects, since those behind a light cast shadows here, but not in MuJoCo.
    """
    materials, geoms = "", ""
    for k in range(20):
        kind, color = rng.choice(KINDS), text(rng.uniform(0, 1, 3), 1)
        texture = f"""texture="{rng.choice(["noise", "checker"])}" texuniform="{rng.choice(["true", "false"])}"
            texrepeat="{text(rng.uniform(0.5, 3, 2))}" """
        materials += f"""<material name="{k}" rgba="{color}" specular="{text(rng.uniform())}"
            shininess="{text(rng.uniform())}" emission="{rng.choice([0, 0.3])}"
            {texture if has_textures and kind == "box" else ""}/>"""
        geoms += f"""<geom type="{kind}" size="{text(rng.uniform(0.15, 0.6, 3))}" quat="{text(rng.normal(size=4))}"
            pos="{text(rng.uniform([1, -3, 0.2], [8, 3, 3.5]))}" {f'material="{k}"' if k % 4 else f'rgba="{color}"'}/>
            """
    if has_textures:
        materials += '<material name="tiles" texture="checker" texrepeat="4 3" texuniform="true"/>'
        materials += """<mesh name="wedge" vertex="0 0 0 .9 0 0 0 .8 0 0 0 .7"/>
            <hfield name="hill" nrow="3" ncol="3" elevation="0 0 0 0 1 0 0 0 0" size="1.5 1.5 .6 .1"/>"""
        materials += textured_box(np.random.default_rng(7)) + textured_icosphere()
        geoms += """<geom type="mesh" mesh="wedge" pos="2 .8 1.2" quat=".5 .5 -.5 .6" material="tiles"/>
            <geom type="mesh" mesh="carton" pos="1.5 -.3 2" quat=".5 .2 -.5 .6" material="tiles"/>
            <geom type="mesh" mesh="icosphere" pos="1.5 1 2.2" quat=".5 .2 -.5 .6" material="tiles"/>
            <geom type="hfield" hfield="hill" pos="4 -1 0" material="tiles"/>
            <geom type="plane" size=".9 .6 .1" pos="3 -1 2" euler="20 -70 10" material="tiles"/>"""
    floor = 'texture="checker" texrepeat="1 1" texuniform="true"' if has_textures else ""
    axes = 0.15 * rng.normal(size=(2, 3)) + [[0, -1, 0], [0.1, 0, 1]]
    return f"""<mujoco><statistic center="0 0 1" extent="3"/>
      <visual><map zfar="10" shadowclip="5" shadowscale="1"/><rgba haze="0.9 0.9 0.2 1"/>
        <quality numslices="64" numstacks="64" numquads="20"/>
        <headlight ambient="{text(rng.uniform(0, 0.3, 3))}" diffuse="{text(rng.uniform(0, 0.4, 3))}"/></visual>
      <asset><texture name="sky" type="skybox" builtin="gradient" rgb1=".6 .8 .9" rgb2=".9 .3 .2" width="64"
          height="384"/>
        <texture name="checker" type="2d" builtin="checker" rgb1=".9 .2 .1" rgb2=".1 .3 .8" width="128" height="64"/>
        <texture name="noise" type="2d" builtin="gradient" mark="random" random="0.02" markrgb="1 1 0" rgb1=".9 .2 .9"
          rgb2=".1 .8 .1" width="64" height="32"/>
        <material name="floor" rgba="{text(rng.uniform(0.2, 1, 3), 1)}" specular="0" {floor}/>{materials}</asset>
      <worldbody>{random_light(rng, has_shadows)}{random_light(rng, has_shadows)}
        <geom type="plane" size="0 0 .05" material="floor"/>{geoms}
        <camera name="eye" pos="{text(rng.uniform([-3, -1, 0.5], [-1, 1, 2.5]))}" xyaxes="{text(axes)}"
          fovy="{text(rng.uniform(40, 80))}"/></worldbody></mujoco>"""


def mujoco_images(model):
    """Return the images of the camera with and without shadows, without drones, and with one sample for a pixel."""
    data = mujoco.MjData(model)
    data.mocap_pos[:, 2] = -100
    mujoco.mj_forward(model, data)
    model.vis.quality.offsamples = 0
    renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
    for _ in range(2):  # MuJoCo centres infinite planes on the camera of the previous update
        renderer.update_scene(data, "eye")
    image = renderer.render().astype(int)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    image_without_shadows = renderer.render().astype(int)
    renderer.close()
    return image, image_without_shadows


def edge_mask(hits, shadow):
    """Whether a pixel or one of its eight neighbours is on the other side of an edge."""
    features = np.concatenate(
        [2 * hits.normal[0, 0], 5 * np.log(np.minimum(hits.distance[0, 0], 1e3))[..., None], shadow / 16], axis=-1
    )
    mask = np.ones((HEIGHT, WIDTH), bool)
    windows = np.lib.stride_tricks.sliding_window_view(features, (3, 3), (0, 1))
    mask[1:-1, 1:-1] = np.ptp(windows, axis=(-1, -2)).max(axis=-1) > 1
    return mask


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("look", ["plain", "textures", "shadows"])
@pytest.mark.parametrize("seed", [1, 2])
def test_colors_equal_those_of_mujocos_renderer(tmp_path, seed, look):
    """The bounds of the mean difference and of 99% of pixels away from edges are less than a person notices.

    Edges of shadows are edges, too.
    """
    path = tmp_path / "scene.xml"
    path.write_text(random_scene(np.random.default_rng(seed), look == "textures", look == "shadows"))
    sim = Sim(1, xml_path=path)
    hits = jax.device_get(jax.jit(sim.scene.depth_fn("eye", WIDTH, HEIGHT, drones=False, color=True))(sim.data))
    expected, without_shadows = mujoco_images(sim.mj_model)
    error = np.abs(hits.color[0, 0] - expected)
    shadow = without_shadows - expected
    assert (shadow > 8).any(axis=-1).mean() > 0.02 or look != "shadows"
    is_inside = ~edge_mask(hits, shadow)
    assert is_inside.mean() > 0.5
    assert len(np.unique(hits.color[0, 0].reshape(-1, 3), axis=0)) > 500
    assert error.mean() <= 4
    assert (error[is_inside].max(axis=-1) <= 16).mean() >= 0.99
    if seed > 1:
        return
    # Without a kernel, the colours differ by rounding alone.
    sim.scene.ray_kernels = RayKernels(None)
    plain = jax.jit(sim.scene.depth_fn("eye", WIDTH, HEIGHT, drones=False, color=True))(sim.data).color
    difference = np.abs(np.asarray(plain, int) - hits.color)
    assert (difference <= 1).mean() > 0.999


@pytest.mark.usefixtures("opengl")
def test_planes_that_are_infinite_along_one_axis_have_mujocos_texture(tmp_path):
    """With the bounds of the test above; a track on the floor, and a fence beside it."""
    path = tmp_path / "scene.xml"
    path.write_text("""<mujoco><statistic extent="3"/><visual><map zfar="10"/><headlight ambient=".8 .8 .8"/></visual>
        <asset><texture name="checker" type="2d" builtin="checker" rgb1=".9 .2 .1" rgb2=".1 .3 .8" width="64"
        height="64"/><material name="tiles" texture="checker" texrepeat=".7 .4"/><material name="uniform"
        texture="checker" texrepeat=".7 .4" texuniform="true"/></asset><worldbody>
        <geom type="plane" size="0 1.4 .1" pos="2 -.5 .1" material="tiles"/>
        <geom type="plane" size="1.2 0 .1" pos="3 1 1.3" euler="90 0 -90" material="uniform"/>
        <camera name="eye" pos="-1 0.2 1.7" xyaxes="0.1 -1 0 0.3 0 1" fovy="60"/></worldbody></mujoco>""")
    sim = Sim(1, xml_path=path)
    hits = jax.device_get(jax.jit(sim.scene.depth_fn("eye", WIDTH, HEIGHT, drones=False, color=True))(sim.data))
    error = np.abs(hits.color[0, 0] - mujoco_images(sim.mj_model)[0])
    is_inside = ~edge_mask(hits, np.zeros_like(error))
    is_upright = hits.normal[0, 0, ..., 1] < -0.9
    assert 0.1 < (is_inside & is_upright).mean() < 0.5
    assert (error[is_inside].max(axis=-1) <= 16).mean() >= 0.99


MOVING = """<mujoco><asset>
<texture name="spots" type="2d" builtin="checker" mark="random" random="0.05" rgb1=".9 .2 .1" rgb2=".1 .3 .8" width="32"
height="16"/><material name="spots" texture="spots" specular="0.8"/></asset><worldbody>
<geom type="box" size=".4 .3 .5" material="spots"/><geom type="sphere" size=".3" pos=".2 .6 .3" rgba=".9 .8 .2 1"/>
</worldbody></mujoco>"""


@pytest.mark.long("compiles two images and a gradient")
def test_gradients_of_colors_are_central_differences(x64, tmp_path):
    """By the poses of two cameras and of an object that turns before them, under spots with shadows."""
    path, rng = tmp_path / "scene.xml", np.random.default_rng(5)
    path.write_text(random_scene(np.random.default_rng(1), True, True))
    sim = Sim(2, xml_path=path, control="attitude")
    sim.scene.add(MOVING, "moving", pos=[1.2, 0.2, 1.3])
    data = jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, sim.data)
    args = [np.asarray(x) for x in (data.states.pos, data.states.quat, data.objects.pos, data.objects.quat)]
    args[0] = args[0] * 0 + rng.uniform([-0.8, -0.2, 1.2], [-0.4, 0.2, 1.7], (2, 1, 3))
    for k in (1, 3):
        args[k] = args[k] + 0.1 * rng.normal(size=args[k].shape)
        args[k] /= np.linalg.norm(args[k], axis=-1, keepdims=True)
    weight = rng.uniform(size=(2, 1, 12, 16, 3))

    def cast_rays(args, gradients):
        pos, quat, object_pos, object_quat = args
        states, objects = (
            x.replace(pos=p, quat=q / jnp.linalg.norm(q, axis=-1, keepdims=True))
            for x, p, q in ((data.states, pos, quat), (data.objects, object_pos, object_quat))
        )
        cast = sim.scene.depth_fn(
            "fpv_cam", 16, 12, color=True, random_colors=RandomColors(), color_gradients=gradients
        )
        return cast(data.replace(states=states, objects=objects))

    def weighted_sum(args):
        hits = cast_rays(args, True)
        return jnp.sum(weight * hits.color), hits

    value_and_gradients = jax.jit(jax.value_and_grad(weighted_sum, has_aux=True))
    (_, hits), gradients = value_and_gradients(args)
    rounded = jax.jit(lambda args: cast_rays(args, False).color)(args)
    assert rounded.dtype == np.uint8
    assert np.abs(255 * hits.color - rounded).max() < 0.5 + 1e-6
    h = 1e-6  # of which rounding costs 1e-16 / h of the sum, about 500
    for k, gradient in enumerate(gradients):
        assert np.abs(gradient).max() > 0.1
        shift = rng.normal(size=gradient.shape)
        sums = [value_and_gradients([*args[:k], args[k] + s * h * shift, *args[k + 1 :]])[0][0] for s in (1, -1)]
        np.testing.assert_allclose(np.sum(gradient * shift), (sums[0] - sums[1]) / (2 * h), rtol=1e-5, err_msg=k)


@pytest.mark.parametrize("engine", ["auto", "plain"])
@pytest.mark.long("compiles derivatives of four kinds")
def test_colors_have_first_derivatives_of_both_modes(engine):
    sim = Sim(2, control="attitude", engine=engine)
    take = Camera(8, 6, outputs=("rgb",), color_gradients=True).image_fn(sim)

    def loss(pos):
        return jnp.sum(take(sim.data.replace(states=sim.data.states.replace(pos=pos)))["rgb"] ** 2)

    points = sim.data.states.pos + np.linspace([0, 0, 1], [0, 0, 2], 2, dtype=np.float32)[:, None, None]
    gradients = jax.jit(jax.vmap(jax.grad(loss)))(points)
    for point, gradient in zip(points, gradients, strict=True):
        assert jnp.abs(gradient).max() > 1e-3
        tangent = jax.jvp(loss, (point,), (jnp.ones_like(point),))[1]
        np.testing.assert_allclose(tangent, gradient.sum(), rtol=1e-5)  # rounding of 288 numbers
    with pytest.raises(ConfigError, match="the first derivative"):
        jax.hessian(loss)(points[0])


def test_law_07_gradients_of_colors_are_finite_without_haze_and_attenuation(x64, tmp_path):
    """Of single precision, among numbers of double precision, towards the sky, the haze and a lit floor."""
    path = tmp_path / "scene.xml"
    path.write_text("""<mujoco><visual><map haze="0"/></visual><asset><texture name="sky" type="skybox"
        builtin="gradient" rgb1=".3 .5 .7" width="8" height="48"/></asset><worldbody><geom type="plane" size="0 0 .1"/>
        <light pos="0 0 3" dir="0 0 -1" type="spot" attenuation="0 0 0" cutoff="90"/></worldbody></mujoco>""")
    sim = Sim(1, control="attitude", xml_path=path)
    take = Camera(9, 7, fovy=110, outputs=("rgb",), color_gradients=True).image_fn(sim)
    data = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, sim.data)
    pos = data.states.pos.at[..., 2].set(0.5)

    def loss(pos):
        return jnp.sum(take(data.replace(states=data.states.replace(pos=pos)))["rgb"] ** 2)

    value, gradient = jax.jit(jax.value_and_grad(loss))(pos)
    assert np.isfinite([value, *gradient.ravel()]).all()
    assert gradient.dtype == np.float32


@pytest.mark.parametrize("random_colors", [None, RandomColors(0, 0, 0)])
@pytest.mark.parametrize("geom, color", [("", 0), ("<geom type='sphere' size='.3' pos='1 0 1'/>", 38)])
def test_scenes_without_lights_textures_and_sky(tmp_path, geom, color, random_colors):
    """MuJoCo adds ambient light of 0.3 to scenes without lights: 0.3 x 0.5 x 255 = 38."""
    path = tmp_path / "scene.xml"
    path.write_text(f"""<mujoco><visual><headlight active="0"/></visual><worldbody>{geom}
        <camera name="eye" pos="0 0 1" xyaxes="0 -1 0 0 0 1"/></worldbody></mujoco>""")
    sim = Sim(2, xml_path=path)
    colors = jax.jit(sim.scene.depth_fn("eye", 8, 6, drones=False, color=True, random_colors=random_colors))(
        sim.data
    ).color
    assert set(np.unique(colors)) == {0, color}


def test_a_camera_sees_the_colors_of_moving_objects_and_other_drones():
    sim = Sim(2, 2, control="attitude")
    ball = sim.scene.add("sphere", pos=[1.5, 0, 1], radius=0.3, rgba=(0, 0, 1, 1))
    sim.data = ball.set_pose(sim.data, np.array([[[1.5, 0, 1.0]], [[-9, 0, 1.0]]]))
    pos = np.broadcast_to([[0.0, 0, 1], [0.5, 0.1, 1]], (2, 2, 3))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.float32(pos)))
    camera = Camera(48, 32, outputs=("rgb", "depth", "segmentation"))
    images = jax.device_get(jax.jit(camera.image_fn(sim))(sim.data))
    assert images["rgb"].shape == (2, 2, 32, 48, 3)
    assert images["rgb"].dtype == np.uint8
    names = camera.segment_names(sim)
    is_ball, is_drone, is_sky = (
        images["segmentation"] == k for k in (names.index("sphere:0"), names.index("drone:1"), -1)
    )
    red, green, blue = np.moveaxis(images["rgb"].astype(int), -1, 0)
    assert is_ball[0].sum() > 20
    assert not is_ball[1].any()
    assert (blue > 2 * np.maximum(red, green))[is_ball].all()
    assert not (blue > 2 * np.maximum(red, green))[~is_ball].any()
    assert is_drone[:, 0].any()
    assert (images["rgb"][is_sky] > 150).all()
    # In the upper half of the image, the sky becomes darker with the height.
    assert (np.diff(red[1, 1, :15, 0]) >= 0).all()


def test_random_colors_differ_by_world_and_episode_and_stay_during_an_episode(monkeypatch):
    sim = Sim(3, control="attitude")
    sim.scene.add("sphere", pos=[1.5, 0, 1.2], radius=0.3, rgba=(0.5, 0.5, 0.5, 1))
    camera = Camera(24, 16, outputs=("rgb", "segmentation"), random_colors=RandomColors(0.4, 0.2))
    take_images = jax.jit(camera.image_fn(sim))
    initial_data = sim.data

    def mean_colors(data, take_images=take_images):
        """Return the mean colour of ball and floor in each world. (3, 2, 3)"""
        images = jax.device_get(take_images(data))
        masks = [images["segmentation"] == k for k in (1, 0)]
        return np.stack([images["rgb"].mean(axis=(1, 2, 3), where=mask[..., None]) for mask in masks], axis=1)

    colors = mean_colors(initial_data)
    assert np.ptp(colors, axis=0).max(axis=-1).min() > 10
    assert np.abs(np.diff(colors / colors.mean(axis=-1, keepdims=True), axis=1)).max() > 0.1, "bodies differ"
    sim.step(1)
    np.testing.assert_allclose(mean_colors(sim.data.replace(states=initial_data.states)), colors)
    sim.reset(np.array([True, False, False]))
    changed = np.abs(mean_colors(sim.data.replace(states=initial_data.states)) - colors).max(axis=(1, 2))
    assert changed[0] > 5
    np.testing.assert_allclose(changed[1:], 0)
    # Worlds that do not fit into memory together have the same colours.
    monkeypatch.setattr(depth, "MAX_RAYS_OF_KERNEL", 24 * 16)
    np.testing.assert_allclose(mean_colors(initial_data, jax.jit(camera.image_fn(sim))), colors, atol=1)
    # Without changes, the colours are those of the scene.
    unchanged, plain = (
        mean_colors(
            initial_data, jax.jit(Camera(24, 16, outputs=("rgb", "segmentation"), random_colors=x).image_fn(sim))
        )
        for x in (RandomColors(0, 0, 0), None)
    )
    np.testing.assert_allclose(unchanged, plain, atol=0.1)


def test_random_textures_are_those_of_the_scene_in_every_world_and_episode(tmp_path):
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    path = tmp_path / "scene.xml"
    textures = "".join(
        f'<texture name="{k}" type="2d" builtin="flat" rgb1="{text(color)}" width="8" height="{8 + k}"/>'
        for k, color in enumerate(colors)
    )
    path.write_text(f"""<mujoco><visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
        <asset>{textures}<material name="floor" texture="0"/></asset>
        <worldbody><geom type="plane" size="0 0 .05" material="floor"/>
        <geom type="sphere" size="0.2" pos="0 0 0.3" rgba="1 1 1 1"/>
        <camera name="eye" pos="0 0 2" fovy="60"/></worldbody></mujoco>""")
    sim = Sim(12, xml_path=path)

    def floor_and_ball(data, textures):
        random_colors = RandomColors(0, 0, 0, textures=textures)
        image = sim.scene.depth_fn("eye", 9, 9, drones=False, color=True, random_colors=random_colors)
        image = np.asarray(jax.jit(image)(data).color)[:, 0] / 255
        assert np.ptp(image[:, 0], axis=1).max() < 0.02
        return image[:, 0, 0], image[:, 4, 4]

    floor, ball = floor_and_ball(sim.data, True)
    index = np.argmax(floor, axis=1)
    np.testing.assert_allclose(floor, colors[index], atol=0.02)
    assert set(index) == {0, 1, 2}, "twelve worlds miss one of three textures with a probability of 2 %"
    np.testing.assert_allclose(ball, 1, atol=0.02)
    next_episode = sim.data.replace(core=sim.data.core.replace(episode=sim.data.core.episode + 1))
    assert (np.argmax(floor_and_ball(next_episode, True)[0], axis=1) != index).sum() > 2
    floor, _ = floor_and_ball(sim.data, False)
    np.testing.assert_allclose(floor, np.broadcast_to(colors[0], floor.shape), atol=0.02)
