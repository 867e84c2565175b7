"""Gaussian splats: scenes of coloured Gaussians, made from photographs, in the world frame of a simulation."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim import rotation
from crazysim.arguments import check_arguments
from crazysim.engine.pytree import PyTree
from crazysim.errors import ConfigError, require
from crazysim.lab.scene.map_files import MAX_FILE_BYTES, read_ply
from crazysim.lab.scene.maps import read_frame
from crazysim.scene.objects import IDENTITY_QUAT
from crazysim.storage import read_bytes, wrap_read_errors
from crazysim.tables import range_between, read_number

N_COLORS = (1, 4, 9, 16)
"""Numbers of spherical harmonics up to degree 0, 1, 2 and 3."""
COMPRESSED_SUFFIXES = (".spz", ".splat", ".ksplat", ".sog", ".sogs")
"""Suffixes of files of compressed splats; ``.compressed.ply`` has the property ``packed_position``."""
CENTRAL_PERCENTILES = (5.0, 95.0)
"""Percentiles of the coordinates between which the extent of splats is measured: a few splats are far outside."""


class Gaussians(PyTree):
    """Gaussians in the world frame, as unconstrained parameters. Images have gradients with respect to them."""

    pos: Array
    """Centres, m. (n, 3)"""
    quat: Array
    """Attitudes, xyzw; normalised when they are used. (n, 4)"""
    log_scale: Array
    """Logarithms of the standard deviations along the axes of a Gaussian, m. (n, 3)"""
    color: Array
    """Coefficients of spherical harmonics for red, green and blue. (n, 1 | 4 | 9 | 16, 3)"""
    logit_opacity: Array
    """Logits of the opacities. (n,)"""


class SplatScene:
    """A scene of Gaussian splats that is read from a file and placed in the world."""

    gaussians: Gaussians
    """The Gaussians, in the world frame."""

    @check_arguments
    def __init__(
        self,
        path: str | Path,
        *,
        pos: ArrayLike = (0.0, 0.0, 0.0),
        quat: ArrayLike = IDENTITY_QUAT,
        scale: float | None = None,
    ):
        values = _read_gaussians(path)
        points = values["pos"]
        central_points = np.percentile(points, CENTRAL_PERCENTILES, axis=0) if len(points) > 100 else points
        origin, rot, scale = read_frame(central_points, pos, quat, scale)
        quat_wxyz = np.empty(4)
        mujoco.mju_mat2Quat(quat_wxyz, rot.reshape(-1))
        self.gaussians = Gaussians(
            pos=jnp.asarray(scale * points @ rot.T + origin, np.float32),
            quat=rotation.multiply(*[jnp.asarray(q, np.float32) for q in (np.roll(quat_wxyz, -1), values["quat"])]),
            log_scale=jnp.asarray(values["log_scale"] + np.log(scale), np.float32),
            color=jnp.asarray(_rotate_colors(values["color"], rot), np.float32),
            logit_opacity=jnp.asarray(values["logit_opacity"], np.float32),
        )

    def __len__(self) -> int:
        return len(self.gaussians.pos)

    def points(self, min_opacity: float = 0.3) -> NDArray[np.float64]:
        """Return the centres of the Gaussians that are not transparent, as a point cloud for ``Scene.add_map``, m.

        Args:
            min_opacity: Smallest opacity.

        Returns:
            (n, 3)
        """
        min_opacity = read_number("min_opacity", min_opacity, range_between(0.0, 1.0))
        opacity = 1 / (1 + np.exp(-np.asarray(self.gaussians.logit_opacity, np.float64)))
        return np.asarray(self.gaussians.pos, np.float64)[opacity >= min_opacity]


def _make_scene(_: None, children: Iterable[Gaussians]) -> SplatScene:
    scene = object.__new__(SplatScene)
    (scene.gaussians,) = children
    return scene


# Jitted functions that expect Gaussians then refuse a scene by themselves, instead of JAX.
jax.tree_util.register_pytree_node(SplatScene, lambda scene: ((scene.gaussians,), None), _make_scene)


def spherical_harmonics(direction: Any, n: int) -> list[Any]:
    """Return the first ``n`` real spherical harmonics, in the order and with the signs of splat files. (...) each

    Args:
        direction: Unit vectors. (..., 3)
        n: One of ``N_COLORS``.
    """
    x, y, z = (direction[..., k] for k in range(3))
    xx, yy, zz = x * x, y * y, z * z
    terms = [  # pi times the square of the factor, and the polynomial, of each harmonic
        (1 / 4, 1 + 0 * x),
        (3 / 4, -y), (3 / 4, z), (3 / 4, -x),
        (15 / 4, x * y), (15 / 4, -y * z), (5 / 16, 2 * zz - xx - yy), (15 / 4, -x * z), (15 / 16, xx - yy),
        (35 / 32, -y * (3 * xx - yy)), (105 / 4, x * y * z), (21 / 32, -y * (4 * zz - xx - yy)),
        (7 / 16, z * (2 * zz - 3 * xx - 3 * yy)), (21 / 32, -x * (4 * zz - xx - yy)), (105 / 16, z * (xx - yy)),
        (35 / 32, -x * (xx - 3 * yy)),
    ]  # fmt: skip
    return [float(np.sqrt(square / np.pi)) * polynomial for square, polynomial in terms[:n]]


def _read_gaussians(path: str | Path) -> dict[str, NDArray[np.float64]]:
    compressed = ConfigError(
        f"expected splats as an uncompressed .ply file, got {str(path)!r}, which is compressed. Convert it, for "
        f"example with splat-transform or SuperSplat of PlayCanvas."
    )
    if Path(path).suffix.lower() in COMPRESSED_SUFFIXES:
        raise compressed
    with wrap_read_errors(path, "a scene of Gaussian splats", "Use a .ply file of a program for Gaussian splatting."):
        vertex = read_ply(read_bytes(path, MAX_FILE_BYTES))["vertex"]
    if "packed_position" in vertex:
        raise compressed
    # Columns of splat files, whose quaternions begin with w.
    names = {
        "pos": ["x", "y", "z"],
        "quat": [f"rot_{k}" for k in (1, 2, 3, 0)],
        "log_scale": [f"scale_{k}" for k in range(3)],
        "color": [f"f_dc_{k}" for k in range(3)],
        "logit_opacity": ["opacity"],
    }
    missing = [name for columns in names.values() for name in columns if name not in vertex]
    if missing:
        raise ConfigError(
            f"expected Gaussian splats, got {str(path)!r}, which has no property {missing[0]!r}. Add a point cloud or "
            f"mesh with sim.scene.add_map."
        )
    values = {field: np.stack([vertex[name] for name in columns], axis=-1) for field, columns in names.items()}
    n, n_rest = len(values["pos"]), sum(name.startswith("f_rest_") for name in vertex)
    require(
        n_rest + 3 in [3 * k for k in N_COLORS],
        f"expected 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ..., got {n_rest} in {str(path)!r}. Save it again.",
    )
    require(n, f"expected Gaussian splats, got {str(path)!r}, which has none. Save it again.")
    # Spherical harmonics, which files list by channel.
    rest = np.array([vertex[f"f_rest_{k}"] for k in range(n_rest)]).reshape(3, n_rest // 3, n)
    values["color"] = np.concatenate([values["color"][:, None], rest.transpose(2, 1, 0)], axis=1)
    values["logit_opacity"] = values["logit_opacity"][:, 0]
    values = {field: np.asarray(x, np.float64) for field, x in values.items()}
    # Finite numbers, and quaternions that can be normalised.
    is_invalid = ~np.logical_and.reduce([np.isfinite(x).reshape(n, -1).all(axis=1) for x in values.values()])
    is_invalid |= ~values["quat"].any(axis=1)
    if is_invalid.any():
        raise ConfigError(
            f"expected Gaussians with finite numbers and non-zero quaternions, got {int(is_invalid.sum())} of {n} "
            f"without in {str(path)!r}. Drop these Gaussians."
        )
    return values


def _rotate_colors(color: NDArray, rot: NDArray) -> NDArray:
    # The colour seen along a direction d in the new frame equals the colour seen along ``rot.T @ d`` in the old frame.
    # Both are linear in the coefficients of a band, so directions that span the bands determine the new coefficients.
    n = color.shape[1]
    directions = np.random.default_rng(0).normal(size=(4 * n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    new, old = (np.stack(spherical_harmonics(d, n), axis=-1) for d in (directions, directions @ rot))
    return np.einsum("ij,njc->nic", np.linalg.pinv(new) @ old, color)
