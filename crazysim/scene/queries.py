"""Compiled queries of the scene of a simulation: contact reports and depth of all worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jax import Array

from crazysim.arguments import check_flag
from crazysim.core.data import SimData
from crazysim.engine.cache import keep_programs
from crazysim.engine.errors import LimitError, UnsupportedError, report_unsupported
from crazysim.engine.query import Query, query
from crazysim.scene import contact_report
from crazysim.scene.collision import CollisionModel
from crazysim.scene.contact_report import ContactReport, ObjectSelection
from crazysim.scene.depth import Along
from crazysim.scene.mocap import MocapPoses, with_mocap_bodies
from crazysim.scene.scene import Scene

MAX_KERNEL_SIZE = 256
"""Largest ``kernel_size`` of a contact report that is computed by a kernel. A kernel for 64 movable boxes takes 20 s to
compile. XLA compiles any number of boxes in 1 s, but its programs take 1.4 times as long in each call."""


class SceneQueries:
    """Queries that are compiled once for each set of arguments, and again after the scene has changed."""

    def __init__(self, scene: Scene):
        self._scene = scene
        self._reported_messages: set[str] = set()
        # The compiled queries, by name and settings, and the model for which they were compiled.
        self._compiled: tuple[mujoco.MjModel | None, dict[tuple[Any, ...], Callable[..., Any]]] = None, {}

    def contact_report(self, data: SimData, objects: ObjectSelection, floor: bool, drones: bool) -> ContactReport:
        """Return the contacts of every drone; see ``Sim.contact_report``."""
        settings = (contact_report.list_objects(objects), check_flag("floor", floor), check_flag("drones", drones))
        return self._run(
            "contacts", lambda: self._build_contacts(*settings), self._scene.collision_model, data, *settings
        )

    def depth(
        self, data: SimData, camera: str | int, width: int, height: int, drones: bool, hide_own: bool, along: Along
    ) -> Array:
        """Return the depth that cameras measure, m; see ``Sim.depth``. (n_worlds, n_cameras, height, width)"""
        settings = (camera, width, height, drones, hide_own, along)

        def build() -> Callable[..., Array]:
            depth_fn = self._scene.depth_fn(*settings)
            return lambda data, mocap: depth_fn(data, mocap).distance

        return self._run("depth", build, self._scene.visual_model, data, *settings)

    def _run(
        self, name: str, build: Callable[[], Callable[..., Any]], model: CollisionModel, data: SimData, *settings: Any
    ) -> Any:
        compiled_model, compiled = self._compiled
        if compiled_model is not self._scene.mj_model:
            _, compiled = self._compiled = self._scene.mj_model, {}
        is_new = (name, *settings) not in compiled
        if is_new:
            compiled[name, *settings] = jax.jit(_restrict_to_poses(build(), data))
        states, objects = data.states, data.objects
        object_poses = (None,) * 3 if objects is None else (objects.pos, objects.quat, objects.map_index)
        # Pass only the arrays that the query needs, since the cost of a compiled call grows with their number.
        poses = (states.pos, states.quat, *object_poses)
        mocap = self._scene.mocap_poses() if model.mocap_bodies else None
        with keep_programs(enabled=is_new):
            return compiled[name, *settings](*poses, mocap)

    def _build_contacts(self, objects: ObjectSelection, floor: bool, drones: bool) -> Callable[..., ContactReport]:
        # Plugins have already moved their objects in the data.
        model, kernels = self._scene.collision_model, self._scene.ray_kernels
        platform = kernels.platform if kernels.mesh is None else None
        xla_contacts = contact_report.build_contact_fn(model, objects, floor, drones)
        if platform is None or contact_report.kernel_size(model, objects) > MAX_KERNEL_SIZE:
            return xla_contacts
        # Poses of mocap bodies are added to the data first, since the kernel reads only the data.
        model_without_mocap = model.without_mocap_bodies()
        queries: list[Query] = []
        if floor or contact_report.select_bodies(model_without_mocap, objects):
            queries.append(
                ("drone", contact_report.build_contact_fn(model_without_mocap, objects, floor, drones=False))
            )
        if drones:
            queries.append(("world", contact_report.build_contact_fn(model_without_mocap, (), floor=False)))

        def contacts(data: SimData, mocap: MocapPoses) -> ContactReport:
            try:
                reports = query(queries, with_mocap_bodies(model, data, mocap), platform)
                return functools.reduce(ContactReport.merge, reports)
            except UnsupportedError as error:
                if not isinstance(error, LimitError):
                    problem = f"the contact report has no kernel: {error.reason}"
                    remedy = "Leave out the geoms that need it with objects="
                    report_unsupported([problem], kernels.strict, self._reported_messages, remedy)
                return xla_contacts(data, mocap)

        return contacts


def _restrict_to_poses(fn: Callable[..., Any], data: SimData) -> Callable[..., Any]:
    empty_data = jax.tree.map(lambda _: None, data)

    def query_poses(
        pos: Array,
        quat: Array,
        objects_pos: Array | None,
        objects_quat: Array | None,
        map_index: Array | None,
        mocap: MocapPoses,
    ) -> Any:
        states, objects = empty_data.states.replace(pos=pos, quat=quat), empty_data.objects
        core = empty_data.core.replace(drone_id=jnp.broadcast_to(jnp.arange(pos.shape[-2]), pos.shape[:-1]))
        if objects is not None:
            # Plugins have already moved their objects, so their records are not needed.
            objects = objects.replace(pos=objects_pos, quat=objects_quat, map_index=map_index, recorded=True)
        return fn(empty_data.replace(states=states, objects=objects, core=core, plugins={}), mocap)

    return query_poses
