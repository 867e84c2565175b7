"""Base class of sensors, with a rate, a delay with jitter, and lost measurements."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin, Simulation, StagePlacement, check_parameter, drone_array, parameter
from crazysim.core.random import drone_key, uniform
from crazysim.core.settings import dividing_rate, setting
from crazysim.core.stage import Stage, is_tick
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, device_array, leaf

R = TypeVar("R", bound=PyTree)

MAX_ROWS = 64
"""Largest number of measurements of one sensor in transit."""
NEVER_ARRIVES = 2**31 - 1
"""Step of arrival of a measurement that is lost."""
MAX_DELAY = 100.0
"""Longest delay, s."""


class Samples(PyTree):
    """Latest measurement that has arrived, and the measurements in transit."""

    value: Array = leaf("drone", 1)
    """Latest measurement that has arrived. (n_worlds, n_drones, k)"""
    taken_step: Array = leaf("drone", 1)
    """Step in which the latest measurement was taken, negative before the first one. (n_worlds, n_drones, 1)"""
    delay: Array | None = leaf("parameter", 1, (1,))
    """Time from measurement to arrival, s; None without delay. (1,)"""
    jitter: Array | None = leaf("parameter", 1, (1,))
    """Largest random addition to the delay, s; None without delay. (1,)"""
    dropout: Array | None = leaf("parameter", 1, (1,))
    """Probability that a measurement is lost, 0 to 1; None if no measurement is lost. (1,)"""
    queue: Array | None = leaf("drone", 2)
    """Measurements in transit, newest first; None without delay. (n_worlds, n_drones, n_rows, k)"""
    arrival_steps: Array | None = leaf("drone", 1)
    """Steps in which the queued measurements arrive; None without delay. (n_worlds, n_drones, n_rows)"""


class Sensor(Plugin):
    """Base class of sensors that measure at a rate; measurements may arrive late or never.

    A subclass defines ``kind`` or ``record``, ``channels``, ``ideal`` and ``measure``, and ``reset_episode`` if some
    errors are drawn once an episode, with ``episode_key``. Its record has a field ``samples``. Measurements are of the
    state after the step. The record has the latest measurement that has arrived; measurements that arrive after a newer
    one are discarded.
    """

    kind: ClassVar[type[PyTree]]
    """Class of the record."""
    reset_before: ClassVar[str | None] = "increment_steps"
    """Name of the stage before which ``reset_episode`` is called in the first step of an episode. The reset uses the
    state of the first measurement."""

    _: dataclasses.KW_ONLY
    freq: int | None = None
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    delay: ArrayLike = parameter(default=0.0, low=0.0, high=MAX_DELAY)
    """Time from measurement to arrival, s, rounded to steps. () or (n_worlds, n_drones)"""
    jitter: ArrayLike = parameter(default=0.0, low=0.0, high=MAX_DELAY)
    """Largest random addition to the delay, s, uniform from zero. () or (n_worlds, n_drones)"""
    dropout: ArrayLike = parameter(default=0.0, low=0.0, high=1.0)
    """Probability that a measurement is lost, 0 to 1. () or (n_worlds, n_drones)"""
    max_delay: float | None = setting(default=None, low=0.0, high=MAX_DELAY)
    """Largest sum of delay and jitter to which the record can be changed later, s; None for ``delay`` plus
    ``jitter``."""
    name: str = "sensor"

    @property
    def channels(self) -> Mapping[str, int]:
        """Names and lengths of the parts of a measurement, in their order."""
        raise NotImplementedError

    def ideal(self, data: SimData) -> Array:
        """Return the measurement without errors, of one drone. (k,)"""
        raise NotImplementedError

    def measure(self, data: SimData, record: Any, key: Array) -> tuple[Array, Any]:
        """Return a measurement of one drone, (k,), and the record of the plugin after it."""
        raise NotImplementedError

    def episode_key(self, data: SimData) -> Array:
        """Return the random key of one drone for the errors that stay the same in an episode. ()"""
        return drone_key(data, f"{self.name}_begin")

    def record(self, sim: Simulation) -> PyTree:
        if not hasattr(self, "kind"):
            raise NotImplementedError(f"{type(self).__name__} needs kind, the class of its record, or a method record")
        return self.fill_record(sim, self.kind)

    def fill_record(self, sim: Simulation, kind: type[R], **fields: Any) -> R:
        return super().fill_record(sim, kind, samples=self.samples(sim), **fields)

    def samples(self, sim: Simulation) -> Samples:
        """Return the field ``samples`` of the record, before the first measurement; check the common settings."""
        period = sampling_period(self, sim)
        k, shape, max_delay = sum(self.channels.values()), sim.data.states.pos.shape[:2], self._max_delay
        n_rows = math.floor(max_delay * sim.data.core.freq / period + 0.5) + 2 if max_delay > 0 else 0
        if n_rows > MAX_ROWS:
            raise ConfigError(
                f"expected a delay of {self.name!r} of zero to {MAX_ROWS - 2} measurements, with its jitter, got "
                f"{max_delay} s. Use a shorter delay or a lower freq=."
            )
        can_lose = bool(np.any(np.asarray(self.dropout)))
        transit = {}
        if n_rows:
            transit = {
                "delay": check_parameter(sim, "delay", self.delay, (1,), 0.0, max_delay),
                "jitter": check_parameter(sim, "jitter", self.jitter, (1,), 0.0, max_delay),
                "queue": drone_array(sim, 0.0, n_rows, k),
                "arrival_steps": device_array(np.full((*shape, n_rows), NEVER_ARRIVES), np.int32),
            }
        return Samples(
            value=drone_array(sim, 0.0, k),
            taken_step=device_array(np.full((*shape, 1), -1), np.int32),
            delay=transit.get("delay"),
            jitter=transit.get("jitter"),
            dropout=check_parameter(sim, "dropout", self.dropout, (1,), 0.0, 1.0) if can_lose else None,
            queue=transit.get("queue"),
            arrival_steps=transit.get("arrival_steps"),
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        end, placements = "increment_steps", []
        condition = None if sampling_period(self, sim) == 1 else lambda data: is_tick(data, self.freq or data.core.freq)
        placements.append(StagePlacement(Stage(self._take_measurement, "drone", condition), before=end))
        if self.is_late:
            placements.append(
                StagePlacement(Stage(self._deliver_measurement, "drone"), before=end, name=f"{self.name}_arrival")
            )
        return placements

    def latest(self, data: SimData) -> Array:
        """Return the latest measurement of one drone; before the first arrives, one without errors. (k,)"""
        samples = self.read(data).samples
        return jnp.where(samples.taken_step >= 0, samples.value, self.ideal(data))

    def part(self, data: SimData, channel: str) -> Array:
        """Return one of the ``channels`` of the latest measurement of one drone. (k,)"""
        return self.split(self.latest(data))[channel]

    def age(self, data: SimData) -> Array:
        """Return the time since the latest measurement was taken, s; infinite before the first one arrives. (..., 1)"""
        return age_at(data, self.read(data).samples.taken_step)

    def split(self, value: Array) -> dict[str, Array]:
        """Return the parts of a measurement by the names of ``channels``. (..., n) each"""
        parts, start = {}, 0
        for name, length in self.channels.items():
            parts[name] = value[..., start : start + length]
            start += length
        return parts

    def observations(self, data: SimData) -> dict[str, Array]:
        return self.split(self.latest(data))

    def interval(self, data: SimData) -> float:
        """Return the time between measurements, s."""
        return 1 / (self.freq or data.core.freq)

    @property
    def is_late(self) -> bool:
        """True if measurements arrive after a delay."""
        return bool(self._max_delay)

    @property
    def _max_delay(self) -> float:
        """Longest sum of delay and jitter for which the record has a queue, s."""
        if self.max_delay is not None:
            return float(self.max_delay)
        return float(np.max(np.asarray(self.delay, np.float64)) + np.max(np.asarray(self.jitter, np.float64)))

    def _take_measurement(self, data: SimData) -> SimData:
        """Take a measurement of one drone, and put it into the queue; without delay, it becomes the latest one."""
        key, step = drone_key(data, self.name), data.core.steps
        value, record = self.measure(data, self.read(data), key)
        samples, is_lost, jitter_fraction = record.samples, False, 0.0
        if samples.dropout is not None or samples.queue is not None:
            random_numbers = uniform(drone_key(data, f"{self.name}_arrival"), (2,), value.dtype)
            is_lost = False if samples.dropout is None else random_numbers[:1] < samples.dropout
            jitter_fraction = random_numbers[1:]
        if samples.queue is None:
            taken_step = jnp.broadcast_to(step, (1,))
            if samples.dropout is not None:
                value = jnp.where(is_lost, samples.value, value)
                taken_step = jnp.where(is_lost, samples.taken_step, taken_step)
            samples = samples.replace(value=value, taken_step=taken_step)
        else:
            arrival_step = step + jnp.round(data.core.freq * (samples.delay + jitter_fraction * samples.jitter)).astype(
                jnp.int32
            )
            arrival_step = arrival_step if samples.dropout is None else jnp.where(is_lost, NEVER_ARRIVES, arrival_step)
            queue = jnp.concatenate([value[None], samples.queue[:-1]])
            arrival_steps = jnp.concatenate([arrival_step, samples.arrival_steps[:-1]])
            samples = samples.replace(queue=queue, arrival_steps=arrival_steps)
        return self.write(data, record.replace(samples=samples))

    def _deliver_measurement(self, data: SimData) -> SimData:
        """Replace the latest measurement of one drone by the newest one that has arrived."""
        record, step = self.read(data), data.core.steps
        samples, period = record.samples, data.core.freq // (self.freq or data.core.freq)
        value, taken_step = samples.value, samples.taken_step
        for row in reversed(range(samples.arrival_steps.shape[0])):  # the newest one last, so that it is kept
            has_arrived = samples.arrival_steps[row] <= step
            value = jnp.where(has_arrived, samples.queue[row], value)
            taken_step = jnp.where(has_arrived, step - step % period - row * period, taken_step)
        return self.write(data, record.replace(samples=samples.replace(value=value, taken_step=taken_step)))


def age_at(data: SimData, taken_step: Array) -> Array:
    """Return the time since a step in which measurements were taken, s; infinite if it is negative. (..., 1)"""
    steps = data.core.steps[..., None] if taken_step.ndim > data.core.steps.ndim else data.core.steps
    return jnp.where(taken_step >= 0, (steps - 1 - taken_step) / data.core.freq, jnp.inf)


def sampling_period(sensor: Any, sim: Simulation) -> int:
    """Return the number of steps between measurements of a plugin with ``freq`` and ``name``."""
    steps = sim.data.core.freq
    return 1 if sensor.freq is None else steps // dividing_rate(f"freq of {sensor.name!r}", sensor.freq, steps)


def mounting_quat(sim: Simulation, rpy: ArrayLike) -> Array:
    """Return the attitude of a sensor, sensor to body, xyzw. (4,) or (n_worlds, n_drones, 4)

    Args:
        sim: The simulation.
        rpy: Roll, pitch and yaw of the sensor's frame in the body frame, rad. (3,) or (n_worlds, n_drones, 3)
    """
    return jax.jit(rotation.from_rpy)(check_parameter(sim, "rpy", rpy, (3,)))


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
