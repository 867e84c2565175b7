"""Radars that detect drones within a lobe, in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, drone_array, param, state
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.rotation import clip, safe_norm

CLEAR_COLOR, ALARM_COLOR = (0.25, 0.6, 0.9, 1.0), (0.95, 0.2, 0.15, 1.0)
"""RGBA colours of an empty lobe, and of a lobe with a drone in it."""
N_MERIDIANS, N_POINTS = 12, 40
"""Number of teardrop outlines drawn for a lobe, and number of points on each half of an outline."""


class Radar(Plugin):
    """Radars that detect the drones within their lobes. Objects do not block radars.

    The lobe is a teardrop in a vertical plane, revolved about the vertical axis: the range is the same in all
    directions. Each setting is one number for all radars, or one number per radar.
    """

    pos: Param = param(core=("radars", 3), scope="shared")
    """Positions of the radars, world frame, m; also (3,) as a setting. (n_radars, 3)"""
    max_range: Param = param(default=10.0, core=("radars",), scope="shared", positive=True)
    """Length of the lobe, m. (n_radars,)"""
    exponent: Param = param(default=1.3, core=("radars",), scope="shared", low=0.0)
    """Exponent of the lobe, 1; the larger, the thinner the lobe is near its radar. (n_radars,)"""
    height_scale: Param = param(default=1.0, core=("radars",), scope="shared", positive=True)
    """Factor of the thickness of the lobe, 1. (n_radars,)"""
    tilt: Param = param(default=0.0, core=("radars",), scope="shared", low=-math.pi / 2, high=math.pi / 2)
    """Elevation of the lobe, rad, positive upwards. (n_radars,)"""
    visible: bool = False
    """Whether to draw the lobes into images, in red where a drone is detected."""
    exposure: Array = state(("radars",))
    """Time that a drone has been within each lobe since the last reset, s. (n_worlds, n_drones, n_radars)"""
    name: str = "radar"

    def bind(self, sim: Simulation) -> Radar:
        pos = np.asarray(self.pos, np.float64)
        pos = pos[None] if pos.ndim == 1 else pos
        if pos.ndim != 2 or pos.shape[1] != 3 or not len(pos):
            raise ConfigError(
                f"expected pos as positions (3,) or (n_radars, 3), m, got {self.pos!r}. Use pos=(0, 0, 1), say."
            )
        dtype = sim.data.states.pos.dtype
        settings = {}
        for name in ("max_range", "exponent", "height_scale", "tilt"):
            value = np.asarray(getattr(self, name), np.float64)
            if value.shape not in ((), (len(pos),)):
                raise ConfigError(
                    f"expected {name} as one number, or one per radar ({len(pos)},), got shape {value.shape}"
                )
            settings[name] = device_array(np.broadcast_to(value, len(pos)), dtype)
        return self.with_arrays(sim, pos=device_array(pos, dtype), **settings, exposure=drone_array(sim, 0.0, len(pos)))

    @jit_eager_calls()
    def margin_at(self, pos: Array) -> Array:
        """Return the depth of a point within each lobe, m, negative outside; see ``lobe_margin``. (..., n_radars)

        For the plugin in ``data.plugins``.
        """
        offset = pos[..., None, :] - self.pos
        return lobe_margin(offset, self.max_range, self.exponent, self.height_scale, self.tilt)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        return [StagePlacement(self.stage(self.count_exposure), before="increment_steps")]

    def count_exposure(self, data: SimData) -> SimData:
        """Add the duration of a step to the exposure of one drone, for each lobe that contains the drone."""
        time = jnp.where(self.margin_at(data.states.pos) > 0, 1 / data.core.freq, 0.0)
        return self.write(data, self.replace(exposure=self.exposure + time))

    def detects(self, data: SimData) -> Array:
        """Whether a radar detects a drone, for one drone, one world or all worlds. (..., n_radars)"""
        return self.read(data).margin_at(data.states.pos) > 0

    def observations(self, data: SimData) -> dict[str, Array]:
        return {"margin": self.margin_at(data.states.pos), "exposure": self.exposure}

    def draw(self, sim: Simulation, world: int) -> None:
        if not self.visible:
            return
        is_detected = np.any(np.asarray(self.detects(sim.data))[world], axis=0).reshape(-1)
        record = self.read(sim.data)
        for k, pos in enumerate(np.asarray(record.pos, np.float64)):
            shape = (float(x[k]) for x in (record.max_range, record.exponent, record.height_scale, record.tilt))
            for curve in lobe_curves(*shape):
                sim.scene.renderer.overlays.line(pos + curve, ALARM_COLOR if is_detected[k] else CLEAR_COLOR, 2.0, 2.0)


@jit_eager_calls()
def lobe_margin(offset: Array, max_range: Array, exponent: Array, height_scale: Array, tilt: Array) -> Array:
    """Return the depth of a point within a radar's lobe along the normal to its axis, m, negative outside. (...)

    With a equal to half the range, the lobe is the teardrop ``x = a (1 - cos t)``, ``|z| <= h a sin(t) sin(t / 2)^e``,
    t from 0 to pi, tilted in the vertical plane and then turned about the vertical axis
    (formula of AIMotionLab-Virtual, 2024). Eliminating t gives ``|z| <= h a 2^(-e / 2) u^((1 + e) / 2) sqrt(2 - u)``
    with ``u = x / a``.

    Args:
        offset: Position relative to the radar, world frame, m. (..., 3)
        max_range: Length of the lobe, 2 a, m. (...)
        exponent: Exponent e, 1. (...)
        height_scale: Factor h of the thickness, 1. (...)
        tilt: Elevation of the lobe, rad. (...)
    """
    level_distance, height = safe_norm(offset[..., :2])[..., 0], offset[..., 2]
    half_range, c, s = 0.5 * max_range, jnp.cos(tilt), jnp.sin(tilt)

    def margin(level_distance: Array) -> Array:
        axial_pos, lateral_pos = c * level_distance + s * height, c * height - s * level_distance
        u = axial_pos / half_range
        clipped_u = clip(u, 1e-6, 2.0)
        root = rotation.safe_sqrt(2 - clipped_u)
        half_thickness = (
            height_scale
            * half_range
            * jnp.exp(0.5 * ((1 + exponent) * jnp.log(clipped_u) - exponent * math.log(2)))
            * root
        )
        overshoot = jnp.maximum(u - 2, 0.0) + jnp.maximum(-u, 0.0)
        return half_thickness - jnp.abs(lateral_pos) - half_range * overshoot

    # A steep lobe extends across the vertical axis, so a point can also be in the lobe of the opposite direction.
    return jnp.maximum(margin(level_distance), margin(-level_distance))


def lobe_curves(max_range: float, exponent: float, height_scale: float, tilt: float) -> list[np.ndarray]:
    """Return outlines of a lobe relative to its radar, m: teardrops in vertical planes, and circles. (n, 3) each"""
    half_range, t = 0.5 * max_range, np.linspace(0.0, math.pi, N_POINTS)
    axial_pos, lateral_pos = (
        half_range * (1 - np.cos(t)),
        height_scale * half_range * np.sin(t) * np.sin(t / 2) ** exponent,
    )
    axial_pos, lateral_pos = (
        np.concatenate([axial_pos, axial_pos[::-1]]),
        np.concatenate([lateral_pos, -lateral_pos[::-1]]),
    )
    level_distance = axial_pos * math.cos(tilt) - lateral_pos * math.sin(tilt)
    height = axial_pos * math.sin(tilt) + lateral_pos * math.cos(tilt)
    meridians = np.linspace(0.0, 2 * math.pi, N_MERIDIANS, endpoint=False)
    curves = [
        np.stack([level_distance * math.cos(a), level_distance * math.sin(a), height], axis=-1) for a in meridians
    ]
    angles = np.linspace(0.0, 2 * math.pi, 2 * N_POINTS)
    for k in (int(np.argmax(level_distance)), int(np.argmax(height)), int(np.argmin(height))):
        curves.append(
            np.stack(
                [level_distance[k] * np.cos(angles), level_distance[k] * np.sin(angles), 0 * angles + height[k]],
                axis=-1,
            )
        )
    return curves
