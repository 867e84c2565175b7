"""Loads and hooks as bodies that collide: point masses with a shape."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin
from crazysim.errors import ConfigError, short_repr
from crazysim.geometry import Shape
from crazysim.tables import LENGTH, as_number_array


class LoadBody(NamedTuple):
    """State of point masses with the poses of their shapes, world frame.

    Leading axes are () for one drone, else (n_loads,).
    """

    pos: Array
    """Centre of the shape, m. (..., 3)"""
    quat: Array
    """Attitude of the shape, xyzw. (..., 4)"""
    vel: Array
    """Velocity of the point mass, m/s. (..., 3)"""
    mass: Array
    """Mass, kg. (..., 1)"""
    exists: Array | None = None
    """Whether the body collides; None if it always does. (...)"""


class Collider(NamedTuple):
    """Bodies of one shape, one for each load, for contacts. The functions take the data of one drone or one world."""

    shape: Shape
    """Shape of each body."""
    body: Callable[[SimData], LoadBody]
    """Function that returns the state of the bodies."""
    with_vel: Callable[[SimData, Array], SimData]
    """Function that returns the data with other velocities of the bodies. (..., 3)"""
    joined_mask: Callable[[SimData], Array]
    """Function that returns True where a rigid rod joins a body to a drone of a world, so that they cannot touch.
    (n_loads, n_drones)"""


class CollidingPlugin(Plugin, abstract=True):
    """Base class of plugins whose loads collide; the loads in the scene are ``name:0``, ...

    ``coupling`` is ``"drone"`` for loads of one drone each, ``"world"`` for loads of a world.
    """

    @property
    def solid_kinds(self) -> tuple[str, ...]:
        """Names of the scene's objects that show the colliding bodies, without their numbers."""
        return (self.name,)

    @property
    def moved_kinds(self) -> tuple[str, ...]:
        return (*self.solid_kinds, f"{self.name}_link")

    def colliders(self) -> tuple[Collider, ...]:
        """Return all bodies that collide: the loads."""
        return (Collider(self.shape(), self.body, self.with_vel, self.joined_mask),)

    def shape(self) -> Shape:
        return load_shape(self.size)  # type: ignore[attr-defined]

    def body(self, data: SimData) -> LoadBody:
        """Return the loads of one drone or one world."""
        raise NotImplementedError

    def with_vel(self, data: SimData, vel: Array) -> SimData:
        """Return the data with other velocities of the loads, for one drone or one world. (..., 3)"""
        raise NotImplementedError

    def joined_mask(self, data: SimData) -> Array:
        """Whether a rigid rod joins a load to a drone, so that the two cannot touch. (n_loads, n_drones)"""
        raise NotImplementedError


def load_shape(size: ArrayLike) -> Shape:
    """Return a ball from its radius, m, or a box from its three full lengths, m."""
    lengths = as_number_array("a body", "size", size)
    if lengths.shape not in ((), (3,)) or not np.all((lengths >= LENGTH.low) & (lengths <= LENGTH.high)):
        raise ConfigError(
            f"expected size as a positive radius, or as three positive lengths of a box, {LENGTH.text}, got "
            f"{short_repr(size)}. Use size=0.05 or size=(0.1, 0.1, 0.05)."
        )
    kind = "box" if lengths.ndim else "sphere"
    return Shape(kind, tuple((lengths / 2).tolist()) if kind == "box" else (float(lengths),))


def rest_height(size: ArrayLike) -> float:
    """Return the height of the middle of a ball or box above the floor on which it stands, m."""
    return load_shape(size).size[-1]
