"""Functions of Crazyflow's API for Gaussian splats; its modules in ``crazysim.names`` export them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.errors import ConfigError, require
from crazysim.lab.scene.splat_images import SplatImage, view_matrices
from crazysim.lab.scene.splats import SplatScene
from crazysim.sim.sim import Sim

Color = tuple[float, float, float]


def attach_splats(sim: Sim, scene: str | Path | None = None, drone: str | Path | None = None) -> None:
    """Read a scene of splats for the functions below; its coordinates are in the world frame, m.

    For other poses and scales, use ``SplatScene`` and ``sim.scene.splat_fn``.

    Args:
        scene: A ``.ply`` file.
        drone: Not supported.
    """
    if drone is not None or scene is None:
        raise ConfigError(
            f"expected scene= and no splats of drones, got scene={scene!r}, drone={drone!r}. Pass scene=."
        )
    sim.scene.splats = SplatScene(scene, scale=1.0)


def render_splat_rgb(
    sim: Sim,
    drones: int | Sequence[int] | None = None,
    resolution: tuple[int, int] = (640, 480),
    background: Color = (1.0, 1.0, 1.0),
    exclude_self: bool = False,
    camera_prefix: str = "fpv_cam",
) -> Array:
    """Return images of the attached splats in every world. (n_worlds, n_selected, height, width, 3)

    Args:
        sim: Simulation with ``attach_splats``.
        drones: Indices of the drones with the cameras; None for all.
        resolution: Width and height, pixels.
        background: Red, green and blue, 0 to 1.
        exclude_self: Without effect, since drones have no splats.
        camera_prefix: Name of the cameras, without index.
    """
    return build_render_splat_fn(sim, drones, resolution, background, exclude_self, camera_prefix)(sim.data)


def render_splat_rgbd(
    sim: Sim,
    drones: int | Sequence[int] | None = None,
    resolution: tuple[int, int] = (640, 480),
    background: Color = (1.0, 1.0, 1.0),
    alpha_threshold: float = 0.5,
    max_range: float = 10.0,
    exclude_self: bool = False,
    camera_prefix: str = "fpv_cam",
) -> Array:
    """Return images with depth, m, as fourth channel. (n_worlds, n_selected, height, width, 4)

    Args:
        sim: Simulation with ``attach_splats``.
        drones: Indices of the drones with the cameras; None for all.
        resolution: Width and height, pixels.
        background: Red, green and blue, 0 to 1.
        alpha_threshold: Coverage of a pixel below which its depth is ``max_range``.
        max_range: Largest depth, m.
        exclude_self: Without effect, since drones have no splats.
        camera_prefix: Name of the cameras, without index.
    """
    settings = (drones, resolution, background, alpha_threshold, max_range, exclude_self, camera_prefix)
    return build_render_splat_rgbd_fn(sim, *settings)(sim.data)


def build_render_splat_fn(
    sim: Sim,
    drones: int | Sequence[int] | None = None,
    resolution: tuple[int, int] = (640, 480),
    background: Color = (1.0, 1.0, 1.0),
    exclude_self: bool = False,
    camera_prefix: str = "fpv_cam",
) -> Callable[[SimData], Array]:
    """Return ``render_splat_rgb`` as a compiled function of the data."""
    del exclude_self
    render_images = _image_fn(sim, drones, resolution, background, 0.0, camera_prefix)
    return jax.jit(lambda data: render_images(data).color)


def build_render_splat_rgbd_fn(
    sim: Sim,
    drones: int | Sequence[int] | None = None,
    resolution: tuple[int, int] = (640, 480),
    background: Color = (1.0, 1.0, 1.0),
    alpha_threshold: float = 0.5,
    max_range: float = 10.0,
    exclude_self: bool = False,
    camera_prefix: str = "fpv_cam",
) -> Callable[[SimData], Array]:
    """Return ``render_splat_rgbd`` as a compiled function of the data."""
    del exclude_self
    render_images = _image_fn(sim, drones, resolution, background, alpha_threshold, camera_prefix)

    def render(data: SimData) -> Array:
        image = render_images(data)
        return jnp.concatenate([image.color, jnp.minimum(image.depth, max_range)[..., None]], axis=-1)

    return jax.jit(render)


def _image_fn(
    sim: Sim,
    drones: int | Sequence[int] | None,
    resolution: tuple[int, int],
    background: Color,
    min_coverage: float,
    camera_prefix: str,
) -> Callable[[SimData], SplatImage]:
    splats = sim.scene.splats
    require(
        splats is not None,
        "expected attached splats, got a simulation without. Call attach_splats(sim, scene=...) first.",
    )
    try:
        width, height = resolution
    except (TypeError, ValueError):
        raise ConfigError(f"expected a resolution of width and height, pixels, got {resolution!r}") from None
    indices = range(sim.n_drones) if drones is None else np.atleast_1d(drones).tolist()
    cameras = [f"{camera_prefix}:{k}" for k in indices]
    render_images = sim.scene.splat_fn(cameras, width, height, background, min_coverage)
    return lambda data: render_images(data, splats.gaussians)


@jax.jit
def viewmats(cam_xpos: Array, cam_xmat: Array) -> Array:
    """Return the matrices from the world to cameras of MuJoCo, with axes right, down and ahead. (..., 4, 4)

    Args:
        cam_xpos: Positions, m. (..., 3)
        cam_xmat: Rotation matrices, camera to world. (..., 3, 3)
    """
    return view_matrices(cam_xpos, cam_xmat)


def camera_intrinsics(
    mj_model: mujoco.MjModel, camera_id: int, resolution: tuple[int, int]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return focal lengths and principal point of a camera, pixels.

    Args:
        resolution: Width and height, pixels.
    """
    width, height = resolution
    focal = float(height / 2 / np.tan(np.deg2rad(mj_model.cam_fovy[camera_id]) / 2))
    return (focal, focal), (width / 2, height / 2)
