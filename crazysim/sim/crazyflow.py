"""Names of Crazyflow's API that crazysim itself does not use; its modules in ``crazysim.names`` export them."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.controls import AttitudeControlData, BodyRateControlData, ForceTorqueControlData, StateControlData
from crazysim.core.settings import as_mask
from crazysim.core.stages import first_principles_derivative, fitted_derivative
from crazysim.drones import AirframeSource, load_airframe
from crazysim.drones.keys import TABLES
from crazysim.dynamics.models import GRAVITY
from crazysim.dynamics.parameters import convert_arrays
from crazysim.engine.pytree import PyTree, n_batch_axes, scopes, select_worlds
from crazysim.errors import ConfigError, UnknownNameError, require
from crazysim.sim.sim import Sim

Record = TypeVar("Record", bound=PyTree)
Tree = TypeVar("Tree")

ControlData = StateControlData | AttitudeControlData | BodyRateControlData | ForceTorqueControlData
"""Record of a command level."""
CrazyflowError = ConfigError
first_principles_dynamics = first_principles_derivative
so_rpy_dynamics = so_rpy_rotor_dynamics = so_rpy_rotor_drag_dynamics = fitted_derivative
CASCADE_NAME = "mellinger"
"""Crazyflow's name for its cascade of controllers, which is ``"crazyflow"`` here; not the controller ``Mellinger``."""
ROTOR_NAMES = {
    "thrust_curve": "rpm2thrust",
    "torque_curve": "rpm2torque",
    "thrust_min": "thrust_min",
    "thrust_max": "thrust_max",
}
"""Crazyflow's names of keys of ``[rotors]``."""
CRAZYFLOW_TABLES = {
    "core": "controller",
    "state2attitude": "controller.state",
    "attitude2force_torque": "controller.attitude",
    "body_rate2force_torque": "controller.attitude",
}
"""Table of an airframe by the name of Crazyflow's table; ``core`` is for all functions of the cascade."""


def load_params(
    controller: str, drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict[str, dict]:
    """Load the parameters of a drone for a controller: ``core``, and one table for each function.

    Parameters that the airframe lacks are left out.

    Args:
        controller: ``"mellinger"``, Crazyflow's cascade; other names are refused.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values, such as ``jax.numpy``; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    require(controller == CASCADE_NAME, f"expected controller {CASCADE_NAME!r}, got {controller!r}", UnknownNameError)
    airframe = load_airframe(drone)
    tables: dict[str, dict[str, Any]] = {
        name: {key: x for key, x in airframe.table(table).items() if key in TABLES[table]}
        for name, table in CRAZYFLOW_TABLES.items()
    }
    rotors = {ROTOR_NAMES[key]: x for key, x in airframe.table("rotors").items() if key in ROTOR_NAMES}
    tables["core"] |= {"gravity_vec": GRAVITY, "L": airframe.arm, "mixing_matrix": airframe.mixing_matrix} | rotors
    return convert_arrays(tables, xp, device)


def load_fn_params(
    fn: Callable[..., Any], drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Load the parameters of one function of the cascade: ``core``, and its own table if it has one.

    Args:
        fn: Function of ``crazysim.control``, such as ``state2attitude``.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    params = load_params(CASCADE_NAME, drone, xp, device)
    return params["core"] | params.get(fn.__name__, {})


def leaf_replace(record: Record, mask: Array | None = None, **changes: Array) -> Record:
    """Return a copy of a record with fields replaced in the worlds of a mask.

    Args:
        record: Record; the replaced fields have a first axis over worlds, or broadcast to such a shape.
        mask: True in the worlds to change; None for all. (n_worlds,)
        **changes: New values. (n_worlds, ...)
    """
    return record.replace(
        **{name: _select_in_worlds(mask, new, getattr(record, name)) for name, new in changes.items()}
    )


def world_mask(tree: Tree) -> Tree:
    """Return a tree of the same structure with bools, True for leaves that have an axis over worlds."""
    return jax.tree.map(lambda scope: n_batch_axes(scope) > 0, scopes(tree))


def pytree_replace(tree: Tree, new_tree: Tree, batched: Any, mask: Array | None = None) -> Tree:
    """Return a tree in which batched leaves have the values of another tree in the worlds of a mask.

    Args:
        tree: Tree to change.
        new_tree: Tree of the same structure with the new values.
        batched: Tree of bools, True for the leaves to replace, such as ``world_mask`` returns.
        mask: True in the worlds to change; None for all. (n_worlds,)
    """
    return jax.tree.map(
        lambda old, new, is_batched: _select_in_worlds(mask, new, old) if is_batched else old,
        tree,
        new_tree,
        batched,
    )


def render_depth(
    sim: Sim, camera: int | str = 0, resolution: tuple[int, int] = (100, 100), include_drone: bool = False
) -> Array:
    """Return the depth image of one camera in every world, m: along the ray, -1 where a ray hits nothing.

    ``sim.depth`` returns the images of all drones' cameras at once, and hides each drone from its own camera only.

    Args:
        camera: Id or name; 0 is ``track_cam:0``.
        resolution: Width and height, pixels.
        include_drone: Whether to show drones, including the one that carries the camera.
    """
    try:
        width, height = resolution
    except (TypeError, ValueError):
        raise ConfigError(f"expected a resolution of width and height, pixels, got {resolution!r}") from None
    depth = sim.depth(camera, width, height, drones=include_drone, hide_own=False, along="ray")
    if depth.shape[1] > 1:
        raise ConfigError(
            f"expected one camera, got {depth.shape[1]} for {camera!r}. Use one such as '{camera}:0', or sim.depth."
        )
    return jnp.where(jnp.isfinite(depth[:, 0]), depth[:, 0], -1.0)


def _select_in_worlds(mask: Any, new: Any, old: Any) -> Array:
    new = jnp.asarray(new)
    n_worlds = np.broadcast_shapes(new.shape, np.shape(old))[:1]
    return select_worlds(as_mask(mask, n_worlds), new, old)
