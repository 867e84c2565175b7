"""Questions of a simulation to its scene, each compiled once: contact reports and depth of all worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax import Array

from crazysim.engine import fused
from crazysim.engine.ask import Question, ask
from crazysim.engine.lower import NoRuleError
from crazysim.scene import report
from crazysim.scene.depth import Along
from crazysim.scene.objects import Handle
from crazysim.scene.report import ContactReport, Objects
from crazysim.scene.scene import Scene
from crazysim.sim.data import SimData


class Questions:
    """What was asked of a scene, compiled for as long as the scene stays as it is."""

    def __init__(self, scene: Scene, platform: str | None):
        """Take the scene, and the platform whose kernels may answer; None for answers by XLA alone."""
        self._scene = scene
        self._platform = None if platform is None or fused.missing(platform) else platform
        self._compiled: dict[tuple[Any, ...], Any] = {}

    def contact_report(self, data: SimData, objects: Objects, floor: bool, drones: bool) -> ContactReport:
        """Return what each drone touches; see ``Sim.contact_report``."""
        asked = objects if isinstance(objects, (Handle, str, type(None))) else tuple(objects)
        return self._answer("report", lambda: self._contacts(asked, floor, drones), asked, floor, drones)(_seen(data))

    def depth(
        self, data: SimData, camera: str | int, width: int, height: int, drones: bool, hide_own: bool, along: Along
    ) -> Array:
        """Return what cameras measure, m; see ``Sim.depth``. (n_worlds, n_cameras, height, width)"""
        settings = (camera, width, height, drones, hide_own, along)

        def build() -> Callable[[SimData], Array]:
            look = self._scene.depth_fn(*settings)
            return lambda data: look(data).distance

        return self._answer("depth", build, *settings)(_seen(data))

    def _answer(self, question: str, build: Callable[[], Any], *settings: Any) -> Any:
        """Return a question to the scene as it is now, compiled once for each setting."""
        scene = id(self._scene.mj_model)
        if (scene, question, *settings) not in self._compiled:
            self._compiled = {k: v for k, v in self._compiled.items() if k[0] == scene}
            self._compiled[scene, question, *settings] = jax.jit(build())
        return self._compiled[scene, question, *settings]

    def _contacts(self, objects: Objects, floor: bool, drones: bool) -> Callable[[SimData], ContactReport]:
        """Return the report of all worlds, by one kernel where it can be written out."""
        whole, platform = self._scene.contact_fn(objects, floor, drones), self._platform
        if platform is None:
            return whole
        questions: list[Question] = []
        if floor or report.choose(self._scene.solids, objects):
            questions.append(("drone", self._scene.contact_fn(objects, floor, drones=False)))
        if drones:
            questions.append(("world", self._scene.contact_fn((), floor=False)))

        def contacts(data: SimData) -> ContactReport:
            try:
                return functools.reduce(ContactReport.joined, ask(questions, data, platform))
            except NoRuleError:
                return whole(data)

        return contacts


def _seen(data: SimData) -> SimData:
    """Return what questions about poses look at: a compiled call costs by the number of its arrays."""
    states = data.states.replace(vel=None, ang_vel=None, rotor_vel=None, force=None, torque=None)
    core = data.core.replace(**dict.fromkeys(CLOCK))
    objects = data.objects if data.objects is None else data.objects.replace(vel=None, mocap_ids=None)
    return data.replace(states=states, controls=None, params=None, plugins={}, core=core, objects=objects)


CLOCK = ("steps", "episode", "nonfinite", "world_id", "drone_id", "drone_mocap_ids", "rng_key", "mjx_synced")
"""What of the core is an array."""
