"""Errors of a three-axis sensor: bias that wanders, noise, scale, misalignment, low-pass, saturation, resolution."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.plugin import Param, Simulation, bind_leaf, check_parameter, derived, drone_array, param, state
from crazysim.core.settings import check_settings
from crazysim.engine.pytree import PyTree, static
from crazysim.plugins.sensors.errors import Changes, Link, gauss_markov_step, quantise


class Triad(PyTree):
    """Errors of a three-axis sensor, in the unit u of the measurement.

    Each setting is one number for all axes, (3,), or (n_worlds, n_drones, 3). The Allan deviation of a measurement is
    ``noise / sqrt(2 t)`` from white noise, ``random_walk sqrt(t / 3)`` from the random walk, and at most
    0.62 ``instability``, at ``t = 1.89 correlation_time``, from the wandering bias.
    """

    _: dataclasses.KW_ONLY
    noise: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Density of white noise as data sheets state it, one-sided, u/sqrt(Hz): the root mean square after an ideal
    low-pass filter is ``noise sqrt(bandwidth)``. (3,)"""
    bias: Param = param(default=0.0, core=(3,), scope="drone", per_axis=True)
    """Bias without the wandering part, u; as a setting, its mean at the beginning of an episode.
    (n_worlds, n_drones, 3)"""
    bias_spread: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, keep=False)
    """Standard deviation of the bias at the beginning of an episode, u."""
    random_walk: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Standard deviation of the random walk of the bias after 1 s, u/sqrt(s). (3,)"""
    instability: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Standard deviation of the wandering bias, a first-order Gauss-Markov process, u. (3,)"""
    correlation_time: Param = param(default=100.0, positive=True)
    """Correlation time of the wandering bias, s. (1,)"""
    scale: Param = param(default=0.0, core=(3,), scope="drone", per_axis=True)
    """Relative error of the scale in this episode, 1; as a setting, its mean. (n_worlds, n_drones, 3)"""
    scale_spread: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, keep=False)
    """Standard deviation of the relative error of the scale between episodes, 1."""
    misalignment: Param = param(default=0.0, core=(3,), scope="drone", per_axis=True)
    """Small rotation of the axes relative to the mounting in this episode, rad; as a setting, its mean.
    (n_worlds, n_drones, 3)"""
    misalignment_spread: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, keep=False)
    """Standard deviation of this rotation between episodes, rad."""
    bandwidth: Param = param(default=None, positive=True)
    """Corner frequency of a first-order low-pass filter, Hz; None for no filter. (1,)"""
    limit: Param = param(default=None, core=(3,), positive=True, per_axis=True)
    """Largest magnitude of a measurement, u; None for no limit. (3,)"""
    resolution: Param = param(default=None, core=(3,), positive=True, per_axis=True)
    """Step to which measurements are rounded, u; None for no rounding. Gradients ignore the rounding. (3,)"""
    mean: Array = derived((9,), sparse=True)
    """Means of bias, scale error and misalignment at the beginning of an episode. (9,)"""
    spread: Array = derived((9,), sparse=True)
    """Standard deviations of bias, scale error and misalignment at the beginning of an episode. (9,)"""
    wander: Array = state((3,))
    """Wandering part of the bias, u. (n_worlds, n_drones, 3)"""
    filtered: Array | None = state((3,), optional=True)
    """Output of the low-pass filter, u; None without a filter. (n_worlds, n_drones, 3)"""
    is_bound: bool = static(default=False, repr=False)
    """True for errors in ``data.plugins``, with arrays."""

    def __post_init__(self) -> None:
        if self.is_bound is not True:
            check_settings(self)

    def bind(self, sim: Simulation, name: str) -> Triad:
        """Return the errors with arrays, before the first measurement; ``name`` is the sensor's name in messages."""

        def join_fields(*fields: str) -> Array:
            parts = [
                np.asarray(check_parameter(sim, f"{x} of {name}", getattr(self, x), (3,), per_axis=True))
                for x in fields
            ]
            batch = np.broadcast_shapes(*(x.shape[:-1] for x in parts))
            parts = [np.broadcast_to(x, (*batch, 3)) for x in parts]
            return check_parameter(sim, name, np.concatenate(parts, axis=-1), (9,))

        bound: dict[str, Any] = {
            field.name: bind_leaf(sim, f"{field.name} of {name}", getattr(self, field.name), field.metadata)
            if "scope" in field.metadata
            else None
            for field in dataclasses.fields(self)
        }
        bound["mean"] = join_fields("bias", "scale", "misalignment")
        bound["spread"] = join_fields("bias_spread", "scale_spread", "misalignment_spread")
        bound["filtered"] = None if self.bandwidth is None else drone_array(sim, 0.0, 3)
        return self.replace(**(bound | {"is_bound": True}))

    def draw_errors(self, truth: Array, noise: Array) -> Triad:
        """Return the errors of one sensor in an episode.

        Args:
            truth: True quantity of the first measurement, in the sensor's frame, u. (3,)
            noise: Standard normal numbers. (12,)
        """
        values = self.mean + self.spread * noise[:9]
        triad = self.replace(
            bias=values[:3], scale=values[3:6], misalignment=values[6:], wander=self.instability * noise[9:]
        )
        return triad if self.filtered is None else triad.replace(filtered=triad.noiseless_measurement(truth))

    def noiseless_measurement(self, truth: Array) -> Array:
        """Return the measurement of one sensor before noise, low-pass, saturation and rounding, u. (3,)"""
        misaligned = truth - rotation.cross(self.misalignment, truth)
        return misaligned + self.scale * misaligned + self.bias + self.wander

    def measure(self, truth: Array, noise: Array, dt: float) -> tuple[Array, Triad]:
        """Return the next measurement of one sensor, u (3,), and the errors after it.

        Args:
            truth: True quantity in the sensor's frame, u. (3,)
            noise: Standard normal numbers. (9,)
            dt: Time between measurements, s.
        """
        bias = self.bias + self.random_walk * math.sqrt(dt) * noise[3:6]
        wander = gauss_markov_step(self.wander, self.instability, self.correlation_time, dt, noise[6:])
        triad = self.replace(bias=bias, wander=wander)
        # The one-sided density extends up to half the sampling rate.
        value = triad.noiseless_measurement(truth) + self.noise * math.sqrt(0.5 / dt) * noise[:3]
        if self.filtered is not None and self.bandwidth is not None:
            value = self.filtered + (1 - jnp.exp(-2 * math.pi * dt * self.bandwidth)) * (value - self.filtered)
            triad = triad.replace(filtered=value)
        if self.limit is not None:
            value = rotation.clip(value, -self.limit, self.limit)
        value = quantise(value, self.resolution)
        return value, triad


@dataclasses.dataclass(frozen=True)
class TriadErrors(Link):
    """The errors of a ``Triad``, which is a field of the sensor."""

    triad: str
    """Name of the field."""

    n_start, n_step = 4, 3

    def start(self, sensor: Any, truth: Array, noise: Array) -> Changes:
        return {self.triad: getattr(sensor, self.triad).draw_errors(truth, noise)}

    def step(self, sensor: Any, x: Array, noise: Array, dt: float) -> tuple[Array, Changes]:
        x, triad = getattr(sensor, self.triad).measure(x, noise, dt)
        return x, {self.triad: triad}
