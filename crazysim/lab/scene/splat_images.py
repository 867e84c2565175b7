"""Images of Gaussian splats: by splax on NVIDIA GPUs, or in plain JAX."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.engine.pytree import PyTree
from crazysim.errors import ConfigError, expect, not_installed, require
from crazysim.lab.scene.splats import Gaussians, spherical_harmonics
from crazysim.scene.collision import CollisionModel
from crazysim.scene.depth import CarriedCamera, camera_pose
from crazysim.scene.mocap import MocapPoses, require_poses, with_mocap_bodies
from crazysim.scene.object_poses import ListPlugins, map_index_of, moving_plugins, with_moved_objects
from crazysim.tables import range_between, read_number, read_numbers

MIN_DEPTH = 0.01
"""Distance along the camera's axis below which Gaussians are not drawn, m; as in splax."""
BLUR_VARIANCE = 0.3
"""Variance added to projected Gaussians, pixels^2, so that they are not smaller than a pixel (Kerbl et al. 2023)."""
MAX_SLOPE = 1.3
"""Largest slope of a direction at which projections are linearised, as a multiple of the slope at the image's edge."""
MIN_ALPHA, MAX_ALPHA = 1 / 255, 0.999
"""Smallest and largest alpha, the opacity of a Gaussian at a pixel, as in splax. Below the smallest alpha the Gaussian
is not drawn there."""
MIN_TRANSMITTANCE = 1e-4
"""Transmittance below which nothing more is drawn in a pixel (Kerbl et al. 2023)."""
MAX_LOG_SCALE = float(np.log(1e4))
"""Largest logarithm of a standard deviation that is drawn, of 10 km: larger ones fill the image as well, and their
squares overflow."""
BLOCK_SIZE = 32
"""Number of Gaussians that are drawn at a time."""
MAX_ALPHAS = 1 << 24
"""Largest number of alphas that are computed at a time: pixels of all images times ``BLOCK_SIZE``."""
RENDERERS = ("auto", "splax", "plain")
"""Renderers of splats."""

Renderer = Literal["auto", "splax", "plain"]


class SplatImage(PyTree):
    """Images of splats; in a function of one world they have no axis ``n_worlds``."""

    color: Array
    """Red, green and blue, 0 to 1. (n_worlds, n_cameras, height, width, 3)"""
    depth: Array
    """Mean distance of the surface along the camera's axis, m; infinite where ``coverage`` is below ``min_coverage``.
    (n_worlds, n_cameras, height, width)"""
    coverage: Array
    """Fraction of the light from Gaussians instead of the background. (n_worlds, n_cameras, height, width)"""


SplatFn = Callable[..., SplatImage]
"""``splats(data, gaussians, mocap=None) -> SplatImage``."""
PADDING = {"log_scale": 0.0, "quat": 1.0, "logit_opacity": -np.inf}
"""Values of Gaussians that are not drawn, which make scenes equally long; other values are zero."""


def build_splat_fn(
    model: CollisionModel,
    cameras: Sequence[CarriedCamera],
    width: int,
    height: int,
    background: ArrayLike,
    min_coverage: float,
    renderer: Renderer,
    platform: str,
    plugins: ListPlugins,
) -> SplatFn:
    """Return ``splats(data, gaussians, mocap=None) -> SplatImage``, pure; see ``Scene.splat_fn``."""
    color = read_numbers("background", background, range_between(0.0, 1.0), ((3,),))
    min_coverage = read_number("min_coverage", min_coverage, range_between(0.0, 1.0))
    require(
        len({camera.fovy for camera in cameras}) <= 1,
        "expected cameras of one field of view, got several. Draw them in several functions.",
    )
    focal = height / 2 / np.tan(np.deg2rad(cameras[0].fovy) / 2)
    draw = functools.partial(
        _choose_renderer(renderer, platform), focal=float(focal), width=width, height=height, background=color
    )
    batch_size = max(1, MAX_ALPHAS // (width * height * BLOCK_SIZE))
    bodies = [camera.body for camera in cameras]
    n_maps = max((body.n_maps for body in model.objects), default=0)

    def splats(data: SimData, gaussians: Gaussians | Sequence[Gaussians], mocap: MocapPoses = None) -> SplatImage:
        require(
            data.states.pos.ndim != 1, "expected data of all worlds or of one world for images, got data of one drone"
        )
        require_poses(model, bodies, mocap)
        data = with_mocap_bodies(model, with_moved_objects(data, moving_plugins(plugins(), bodies)), mocap)
        poses = [camera_pose(camera, data) for camera in cameras]
        pos, rot = (jnp.stack(x, axis=data.states.pos.ndim - 2) for x in zip(*poses, strict=True))
        leading = pos.shape[:-1]
        camera_poses = pos.reshape(-1, 3), rot.reshape(-1, 3, 3)
        scene_index = None
        if not isinstance(gaussians, Gaussians):
            expect(
                isinstance(gaussians, (list, tuple)) and all(isinstance(x, Gaussians) for x in gaussians),
                "Gaussians, or a list of them",
                gaussians,
                "Use SplatScene.gaussians.",
            )
            require(
                len(gaussians) == n_maps > 0,
                f"expected Gaussians of one scene, or a list with those of each of {n_maps} maps, got a list of "
                f"{len(gaussians)}. Add Maps with as many maps.",
            )
            index, gaussians = map_index_of(data), _stack_scenes(gaussians)
            scene_index = jnp.broadcast_to(index, leading).reshape(-1)
        images = draw(gaussians, camera_poses, scene_index, batch_size=batch_size)
        color, depth, coverage = (x.reshape(*leading, *x.shape[1:]) for x in images)
        return SplatImage(color, jnp.where(coverage < min_coverage, jnp.inf, depth), coverage)

    return splats


def _choose_renderer(renderer: Renderer, platform: str) -> Callable[..., tuple[Array, Array, Array]]:
    require(
        isinstance(renderer, str) and renderer in RENDERERS,
        f"expected renderer {' or '.join(map(repr, RENDERERS))}, got {renderer!r}",
    )
    if renderer == "plain" or (renderer == "auto" and (platform != "gpu" or not importlib.util.find_spec("splax"))):
        return _draw_with_jax
    require(
        platform == "gpu",
        f"expected a simulation on a GPU for renderer='splax', got one on {platform!r}. Pass device='gpu', or use "
        f"renderer='plain'.",
    )
    return functools.partial(_draw_with_splax, import_splax())


def import_splax() -> ModuleType:
    """Return the module ``splax``.

    Raises:
        ImportError: If it is not installed.
    """
    try:
        import splax
    except ImportError as error:
        raise ImportError(not_installed("splats on a GPU need", "splax", "splats")) from error
    except RuntimeError as error:  # splax sets an option that SciPy only reads when it is imported
        raise ConfigError(
            f"expected to import splax, got: {error}. Set SCIPY_ARRAY_API=1 before Python starts."
        ) from error
    return splax


def _stack_scenes(scenes: Sequence[Gaussians]) -> Gaussians:
    # Scenes as long as the longest, with spherical harmonics up to the highest degree, along a new first axis.
    n, n_colors = (max(x.color.shape[k] for x in scenes) for k in (0, 1))

    def padded(name: str, x: Array) -> Array:
        more_colors = n_colors - x.shape[1] if name == "color" else 0
        x = jnp.pad(x, ((0, 0), (0, more_colors), (0, 0))) if more_colors else x
        widths = ((0, n - len(x)), *[(0, 0)] * (x.ndim - 1))
        return jnp.pad(x, widths, constant_values=PADDING.get(name, 0.0))

    names = [field.name for field in dataclasses.fields(Gaussians)]
    return Gaussians(**{name: jnp.stack([padded(name, getattr(x, name)) for x in scenes]) for name in names})


CameraPoses = tuple[Array, Array]
"""Positions of cameras, m (n, 3), and axes as columns, right, up and back (n, 3, 3)."""


def _draw_with_splax(
    splax: ModuleType,
    gaussians: Gaussians,
    camera_poses: CameraPoses,
    scene_index: Array | None,
    focal: float,
    width: int,
    height: int,
    background: np.ndarray,
    batch_size: int,
) -> tuple[Array, Array, Array]:
    del batch_size
    parameters = (
        gaussians.pos, jnp.minimum(gaussians.log_scale, MAX_LOG_SCALE), jnp.roll(gaussians.quat, 1, axis=-1),
        gaussians.color, gaussians.logit_opacity,
    )  # fmt: skip

    def draw(view: Array, index: Array | None = None) -> tuple[Array, Array]:
        return splax.render(
            *(parameters if index is None else [x[index] for x in parameters]),
            viewmat=view,
            background=jnp.asarray(background, jnp.float32),
            img_shape=(height, width),
            f=(focal, focal),
            clip_thresh=MIN_DEPTH,
            render_depth=True,
        )

    views = view_matrices(*camera_poses)
    if scene_index is None:
        image, coverage = jax.vmap(draw)(views)
    else:
        image, coverage = jax.lax.map(lambda x: draw(*x), (views, scene_index))
    return jnp.clip(image[..., :3], 0.0, 1.0), image[..., 3], coverage


def view_matrices(pos: Array, rot: Array) -> Array:
    """Return the matrices from the world frame to the frames of cameras: right, down, ahead. (..., 4, 4)

    Args:
        pos: Positions of the cameras, m. (..., 3)
        rot: Axes of the cameras as columns: right, up and back, as in MuJoCo. (..., 3, 3)
    """
    axes = jnp.swapaxes(rot, -1, -2) * np.array([[1.0], [-1.0], [-1.0]], np.float32)
    upper = jnp.concatenate([axes, -rotation.matvec(axes, pos)[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], upper.dtype), (*upper.shape[:-2], 1, 4))
    return jnp.concatenate([upper, last], axis=-2)


def _draw_with_jax(
    gaussians: Gaussians,
    camera_poses: CameraPoses,
    scene_index: Array | None,
    focal: float,
    width: int,
    height: int,
    background: np.ndarray,
    batch_size: int,
) -> tuple[Array, Array, Array]:
    def draw(camera_pose: CameraPoses, index: Array | None) -> tuple[Array, Array, Array]:
        return _draw_image(gaussians, camera_pose, focal, width, height, background, index)

    batch_size = min(batch_size, len(camera_poses[0]))
    return jax.lax.map(lambda x: draw(*x), (camera_poses, scene_index), batch_size=batch_size)


def _draw_image(
    gaussians: Gaussians,
    camera_pose: CameraPoses,
    focal: float,
    width: int,
    height: int,
    background: np.ndarray,
    scene_index: Array | None = None,
) -> tuple[Array, Array, Array]:
    # Gaussians are projected to Gaussians in the image plane (Zwicker et al. 2001) and blended from near to far. Of
    # several scenes, only positions are copied for each image.
    pos, rot = camera_pose
    scene = () if scene_index is None else (scene_index,)
    order = jnp.argsort(jnp.sum((gaussians.pos[scene] - pos) * -rot[:, 2], axis=-1))
    order = jnp.pad(order, (0, -len(order) % BLOCK_SIZE), constant_values=-1).reshape(-1, BLOCK_SIZE)
    y, x = (np.arange(n, dtype=np.float32) + 0.5 for n in (height, width))
    zero = jnp.zeros((height, width), gaussians.pos.dtype)

    def blend(carry: tuple[Array, ...], block: Array) -> tuple[tuple[Array, ...], None]:
        # The transmittance includes the Gaussian at which a pixel is finished, which is not drawn, so that the next
        # block knows it.
        color, depth, coverage, transmittance = carry
        block_gaussians = jax.tree.map(lambda leaf: leaf[(*scene, block)], gaussians)
        center, (a, b, c), z, opacity = _project(block_gaussians, pos, rot, focal, width, height)
        dx, dy = (e[:, None, None] - p for e, p in zip(center, (x, y[:, None]), strict=True))
        a, b, c, opacity = (e[:, None, None] for e in (a, b, c, jnp.where(block < 0, 0.0, opacity)))
        exponent = jnp.minimum(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy, 0.0)  # rounding may make it positive
        alpha = jnp.minimum(MAX_ALPHA, opacity * jnp.exp(exponent))
        alpha = jnp.where(alpha < MIN_ALPHA, 0.0, alpha)
        remaining = transmittance * jnp.cumprod(1 - alpha, axis=0)
        alpha = jnp.where(remaining > MIN_TRANSMITTANCE, alpha, 0.0)
        weight = jnp.concatenate([transmittance[None], remaining[:-1]]) * alpha
        gaussian_colors = _colors(block_gaussians, pos)
        # With the default precision, a GPU may round matrix products to 10 bits.
        color = color + jnp.einsum("kyx,kc->yxc", weight, gaussian_colors, precision="highest")
        depth = depth + jnp.sum(weight * z[:, None, None], axis=0)
        return (color, depth, coverage + jnp.sum(weight, axis=0), remaining[-1]), None

    start = jnp.zeros((height, width, 3), zero.dtype), zero, zero, zero + 1
    (color, depth, coverage, _), _ = jax.lax.scan(blend, start, order)
    is_covered = coverage > 0
    color = jnp.clip(color + (1 - coverage[..., None]) * jnp.asarray(background, zero.dtype), 0.0, 1.0)
    return color, jnp.where(is_covered, depth / jnp.where(is_covered, coverage, 1.0), 0.0), coverage


def _project(
    gaussians: Gaussians, pos: Array, rot: Array, focal: float, width: int, height: int
) -> tuple[tuple[Array, Array], tuple[Array, Array, Array], Array, Array]:
    right, up, back = (rot[:, k] for k in range(3))
    offset = gaussians.pos - pos
    z = -jnp.sum(offset * back, axis=-1)
    is_near = z > MIN_DEPTH
    u, v = (jnp.sum(offset * axis, axis=-1) / jnp.where(is_near, z, 1.0) for axis in (right, -up))
    scale = focal / jnp.where(is_near, z, 1.0)
    # Rows of the product of projection and rotation, and standard deviations along the axes of a Gaussian.
    forward = -back
    slopes = [jnp.clip(t, -s, s) for t, s in zip((u, v), _max_slopes(focal, width, height), strict=True)]
    rows = [scale[:, None] * (axis - t[:, None] * forward) for axis, t in zip((right, -up), slopes, strict=True)]
    quat = gaussians.quat * jax.lax.rsqrt(jnp.sum(gaussians.quat**2, axis=-1, keepdims=True))
    deviation = jnp.exp(jnp.minimum(gaussians.log_scale, MAX_LOG_SCALE))
    axes = rotation.matrix(quat)
    px, py = (jnp.sum(row[:, :, None] * axes, axis=1) * deviation for row in rows)
    pxx, xy, pyy = (jnp.sum(p * q, axis=-1) for p, q in ((px, px), (px, py), (py, py)))
    xx, yy = pxx + BLUR_VARIANCE, pyy + BLUR_VARIANCE
    # ``xx * yy - xy * xy``, as a sum of positive terms: the difference of a needle may be rounded to zero.
    normal = rotation.cross(px, py)
    determinant = BLUR_VARIANCE * (BLUR_VARIANCE + pxx + pyy) + jnp.sum(normal * normal, axis=-1)
    opacity = jnp.where(is_near, jax.nn.sigmoid(gaussians.logit_opacity), 0.0)
    center = focal * u + width / 2, focal * v + height / 2
    return center, (yy / determinant, -xy / determinant, xx / determinant), z, opacity


def _max_slopes(focal: float, width: int, height: int) -> tuple[float, float]:
    return MAX_SLOPE * width / 2 / focal, MAX_SLOPE * height / 2 / focal


def _colors(gaussians: Gaussians, pos: Array) -> Array:
    direction = rotation.safe_normalize(gaussians.pos - pos, jnp.array([1.0, 0.0, 0.0], gaussians.pos.dtype))
    harmonics = spherical_harmonics(direction, gaussians.color.shape[1])
    colors = sum(h[:, None] * gaussians.color[:, k] for k, h in enumerate(harmonics))
    return jnp.maximum(colors + 0.5, 0.0)
