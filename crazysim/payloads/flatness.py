"""Differential flatness of a drone with a point load: states and inputs from the path of the load.

The load's position and the yaw are a flat output (Sreenath, Lee and Kumar 2013). With the load's mass m_L, the drone's
mass m and the rod's length L the tension is ``T q = -m_L (x_L'' - g)``, so the load's acceleration gives the direction
q of the rod, its next two derivatives give q' and q'', the drone is at ``x = x_L - L q``, and its thrust is
``F = m (x'' - g) + m_L (x_L'' - g)``. The drone's jerk and snap need the fifth and sixth derivative of the path.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.eager import compiled

ORDER = 6
"""Highest derivative of the load's path that is needed."""


class LoadedState(NamedTuple):
    """States and inputs of a drone that carries a load along a path. Leading axes are those of the path."""

    pos: Array
    """Position of the drone, world frame, m. (..., 3)"""
    vel: Array
    """Velocity of the drone, m/s. (..., 3)"""
    acc: Array
    """Acceleration of the drone, m/s^2. (..., 3)"""
    direction: Array
    """Unit vector from drone to load. (..., 3)"""
    direction_rate: Array
    """Its rate, 1/s. (..., 3)"""
    quat: Array
    """Attitude, body to world, xyzw. (..., 4)"""
    ang_vel: Array
    """Angular velocity, body frame, rad/s. (..., 3)"""
    ang_acc: Array
    """Angular acceleration, body frame, rad/s^2. (..., 3)"""
    tension: Array
    """Tension of the rod, N. (..., 1)"""
    thrust: Array
    """Collective thrust, N. (..., 1)"""
    torque: Array
    """Torque, body frame, N m. (..., 3)"""


def _rate(fn: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Return the derivative of a function of time; ``jacfwd`` would map over the axes of the argument as well."""
    return lambda t: jax.jvp(fn, (t,), (jnp.ones_like(t),))[1]


@compiled()
def load_flat_state(
    path: Array, yaw: Array, mass: Array, load_mass: Array, length: Array, inertia: Array, gravity_vec: Array
) -> LoadedState:
    """Return states and inputs with which a drone carries a point load along a path.

    The rod is attached at the drone's centre of mass. Time derivatives are taken by differentiating the equations
    along the Taylor polynomial of the path. A load in free fall has no tension and no direction; there the results are
    not finite.

    Args:
        path: Position of the load and its time derivatives up to the sixth, world frame, m, m/s, ... (..., 7, 3)
        yaw: Heading and its first two derivatives, rad, rad/s, rad/s^2. (..., 3)
        mass: Mass of the drone, kg. ()
        load_mass: Mass of the load, kg. ()
        length: Length of the rod, m. ()
        inertia: Inertia of the drone, body frame, kg m^2. (3, 3)
        gravity_vec: Gravitational acceleration, world frame, m/s^2. (3,)
    """
    if path.ndim > 2:
        return jax.vmap(lambda p, y: load_flat_state(p, y, mass, load_mass, length, inertia, gravity_vec))(path, yaw)

    def derivatives(order: int, t: Array) -> Array:
        """Return a derivative of the path as a function of the time from now."""
        total, factor = jnp.zeros_like(path[0]), 1.0
        for k in range(ORDER - order + 1):
            factor = factor / k if k else factor
            total = total + path[order + k] * factor * t**k
        return total

    def pull(t: Array) -> Array:
        return load_mass * (derivatives(2, t) - gravity_vec)

    def pos(t: Array) -> Array:
        return derivatives(0, t) + length * pull(t) / jnp.linalg.norm(pull(t))

    velocity = _rate(pos)
    acceleration = _rate(velocity)

    def force(t: Array) -> Array:
        return mass * (acceleration(t) - gravity_vec) + pull(t)

    def attitude(t: Array) -> Array:
        """Return the rotation matrix whose z axis is along the thrust and whose x axis has the heading."""
        heading = yaw[0] + yaw[1] * t + yaw[2] * t * t / 2
        z = force(t) / jnp.linalg.norm(force(t))
        ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(t)])
        y = rotation.cross(z, ahead)
        y = y / jnp.linalg.norm(y)
        return jnp.stack([rotation.cross(y, z), y, z], axis=-1)

    def ang_vel(t: Array) -> tuple[Array, Array]:
        """Return the angular velocity of ``R' = R [w]``, and R."""
        rot, rot_rate = jax.jvp(attitude, (t,), (jnp.ones_like(t),))
        turned = jnp.sum(rot[:, :, None] * rot_rate[:, None, :], axis=0)
        return jnp.stack([turned[2, 1], turned[0, 2], turned[1, 0]]), rot

    now = jnp.zeros((), path.dtype)
    w, w_rate, rot = jax.jvp(ang_vel, (now,), (jnp.ones_like(now),), has_aux=True)
    tension = jnp.linalg.norm(pull(now))[None]
    offset = path[0] - pos(now)
    torque = rotation.matvec(inertia, w_rate) + rotation.cross(w, rotation.matvec(inertia, w))
    return LoadedState(
        pos=pos(now),
        vel=velocity(now),
        acc=acceleration(now),
        direction=offset / length,
        direction_rate=(path[1] - velocity(now)) / length,
        quat=rotation.quat_from_axes(rot[:, 0], rot[:, 1], rot[:, 2]),
        ang_vel=w,
        ang_acc=w_rate,
        tension=tension,
        thrust=jnp.linalg.norm(force(now))[None],
        torque=torque,
    )
