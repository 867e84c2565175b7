"""Wind with a mean that is constant or grows with height, and Dryden gusts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, drone_array, param, state
from crazysim.core.random import drone_key, normal
from crazysim.errors import ConfigError
from crazysim.plugins.effects.ground import ground_below
from crazysim.plugins.effects.moving_air import MovingAir, needs_drag, with_moving_air
from crazysim.rotation import clip, dot, safe_normalize

METRES_PER_FOOT = 0.3048
"""Length of a foot, m, because the low-altitude model is stated in feet."""
MIN_HEIGHT_FT, MAX_HEIGHT_FT = 10.0, 1000.0
"""Range of heights in which the low-altitude model holds, ft; heights outside are clipped to it."""
MIN_PROFILE_HEIGHT = 0.01
"""Height below which the wind of a power law stays constant, m: its slope would be infinite at zero."""
MIN_AIRSPEED = 1.0
"""Airspeed assumed for the gusts at a drone that drifts with the mean wind, m/s. An assumption: in the model's frozen
field the gust at such a drone would never change."""


class Wind(MovingAir, Plugin, requires=needs_drag):
    """Wind that acts through the drag of the velocity relative to the air; needs a model with drag.

    The gusts have the Dryden spectra of MIL-F-8785C (3.7.1.2): white noise through filters, ``1 / (1 + t s)`` along the
    mean wind, ``(1 + sqrt(3) t s) / (1 + t s)^2`` across and vertically, with ``t = L / V``, the scale length by the
    airspeed. MIL-HDBK-1797 writes 2 L for L across and vertically and halves these lengths, which is equivalent at low
    altitude. An episode begins with gusts at full strength, not with calm air.
    """

    velocity: Param = param(default=(0.0, 0.0, 0.0), core=(3,))
    """Mean wind (with a profile, its value at ``reference_height``), world frame, m/s. (3,)"""
    speed_20ft: Param = param(default=None, low=0.0)
    """Mean wind speed 20 ft above ground, m/s, which sets the strength of gusts: 15 knots (7.7 m/s) is light, 30
    moderate, 45 severe turbulence (MIL-F-8785C, 3.7.3.4). None for no gusts. (1,)"""
    roughness: Param = param(default=None, positive=True)
    """Roughness length of the ground, m, for a mean that grows with the logarithm of the height: 0.15 ft (0.046 m) in
    MIL-F-8785C near airfields, 2 ft (0.61 m) elsewhere. None for no such growth. (1,)"""
    exponent: Param = param(default=None, low=0.0)
    """Exponent of a mean that grows with a power of the height, 1, such as 0.2 over land (IEC 61400-1) and 0.14 over
    the sea (IEC 61400-3). None for no such growth. (1,)"""
    reference_height: Param = param(default=20 * METRES_PER_FOOT, positive=True)
    """Height at which a mean that grows with height equals ``velocity``, m; in the data None for the same wind
    at all heights. (1,)"""
    filters: Array = state((5,), optional=True)
    """States of the shaping filters at unit variance, 1; None without gusts. (n_worlds, n_drones, 5)"""
    gust: Array = state((3,), optional=True)
    """Gust, world frame, m/s; None without gusts. (n_worlds, n_drones, 3)"""
    name: str = "wind"

    def bind(self, sim: Simulation) -> Wind:
        if self.roughness is not None and self.exponent is not None:
            raise ConfigError(
                "expected a roughness or an exponent of the wind's profile, got both. Use roughness for the "
                "logarithmic profile, exponent for the power law."
            )

        values: dict[str, Any] = {}
        if self.speed_20ft is not None:
            values = {"filters": drone_array(sim, 0.0, 5), "gust": drone_array(sim, 0.0, 3)}
        if self.roughness is None and self.exponent is None:
            values["reference_height"] = None
        bound = self.with_arrays(sim, **values)
        if self.roughness is not None and np.any(np.asarray(bound.roughness) >= np.asarray(bound.reference_height)):
            raise ConfigError(
                f"expected a roughness below the reference height, got {self.roughness} m and "
                f"{self.reference_height} m. The roughness length is about a tenth of the height of grass or bushes."
            )
        return bound

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        return [] if self.speed_20ft is None else [StagePlacement(self.stage(self.advance_gust))]

    def influence(self, data: SimData) -> SimData:
        return with_moving_air(data, self.velocity_at_drone(data))

    def velocity_at_drone(self, data: SimData) -> Array:
        return self.velocity_at(data.states.pos, ground_below(data))

    def mean_at(self, pos: Array, ground: Array | float = 0.0) -> Array:
        """Return the mean wind at a position, world frame, m/s. (..., 3)

        Args:
            pos: Position, world frame, m. (..., 3)
            ground: Height of the ground below the position, m. (..., 1)
        """
        if self.reference_height is None:
            return self.velocity
        height = pos[..., 2:] - ground
        if self.roughness is not None:
            return log_profile(height, self.reference_height, self.roughness) * self.velocity
        return power_profile(height, self.reference_height, self.exponent) * self.velocity

    def velocity_at(self, pos: Array, ground: Array | float = 0.0) -> Array:
        """Return the velocity of the air at a position, with the drone's gust, world frame, m/s. (..., 3)"""
        mean = self.mean_at(pos, ground)
        return mean if self.gust is None else mean + self.gust

    def advance_gust(self, data: SimData) -> SimData:
        """Advance the gust at one drone by a step."""
        s = data.states
        ground = ground_below(data)
        mean = self.mean_at(s.pos, ground)
        length, deviation = low_altitude_gusts(s.pos[..., 2:] - ground, self.speed_20ft)
        relative_vel = s.vel - mean
        airspeed = jnp.sqrt(dot(relative_vel, relative_vel) + MIN_AIRSPEED**2)
        step_ratio = airspeed / (data.core.freq * length)  # duration of the step per time constant of the filters

        noise = normal(drone_key(data, self.name), (6,), s.vel.dtype)
        is_first_step = data.core.steps == 0
        x1, x2 = self.filters[:3], self.filters[3:]
        x1 = jnp.where(is_first_step, noise[3:], x1)
        loss = jnp.where(is_first_step, 1.0, step_ratio / (1 + step_ratio / 2))
        filters = shape_noise(x1, x2, noise[:3], loss)

        x1, x2 = filters[:3], filters[3:]
        transverse = (3**0.5 * x1[1:] + (1 - 3**0.5) * x2) / 2**0.5
        gust = wind_axes_to_world(deviation * jnp.concatenate([x1[:1], transverse]), mean)
        return self.write(data, self.replace(filters=filters, gust=gust))


def wind_at(data: SimData, pos: Array) -> Array:
    """Return the velocity of the air at a position near one drone, the sum over all ``Wind``, world frame, m/s. (3,)"""
    total = jnp.zeros_like(pos)
    for record in data.plugins.values():
        if isinstance(record, Wind):
            total = total + record.velocity_at(pos, ground_below(data))
    return total


def log_profile(height: Array, reference_height: Array, roughness: Array) -> Array:
    """Return the ratio of the mean wind at a height to the mean wind at the reference height.

    ``ln(z / z_0) / ln(z_ref / z_0)``, zero below the roughness length z_0: the wind shear of MIL-F-8785C with z_ref =
    20 ft, stated for 3 to 1000 ft (quoted by MathWorks, Aerospace Blockset, Wind Shear Model).

    Args:
        height: Height above ground, m. (..., 1)
        reference_height: Height at which the ratio is one, m. (..., 1)
        roughness: Roughness length, m. (..., 1)
    """
    height = jnp.where(height > roughness, height, roughness)
    return jnp.log(height / roughness) / jnp.log(reference_height / roughness)


def power_profile(height: Array, reference_height: Array, exponent: Array) -> Array:
    """Return the ratio of the mean wind at a height to the mean wind at the reference height.

    ``(z / z_ref)^alpha``, as in the normal wind profile of IEC 61400-1; constant below ``MIN_PROFILE_HEIGHT``.

    Args:
        height: Height above ground, m. (..., 1)
        reference_height: Height at which the ratio is one, m. (..., 1)
        exponent: Exponent, 1. (..., 1)
    """
    height = jnp.where(height > MIN_PROFILE_HEIGHT, height, MIN_PROFILE_HEIGHT)
    return jnp.exp(exponent * jnp.log(height / reference_height))


def low_altitude_gusts(height: Array, speed_20ft: Array) -> tuple[Array, Array]:
    """Return the scale lengths and standard deviations of gusts near the ground.

    MIL-F-8785C, 3.7.3.4: with h in ft, ``L_w = h``, ``L_u = L_v = h / (0.177 + 0.000823 h)^1.2``,
    ``sigma_w = 0.1 W_20``, ``sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4``.

    Args:
        height: Height above ground, m. (..., 1)
        speed_20ft: Mean wind speed 20 ft above ground, m/s. (..., 1)

    Returns:
        Scale lengths along the mean wind, across and vertically, m, and standard deviations, m/s. (..., 3) each
    """
    h = clip(height / METRES_PER_FOOT, MIN_HEIGHT_FT, MAX_HEIGHT_FT)
    log = jnp.log(0.177 + 0.000823 * h)
    length_u, sigma_w = h * jnp.exp(-1.2 * log), 0.1 * speed_20ft
    length = METRES_PER_FOOT * jnp.concatenate([length_u, length_u, h], axis=-1)
    sigma_u = sigma_w * jnp.exp(-0.4 * log)
    return length, jnp.concatenate([sigma_u, sigma_u, sigma_w + jnp.zeros_like(h)], axis=-1)


def shape_noise(x1: Array, x2: Array, noise: Array, loss: Array) -> Array:
    """Return the states of the shaping filters one step later.

    ``x1' + x1 / t = sqrt(2 / t) w`` and ``x2' = (x1 - x2) / t``, both by the trapezoidal rule, which preserves the
    covariance of the continuous filters, ((1, 1/2), (1/2, 1/2)), exactly for steps of any length, also varying ones.

    Args:
        x1: First states, along the mean wind, across and vertically, 1. (..., 3)
        x2: Second states, across and vertically, 1. (..., 2)
        noise: Standard normal numbers. (..., 3)
        loss: Fraction of a filter's state that is lost in the step, ``h / (1 + h / 2)`` with h = dt / t; at 1 the new
            x1 does not depend on the old x1. (..., 3)

    Returns:
        New x1, then new x2. (..., 5)
    """
    new_x1 = x1 - loss * x1 + jnp.sqrt(loss * (2 - loss)) * noise
    mean_x1 = 0.5 * (x1 + new_x1)[..., 1:]
    return jnp.concatenate([new_x1, x2 - loss[..., 1:] * (x2 - mean_x1)], axis=-1)


def wind_axes_to_world(vector: Array, velocity: Array) -> Array:
    """Transform a vector from wind axes (along the mean wind, to its left, up) to the world frame. (..., 3)

    The axes are level, as in MIL-F-8785C at low altitude; without mean wind they are the axes of the world.
    """
    direction = safe_normalize(velocity[..., :2], jnp.asarray([1.0, 0.0], velocity.dtype))
    c, s = direction[..., 0], direction[..., 1]
    u, v = vector[..., 0], vector[..., 1]
    return jnp.stack([c * u - s * v, s * u + c * v, vector[..., 2]], axis=-1)
