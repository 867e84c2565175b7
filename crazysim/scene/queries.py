"""SceneQueries of a simulation to its scene, each compiled once: contact reports and depth of all worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax import Array

from crazysim.core.data import SimData
from crazysim.engine import fused
from crazysim.engine.lower import UnsupportedError
from crazysim.engine.query import Query, query
from crazysim.scene import report
from crazysim.scene.depth import Along
from crazysim.scene.objects import Handle
from crazysim.scene.report import ContactReport, Objects
from crazysim.scene.scene import Scene


class SceneQueries:
    """What was asked of a scene, compiled for as long as the scene stays as it is."""

    def __init__(self, scene: Scene, platform: str | None):
        """Take the scene, and the platform whose kernels may answer; None for answers by XLA alone."""
        self._scene = scene
        self._platform = None if platform is None or fused.missing(platform) else platform
        self._model: Any = None
        self._compiled: dict[tuple[Any, ...], Any] = {}

    def contact_report(self, data: SimData, objects: Objects, floor: bool, drones: bool) -> ContactReport:
        """Return what each drone touches; see ``Sim.contact_report``."""
        asked = objects if isinstance(objects, (Handle, str, type(None))) else tuple(objects)
        answer = self._answer("report", data, lambda: self._contacts(asked, floor, drones), asked, floor, drones)
        return answer(*_poses(data))

    def depth(
        self, data: SimData, camera: str | int, width: int, height: int, drones: bool, hide_own: bool, along: Along
    ) -> Array:
        """Return what cameras measure, m; see ``Sim.depth``. (n_worlds, n_cameras, height, width)"""
        settings = (camera, width, height, drones, hide_own, along)

        def build() -> Callable[[SimData], Array]:
            look = self._scene.depth_fn(*settings)
            return lambda data: look(data).distance

        return self._answer("depth", data, build, *settings)(*_poses(data))

    def _answer(
        self, question: str, data: SimData, build: Callable[[], Callable[[SimData], Any]], *settings: Any
    ) -> Callable[..., Any]:
        """Return a question about poses to the scene as it is now, compiled once for each setting."""
        if self._model is not self._scene.mj_model:
            self._model, self._compiled = self._scene.mj_model, {}
        if (question, *settings) not in self._compiled:
            self._compiled[question, *settings] = jax.jit(_of_poses(build(), data))
        return self._compiled[question, *settings]

    def _contacts(self, objects: Objects, floor: bool, drones: bool) -> Callable[[SimData], ContactReport]:
        """Return the report of all worlds, by one kernel where it can be written out."""
        whole, platform = self._scene.contact_fn(objects, floor, drones), self._platform
        if platform is None:
            return whole
        queries: list[Query] = []
        if floor or report.choose(self._scene.solids, objects):
            queries.append(("drone", self._scene.contact_fn(objects, floor, drones=False)))
        if drones:
            queries.append(("world", self._scene.contact_fn((), floor=False)))

        def contacts(data: SimData) -> ContactReport:
            try:
                return functools.reduce(ContactReport.joined, query(queries, data, platform))
            except UnsupportedError:
                return whole(data)

        return contacts


def _poses(data: SimData) -> tuple[Array | None, ...]:
    """Return all that questions about poses look at: a compiled call costs by the number of its arrays."""
    states, objects = data.states, data.objects
    return states.pos, states.quat, *((None, None) if objects is None else (objects.pos, objects.quat))


def _of_poses(fn: Callable[[SimData], Any], data: SimData) -> Callable[..., Any]:
    """Return a function of data as one of its poses; nothing else of the data is there."""
    bare = jax.tree.map(lambda _: None, data)

    def of_poses(pos: Array, quat: Array, objects_pos: Array | None, objects_quat: Array | None) -> Any:
        states, objects = bare.states.replace(pos=pos, quat=quat), bare.objects
        if objects is not None:
            objects = objects.replace(pos=objects_pos, quat=objects_quat)
        return fn(bare.replace(states=states, objects=objects, plugins={}))

    return of_poses
