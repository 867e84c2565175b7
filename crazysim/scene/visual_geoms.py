"""Visible geoms of a scene as plain arrays, for viewers without MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from crazysim.scene.collision import VISIBLE_GROUPS, texture_of

GEOM_KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
"""Kinds of geoms, as named in MJCF."""
DEFAULT_COLOR = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's colour of geoms without a colour, RGBA."""


@dataclass(frozen=True, eq=False)
class VisualGeom:
    """One visible geom, in the frame of the mocap body that carries it, or in the world frame."""

    kind: str
    """One of ``GEOM_KINDS``."""
    size: NDArray
    """Radii and half sizes, m, as in MJCF. (3,)"""
    rgba: NDArray
    """Colour, RGBA, 0 to 1. (4,)"""
    mocap: int
    """Mocap id of the body that carries the geom; -1 for a geom that does not move."""
    pos: NDArray
    """Position in the frame of that body or the world, m. (3,)"""
    quat: NDArray
    """Attitude in the frame of that body or the world, xyzw. (4,)"""
    vertices: NDArray
    """Vertices of a mesh, m; empty for other kinds. (n, 3)"""
    faces: NDArray
    """Indices of the vertices of each triangle of a mesh; empty for other kinds. (n, 3)"""


def visual_geoms(model: mujoco.MjModel, data: mujoco.MjData) -> list[VisualGeom]:
    """Return all visible geoms except height fields.

    Args:
        model: Compiled scene.
        data: State of one world, with its kinematics up to date.
    """
    return [
        _read_geom(model, data, geom)
        for geom in range(model.ngeom)
        if model.geom_group[geom] in VISIBLE_GROUPS
        and _geom_kind(model, geom) in GEOM_KINDS
        and _geom_color(model, geom)[3] > 0
    ]


def _geom_kind(model: mujoco.MjModel, geom: int) -> str:
    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _read_geom(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> VisualGeom:
    root = int(model.body_rootid[model.geom_bodyid[geom]])
    body = root if model.body_mocapid[root] >= 0 else 0
    pos, quat = np.zeros(3), np.zeros(4)
    geom_quat = np.zeros(4)
    mujoco.mju_mat2Quat(geom_quat, data.geom_xmat[geom])
    inverse_quat, inverse_pos = np.zeros(4), np.zeros(3)
    mujoco.mju_negPose(inverse_pos, inverse_quat, data.xpos[body], data.xquat[body])
    mujoco.mju_mulPose(pos, quat, inverse_pos, inverse_quat, data.geom_xpos[geom], geom_quat)
    vertices, faces = _mesh_arrays(model, geom)
    return VisualGeom(
        kind=_geom_kind(model, geom),
        size=model.geom_size[geom].copy(),
        rgba=_geom_color(model, geom),
        mocap=int(model.body_mocapid[body]),
        pos=pos,
        quat=np.roll(quat, -1),
        vertices=vertices,
        faces=faces,
    )


def _geom_color(model: mujoco.MjModel, geom: int) -> NDArray:
    # For a geom of the default colour it is the colour of the material times the mean colour of the texture.
    material = int(model.geom_matid[geom])
    if material < 0 or not np.allclose(model.geom_rgba[geom], DEFAULT_COLOR):
        return model.geom_rgba[geom].astype(float)
    color = model.mat_rgba[material].astype(float)
    texture = texture_of(model, geom)
    if texture >= 0:
        channels = int(model.tex_nchannel[texture])
        start, n = model.tex_adr[texture], model.tex_width[texture] * model.tex_height[texture] * channels
        texels = model.tex_data[start : start + n].reshape(-1, channels)
        color[:3] *= texels[:, :3].mean(0) / 255
    return color


def _mesh_arrays(model: mujoco.MjModel, geom: int) -> tuple[NDArray, NDArray]:
    if _geom_kind(model, geom) != "mesh":
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    mesh = int(model.geom_dataid[geom])
    first_vertex, first_face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
    return (
        model.mesh_vert[first_vertex : first_vertex + model.mesh_vertnum[mesh]].astype(float),
        model.mesh_face[first_face : first_face + model.mesh_facenum[mesh]].astype(int),
    )
