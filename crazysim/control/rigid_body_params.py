"""Mass, inertia, drag and rotor limits that controllers assume."""

from __future__ import annotations

from typing import Any

from jax import Array

from crazysim.control.allocation import AllocationParams
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY, BodyParams, part
from crazysim.engine.pytree import leaf


def limited_allocation(airframe: Airframe, **values: Any) -> AllocationParams:
    """Return the allocation in which torques raise the collective thrust at most to the weight."""
    return AllocationParams.create(airframe, weight=-GRAVITY[2] * airframe.value("rigid_body.mass"), **values)


class RigidBodyParams(BodyParams):
    """Physical parameters that a controller assumes, each shared or one per drone. Subclasses add gains."""

    drag_matrix: Array = leaf("parameter", 2, (3, 3), airframe=lambda x: x.matrix("drag.coefficients"))
    """Linear drag coefficients that the controller compensates, body frame, N s/m. (3, 3)"""
    allocation: AllocationParams = part(limited_allocation)
    """Limits of the rotors."""
