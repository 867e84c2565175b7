"""How an effect is put into a simulation: a record, a stage that advances it, and what the dynamics feel of it.

The stage writes nothing but the effect's own record. The *influence* changes what the time derivative is taken of, and
only for that: the user's external wrench, commands and parameters are left alone. So effects neither pile up in them
nor overwrite each other, and every substep of an integrator feels the effect at its own attitude.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.pipeline import Pipeline, insert_fn_before, replace_fn
from crazysim.core.stage import Stage
from crazysim.drones import Airframe
from crazysim.dynamics import first_principles
from crazysim.dynamics.drag import drag_force
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree

Influence = Callable[[SimData], SimData]
"""Returns the data as the dynamics feel them; takes data of one drone, one world or all worlds alike."""


class Simulation(Protocol):
    """What an effect needs of ``crazysim.Sim``."""

    data: SimData
    default_data: SimData
    step_pipeline: Pipeline
    airframe: Airframe

    def build_step_fn(self) -> Any:
        """Make the step pipeline as it is now take effect."""
        ...


def install(
    sim: Simulation,
    name: str,
    record: PyTree,
    stage: Stage | None = None,
    influence: Influence | None = None,
    default: PyTree | None = None,
    before: str = "integration",
    felt_first: bool = False,
) -> None:
    """Switch an effect on: put its record and its stage in place, and build the step.

    The record goes into the data and into the default data, of which nothing else is changed.

    Args:
        sim: The simulation.
        name: Name of the effect: key of its record in ``data.plugins``, name of its stage.
        record: The record as it is now.
        stage: Advances the record once a step; None if nothing changes with time.
        influence: What the dynamics feel; None if nothing.
        default: The record that resets return to; None for the record as it is now.
        before: The stage in front of which the effect's own stage goes.
        felt_first: Whether the influence comes before those of the effects that are on already, else after.

    Raises:
        ConfigError: If the effect is on already, its name is taken, or the step has no built-in integration.
        UnknownNameError: If there is no stage to go in front of.
    """
    if name in sim.data.plugins or name in sim.step_pipeline:
        raise ConfigError(
            f"the simulation has a plugin or stage {name!r} already. To change an effect that is on, replace its "
            f"record: sim.data = sim.data.replace(plugins=sim.data.plugins | {{{name!r}: ...}})"
        )
    pipeline = dict(sim.step_pipeline)
    if influence is not None:
        replace_fn(pipeline, _felt(pipeline.get("integration"), influence, felt_first), "integration")
    if stage is not None:
        insert_fn_before(pipeline, before, stage, name)
    _put(sim, name, record if default is None else default)
    sim.default_data = sim.default_data.replace(plugins=sim.default_data.plugins | {name: sim.data.plugins[name]})
    _put(sim, name, record)
    sim.step_pipeline = pipeline
    sim.build_step_fn()


def _put(sim: Simulation, name: str, record: PyTree) -> None:
    """Put a record into the data, and by that onto the simulation's devices."""
    sim.data = sim.data.replace(plugins=sim.data.plugins | {name: record})


class Influenced:
    """A time derivative of the data as effects change them, each after the other."""

    def __init__(self, deriv_fn: Callable[..., Any], influences: tuple[Influence, ...]):
        """Take the derivative without effects, and the influences in their order."""
        self.deriv_fn, self.influences = deriv_fn, influences

    def __call__(self, data: SimData) -> Any:
        """Return the derivative."""
        for influence in self.influences:
            data = influence(data)
        return self.deriv_fn(data)


def _felt(integration: Any, influence: Influence, first: bool) -> Stage:
    """Return an integration with one more influence on its derivative."""
    fn = getattr(integration, "fn", None)
    if not isinstance(fn, partial) or "deriv_fn" not in fn.keywords:
        raise ConfigError(
            f"effects act on the time derivative within the stage 'integration', which is {integration!r} here; add "
            f"effects before that stage is exchanged or taken out"
        )
    deriv_fn, present = fn.keywords["deriv_fn"], ()
    if isinstance(deriv_fn, Influenced):
        deriv_fn, present = deriv_fn.deriv_fn, deriv_fn.influences
    influences = (influence, *present) if first else (*present, influence)
    influenced = partial(fn, deriv_fn=Influenced(deriv_fn, influences))
    return Stage(influenced, integration.scope, integration.when, integration.batched, "integration")


def blown_upon(data: SimData, air_vel: Array) -> SimData:
    """Return the data with the force that moving air adds to the drag.

    The drag is linear, so that of the velocity relative to the air is that of the velocity and that of the opposite of
    the air's.

    Args:
        data: The simulation, of a model with drag.
        air_vel: Velocity of the air, world frame, m/s. (..., 3)
    """
    s = data.states
    force = s.force + drag_force(s.quat, -air_vel, data.params.drag_matrix)
    return data.replace(states=s.replace(force=force))


def require_drag(sim: Simulation, effect: str) -> None:
    """Check that moving air would push the drones at all.

    Raises:
        ConfigError: If the model has no drag, or an airframe's is zero.
    """
    drag = getattr(sim.data.params, "drag_matrix", None)
    if drag is None or not np.any(np.asarray(drag)):
        raise ConfigError(
            f"{effect} pushes a drone through its drag, and drone {sim.airframe.name!r} has none in this model. Use "
            f"dynamics='first_principles' or 'so_rpy_rotor_drag' and an airframe with drag coefficients."
        )


def require_rotors(sim: Simulation, effect: str) -> None:
    """Check that the model has rotors of its own.

    Raises:
        ConfigError: If it is a fitted one.
    """
    if not isinstance(sim.data.params, first_principles.Params):
        raise ConfigError(f"{effect} acts on single rotors, which only dynamics='first_principles' has")


def controls_of(data: SimData) -> Any:
    """Return the controls untyped: which of their fields are None follows from the command level and the model."""
    return data.controls


def as_setting(
    sim: Simulation,
    name: str,
    value: Any,
    core: tuple[int, ...] = (1,),
    low: float = -np.inf,
    high: float = np.inf,
    dtype: Any = None,
    positive: bool = False,
) -> Array:
    """Return a setting as a parameter: shared by all drones, or one per drone.

    Args:
        sim: The simulation.
        name: What messages call it.
        value: One number for every entry (not for vectors), ``core``, or (n_worlds, n_drones, *core); the last axis
            may be left out where it has length one.
        core: Shape of one drone's.
        low: Least value allowed.
        high: Largest value allowed.
        dtype: Type; None for that of the states.
        positive: Whether zero is refused too.

    Returns:
        (*core) or (n_worlds, n_drones, *core)

    Raises:
        ConfigError: If shape or value cannot be, with what came and what was needed.
    """
    array = np.asarray(value)
    batch = sim.data.states.pos.shape[:2]
    if core == (1,) and array.shape == batch:
        array = array[..., None]
    is_number = array.dtype.kind in ("iu" if dtype is not None and np.issubdtype(dtype, np.integer) else "iuf")
    is_shared = array.shape == core or (array.ndim == 0 and core != (3,))
    if not is_number or not (is_shared or array.shape == (*batch, *core)):
        raise ConfigError(
            f"{name} has shape {array.shape} and type {array.dtype}; needed are "
            f"{'whole' if dtype is not None else 'real'} numbers of shape {core} for all drones, or {(*batch, *core)} "
            f"= (n_worlds, n_drones, {core[0]}) for each"
        )
    if (
        not np.all(np.isfinite(array))
        or np.any(array < low)
        or np.any(array > high)
        or (positive and np.any(array <= 0))
    ):
        bounds = "positive" if positive else f"from {low} to {high}"
        raise ConfigError(f"{name} is {value!r}; it must be finite and {bounds}")
    dtype = sim.data.states.pos.dtype if dtype is None else dtype
    return jnp.asarray(np.broadcast_to(array, core) if is_shared else array, dtype)


def per_drone(sim: Simulation, value: Array) -> Array:
    """Return a setting of all drones or of each as one of each. (n_worlds, n_drones, *core)"""
    return jnp.broadcast_to(value, (*sim.data.states.pos.shape[:2], value.shape[-1]))


def zeros(sim: Simulation, n: int) -> Array:
    """Return zeros for every drone, of the states' type. (n_worlds, n_drones, n)"""
    return jnp.zeros((*sim.data.states.pos.shape[:2], n), sim.data.states.pos.dtype)
