"""What is seen of a scene, as plain arrays: for viewers that know no MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

SEEN_GROUPS = 3
"""Geoms of groups below this one are seen, as in MuJoCo's own pictures."""
KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
"""Kinds of shapes, called as MJCF calls them."""
UNCOLORED = (0.5, 0.5, 0.5, 1.0)
"""The colour of a geom that has none of its own."""


@dataclass(frozen=True, eq=False)
class VisualGeom:
    """One geom, in the frame of the body that carries it."""

    kind: str
    """One of ``KINDS``."""
    size: NDArray
    """Radii and half sizes, m, as MJCF has them. (3,)"""
    rgba: NDArray
    """Colour, 0 to 1. (4,)"""
    mocap: int
    """Mocap id of the body that it moves with; -1 if it stands still."""
    pos: NDArray
    """Place in the frame of that body, or in the world, m. (3,)"""
    quat: NDArray
    """Attitude in that frame, xyzw. (4,)"""
    vertices: NDArray
    """Vertices of a mesh, m. (n, 3)"""
    faces: NDArray
    """Vertices of each triangle of a mesh. (n, 3)"""


def shapes_of(model: mujoco.MjModel, data: mujoco.MjData) -> list[VisualGeom]:
    """Return the shapes of every geom that is seen, as ``data`` has them; height fields are left out.

    Args:
        model: The scene.
        data: One world of it, its kinematics up to date.
    """
    return [
        _shape(model, data, geom)
        for geom in range(model.ngeom)
        if model.geom_group[geom] < SEEN_GROUPS and _kind(model, geom) in KINDS and _color(model, geom)[3] > 0
    ]


def _kind(model: mujoco.MjModel, geom: int) -> str:
    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _shape(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> VisualGeom:
    body = int(model.geom_bodyid[geom])
    while body and model.body_mocapid[body] < 0:
        body = int(model.body_parentid[body])
    pos, quat = np.zeros(3), np.zeros(4)
    turned = np.zeros(4)
    mujoco.mju_mat2Quat(turned, data.geom_xmat[geom])
    inverse, back = np.zeros(4), np.zeros(3)
    mujoco.mju_negPose(back, inverse, data.xpos[body], data.xquat[body])
    mujoco.mju_mulPose(pos, quat, back, inverse, data.geom_xpos[geom], turned)
    vertices, faces = _mesh(model, geom)
    return VisualGeom(
        kind=_kind(model, geom),
        size=model.geom_size[geom].copy(),
        rgba=_color(model, geom),
        mocap=int(model.body_mocapid[body]),
        pos=pos,
        quat=np.roll(quat, -1),
        vertices=vertices,
        faces=faces,
    )


def _color(model: mujoco.MjModel, geom: int) -> NDArray:
    """Return a geom's own colour, or its material's, mixed with what its texture is on average. (4,)"""
    material = int(model.geom_matid[geom])
    if material < 0 or not np.allclose(model.geom_rgba[geom], UNCOLORED):
        return model.geom_rgba[geom].astype(float)
    color = model.mat_rgba[material].astype(float)
    texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    if texture >= 0:
        channels = int(model.tex_nchannel[texture])
        begin, n = model.tex_adr[texture], model.tex_width[texture] * model.tex_height[texture] * channels
        texels = model.tex_data[begin : begin + n].reshape(-1, channels)
        color[:3] *= texels[:, :3].mean(0) / 255
    return color


def _mesh(model: mujoco.MjModel, geom: int) -> tuple[NDArray, NDArray]:
    if _kind(model, geom) != "mesh":
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    mesh = int(model.geom_dataid[geom])
    vertex, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
    return (
        model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]].astype(float),
        model.mesh_face[face : face + model.mesh_facenum[mesh]].astype(int),
    )
