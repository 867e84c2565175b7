"""Collision boxes of drones, of each airframe."""

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
"""Drones of each airframe, with centre and half extents of their collision box, body frame, m. (6,)"""


def collision_boxes(sim: Simulation) -> DroneBoxes:
    """Return the collision boxes of a simulation's drones."""
    kinds = [DroneGeoms((), drones) for drones in sim.scene.kinds]
    firsts = [0 if kind.drones is None else kind.drones[0] for kind in kinds]
    boxes = [np.asarray(sim.airframes[k].value("shape.collision_box"), np.float64) for k in firsts]
    return list(zip(kinds, boxes, strict=True))


def select_airframe(results: Sequence[tuple[DroneGeoms, Any]], drone_id: Array) -> Any:
    """Return for each drone the result for its airframe.

    Args:
        results: Results for drones of each airframe: trees of arrays of one drone, or (..., n_drones, k).
        drone_id: Indices of the drones. () or (n_drones,)
    """
    (_, result), *others = results
    for kind, other in others:
        present: Any = kind.drone_mask(drone_id)
        mask = present[..., None] if present.ndim else present
        result = jax.tree.map(lambda x, y, mask=mask: x if y is x else jnp.where(mask, y, x), result, other)
    return result
