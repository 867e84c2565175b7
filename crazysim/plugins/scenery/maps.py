"""Maps: a list of scenes, of which each world has one, drawn again in every episode."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Self

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData, require_data
from crazysim.core.plugin import Plugin, Simulation, state
from crazysim.core.random import uniform, world_key
from crazysim.core.settings import as_mask, setting
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import device_array, select_worlds
from crazysim.errors import expect, require
from crazysim.geometry import Shape
from crazysim.scene.build import compile_spec
from crazysim.scene.collision import CollisionBody, CollisionGeom, collision_model
from crazysim.scene.contact_report import map_distance
from crazysim.scene.object_poses import map_index_of
from crazysim.scene.objects import IDENTITY_QUAT, add_bodies
from crazysim.tables import range_between, read_numbers

MAX_MAPS = 10_000
"""Largest number of maps."""
BALL_RADIUS = 1e-3
"""Radius of the ball by whose distance points are measured, m."""


class Maps(Plugin):
    """Scenes that do not move, of which each world draws one at every reset; until the first, all have map 0.

    Geoms of the other maps cost a world nothing: rays and contacts search only the map of their world. In
    ``object_names`` and images the present map is one object, with the name of the plugin. A scene has one list of
    maps.
    """

    maps: Sequence[Any] = setting()
    """Sources as for ``sim.scene.add``: MJCF files or text, ``MjSpec`` or bodies of one. For scans and meshes that are
    not convex use ``crazysim.scene.map_spec``."""
    chosen: Array = state((), scope="world", dtype=np.int32)
    """Index that ``select`` has set for this episode; -1 if the index was drawn. (n_worlds, 1)"""
    name: str = "maps"

    def check_settings(self) -> None:
        super().check_settings()
        expect(
            isinstance(self.maps, (list, tuple)) and 0 < len(self.maps) <= MAX_MAPS,
            f"a list of 1 to {MAX_MAPS} maps",
            self.maps,
            "Use Maps([spec, ...]), with sources as for sim.scene.add.",
        )

    @property
    def scope(self) -> str:
        return "world"

    def bind(self, sim: Simulation) -> Self:
        sim.scene.add_maps(self.maps, self.name)
        return self.with_arrays(sim, chosen=device_array(np.full((sim.n_worlds, 1), -1), np.int32))

    def index(self, data: SimData) -> Array:
        """Return the index of the map of each world. (n_worlds,), or () in one world"""
        require_data(data)
        index = map_index_of(data)
        return index[:, 0] if index.ndim else index

    def select(self, data: SimData, index: ArrayLike, mask: ArrayLike | None = None) -> SimData:
        """Return the data with other maps until the next reset.

        Args:
            data: Data of all worlds.
            index: Index of a map, for all worlds or for each. () or (n_worlds,)
            mask: True in the worlds to change; None for all. (n_worlds,)
        """
        old = self.index(data)
        require(old.ndim == 1, "expected data of all worlds, got data of one world. Use maps.select outside of stages.")
        last = range_between(0, len(self.maps) - 1)
        values = read_numbers("index", index, last, ((), old.shape), whole=True)
        new = select_worlds(as_mask(mask, old.shape), jnp.broadcast_to(jnp.asarray(values, np.int32), old.shape), old)
        chosen = self.read(data).replace(chosen=new[:, None])
        return self.write(data.replace(objects=data.objects.replace(map_index=new[:, None])), chosen)  # type: ignore[union-attr]

    @functools.cached_property
    def body(self) -> CollisionBody:
        """Geoms of all maps that drones can touch."""
        spec, names = mujoco.MjSpec(), [f"{self.name}:{k}" for k in range(len(self.maps))]
        spec.copy_during_attach = True
        origin = np.zeros((len(names), 3)), np.tile(IDENTITY_QUAT, (len(names), 1))
        add_bodies(spec, list(self.maps), names, *origin, mocap=False, options={})
        (body,) = collision_model(compile_spec(spec), (), (), names).objects
        return body

    def clearance(self, data: SimData, pos: Array) -> Array:
        """Return the distance from points to the nearest surface of the map of their world, m, negative inside. (...)

        It is infinite in an empty map.

        Args:
            data: Data of all worlds, one world, or one drone.
            pos: Points, world frame, m: (n_worlds, n, 3), without n_worlds in one world, or (3,) for one drone.
        """
        return self._distance(pos, map_index_of(data))

    @functools.cached_property
    def _distance(self) -> Callable[[Array, Array], Array]:
        ball = CollisionGeom(Shape("sphere", (BALL_RADIUS,)), (0.0, 0.0, 0.0), None)

        @jit_eager_calls()
        def distance(pos: Array, index: Array) -> Array:
            return map_distance([(ball, pos, None)], None, self.body, index) + BALL_RADIUS

        return distance

    def reset_episode(self, data: SimData) -> SimData:
        chosen = self.read(data).chosen
        drawn = jnp.floor(uniform(world_key(data, self.name), ()) * len(self.maps)).astype(np.int32)
        index = jnp.where(chosen >= 0, chosen, jnp.minimum(drawn, len(self.maps) - 1))
        return data.replace(objects=data.objects.replace(map_index=index))  # type: ignore[union-attr]
