"""Bodies of a scene that viewers pick and follow: drones, vehicles, loads and objects, each with its parts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.lab.live.attitude import rotate
from crazysim.media.picture import Picture
from crazysim.scene.visual_geoms import VisualGeom
from crazysim.sim.sim import Sim

DRONE = "drone"
"""Kind of drones."""
MARK_RADIUS = 0.12
"""Radius of the sphere that marks a drone, and smallest radius of the spheres that mark other bodies, m."""
CLICK_SIZE = 0.02
"""Smallest half size of the box in which a click hits a body, as a fraction of the distance from the camera."""
MAX_TRAILS = 256
"""Largest number of bodies of a world for which all have trails; with more bodies, only drones have trails."""


class SceneBody(NamedTuple):
    """A body that every world has."""

    kind: str
    """``"drone"``, or the name of the objects in the scene, such as ``"cars"``, ``"load"`` or a handle's name."""
    index: int
    """Index of the body among the bodies of its kind."""
    name: str
    """Name in viewers."""
    mocap: int
    """Mocap id."""


class SceneBodies:
    """All bodies that can be picked, drones first."""

    items: tuple[SceneBody, ...]
    """Bodies, drones first."""
    owner: NDArray
    """Index into ``items`` for each mocap body: the body itself, or, for a part such as a wheel, its car. (n_mocap,)"""
    low: NDArray
    """Lower corner of the box around the visible geoms of each mocap body, body frame, m. (n_mocap, 3)"""
    high: NDArray
    """Upper corner of that box, body frame, m. (n_mocap, 3)"""

    def __init__(self, sim: Sim, shapes: Sequence[VisualGeom] = ()):
        kinds_and_numbers = _list_kinds_and_numbers(sim)
        parts = {part: base for plugin in sim.plugins.values() for part, base in _find_parts(plugin.moved_kinds or ())}
        counts = Counter(kind for kind, _ in kinds_and_numbers)
        members = {plugin.name: sim.plugins.members_of(plugin) for plugin in sim.plugins.values()}
        items = [SceneBody(DRONE, k, name, mocap) for k, (name, mocap) in enumerate(_list_drones(sim))]
        mocap_ids = {body.mocap for body in items}
        for mocap, (kind, k) in enumerate(kinds_and_numbers):
            if mocap not in mocap_ids and kind not in parts:
                member_names = members.get(kind, ())
                name = member_names[k] if k < len(member_names) else kind if counts[kind] == 1 else f"{kind} {k}"
                items.append(SceneBody(kind, k, name, mocap))
        self.items = tuple(items)
        item_indices = {(body.kind, body.index): i for i, body in enumerate(items)}
        index_of_mocap = {body.mocap: i for i, body in enumerate(items)}
        self.owner = np.array([index_of_mocap.get(mocap, -1) for mocap in range(len(kinds_and_numbers))], int)
        for mocap in np.flatnonzero(self.owner < 0):
            kind, k = kinds_and_numbers[mocap]
            base = parts[kind]  # parts are in the order of their bodies, equally many for each
            self.owner[mocap] = item_indices[base, k * counts[base] // counts[kind]]
        self.low, self.high = _bounding_boxes(len(kinds_and_numbers), shapes)

    @property
    def trail_mocap_ids(self) -> NDArray:
        """Mocap ids of the bodies that have trails, drones first. (n,)"""
        drones = [body.mocap for body in self.items if body.kind == DRONE]
        others = [body.mocap for body in self.items if body.kind != DRONE]
        return np.array(drones + (others if len(self.items) <= MAX_TRAILS else []), int)

    def mark_radius(self, mocap: int) -> float:
        """Return the radius of the mark around a body, m.

        Args:
            mocap: Mocap id of the body.
        """
        if self.items[self.owner[mocap]].kind == DRONE:
            return MARK_RADIUS
        return max(MARK_RADIUS, float(np.linalg.norm(np.maximum(-self.low[mocap], self.high[mocap]))))

    def find(self, kind: str, index: int) -> SceneBody:
        """Return a body.

        Args:
            kind: Kind, see ``SceneBody``.
            index: Index of the body among the bodies of its kind.
        """
        match = next((body for body in self.items if (body.kind, body.index) == (kind, index)), None)
        if match is None:
            counts = Counter(body.kind for body in self.items)
            choices = ", ".join(f"{kind!r} (0 to {n - 1})" for kind, n in counts.items())
            raise ConfigError(f"expected a body to follow, got {kind!r} {index!r}. Use one of {choices}.")
        return match

    def pick(
        self, picture: Picture, origins: NDArray, direction: NDArray
    ) -> tuple[int, SceneBody | None, NDArray | None]:
        """Return what a ray from the camera hits: the index of a shown world, a body, and a point of the floor.

        If the ray hits a body, the point is None; if it hits the floor, the body is None. If it hits nothing, both are
        None. The point is in the frame of the world, m. (3,)

        Args:
            picture: Picture that the user has seen.
            origins: Origin of the ray in the frame of each world, m; NaN for worlds elsewhere. (n, 3)
            direction: Direction of the ray. (3,)
        """
        direction = direction / np.linalg.norm(direction)
        distances = self._ray_distances(picture.quat, origins[:, None] - picture.pos, direction)
        if np.isfinite(distances).any():
            shown_index, mocap = np.unravel_index(distances.argmin(), distances.shape)
            return int(shown_index), self.items[self.owner[mocap]], None
        points = origins - direction * origins[:, 2:] / min(direction[2], -1e-6)
        shown_index = int(np.nanargmin(np.linalg.norm(points, axis=-1)))
        return shown_index, None, points[shown_index] if direction[2] < -1e-6 else None

    def _ray_distances(self, quat: NDArray, start: NDArray, direction: NDArray) -> NDArray:
        # The distance is infinite if the ray does not enter the box around the body. Boxes of small and distant bodies
        # are enlarged, so that these bodies are easy to click.
        distance = np.linalg.norm(start, axis=-1, keepdims=True)
        is_drone = np.array([self.items[k].kind == DRONE for k in self.owner])
        min_radius = np.maximum(np.where(is_drone, MARK_RADIUS, 0.0)[:, None], CLICK_SIZE * distance)
        to_body = quat * (-1, -1, -1, 1)
        local_start = rotate(to_body, start)
        local_direction = rotate(to_body, np.broadcast_to(direction, start.shape))
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low = (np.minimum(self.low, -min_radius) - local_start) / local_direction
            to_high = (np.maximum(self.high, min_radius) - local_start) / local_direction
        entry_distance, exit_distance = np.fmin(to_low, to_high).max(-1), np.fmax(to_low, to_high).min(-1)
        is_hit = (entry_distance > 0) & (entry_distance <= exit_distance) & (self.high > self.low).any(-1)
        ray_distance = np.linalg.norm(start - (start @ direction)[..., None] * direction, axis=-1)
        return np.where(is_hit, ray_distance, np.inf)


def _list_drones(sim: Sim) -> list[tuple[str, int]]:
    return list(zip(sim.drone_names, np.asarray(sim.data.core.drone_mocap_ids).tolist(), strict=True))


def _list_kinds_and_numbers(sim: Sim) -> list[tuple[str, int]]:
    model = sim.mj_model
    kinds_and_numbers: list[tuple[str, int]] = [("", 0)] * model.nmocap
    for body in np.flatnonzero(model.body_mocapid >= 0):
        text = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(body)) or f"body {body}"
        kind, _, number = text.rpartition(":")
        kinds_and_numbers[model.body_mocapid[body]] = (kind, int(number)) if kind and number.isdigit() else (text, 0)
    return kinds_and_numbers


def _find_parts(kinds: Sequence[str]) -> list[tuple[str, str]]:
    parts = []
    for kind in kinds:
        bases = [base for base in kinds if kind.startswith(f"{base}_")]
        parts += [(kind, min(bases, key=len))] if bases else []
    return parts


def _bounding_boxes(n: int, shapes: Sequence[VisualGeom]) -> tuple[NDArray, NDArray]:
    low, high = np.full((n, 3), np.inf), np.full((n, 3), -np.inf)
    for shape in shapes:
        if shape.mocap >= 0 and shape.kind != "plane":
            points = shape.pos + rotate(shape.quat, _corners(shape))
            low[shape.mocap] = np.minimum(low[shape.mocap], points.min(0))
            high[shape.mocap] = np.maximum(high[shape.mocap], points.max(0))
    is_empty = ~np.isfinite(low).all(-1)
    low[is_empty] = high[is_empty] = 0.0
    return low, high


def _corners(shape: VisualGeom) -> NDArray:
    if shape.kind == "mesh":
        return shape.vertices
    r, h, _ = shape.size
    half_size = {"sphere": (r, r, r), "capsule": (r, r, r + h), "cylinder": (r, r, h)}.get(
        shape.kind, tuple(shape.size)
    )
    return np.array(half_size) * (2 * np.indices((2, 2, 2)).reshape(3, 8).T - 1)
