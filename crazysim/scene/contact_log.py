"""Contacts at every step, remembered: which drones have touched what since their world's last reset, and when first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.pipeline import insert_fn_before
from crazysim.core.stage import Stage, StageScope
from crazysim.effects.core import Simulation, install
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf, static
from crazysim.scene.report import ContactReport, Objects, choose
from crazysim.scene.scene import Scene

NAME = "contacts"
"""Name of the stage, and of its record in ``data.plugins``."""


class SimulationWithScene(Simulation, Protocol):
    """What it needs of ``crazysim.Sim``."""

    n_worlds: int
    n_drones: int

    @property
    def scene(self) -> Scene:
        """What MuJoCo holds."""
        ...


class Touched(PyTree):
    """What each drone has touched since its world's last reset."""

    floor: Array = leaf("drone", 0)
    """Whether it has touched the floor. (n_worlds, n_drones)"""
    objects: Array = leaf("drone", 1)
    """Whether it has touched an object. (n_worlds, n_drones, n_objects)"""
    drones: Array = leaf("drone", 0)
    """Whether it has touched another drone. (n_worlds, n_drones)"""
    first: Array = leaf("drone", 0)
    """Step at whose end it touched anything for the first time; -1 as long as it has not. (n_worlds, n_drones)"""
    object_names: tuple[str, ...] = static()
    """Names of the objects' bodies."""

    @property
    def any(self) -> Array:
        """Whether it has touched anything. (n_worlds, n_drones)"""
        return self.first >= 0


def latch_contacts(sim: SimulationWithScene, objects: Objects = None, floor: bool = True, drones: bool = True) -> None:
    """Check contacts at the end of every step, in the step itself, and remember them in ``data.plugins["contacts"]``.

    A reset of a world forgets. Objects that are
    added to the scene later are not looked at.

    Args:
        sim: The simulation.
        objects: Handles, or names of bodies; None for all there are now, () for none.
        floor: Whether to check the floor. Drones that start on it have touched it at once.
        drones: Whether to check drones against each other.

    Raises:
        ConfigError: If contacts are latched already, nothing is asked for, or an object is not there or is moved by
            hand.
    """
    names = tuple(body.name for body in choose(sim.scene.collision_model, objects))
    if not (names or floor or drones):
        raise ConfigError("contacts of nothing are not latched; ask for floor, drones or some object")
    shape = (sim.n_worlds, sim.n_drones)
    record = Touched(
        floor=jnp.zeros(shape, bool),
        objects=jnp.zeros((*shape, len(names)), bool),
        drones=jnp.zeros(shape, bool),
        first=jnp.full(shape, -1, jnp.int32),
        object_names=names,
    )
    # A stage of one world computes everything for all drones of it: what one drone sees alone is a stage of its own.
    alone = _stage(sim.scene.contact_fn(names, floor, drones=False), "drone") if names or floor else None
    install(sim, NAME, record, alone, before="increment_steps")
    if drones:
        together = _stage(sim.scene.contact_fn((), floor=False), "world")
        insert_fn_before(sim.step_pipeline, "increment_steps", together, f"{NAME}_of_drones")
        sim.build_step_fn()


def _stage(contacts: Callable[[SimData], ContactReport], scope: StageScope) -> Stage:
    def check(data: SimData) -> SimData:
        touched, report = data.plugins[NAME], contacts(data)
        new = touched.replace(
            floor=_or(touched.floor, report.floor),
            objects=_or(touched.objects, report.objects),
            drones=_or(touched.drones, report.drones),
            first=jnp.where((touched.first < 0) & report.any, data.core.steps + 1, touched.first),
        )
        return data.replace(plugins=data.plugins | {NAME: new})

    return Stage(check, scope)


def _or(before: Array, now: Array | None) -> Array:
    return before if now is None else before | now
