"""Thrust of a rotor that moves through the air, by blade element and momentum theory.

The model needs only the static thrust at a rotor speed, from the thrust curve, and one coefficient of the blades; the
pitch of the blades follows from the static thrust.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.rotation import safe_sqrt

MIN_AIR_SPEED = 1e-3
"""Speed that is added in quadrature to the air speed at a rotor, m/s, so that a stopped rotor in still air has an
inflow. An assumption; 1 mm/s has no other noticeable effect."""
N_ITERATIONS = 3
"""Number of Newton steps, which begin at the solution without in-plane velocity. For in-plane velocities of up to four
times the induced velocity, the error is at most 5e-7 of the static thrust (in float64, for 100,000 random states)."""


def disc_factor(radius: Array, air_density: Array) -> Array:
    """Return ``2 rho A`` of a rotor disc, kg/m: thrust over the square of the induced velocity in hover. (..., 1)"""
    return (2 * math.pi) * air_density * radius * radius


def blade_coefficient(
    slope: np.ndarray | float, thrust: np.ndarray | float, ang_vel: np.ndarray | float, disc: np.ndarray | float
) -> np.ndarray:
    """Return the coefficient b of the blades, the loss of thrust per inflow velocity and rotor speed, N s^2/(m rad).

    A rotor that climbs at a velocity u loses thrust, but its induced velocity v falls too. In hover, momentum theory
    and ``T = B - b omega (u + v)`` together have the slope ``dT/du = -d`` with ``b omega = 2 d y / (y - d)`` and
    ``y = T / v``, where ``T = 2 rho A v^2``. d cannot exceed y, the limit of an infinite lift slope. Blades of constant
    chord and pitch have ``b = rho A R sigma a / 4`` with solidity sigma and lift slope a (the coefficient of inflow in
    ``C_T = sigma a / 2 (theta / 3 - lambda / 2)``). The result is negative or infinite if no coefficient exists.

    Args:
        slope: Loss d of thrust per axial velocity of the hovering rotor, N s/m.
        thrust: Thrust in hover, N.
        ang_vel: Speed in hover, rad/s.
        disc: ``disc_factor`` of the rotor, kg/m.
    """
    y = np.sqrt(np.asarray(thrust * disc))
    with np.errstate(divide="ignore"):
        return 2 * slope * y / ((y - slope) * ang_vel)


def thrust_in_flight(
    static_thrust: Array,
    ang_vel: Array,
    axial_vel: Array,
    in_plane_square: Array,
    blade: Array,
    radius: Array,
    air_density: Array,
    ceiling: Array | float = 1.0,
) -> Array:
    """Return the thrust of a rotor in moving air, N. (...)

    Blade elements of constant chord and pitch give ``C_T = sigma a / 2 (theta / 3 (1 + 3/2 mu^2) - lambda / 2)``
    (Leishman, Principles of Helicopter Aerodynamics, 2006, chapter 3). With the pitch theta that gives the static
    thrust T_0 at its induced velocity v_0 this is

        T = (T_0 + b omega v_0) (1 + 3/2 mu^2) - b omega w

    at the inflow w through the disc, with the coefficient b of the blades and the advance ratio mu. Momentum theory for
    any direction of flight (Glauert; Leishman 2006, chapter 2) gives

        T = 2 rho A g^2 (w - u) sqrt(V^2 + w^2)

    at axial velocity u and in-plane velocity V, with g = 1 far from a ceiling. With growing w, the first expression
    falls and the second rises. Therefore a climb loses thrust, and forward flight gains thrust (translational lift), at
    most ``b omega v_0`` from its smaller inflow. w does not fall below zero, and ``mu^2 = V^2 / ((omega R)^2 + V^2)``
    is bounded by one: assumptions for windmilling and stopped rotors, which neither theory describes.

    Args:
        static_thrust: Thrust T_0 at this speed in still air, N; negative values are replaced by zero. (...)
        ang_vel: Speed of the rotor, rad/s. (...)
        axial_vel: Velocity of the hub relative to the air along the thrust, m/s. (...)
        in_plane_square: Square of the velocity of the hub relative to the air across the thrust, m^2/s^2. (...)
        blade: Coefficient b, N s^2/(m rad). (...)
        radius: Radius of the propeller, m. (...)
        air_density: Density of air, kg/m^3. (...)
        ceiling: Factor g from ``ceiling_factor``, dimensionless. (...)
    """
    hover_thrust = jnp.where(static_thrust > 0, static_thrust, 0.0)
    disc, loss = disc_factor(radius, air_density), blade * ang_vel
    tip_speed = radius * ang_vel
    advance_squared = in_plane_square / (tip_speed * tip_speed + in_plane_square + MIN_AIR_SPEED**2)
    # The first expression for the thrust at an inflow w is ``lift - loss * w``.
    lift = (hover_thrust + loss * safe_sqrt(hover_thrust / disc)) * (1 + 1.5 * advance_squared)

    disc = disc * ceiling * ceiling
    # First guess without in-plane speed, then Newton's method.
    squared_speed = in_plane_square + MIN_AIR_SPEED**2
    linear_term = loss - disc * axial_vel
    inflow = (safe_sqrt(linear_term * linear_term + 4 * disc * lift) - linear_term) / (2 * disc)
    for _ in range(N_ITERATIONS):
        speed = jnp.sqrt(squared_speed + inflow * inflow)
        residual = disc * (inflow - axial_vel) * speed + loss * inflow - lift
        slope = disc * (speed + (inflow - axial_vel) * inflow / speed) + loss
        inflow = inflow - residual / slope
        inflow = jnp.where(inflow > 0, inflow, 0.0)
    return lift - loss * inflow


def ceiling_factor(gap: Array, radius: Array) -> Array:
    """Return half the ratio of the air speed in the far wake to the air speed at the disc, below a ceiling. (...)

    The factor is ``1/2 + 1/2 sqrt(1 + (R / d)^2 / 8)`` for a disc at a distance d. Below the ceiling, the air flows
    inwards at the velocity ``v r / (2 d)`` at a distance r from the axis (conservation of mass). Therefore the suction
    on the ceiling is ``rho A v^2 (R / d)^2 / 16`` (Bernoulli). The momentum flow of the wake, ``rho A v v_wake``, is
    thrust less suction, and ``T = rho A v_wake^2 / 2``. Hsiao and Chirarattananon (2019, arXiv 1905.04632) measured
    propellers below a ceiling and describe them by momentum and blade element theory. Gaps are at least a twentieth of
    the radius, an assumption. A rotor above the ceiling (negative gap) has the factor 1, as in free air.

    Args:
        gap: Height of the ceiling over the rotor, m. (...)
        radius: Radius of the propeller, m. (...)
    """
    min_distance = radius / 20
    ratio = radius / jnp.where(gap > min_distance, gap, min_distance)
    return jnp.where(gap < 0, 1.0, 0.5 + 0.5 * jnp.sqrt(1 + ratio * ratio / 8))
