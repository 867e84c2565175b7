"""Contact log: contacts checked at every step, and the drones that have touched something since their last reset."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin, Simulation, StagePlacement, param, state
from crazysim.engine.pytree import device_array
from crazysim.engine.stage import Stage, StageScope
from crazysim.errors import ConfigError
from crazysim.scene.contact_report import ContactReport, ObjectSelection, select_bodies
from crazysim.scene.object_poses import moving_plugins


class ContactLog(Plugin):
    """Log of contacts, checked at the end of every step within the compiled step.

    A reset of a world clears its log. In ``data.plugins`` the settings are the log: True where a drone has touched what
    they select, None for what is not checked.
    """

    objects: ObjectSelection = param(default=None, core=("objects",), scope="drone")
    """Handles, or names of bodies; None for all bodies in the scene, () for none. (n_worlds, n_drones, n_objects)"""
    floor: bool = param(default=True, core=(), scope="drone")
    """Whether to check the floor. Drones that start on the floor touch it at once. (n_worlds, n_drones)"""
    drones: bool = param(default=True, core=(), scope="drone")
    """Whether to check drones against each other. (n_worlds, n_drones)"""
    first_step: Array = state((), dtype=np.int32)
    """Step in which the drone first touched anything; -1 before. (n_worlds, n_drones)"""
    name: str = "contacts"
    object_names: tuple[str, ...] = dataclasses.field(default=(), kw_only=True, repr=False)
    """Names of the bodies of the objects in ``data.plugins``. (n_objects,)"""

    @property
    def any(self) -> Array:
        """Whether the drone has touched anything. (n_worlds, n_drones)"""
        return self.first_step >= 0

    def bind(self, sim: Simulation) -> ContactLog:
        names = self._object_names(sim)
        if not (names or self.floor or self.drones):
            raise ConfigError("expected something to check for contacts, got nothing. Use floor, drones or objects.")
        shape = (sim.n_worlds, sim.n_drones)
        flags: Any = {
            "floor": device_array(np.zeros(shape), bool) if self.floor else None,
            "objects": device_array(np.zeros((*shape, len(names))), bool),
            "drones": device_array(np.zeros(shape), bool) if self.drones else None,
        }
        first_step = device_array(np.full(shape, -1), np.int32)
        return self.replace(**flags, first_step=first_step, object_names=names, is_bound=True)

    def carry_over(self, record: ContactLog, old_record: ContactLog) -> ContactLog:
        old_names = old_record.object_names
        columns = [k for k, name in enumerate(record.object_names) if name in old_names]
        old_columns = [old_names.index(record.object_names[k]) for k in columns]
        objects = np.array(record.objects)
        objects[..., columns] = np.asarray(old_record.objects)[..., old_columns]
        return record.replace(objects=device_array(objects, bool))

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        """Return a stage of one drone, and a stage of one world for loads and other objects that plugins move.

        A stage of one world computes everything for all of its drones, so it checks only these objects.
        """
        names, placements = self._object_names(sim), []
        moved_names = moving_plugins(sim.scene.plugins(), names)
        static_names = [name for name in names if name not in moved_names]
        if static_names or self.floor or self.drones:
            drone_stage = self._log_stage(sim.scene.contact_fn(static_names, self.floor, self.drones), "drone")
            placements.append(StagePlacement(drone_stage, before="increment_steps"))
        if moved_names:
            object_stage = self._log_stage(sim.scene.contact_fn(list(moved_names), floor=False, drones=False), "world")
            placements.append(StagePlacement(object_stage, before="increment_steps", name=f"{self.name}_of_moved"))
        return placements

    def _object_names(self, sim: Simulation) -> tuple[str, ...]:
        return tuple(body.name for body in select_bodies(sim.scene.collision_model, self.objects))

    def _log_stage(self, contacts: Callable[[SimData], ContactReport], scope: StageScope) -> Stage:
        def log_contacts(data: SimData) -> SimData:
            log, report = self.read(data), contacts(data)
            new_log = log.replace(
                floor=_logical_or(log.floor, report.floor),
                objects=_merge_objects(log, report),
                drones=_logical_or(log.drones, report.drones),
                first_step=jnp.where((log.first_step < 0) & report.any, data.core.steps + 1, log.first_step),
            )
            return self.write(data, new_log)

        return Stage(log_contacts, scope)


def _merge_objects(log: Any, report: ContactReport) -> Array:
    if report.objects is None or report.object_names == log.object_names:
        return _logical_or(log.objects, report.objects)
    columns = np.array([log.object_names.index(name) for name in report.object_names])
    return log.objects | jnp.zeros_like(log.objects).at[..., columns].set(report.objects)


def _logical_or(old: Any, new: Array | None) -> Any:
    return old if new is None else old | new
