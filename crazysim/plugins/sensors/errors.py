"""Errors of measurements: links that turn the true part of a measurement into the measured one.

A sensor declares them by channel, with the names of its numbers and states::

    chains: ClassVar = {"pos": [GaussMarkov("drift", "drift_error", "drift_time"), White("noise")]}
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.errors import expect

Changes = dict[str, Any]
"""New values of fields of a sensor, by name."""


class Link:
    """An error of a measurement of one drone; its settings are names of fields of the sensor."""

    n_start: ClassVar[float] = 0
    """Standard normal numbers that it draws when an episode begins, per component of the measurement."""
    n_step: ClassVar[float] = 0
    """Standard normal numbers that it draws for each measurement, per component."""

    def start(self, sensor: Any, truth: Array, noise: Array) -> Changes:
        """Return the states of the error at the beginning of an episode."""
        return {}

    def step(self, sensor: Any, x: Array, noise: Array, dt: float) -> tuple[Array, Changes]:
        """Return ``x`` with the error, and the states of the error, ``dt`` seconds after the last measurement."""
        return x, {}

    def variance(self, sensor: Any) -> Array | float:
        """Return the variance of the error, for filters."""
        raise NotImplementedError(f"{type(self).__name__} needs a method variance(sensor)")


@dataclasses.dataclass(frozen=True)
class White(Link):
    """Noise that is independent from measurement to measurement."""

    deviation: str
    """Standard deviation."""
    n_step = 1

    def __post_init__(self) -> None:
        for x in vars(self).values():
            expect(
                isinstance(x, str), f"names of the sensor's fields in {type(self).__name__}", x, "Use White('noise')."
            )

    def step(self, sensor: Any, x: Array, noise: Array, dt: float) -> tuple[Array, Changes]:
        return x + getattr(sensor, self.deviation) * noise, {}

    def variance(self, sensor: Any) -> Array:
        return getattr(sensor, self.deviation) ** 2


class Turned(White):
    """Small rotations of an attitude, xyzw, about the axes of the body, rad."""

    n_step = 3 / 4  # three angles for four components

    def step(self, sensor: Any, x: Array, noise: Array, dt: float) -> tuple[Array, Changes]:
        half_rotvec = 0.5 * getattr(sensor, self.deviation) * noise
        quat = rotation.multiply(x, jnp.concatenate([half_rotvec, jnp.ones_like(half_rotvec[:1])]))
        return quat / jnp.sqrt(rotation.dot(quat, quat)), {}


@dataclasses.dataclass(frozen=True)
class Constant(White):
    """An offset that is drawn when an episode begins, and stays."""

    state: str
    """The offset."""
    n_start, n_step = 1, 0

    def start(self, sensor: Any, truth: Array, noise: Array) -> Changes:
        return {self.state: getattr(sensor, self.deviation) * noise}

    def step(self, sensor: Any, x: Array, noise: Array, dt: float) -> tuple[Array, Changes]:
        return x + getattr(sensor, self.state), {}


@dataclasses.dataclass(frozen=True)
class GaussMarkov(Constant):
    """An offset that wanders: a first-order Gauss-Markov process, stationary from the start."""

    time: str
    """Correlation time, s."""
    n_step = 1

    def step(self, sensor: Any, x: Array, noise: Array, dt: float) -> tuple[Array, Changes]:
        offset, deviation, time = (getattr(sensor, name) for name in (self.state, self.deviation, self.time))
        offset = gauss_markov_step(offset, deviation, time, dt, noise)
        return x + offset, {self.state: offset}


@dataclasses.dataclass(frozen=True)
class Rounded(Link):
    """Rounding to multiples of a resolution, which gradients ignore."""

    resolution: str
    """The resolution, whose value is None for no rounding."""

    def step(self, sensor: Any, x: Array, noise: Array, dt: float) -> tuple[Array, Changes]:
        return quantise(x, getattr(sensor, self.resolution)), {}

    def variance(self, sensor: Any) -> Array | float:
        resolution = getattr(sensor, self.resolution)
        return 0.0 if resolution is None else resolution**2 / 12


def quantise(x: Array, resolution: Array | None) -> Array:
    """Return the nearest multiple of a resolution, with the gradient of ``x``; ``x`` itself for None. (...)"""
    return x if resolution is None else _nearest_multiple(x, resolution)


@jax.custom_jvp
def _nearest_multiple(x: Array, resolution: Array) -> Array:
    return resolution * jnp.round(x / resolution)


@_nearest_multiple.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    return _nearest_multiple(*primals), tangents[0]


def gauss_markov_step(state: Array, deviation: Array, time: Array, dt: float, noise: Array) -> Array:
    """Return a first-order Gauss-Markov process one interval later; the variance is exact for any interval.

    Args:
        state: Value of the process. (..., k)
        deviation: Standard deviation of the process. (..., k)
        time: Correlation time of the process, s. (..., k)
        dt: Length of the interval, s.
        noise: Standard normal numbers. (..., k)
    """
    decay = jnp.exp(-dt / time)
    return decay * state + deviation * rotation.safe_sqrt((1 - decay) * (1 + decay)) * noise
