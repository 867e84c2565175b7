"""Gaussian splats: files, frames, and images in plain JAX. ``tests/gpu`` tests images by splax."""

import functools
import sys
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from splat_files import make_splat, spot_alpha, write_splats

from crazysim import Maps, Sim
from crazysim.errors import ConfigError
from crazysim.lab.scene import splat_images
from crazysim.lab.scene.splats import Gaussians, SplatScene

SIZE = {"width": 24, "height": 16}


@pytest.fixture(scope="module")
def sim():
    sim = Sim(n_worlds=2, n_drones=2)
    states = sim.data.states
    pos = np.float32([[[0, 0, 1], [0.3, 0.5, 1.2]], [[-0.5, 0.2, 0.8], [0.2, -0.4, 1.1]]])
    quat = np.float32([[0, 0, 0, 1], [0.05, 0.1, -0.1, 1]])
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    sim.data = sim.data.replace(states=states.replace(pos=pos, quat=np.broadcast_to(quat, (2, 2, 4))))
    return sim


@pytest.fixture(scope="module")
def draw_splats(sim):
    return jax.jit(sim.scene.splat_fn(**SIZE, background=(0.1, 0.2, 0.3)))


def gaussians_of(columns):
    columns = {name: np.float32(x) for name, x in columns.items()}
    rest = sum(name.startswith("f_rest") for name in columns) // 3
    colors = [[columns[f"f_dc_{c}"], *(columns[f"f_rest_{c * rest + k}"] for k in range(rest))] for c in range(3)]
    stack = lambda names: jnp.asarray(np.stack([columns[name] for name in names], axis=-1))  # noqa: E731
    return Gaussians(
        stack("xyz"), stack(["rot_1", "rot_2", "rot_3", "rot_0"]), stack([f"scale_{k}" for k in range(3)]),
        jnp.asarray(np.array(colors).transpose(2, 1, 0)), jnp.asarray(columns["opacity"]),
    )  # fmt: skip


@pytest.mark.parametrize("n_colors", [1, 4, 9, 16])
def test_files_are_read(n_colors, tmp_path):
    columns = write_splats(tmp_path / "a.ply", n_colors=n_colors)
    splats = SplatScene(tmp_path / "a.ply")
    assert len(splats) == 30
    for x, y in zip(jax.tree.leaves(splats.gaussians), jax.tree.leaves(gaussians_of(columns)), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)
    opaque = 1 / (1 + np.exp(-columns["opacity"])) >= 0.6
    assert len(splats.points(0.6)) == opaque.sum() > 0


def test_the_image_of_one_splat_equals_its_analytic_projection(sim):
    """A round Gaussian ahead is a round spot, of the standard deviation f s / z and the low-pass of 0.3 pixels^2."""
    draw_splats = sim.scene.splat_fn("fpv_cam:0", 33, 33, background=(0, 0, 0), min_coverage=0.2)
    ahead = float(sim.mj_model.cam("fpv_cam:0").pos[0])
    z, s, opacity, color = 2.0, 0.1, 0.8, np.array([0.9, 0.5, 0.2])
    eye = np.array([ahead, 0, float(sim.mj_model.cam("fpv_cam:0").pos[2]) + 1.0])
    spot = make_splat(eye + [z, 0.2, 0.1], s, opacity, color)
    image = draw_splats(sim.data, spot)
    assert image.color.shape == (2, 1, 33, 33, 3)
    focal = 33 / 2 / np.tan(np.deg2rad(float(sim.mj_model.cam("fpv_cam:0").fovy[0])) / 2)
    alpha = spot_alpha([z, 0.2, 0.1], s, opacity, focal, 33)
    np.testing.assert_allclose(image.coverage[0, 0], alpha, atol=2e-5)
    np.testing.assert_allclose(image.color[0, 0], alpha[..., None] * color, atol=2e-5)
    np.testing.assert_allclose(image.depth[0, 0], np.where(alpha < 0.2, np.inf, z), rtol=1e-5)


def test_many_splats_are_blended_from_near_to_far(sim, draw_splats, tmp_path):
    """The image equals that of a loop over splats in the order of depth; splats behind the camera are not drawn."""
    g = gaussians_of(write_splats(tmp_path / "a.ply", n=70, x=np.random.default_rng(1).uniform(-1, 3, 70)))
    image = draw_splats(sim.data, g)
    pos, rot = sim_camera(sim, 1, 1)
    color = np.tile([0.1, 0.2, 0.3], (16, 24, 1))
    eye = jnp.float32(pos), jnp.float32(rot)
    center, (a, b, c), z, opacity = splat_images._project(g, *eye, focal_of(sim), **SIZE)
    colors = np.asarray(splat_images._colors(g, eye[0]))
    y, x = np.mgrid[:16, :24] + 0.5
    for k in np.argsort(-np.asarray(z)):  # from far to near: each is painted over those behind it
        dx, dy = float(center[0][k]) - x, float(center[1][k]) - y
        sigma = (float(a[k]) * dx**2 + float(c[k]) * dy**2) / 2 + float(b[k]) * dx * dy
        alpha = np.minimum(0.999, float(opacity[k]) * np.exp(-sigma))
        alpha = np.where(alpha < 1 / 255, 0, alpha)[..., None]
        color = (1 - alpha) * color + alpha * colors[k]
    np.testing.assert_allclose(image.color[1, 1], np.clip(color, 0, 1), atol=3e-4)  # it stops at 1e-4


def test_a_finished_pixel_stays_finished_whatever_follows(sim, draw_splats):
    """Invisible Gaussians shift those behind them into other blocks, and change nothing."""
    eye = np.array([0.0, 0.0, 1.0])
    visible = [
        make_splat(eye + [1 + 0.1 * k, 0, 0], 1.0, opacity, (0.5, 0.5, 0.5))
        for k, opacity in enumerate([0.9] * 3 + [0.99] + [0.2] * 50)
    ]
    hidden = [make_splat(eye + [0.5, 0, 0], 0.1, 1e-6, (1, 1, 1))] * 30
    images = [
        draw_splats(sim.data, jax.tree.map(lambda *x: jnp.concatenate(x), *visible, *hidden[:n])) for n in (0, 29, 30)
    ]
    for image in images[1:]:
        np.testing.assert_allclose(image.coverage, images[0].coverage, atol=1e-5)
        np.testing.assert_allclose(image.color, images[0].color, atol=1e-5)


def test_law_07_splats_of_any_size_have_finite_images_and_gradients(sim):
    draw = sim.scene.splat_fn(**SIZE, renderer="plain")

    @jax.jit
    @functools.partial(jax.grad, has_aux=True)
    def slopes_and_image(g):
        image = draw(sim.data, g)
        return jnp.sum(image.color), (image.color, image.coverage)

    g = make_splat([2.0, 0.1, 1.0], 1.0, 0.9, (0.9, 0.5, 0.2)).replace(quat=jnp.float32([[0.2, 0.4, 0.4, 0.8]]))
    for log_scale in ((1000, 1000, 1000), (88, -3, -3), (-1000, -1000, 20), (5, -20, -20)):
        slopes, (color, coverage) = slopes_and_image(g.replace(log_scale=jnp.float32([log_scale])))
        assert np.all(np.asarray(coverage) <= 1)
        for x in jax.tree.leaves((color, coverage, slopes)):
            assert np.isfinite(x).all(), log_scale


def test_each_world_sees_the_splats_of_its_map(tmp_path):
    """Scenes of other lengths and degrees: an image equals that of its scene alone, also in one world."""
    scenes = [gaussians_of(write_splats(tmp_path / "a.ply", n=n, n_colors=k)) for n, k in ((40, 1), (70, 4), (5, 9))]
    sim = Sim(n_worlds=4)
    maps = sim.add(Maps([mujoco.MjSpec() for _ in scenes]))
    data = maps.select(sim.data, [2, 0, 1, 0])
    draw = jax.jit(sim.scene.splat_fn(width=12, height=8))
    images = draw(data, scenes)
    for k, worlds in enumerate(([1, 3], [2], [0])):
        # Rounding only: the same Gaussians in the same order.
        alone, rows = draw(data, scenes[k]), np.array(worlds)
        assert alone.coverage[rows].max() > 0.1
        np.testing.assert_allclose(images.color[rows], alone.color[rows], atol=1e-5)
        np.testing.assert_allclose(images.coverage[rows], alone.coverage[rows], atol=1e-5)
    with pytest.raises(ConfigError, match="each of 3 maps, got a list of 2"):
        draw(data, scenes[:2])
    scene = SplatScene(tmp_path / "a.ply")
    for wrong in (scene, [scene] * 3):
        with pytest.raises(
            ConfigError, match=r"expected Gaussians, or a list of them, got .* Use SplatScene.gaussians"
        ):
            draw(data, wrong)


def sim_camera(sim, world, drone):
    """Return position and axes of a drone's camera, by MuJoCo."""
    sim.scene.sync_one(sim.data, world)
    mujoco.mj_kinematics(sim.mj_model, sim.mj_data)
    mujoco.mj_comPos(sim.mj_model, sim.mj_data)
    mujoco.mj_camlight(sim.mj_model, sim.mj_data)
    camera = sim.mj_model.cam(f"fpv_cam:{drone}").id
    return np.array(sim.mj_data.cam_xpos[camera]), sim.mj_data.cam_xmat[camera].reshape(3, 3).copy()


def focal_of(sim):
    return 16 / 2 / np.tan(np.deg2rad(float(sim.mj_model.cam("fpv_cam:0").fovy[0])) / 2)


def test_a_scene_looks_the_same_at_any_pose_and_scale(sim, draw_splats, tmp_path):
    """A file of other axes and units, registered with the world, gives the image of the file in the world's frame."""
    columns = write_splats(tmp_path / "world.ply")
    quat, pos, scale = np.array([0.3, -0.2, 0.5, 0.7]), np.array([1.0, -2.0, 0.5]), 2.5
    quat /= np.linalg.norm(quat)
    rot = np.empty(9)
    mujoco.mju_quat2Mat(rot, np.roll(quat, 1))
    rot = rot.reshape(3, 3)
    points = (np.stack([columns[a] for a in "xyz"], axis=1) - pos) @ rot / scale
    rotated = SplatScene(tmp_path / "world.ply", quat=np.r_[-quat[:3], quat[3]]).gaussians
    values = np.concatenate(
        [np.roll(rotated.quat, 1, axis=1), rotated.color.transpose(0, 2, 1).reshape(30, -1)], axis=1
    )
    changes = dict(zip([f"rot_{k}" for k in range(4)], values[:, :4].T, strict=True))
    changes |= {f"scale_{k}": columns[f"scale_{k}"] - np.log(scale) for k in range(3)} | dict(
        zip("xyz", points.T, strict=True)
    )
    colors = values[:, 4:].reshape(30, 3, 16)
    changes |= {f"f_dc_{c}": colors[:, c, 0] for c in range(3)}
    changes |= {f"f_rest_{15 * c + k}": colors[:, c, 1 + k] for c in range(3) for k in range(15)}
    write_splats(tmp_path / "file.ply", **changes)
    registered = SplatScene(tmp_path / "file.ply", pos=pos, quat=quat, scale=scale)
    expected, result = (
        draw_splats(sim.data, SplatScene(tmp_path / "world.ply").gaussians),
        draw_splats(sim.data, registered.gaussians),
    )
    np.testing.assert_allclose(result.color, expected.color, atol=2e-3)
    np.testing.assert_allclose(result.coverage, expected.coverage, atol=2e-3)
    assert np.asarray(expected.coverage).std() > 0.1


def test_images_have_gradients_to_splats_and_poses(sim, tmp_path):
    """Splats are large and faint, so that no pixel is where an image jumps: at an alpha of 1/255."""
    large = {f"scale_{k}": np.full(4, 0.2 * k) for k in range(3)} | {f"f_dc_{k}": np.zeros(4) for k in range(3)}
    write_splats(tmp_path / "a.ply", n=4, n_colors=4, x=np.linspace(3, 4, 4), opacity=np.linspace(-1, 0, 4), **large)
    g = SplatScene(tmp_path / "a.ply").gaussians
    draw_splats = sim.scene.splat_fn("fpv_cam:0", 6, 4)

    def loss(g, pos):
        data = sim.data.replace(states=sim.data.states.replace(pos=pos))
        image = draw_splats(data, g)
        return jnp.sum(jnp.sin(image.color * 3)) + jnp.sum(image.coverage**2)

    pos = jnp.asarray(sim.data.states.pos)
    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))(g, pos)
    value = jax.jit(loss)
    rng = np.random.default_rng(0)
    for _ in range(3):
        step = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), (g, pos))
        slope = sum(float(jnp.sum(a * b)) for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(step), strict=True))
        plus, minus = (jax.tree.map(lambda x, d, s=s: x + s * 1e-3 * d, (g, pos), step) for s in (1, -1))
        difference = float(value(*plus) - value(*minus)) / 2e-3
        assert abs(slope - difference) < 0.02 * abs(difference) + 0.02
        assert abs(slope) > 0.1
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))


def test_cameras_of_a_list_have_the_images_of_their_drones(sim, draw_splats, tmp_path):
    write_splats(tmp_path / "a.ply", n=9, n_colors=4)
    g = SplatScene(tmp_path / "a.ply").gaussians
    image = draw_splats(sim.data, g)
    assert image.color.shape == (2, 2, 16, 24, 3)
    assert image.depth.shape == image.coverage.shape == (2, 2, 16, 24)
    chosen = sim.scene.splat_fn(["fpv_cam:1", "fpv_cam:0"], **SIZE, background=(0.1, 0.2, 0.3))(sim.data, g)
    np.testing.assert_allclose(chosen.color[:, ::-1], image.color, atol=1e-5)


def fake_splax(calls):
    """Return a module with the signature of splax 0.2.3 that draws with the plain renderer and records its calls."""

    def render(
        means, log_scales, quats, colors, logits, *, viewmat, background, img_shape, f, clip_thresh, render_depth
    ):
        calls.append((img_shape, f, clip_thresh, render_depth))
        axes = viewmat[:3, :3] * jnp.array([[1.0], [-1.0], [-1.0]])
        pos = -viewmat[:3, :3].T @ viewmat[:3, 3]
        g = Gaussians(means, jnp.roll(quats, -1, axis=-1), log_scales, colors, logits)
        height, width = img_shape
        color, depth, coverage = splat_images._draw_image(g, (pos, axes.T), f[0], width, height, background)
        return jnp.concatenate([color, depth[..., None]], axis=-1), coverage

    return types.SimpleNamespace(render=render)


def test_splax_gets_the_cameras_of_the_plain_renderer(sim, draw_splats, tmp_path, monkeypatch):
    write_splats(tmp_path / "a.ply", n=9, n_colors=4)
    g, calls = SplatScene(tmp_path / "a.ply").gaussians, []
    monkeypatch.setitem(sys.modules, "splax", fake_splax(calls))
    choose = splat_images._choose_renderer
    monkeypatch.setattr(splat_images, "_choose_renderer", lambda renderer, platform: choose(renderer, "gpu"))
    by_splax = sim.scene.splat_fn(**SIZE, background=(0.1, 0.2, 0.3), renderer="splax")(sim.data, g)
    (shape, focal, near, depth), expected = calls[0], draw_splats(sim.data, g)
    assert (shape, near, depth) == ((16, 24), splat_images.MIN_DEPTH, True)
    np.testing.assert_allclose(focal, focal_of(sim), rtol=1e-6)
    for x, y in zip(jax.tree.leaves(by_splax), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-3)


def test_without_splax_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "splax", None)
    with pytest.raises(ImportError, match=r"crazysim\[splats\]"):
        splat_images.import_splax()
