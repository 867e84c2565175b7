"""Collision and visual models of a compiled scene: geoms of floor, objects and drones, as constants."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.errors import ConfigError
from crazysim.geometry import Shape, hfield, hull
from crazysim.geometry.shapes import UNBOUNDED_LENGTH

GEOM_KINDS = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")): kind for kind in
         ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")}  # fmt: skip
DRONE_BITS = (3, 1)
"""``contype`` and ``conaffinity`` of the geoms with which drones collide."""
VISIBLE_GROUPS = range(3)
"""Groups of geoms that are drawn, as by MuJoCo's renderer."""
MIN_ALPHA = 0.5
"""Smallest alpha of geoms that rays hit."""

DroneGroups = Sequence[tuple[int, ...] | None]
"""Indices of the drones of each airframe; None in place of the indices of all drones."""
Matrix = tuple[tuple[float, float, float], ...]
"""Rows of a 3 x 3 matrix."""


@dataclasses.dataclass(frozen=True)
class CollisionGeom:
    """A shape and its pose in the frame of a body, or in the world frame."""

    shape: Shape
    """Shape, in its own frame."""
    pos: tuple[float, float, float]
    """Origin of the shape's frame, m."""
    rot: Matrix | None
    """Rows of the rotation matrix from the shape's frame; None for the identity."""
    name: str = dataclasses.field(default="", compare=False)
    """Name of the geom; empty if it has none."""
    index: int = dataclasses.field(default=-1, compare=False)
    """Index of the geom in MuJoCo's model."""


@dataclasses.dataclass(frozen=True)
class CollisionBody:
    """An object: a child of the world body, with everything that is attached to it."""

    name: str
    """Name of the body."""
    row: int | None
    """Row of its pose in ``data.objects`` after ``with_mocap_bodies``; None for a body that cannot move."""
    geoms: tuple[CollisionGeom, ...]
    """Geoms in the frame of the body; in the world frame where ``row`` is None."""
    initial_pos: tuple[float, ...] = dataclasses.field(default=(0.0, 0.0, 0.0), compare=False)
    """Position in the compiled scene, m. (3,)"""
    maps: tuple[int, ...] = ()
    """Index of the map of each geom, where each world has one of several maps; empty for other bodies."""
    n_maps: int = 0
    """Number of these maps; 0 for other bodies."""


@dataclasses.dataclass(frozen=True)
class DroneGeoms:
    """Geoms of drones of one airframe."""

    geoms: tuple[CollisionGeom, ...]
    """Geoms of one of these drones, in its body frame."""
    drones: tuple[int, ...] | None = None
    """Indices of the drones; None for all."""

    def drone_mask(self, drone_id: Array) -> Array | None:
        """Whether an index is in ``drones``; None if all drones have these geoms. (...)"""
        if self.drones is None:
            return None
        return functools.reduce(
            jnp.logical_or, [(drone_id >= a) & (drone_id <= b) for a, b in _consecutive_runs(self.drones)]
        )


def _consecutive_runs(numbers: Sequence[int]) -> list[tuple[int, int]]:
    runs: list[tuple[int, int]] = []
    for k in sorted(numbers):
        if runs and runs[-1][1] == k - 1:
            runs[-1] = (runs[-1][0], k)
        else:
            runs.append((k, k))
    return runs


@dataclasses.dataclass(frozen=True)
class CollisionModel:
    """Geoms of a scene that drones can touch, or that cameras see."""

    floor: tuple[CollisionGeom, ...]
    """Planes and height fields of the world body."""
    objects: tuple[CollisionBody, ...]
    """Objects with at least one geom; geoms of the world body that are not floor form the object ``world``."""
    drones: tuple[DroneGeoms, ...]
    """Geoms of the drones, one entry per airframe."""
    mocap_bodies: tuple[str, ...]
    """Mocap bodies without a handle. Only ``mjx_data`` has their poses; ``with_mocap_bodies`` appends them to the
    data."""
    mocap_ids: tuple[int, ...]
    """Mocap ids of ``mocap_bodies``."""

    def without_mocap_bodies(self) -> CollisionModel:
        """Return the model for data to which ``with_mocap_bodies`` has appended the poses of ``mocap_bodies``."""
        return dataclasses.replace(self, mocap_bodies=(), mocap_ids=())


def touches_drones(contype: int, conaffinity: int) -> bool:
    """Return whether drones collide with a geom that has these bits."""
    return bool(DRONE_BITS[0] & conaffinity or DRONE_BITS[1] & contype)


def collision_model(
    model: mujoco.MjModel, handles: Sequence[str], drone_groups: DroneGroups = (None,), maps: Sequence[str] = ()
) -> CollisionModel:
    """Return the geoms that drones can touch.

    Args:
        handles: Names of bodies with handles, in the order of ``data.objects``.
        drone_groups: Drones of each airframe.
        maps: Names of the bodies of maps, of which each world has one.
    """

    def can_touch(geom: int) -> bool:
        return touches_drones(model.geom_contype[geom], model.geom_conaffinity[geom])

    def can_collide(geom: int) -> bool:
        return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])

    return _build_model(model, handles, drone_groups, maps, can_touch, can_collide, _read_shape)


def visual_model(
    model: mujoco.MjModel, handles: Sequence[str], drone_groups: DroneGroups = (None,), maps: Sequence[str] = ()
) -> CollisionModel:
    """Return the geoms that cameras see: meshes as convex hulls, without geoms that are more than half transparent.

    Planes are as large as they are drawn, as for MuJoCo's rays; drones touch their infinite extension.

    For the arguments see ``collision_model``.
    """

    def is_seen(geom: int) -> bool:
        material = model.geom_matid[geom]
        alpha = model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3]
        return model.geom_group[geom] in VISIBLE_GROUPS and alpha >= MIN_ALPHA

    def read_shape(model: mujoco.MjModel, geom: int) -> Shape:
        shape, size = _read_shape(model, geom), model.geom_size[geom, :2]
        if shape.kind == "mesh":
            return dataclasses.replace(shape, triangles=_read_triangles(model, geom))
        if shape.kind != "plane" or not size.any():
            return shape
        return Shape("rectangle", tuple(float(x) if x > 0 else UNBOUNDED_LENGTH for x in size))

    return _build_model(model, handles, drone_groups, maps, is_seen, is_seen, read_shape)


def _build_model(
    model: mujoco.MjModel,
    handles: Sequence[str],
    drone_groups: DroneGroups,
    maps: Sequence[str],
    is_included: Callable[[int], bool],
    is_drone_geom: Callable[[int], bool],
    read_shape: Callable[[mujoco.MjModel, int], Shape],
) -> CollisionModel:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    read_geom = functools.partial(_read_geom, model, data, read_shape)
    # Geoms by their carrier: floor, drones, other bodies.
    floor = []
    drone_geoms: dict[str, list[CollisionGeom]] = {f"drone:{group[0] if group else 0}": [] for group in drone_groups}
    geoms_by_root = dict[int, list[int]]()
    for geom in range(model.ngeom):
        root = int(model.body_rootid[model.geom_bodyid[geom]])
        name = body_name(model, root)
        if name.startswith("drone:"):
            if name in drone_geoms and is_drone_geom(geom):
                drone_geoms[name].append(read_geom(geom, root))
            continue
        if not is_included(geom):
            continue
        kind = GEOM_KINDS.get(int(model.geom_type[geom]))
        if kind is None:
            raise ConfigError(
                f"expected a geom of type {', '.join(GEOM_KINDS.values())}, got geom {model.geom(geom).name!r} of type "
                f"{int(model.geom_type[geom])}. Give it contype='0' conaffinity='0', or another type."
            )
        if root == 0 and kind in ("plane", "hfield"):
            floor.append(read_geom(geom, None))
        else:
            geoms_by_root.setdefault(root, []).append(geom)
    # Rows of movable bodies: first those with handles.
    mocap = {
        name: int(mocap_id)
        for body, mocap_id in enumerate(model.body_mocapid)
        if mocap_id >= 0
        and not (name := body_name(model, body)).startswith("drone:")
        and name not in handles
        and name not in maps
    }
    rows = {name: row for row, name in enumerate((*handles, *mocap))}
    # Geoms in the frame of their body, or of the world if it stays.
    objects, map_geoms, map_indices = [], [], []
    for root, geoms in geoms_by_root.items():
        if body_name(model, root) in maps:
            map_geoms += [read_geom(geom, None) for geom in geoms]
            map_indices += [maps.index(body_name(model, root))] * len(geoms)
            continue
        row = rows.get(body_name(model, root))
        frame = None if row is None else root
        objects.append(
            CollisionBody(
                body_name(model, root),
                row,
                tuple(read_geom(geom, frame) for geom in geoms),
                tuple(map(float, data.xpos[root])),
            )
        )
    if maps:
        name = maps[0].rpartition(":")[0]
        objects.append(CollisionBody(name, None, tuple(map_geoms), maps=tuple(map_indices), n_maps=len(maps)))
    drones = tuple(
        [DroneGeoms(tuple(geoms), group) for geoms, group in zip(drone_geoms.values(), drone_groups, strict=True)]
    )
    return CollisionModel(tuple(floor), tuple(objects), drones, tuple(mocap), tuple(mocap.values()))


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body, or ``body <id>`` if it has none."""
    return model.body(body).name or f"body {body}"


def _read_geom(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    read_shape: Callable[[mujoco.MjModel, int], Shape],
    geom: int,
    body: int | None,
) -> CollisionGeom:
    pos, rot = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if body is not None:
        to_body = data.xmat[body].reshape(3, 3).T
        pos, rot = to_body @ (pos - data.xpos[body]), to_body @ rot
    rot = np.where(np.abs(rot) < 1e-12, 0.0, rot)
    # The compiler stores attitudes as quaternions; their rounding would rotate axis-aligned boxes.
    rot = np.where(np.abs(np.abs(rot) - 1) < 1e-9, np.sign(rot), rot)
    rows = None if np.allclose(rot, np.eye(3), rtol=0, atol=1e-9) else tuple(tuple(map(float, row)) for row in rot)
    return CollisionGeom(read_shape(model, geom), tuple(map(float, pos)), rows, model.geom(geom).name, geom)  # type: ignore[arg-type]


def _read_shape(model: mujoco.MjModel, geom: int) -> Shape:
    kind, size = GEOM_KINDS[int(model.geom_type[geom])], model.geom_size[geom]
    if kind == "mesh":
        return _read_hull(model, int(model.geom_dataid[geom]))
    if kind == "hfield":
        field = int(model.geom_dataid[geom])
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        start = int(model.hfield_adr[field])
        heights = model.hfield_data[start : start + rows * columns].reshape(rows, columns)
        return hfield(heights * model.hfield_size[field][2], tuple(map(float, model.hfield_size[field])))
    return Shape(kind, tuple(map(float, size)))


def _read_triangles(model: mujoco.MjModel, geom: int) -> np.ndarray | None:
    mesh = int(model.geom_dataid[geom])
    texture, first_vertex, first_coordinate = (
        texture_of(model, geom),
        model.mesh_vertadr[mesh],
        model.mesh_texcoordadr[mesh],
    )
    if texture < 0 or first_coordinate < 0 or int(model.tex_type[texture]) != int(mujoco.mjtTexture.mjTEXTURE_2D):
        return None
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    corners = model.mesh_vert[first_vertex + model.mesh_face[faces]]
    coordinates = model.mesh_texcoord[first_coordinate + model.mesh_facetexcoord[faces]]
    return np.concatenate([x.reshape(len(x), -1) for x in (corners, coordinates)], axis=-1).astype(np.float64)


def texture_of(model: mujoco.MjModel, geom: int) -> int:
    """Return the index of the texture that colours a geom; -1 if it has none."""
    material = int(model.geom_matid[geom])
    return int(model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]) if material >= 0 else -1


def _read_hull(model: mujoco.MjModel, mesh: int) -> Shape:
    # MuJoCo's ``mesh_graph`` of a hull holds the numbers of vertices and faces, an address for each vertex, the indices
    # of the vertices in the mesh, edges, and three vertices for each face.
    first, n = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = np.asarray(model.mesh_vert[first : first + n], np.float64)
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        return hull(vertices)
    graph = model.mesh_graph[start:]
    n_vertices, n_faces = int(graph[0]), int(graph[1])
    face_start = 2 + 2 * n_vertices + n_vertices + 3 * n_faces
    return hull(vertices, np.asarray(graph[face_start : face_start + 3 * n_faces]).reshape(-1, 3))
