"""Splats by splax on a GPU: a known splat against its projection, and scenes against the plain renderer.

It needs ``pip install "crazysim[splats]"`` beside the requirements of the tests.
"""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_devices import ACCELERATOR, require_device
from splat_files import make_splat, spot_alpha, write_splats

from crazysim import Sim, SplatScene
from crazysim.sim.sensors.splat import render_splat_rgbd
from crazysim.sim.splat import attach_splats

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # before any test imports SciPy
splax = pytest.importorskip("splax")


@pytest.fixture(scope="module")
def sim():
    sim = Sim(n_worlds=3, n_drones=2, device=ACCELERATOR)
    states = sim.data.states
    pos = np.random.default_rng(0).normal([0, 0, 1], 0.2, (3, 2, 3)).astype(np.float32)
    pos[0, 0] = 0, 0, 1
    sim.data = sim.data.replace(states=states.replace(pos=jax.device_put(pos, sim.device)))
    return sim


def test_the_image_of_a_known_splat_equals_its_analytic_projection(sim):
    draw = jax.jit(sim.scene.splat_fn("fpv_cam:0", 33, 33, (0, 0, 0), min_coverage=0.2, renderer="splax"))
    camera = sim.mj_model.cam("fpv_cam:0")
    offset, deviation, opacity, color = np.array([2.0, 0.2, 0.1]), 0.1, 0.8, np.array([0.9, 0.5, 0.2])
    eye = np.array([camera.pos[0], camera.pos[1], camera.pos[2] + 1.0])
    image = require_device(
        ACCELERATOR, draw(sim.data, jax.device_put(make_splat(eye + offset, deviation, opacity, color), sim.device))
    )
    focal = 33 / 2 / np.tan(np.deg2rad(float(camera.fovy[0])) / 2)
    alpha = spot_alpha(offset, deviation, opacity, focal, 33)
    np.testing.assert_allclose(image.coverage[0, 0], alpha, atol=1 / 200)  # single pixels are at the limit of 1/255
    np.testing.assert_allclose(image.color[0, 0], alpha[..., None] * color, atol=1 / 200)
    np.testing.assert_allclose(np.asarray(image.depth[0, 0])[alpha > 0.25], 2.0, rtol=1e-3)
    assert np.isinf(np.asarray(image.depth[0, 0])[alpha < 0.15]).all()


@pytest.mark.parametrize("n_colors", [1, 4, 9, 16])
def test_images_agree_with_plain_jax(n_colors, sim, tmp_path):
    write_splats(tmp_path / "a.ply", n=2000, n_colors=n_colors)
    gaussians = jax.device_put(SplatScene(tmp_path / "a.ply").gaussians, sim.device)
    size = {"width": 64, "height": 48, "background": (0.1, 0.2, 0.3)}
    by_splax, plain = (
        jax.jit(sim.scene.splat_fn(**size, renderer=renderer))(sim.data, gaussians) for renderer in ("splax", "plain")
    )
    assert by_splax.color.shape == (3, 2, 48, 64, 3)
    for name in ("color", "coverage"):
        error = np.abs(np.asarray(getattr(by_splax, name)) - np.asarray(getattr(plain, name)))
        assert error.mean() < 2e-3, name  # splax sorts by depths of few bits, so single pixels differ
        assert np.quantile(error, 0.99) < 0.03, name
    is_hit = np.isfinite(by_splax.depth) & np.isfinite(plain.depth)
    assert is_hit.mean() > 0.2
    assert np.quantile(np.abs(np.asarray(by_splax.depth)[is_hit] - np.asarray(plain.depth)[is_hit]), 0.99) < 0.05


def test_gradients_agree_with_plain_jax(sim, tmp_path):
    write_splats(tmp_path / "a.ply", n=50, n_colors=4)
    gaussians = jax.device_put(SplatScene(tmp_path / "a.ply").gaussians, sim.device)
    slopes = []
    for renderer in ("splax", "plain"):
        draw = sim.scene.splat_fn(width=32, height=24, renderer=renderer)

        def loss(gaussians, pos, draw=draw):
            image = draw(sim.data.replace(states=sim.data.states.replace(pos=pos)), gaussians)
            return jnp.mean(image.color**2) + jnp.mean(image.coverage)

        slopes.append(jax.jit(jax.grad(loss, argnums=(0, 1)))(gaussians, sim.data.states.pos))
    for result, expected in zip(*map(jax.tree.leaves, slopes), strict=True):
        result, expected = np.asarray(result), np.asarray(expected)
        assert np.isfinite(result).all()
        assert np.linalg.norm(result - expected) < 0.05 * np.linalg.norm(expected) + 1e-6


def test_the_functions_of_crazyflow_draw_with_splax(sim, tmp_path):
    write_splats(tmp_path / "a.ply")
    attach_splats(sim, scene=tmp_path / "a.ply")
    image = render_splat_rgbd(sim, drones=[1], resolution=(32, 24))
    assert image.shape == (3, 1, 24, 32, 4)
    assert image.device == sim.device
    assert 0 <= float(image[..., :3].min()) <= float(image[..., :3].max()) <= 1
