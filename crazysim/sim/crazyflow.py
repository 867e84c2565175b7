"""Names of Crazyflow's API that crazysim itself does not use; its modules in ``crazysim.names`` export them."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.controls import AttitudeControlData, BodyRateControlData, ForceTorqueControlData, StateControlData
from crazysim.core.settings import as_mask
from crazysim.core.stages import first_principles_derivative, fitted_derivative
from crazysim.engine.pytree import PyTree, n_batch_axes, scopes, select_worlds
from crazysim.errors import ConfigError
from crazysim.sim.sim import Sim

Record = TypeVar("Record", bound=PyTree)
Tree = TypeVar("Tree")

ControlData = StateControlData | AttitudeControlData | BodyRateControlData | ForceTorqueControlData
"""Record of a command level."""
CrazyflowError = ConfigError
first_principles_dynamics = first_principles_derivative
so_rpy_dynamics = so_rpy_rotor_dynamics = so_rpy_rotor_drag_dynamics = fitted_derivative


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
        sim: Simulation.
        camera: Id or name; 0 is ``track_cam:0``.
        resolution: Width and height, pixels.
        include_drone: True to show drones, including the one that carries the camera.
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
