"""Collision boxes of the drones, one for each airframe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.plugin import Simulation
from crazysim.scene.collision import DroneGeoms

DroneBoxes = Sequence[tuple[DroneGeoms, np.ndarray]]
"""For each airframe: its drones, with the centre and half extents of their collision box, body frame, m. (6,)"""


def collision_boxes(sim: Simulation) -> DroneBoxes:
    """Return the collision box of each airframe in a simulation, with the drones that have it."""
    drone_groups = [DroneGeoms((), drones) for drones in sim.scene.drone_groups]
    first_drones = [0 if group.drones is None else group.drones[0] for group in drone_groups]
    boxes = [np.asarray(sim.airframes[k].value("shape.collision_box"), np.float64) for k in first_drones]
    return list(zip(drone_groups, boxes, strict=True))


def select_airframe(results: Sequence[tuple[DroneGeoms, Any]], drone_id: Array) -> Any:
    """Return for each drone the result that belongs to its airframe.

    Args:
        results: For each airframe: its drones, with a result that was computed as if all drones had this airframe. A
            result is a tree of arrays, (k,) for one drone, else (..., n_drones, k).
        drone_id: Index of the drone, or indices of all drones. () or (n_drones,)
    """
    (_, result), *others = results
    for group, other in others:
        is_in_group: Any = group.drone_mask(drone_id)
        mask = is_in_group[..., None] if is_in_group.ndim else is_in_group
        result = jax.tree.map(lambda x, y, mask=mask: x if y is x else jnp.where(mask, y, x), result, other)
    return result
