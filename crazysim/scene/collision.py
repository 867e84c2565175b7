"""What contacts and rays see of a compiled scene: shapes on the floor, on objects and on drones, as constants."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from crazysim.errors import ConfigError
from crazysim.geometry import Shape, hfield, hull

KINDS = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")): kind for kind in
         ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")}  # fmt: skip

Matrix = tuple[tuple[float, float, float], ...]


@dataclasses.dataclass(frozen=True)
class CollisionGeom:
    """A shape in the frame of what it belongs to."""

    shape: Shape
    """The shape, in a frame of its own."""
    pos: tuple[float, float, float]
    """Where that frame is, m."""
    rot: Matrix | None
    """How it is turned, as rows of a matrix; None if it is not."""


@dataclasses.dataclass(frozen=True)
class CollisionBody:
    """An object of the scene."""

    name: str
    """Name of its body."""
    place: int | None
    """Where its pose is in ``data.objects``; None if its parts are where they are in every world."""
    parts: tuple[CollisionGeom, ...]
    """What it is made of."""


@dataclasses.dataclass(frozen=True)
class CollisionModel:
    """Everything that drones can touch."""

    floor: tuple[CollisionGeom, ...]
    """Planes and height fields of the world itself."""
    objects: tuple[CollisionBody, ...]
    """Every body with something to touch; what else belongs to the world itself is ``world``."""
    drone: tuple[CollisionGeom, ...]
    """The shapes by which a drone touches."""
    by_hand: tuple[str, ...]
    """Bodies that a user can move by hand, of which only ``mjx_data`` knows where they are."""


def read(model: mujoco.MjModel, movable: Sequence[str], touching: bool = True) -> CollisionModel:
    """Return what a compiled scene is made of.

    Args:
        model: The scene.
        movable: Bodies with handles, in the order of ``data.objects``.
        touching: Whether to take what drones touch; else what cameras see.

    Raises:
        ConfigError: If a geom is of a kind that there is no shape for.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    drone_geoms = [g for g in range(model.ngeom) if _root(model, g).startswith("drone:")]
    first = [g for g in drone_geoms if _root(model, g) == "drone:0"]
    if touching:
        first = [g for g in first if model.geom_contype[g] or model.geom_conaffinity[g]]
    else:
        first = [g for g in first if model.geom_group[g] <= VISIBLE_GROUPS and _alpha(model, g) >= OPAQUE]
    of_drone = (3, 1)
    floor, bodies = [], dict[str, list[int]]()
    for g in sorted(set(range(model.ngeom)) - set(drone_geoms)):
        kind = KINDS.get(int(model.geom_type[g]))
        if touching:
            meets = (of_drone[0] & model.geom_conaffinity[g]) or (of_drone[1] & model.geom_contype[g])
        else:
            meets = model.geom_group[g] <= VISIBLE_GROUPS and _alpha(model, g) >= OPAQUE
        if not meets:
            continue
        if kind is None:
            raise ConfigError(f"geom {model.geom(g).name!r} is of a type that contacts and rays know no shape for")
        root = _root(model, g)
        if kind in ("plane", "hfield") and root == "world":
            floor.append(_part(model, data, g, None))
        else:
            bodies.setdefault(root, []).append(g)
    numbers = {name: k for k, name in enumerate(movable)}
    objects = []
    for name, geoms in bodies.items():
        body = model.body(name).id if name in numbers else None
        parts = tuple(_part(model, data, g, body) for g in geoms)
        objects.append(CollisionBody(name, numbers.get(name), parts))
    by_hand = tuple(o.name for o in objects if o.place is None and o.name != "world" and _moves(model, o.name))
    drone = model.body("drone:0").id
    return CollisionModel(tuple(floor), tuple(objects), tuple(_part(model, data, g, drone) for g in first), by_hand)


VISIBLE_GROUPS = 2
"""Last group of geoms that pictures show."""
OPAQUE = 0.5
"""How opaque a geom must be to be seen by rays."""


def _root(model: mujoco.MjModel, geom: int) -> str:
    """Return the body below the world that a geom belongs to, or ``world``."""
    root = model.body_rootid[model.geom_bodyid[geom]]
    return model.body(root).name or f"body {root}"


def _alpha(model: mujoco.MjModel, geom: int) -> float:
    material = model.geom_matid[geom]
    return float(model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3])


def _moves(model: mujoco.MjModel, name: str) -> bool:
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    return body >= 0 and bool(model.body_mocapid[body] >= 0)


def _part(model: mujoco.MjModel, data: mujoco.MjData, geom: int, body: int | None) -> CollisionGeom:
    """Return a geom in the frame of a body, or of the world."""
    pos, rot = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if body is not None:
        turned = data.xmat[body].reshape(3, 3).T
        pos, rot = turned @ (pos - data.xpos[body]), turned @ rot
    rot = np.where(np.abs(rot) < 1e-12, 0.0, rot)
    # Poses go through float32 of no file, but through a quaternion: what is right-angled is kept so.
    rot = np.where(np.abs(np.abs(rot) - 1) < 1e-9, np.sign(rot), rot)
    rows = None if np.allclose(rot, np.eye(3), rtol=0, atol=1e-9) else tuple(tuple(map(float, row)) for row in rot)
    return CollisionGeom(_shape(model, geom), tuple(map(float, pos)), rows)  # type: ignore[arg-type]


def _shape(model: mujoco.MjModel, geom: int) -> Shape:
    kind, size = KINDS[int(model.geom_type[geom])], model.geom_size[geom]
    if kind == "mesh":
        return _hull(model, int(model.geom_dataid[geom]))
    if kind == "hfield":
        field = int(model.geom_dataid[geom])
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        begin = int(model.hfield_adr[field])
        heights = model.hfield_data[begin : begin + rows * columns].reshape(rows, columns)
        return hfield(heights * model.hfield_size[field][2], tuple(map(float, model.hfield_size[field])))
    return Shape(kind, tuple(map(float, size)))


def _hull(model: mujoco.MjModel, mesh: int) -> Shape:
    """Return a mesh's convex hull, which is what MuJoCo touches with as well.

    The graph of the hull is numbers of vertices and faces, an address for each vertex, the vertices' numbers in the
    mesh, edges, and three vertices for each face (MuJoCo's ``mesh_graph``).
    """
    first, n = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = np.asarray(model.mesh_vert[first : first + n], np.float64)
    at = int(model.mesh_graphadr[mesh])
    if at < 0:
        return hull(vertices)
    graph = model.mesh_graph[at:]
    n_vertices, n_faces = int(graph[0]), int(graph[1])
    begin = 2 + 2 * n_vertices + n_vertices + 3 * n_faces
    return hull(vertices, np.asarray(graph[begin : begin + 3 * n_faces]).reshape(-1, 3))
