"""Errors of a three-axis sensor: bias that wanders, noise, scale, misalignment, low-pass, saturation, resolution."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.plugin import Simulation, check_parameter, drone_array
from crazysim.core.settings import check_settings, setting
from crazysim.plugins.sensors.sensor import gauss_markov_step, quantise
from crazysim.pytree import PyTree, leaf


class TriadData(PyTree):
    """Errors of the three axes of every sensor, in the unit u of the measurement."""

    bias: Array = leaf("drone", 1)
    """Current bias without the wandering part, u. (n_worlds, n_drones, 3)"""
    scale: Array = leaf("drone", 1)
    """Relative error of the scale in this episode, 1. (n_worlds, n_drones, 3)"""
    misalignment: Array = leaf("drone", 1)
    """Rotation of the axes in this episode, rad. (n_worlds, n_drones, 3)"""
    wander: Array = leaf("drone", 1)
    """Wandering part of the bias, u. (n_worlds, n_drones, 3)"""
    filtered: Array | None = leaf("drone", 1)
    """Output of the low-pass filter, u; None without a filter. (n_worlds, n_drones, 3)"""
    noise: Array = leaf("parameter", 1, (3,), sparse=True)
    """Density of the white noise, one-sided, u/sqrt(Hz). (3,)"""
    random_walk: Array = leaf("parameter", 1, (3,), sparse=True)
    """Standard deviation of the random walk of the bias after 1 s, u/sqrt(s). (3,)"""
    instability: Array = leaf("parameter", 1, (3,), sparse=True)
    """Standard deviation of the wandering part of the bias, u. (3,)"""
    correlation_time: Array = leaf("parameter", 1, (1,))
    """Correlation time of the wandering part, s. (1,)"""
    mean: Array = leaf("parameter", 1, (9,), sparse=True)
    """Means of bias, scale error and misalignment at the beginning of an episode. (9,)"""
    spread: Array = leaf("parameter", 1, (9,), sparse=True)
    """Standard deviations of bias, scale error and misalignment at the beginning of an episode. (9,)"""
    bandwidth: Array | None = leaf("parameter", 1, (1,))
    """Corner frequency of the low-pass filter, Hz; None without a filter. (1,)"""
    limit: Array | None = leaf("parameter", 1, (3,))
    """Largest magnitude of a measurement, u; None for no limit. (3,)"""
    resolution: Array | None = leaf("parameter", 1, (3,))
    """Step to which measurements are rounded, u; None for no rounding. (3,)"""

    def draw_errors(self, truth: Array, noise: Array) -> TriadData:
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

    def measure(self, truth: Array, noise: Array, dt: float) -> tuple[Array, TriadData]:
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


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Triad:
    """Errors of a three-axis sensor, in the unit u of the measurement.

    Each setting is one number for all axes, (3,), or (n_worlds, n_drones, 3). The Allan deviation of a measurement is
    ``noise / sqrt(2 t)`` from white noise, ``random_walk sqrt(t / 3)`` from the random walk, and at most
    0.62 ``instability``, at ``t = 1.89 correlation_time``, from the wandering bias.
    """

    noise: ArrayLike = setting(default=0.0, low=0.0)
    """Density of white noise as data sheets state it, one-sided, u/sqrt(Hz): the root mean square after an ideal
    low-pass filter is ``noise sqrt(bandwidth)``."""
    bias: ArrayLike = 0.0
    """Mean of the bias at the beginning of an episode, u."""
    bias_spread: ArrayLike = setting(default=0.0, low=0.0)
    """Standard deviation of the bias at the beginning of an episode, u."""
    random_walk: ArrayLike = setting(default=0.0, low=0.0)
    """Standard deviation of the random walk of the bias after 1 s, u/sqrt(s)."""
    instability: ArrayLike = setting(default=0.0, low=0.0)
    """Standard deviation of the wandering bias, a first-order Gauss-Markov process, u."""
    correlation_time: ArrayLike = setting(default=100.0, positive=True)
    """Correlation time of the wandering bias, s. () or (n_worlds, n_drones)"""
    scale: ArrayLike = 0.0
    """Mean relative error of the scale, 1."""
    scale_spread: ArrayLike = setting(default=0.0, low=0.0)
    """Standard deviation of the relative error of the scale between episodes, 1."""
    misalignment: ArrayLike = 0.0
    """Mean of a small rotation of the axes relative to the mounting, rad."""
    misalignment_spread: ArrayLike = setting(default=0.0, low=0.0)
    """Standard deviation of this rotation between episodes, rad."""
    bandwidth: ArrayLike | None = setting(default=None, positive=True)
    """Corner frequency of a first-order low-pass filter, Hz; None for no filter. () or (n_worlds, n_drones)"""
    limit: ArrayLike | None = setting(default=None, positive=True)
    """Largest magnitude of a measurement, u; None for no limit."""
    resolution: ArrayLike | None = setting(default=None, positive=True)
    """Step to which measurements are rounded, u; None for no rounding. Gradients ignore the rounding."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_settings(self)

    def record(self, sim: Simulation, name: str) -> TriadData:
        """Return the record before the first measurement; ``name`` is the sensor's name in messages."""

        def read_vector(field: str) -> Array:
            return check_parameter(sim, f"{field} of {name}", getattr(self, field), (3,), per_axis=True)

        def join_fields(*fields: str) -> Array:
            parts = [np.asarray(read_vector(field)) for field in fields]
            batch = np.broadcast_shapes(*(x.shape[:-1] for x in parts))
            parts = [np.broadcast_to(x, (*batch, 3)) for x in parts]
            return check_parameter(sim, name, np.concatenate(parts, axis=-1), (9,))

        def read_optional(field: str, n: int) -> Array | None:
            value = getattr(self, field)
            setting_name = f"{field} of {name}"
            return None if value is None else check_parameter(sim, setting_name, value, (n,), per_axis=True)

        mean = join_fields("bias", "scale", "misalignment")
        means = drone_array(sim, mean, 9)
        return TriadData(
            bias=means[..., :3],
            scale=means[..., 3:6],
            misalignment=means[..., 6:],
            wander=drone_array(sim, 0.0, 3),
            filtered=None if self.bandwidth is None else drone_array(sim, 0.0, 3),
            noise=read_vector("noise"),
            random_walk=read_vector("random_walk"),
            instability=read_vector("instability"),
            correlation_time=check_parameter(sim, f"correlation_time of {name}", self.correlation_time, (1,)),
            mean=mean,
            spread=join_fields("bias_spread", "scale_spread", "misalignment_spread"),
            bandwidth=read_optional("bandwidth", 1),
            limit=read_optional("limit", 3),
            resolution=read_optional("resolution", 3),
        )
