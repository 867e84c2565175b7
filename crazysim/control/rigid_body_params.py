"""Mass, inertia, drag and rotor limits that controllers assume."""

from __future__ import annotations

from typing import Any

from jax import Array

from crazysim.control.allocation import AllocationParams
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY
from crazysim.pytree import PyTree, as_parameter, leaf


class RigidBodyParams(PyTree):
    """Physical parameters that a controller assumes, each shared or one per drone. Subclasses add gains."""

    mass: Array = leaf("parameter", 1, (1,))
    """Mass that the controller assumes, kg. (1,)"""
    gravity_vec: Array = leaf("parameter", 1)
    """Gravitational acceleration that the controller assumes, world frame, m/s^2. (3,)"""
    J: Array = leaf("parameter", 2)
    """Inertia that the controller assumes, body frame, kg m^2. (3, 3)"""
    drag_matrix: Array = leaf("parameter", 2)
    """Linear drag coefficients that the controller compensates, body frame, N s/m. (3, 3)"""
    allocation: AllocationParams
    """Limits of the rotors."""


def rigid_body_params(airframe: Airframe) -> dict[str, Any]:
    """Return the fields of ``RigidBodyParams`` for an airframe, by name."""
    mass = airframe.value("rigid_body.mass")
    return {
        "mass": as_parameter(mass),
        "gravity_vec": as_parameter(GRAVITY),
        "J": as_parameter(airframe.inertia),
        "drag_matrix": as_parameter(airframe.matrix("drag.coefficients")),
        "allocation": AllocationParams.create(airframe).replace(weight=as_parameter(-GRAVITY[2] * mass)),
    }
