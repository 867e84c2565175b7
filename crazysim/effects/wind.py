"""Wind: a constant mean, and gusts with the spectra of Dryden."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.random import drone_key
from crazysim.core.stage import stage
from crazysim.effects.core import Simulation, as_setting, blown_upon, install, require_drag, zeros
from crazysim.pytree import PyTree, leaf
from crazysim.rotation import dot, safe_clip, safe_normalize

FOOT = 0.3048
"""Metres per foot: the low-altitude model is stated in feet."""
LOWEST, HIGHEST = 10.0, 1000.0
"""Heights between which the low-altitude model holds, ft; below and above, those of the nearer end are taken."""
MIN_AIRSPEED = 1.0
"""Airspeed at which gusts pass a drone that drifts along with the mean wind, m/s: an assumption, for the frozen field
of the model would stand still then."""


class Wind(PyTree):
    """Velocity of the air at every drone."""

    velocity: Array = leaf("parameter", 1, (3,))
    """Mean wind, world frame, m/s. (3,)"""
    speed_20ft: Array | None = leaf("parameter", 1, (1,))
    """Mean wind speed 20 ft above ground, which sets how strong gusts are, m/s; None without gusts. (1,)"""
    filters: Array | None = leaf("drone", 1)
    """States of the shaping filters at unit variance, 1; None without gusts. (n_worlds, n_drones, 5)"""
    gust: Array | None = leaf("drone", 1)
    """Present gust, world frame, m/s; None without gusts. (n_worlds, n_drones, 3)"""


def add(sim: Simulation, velocity: Any = (0.0, 0.0, 0.0), speed_20ft: Any = None) -> None:
    """Let wind blow: the drones feel the drag of their velocity relative to the air.

    Args:
        sim: The simulation; its model must have drag.
        velocity: Mean wind, world frame, m/s, for all drones or each. (3,) or (n_worlds, n_drones, 3)
        speed_20ft: Mean wind speed 20 ft above ground, m/s, which sets how strong gusts are: 15 knots (7.7 m/s) is
            light, 30 moderate, 45 severe turbulence (MIL-F-8785C, 3.7.3.4). None for no gusts.
            () or (n_worlds, n_drones)

    Raises:
        ConfigError: If a setting cannot be, the model has no drag, or there is wind already.
    """
    require_drag(sim, "wind")
    mean = as_setting(sim, "velocity", velocity, (3,))
    if speed_20ft is None:
        install(sim, "wind", Wind(mean, None, None, None), influence=drag_in_wind)
        return
    record = Wind(mean, as_setting(sim, "speed_20ft", speed_20ft, low=0.0), zeros(sim, 5), zeros(sim, 3))
    install(sim, "wind", record, gusts, drag_in_wind)


def drag_in_wind(data: SimData) -> SimData:
    """Return the data with the force that the wind adds to the drag."""
    wind = data.plugins["wind"]
    return blown_upon(data, wind.velocity if wind.gust is None else wind.velocity + wind.gust)


@stage("drone")
def gusts(data: SimData) -> SimData:
    """Let the gust at one drone go on by a step.

    The Dryden spectra of MIL-F-8785C (3.7.1.2) as white noise through filters: ``1 / (1 + t s)`` along the mean wind,
    ``(1 + sqrt(3) t s) / (1 + t s)^2`` across and vertically, ``t = L / V``. MIL-HDBK-1797 writes 2 L for L across and
    vertically and halves these lengths, which at low altitude comes to the same. An episode begins with gusts at full
    strength, not with calm air.
    """
    wind = data.plugins["wind"]
    s = data.states
    length, deviation = low_altitude(s.pos[..., 2:], wind.speed_20ft)
    relative = s.vel - wind.velocity
    airspeed = jnp.sqrt(dot(relative, relative) + MIN_AIRSPEED**2)
    step = airspeed / (data.core.freq * length)

    noise = jax.random.normal(drone_key(data, "wind"), (6,), s.vel.dtype)
    begins = data.core.steps == 0
    first, second = wind.filters[:3], wind.filters[3:]
    first = jnp.where(begins, noise[3:], first)
    filters = shape_noise(first, second, noise[:3], jnp.where(begins, 1.0, step / (1 + step / 2)))

    first, second = filters[:3], filters[3:]
    across = (3**0.5 * first[1:] + (1 - 3**0.5) * second) / 2**0.5
    gust = from_wind_axes(deviation * jnp.concatenate([first[:1], across]), wind.velocity)
    return data.replace(plugins=data.plugins | {"wind": wind.replace(filters=filters, gust=gust)})


def low_altitude(height: Array, speed_20ft: Array) -> tuple[Array, Array]:
    """Return scale lengths and standard deviations of gusts near the ground.

    MIL-F-8785C, 3.7.3.4: with h in ft, ``L_w = h``, ``L_u = L_v = h / (0.177 + 0.000823 h)^1.2``,
    ``sigma_w = 0.1 W_20``, ``sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4``.

    Args:
        height: Height above ground, m. (..., 1)
        speed_20ft: Mean wind speed 20 ft above ground, m/s. (..., 1)

    Returns:
        Scale lengths along the mean wind, across and vertically, m, and standard deviations, m/s. (..., 3) each
    """
    h = safe_clip(height / FOOT, LOWEST, HIGHEST)
    log = jnp.log(0.177 + 0.000823 * h)
    horizontal, sigma = h * jnp.exp(-1.2 * log), 0.1 * speed_20ft
    length = FOOT * jnp.concatenate([horizontal, horizontal, h], axis=-1)
    sigma_h = sigma * jnp.exp(-0.4 * log)
    return length, jnp.concatenate([sigma_h, sigma_h, sigma + jnp.zeros_like(h)], axis=-1)


def shape_noise(first: Array, second: Array, noise: Array, loss: Array) -> Array:
    """Return the states of the shaping filters one step later.

    ``x1' + x1 / t = sqrt(2 / t) w`` and ``x2' = (x1 - x2) / t``, both by the trapezoidal rule, which keeps the
    covariance of the continuous filters, ((1, 1/2), (1/2, 1/2)), exactly, however large or uneven the steps.

    Args:
        first: x1 along the mean wind, across and vertically, 1. (..., 3)
        second: x2 across and vertically, 1. (..., 2)
        noise: Standard normal numbers. (..., 3)
        loss: Fraction of a filter's state that is lost in the step, ``h / (1 + h / 2)`` with h = dt / t; at 1 the new
            state knows nothing of the old. (..., 3)

    Returns:
        x1, then x2. (..., 5)
    """
    new = first - loss * first + jnp.sqrt(loss * (2 - loss)) * noise
    mean = 0.5 * (first + new)[..., 1:]
    return jnp.concatenate([new, second - loss[..., 1:] * (second - mean)], axis=-1)


def from_wind_axes(vector: Array, velocity: Array) -> Array:
    """Return a vector given along the mean wind, across (left of it) and vertically, in the world frame. (..., 3)

    The axes are level, as MIL-F-8785C has them at low altitude; without any mean wind they are those of the world.
    """
    along = safe_normalize(velocity[..., :2], jnp.asarray([1.0, 0.0], velocity.dtype))
    c, s = along[..., 0], along[..., 1]
    u, v = vector[..., 0], vector[..., 1]
    return jnp.stack([c * u - s * v, s * u + c * v, vector[..., 2]], axis=-1)
