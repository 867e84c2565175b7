"""Base class of sensors, with a rate, a delay with jitter, and lost measurements."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, check_parameter, drone_array, nested, param
from crazysim.core.random import drone_key, normal, uniform
from crazysim.core.settings import default_rates, dividing_rate, setting
from crazysim.engine.pytree import PyTree, device_array, leaf
from crazysim.engine.stage import is_tick
from crazysim.errors import expect, require
from crazysim.plugins.sensors.errors import Link
from crazysim.tables import range_between

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

    A subclass defines ``channels``, ``ideal`` and ``chains``, or overrides ``measure`` if its measurement is not a true
    value with errors. Measurements are of the state after the step. ``samples`` has the latest measurement that has
    arrived; measurements that arrive after a newer one are discarded.
    """

    channels: ClassVar[Mapping[str, int]] = {}
    """Names and lengths of the parts of a measurement, in their order."""
    chains: ClassVar[Mapping[str, Sequence[Link]]] = {}
    """Errors by channel, for channels that have any; see ``crazysim.plugins.sensors.errors``."""
    measures_motion: ClassVar[bool] = True
    """Whether ``ideal`` is a smooth function of position, velocity, attitude and angular velocity, so that ``ESKF`` can
    use the channels that have ``chains``."""
    reset_before: ClassVar[str | None] = "increment_steps"
    """Name of the stage before which ``reset_episode`` is called in the first step of an episode. The reset uses the
    state of the first measurement."""

    _: dataclasses.KW_ONLY
    freq: int | None = None
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    delay: Param = param(default=0.0, low=0.0, high=MAX_DELAY, keep=False)
    """Time from measurement to arrival, s, rounded to steps. () or (n_worlds, n_drones)"""
    jitter: Param = param(default=0.0, low=0.0, high=MAX_DELAY, keep=False)
    """Largest random addition to the delay, s, uniform from zero. () or (n_worlds, n_drones)"""
    dropout: Param = param(default=0.0, low=0.0, high=1.0, keep=False)
    """Probability that a measurement is lost, 0 to 1. () or (n_worlds, n_drones)"""
    max_delay: float | None = setting(default=None, low=0.0, high=MAX_DELAY)
    """Largest sum of delay and jitter to which the sensor can be changed later, s; None for ``delay`` plus
    ``jitter``."""
    samples: Samples | None = nested(default=None)
    """Measurements that have arrived or are in transit, with delay and losses."""
    name: str = "sensor"

    def ideal(self, data: SimData) -> Array:
        """Return the measurement without errors, of one drone. (k,)"""
        raise NotImplementedError(f"{type(self).__name__} needs a method ideal(data)")

    def measure(self, data: SimData, key: Array) -> tuple[Array, Self]:
        """Return a measurement of one drone, (k,), and the sensor after it."""
        return self.with_errors(self.ideal(data), key, self.interval(data))

    def with_errors(self, truth: Array, key: Array, dt: float) -> tuple[Array, Self]:
        """Return a measurement of one drone with its errors, (k,), and the sensor after it.

        Args:
            truth: The measurement without errors. (k,)
            key: Random key of the drone at this step.
            dt: Time since the last measurement, s.
        """
        parts, changes = self.split(truth), {}
        for name, link, noise in self._draw("n_step", key, truth.dtype):
            parts[name], new = link.step(self, parts[name], noise, dt)
            changes |= new
        return jnp.concatenate(list(parts.values())), self.replace(**changes)

    def reset_episode(self, data: SimData) -> SimData:
        truth, changes = self.split(self.ideal(data)), {}
        for name, link, noise in self._draw("n_start", drone_key(data, f"{self.name}_begin"), data.states.pos.dtype):
            changes |= link.start(self, truth[name], noise)
        return self.write(data, self.replace(**changes))

    def _draw(self, n: str, key: Array, dtype: Any) -> Iterator[tuple[str, Link, Array]]:
        links = [(name, link) for name, chain in self.chains.items() for link in chain]
        counts = [round(getattr(link, n) * self.channels[name]) for name, link in links]
        noise = normal(key, (max(1, sum(counts)),), dtype)
        for (name, link), count in zip(links, counts, strict=True):
            yield name, link, noise[:count]
            noise = noise[count:]

    def variance(self, channel: str) -> Array | float:
        """Return the variance of the errors of a channel; for the sensor in ``data.plugins``."""
        return sum(link.variance(self) for link in self.chains[channel])

    @property
    def resets_episode(self) -> bool:
        is_overridden = type(self).reset_episode is not Sensor.reset_episode
        return is_overridden or any(link.n_start for chain in self.chains.values() for link in chain)

    def with_arrays(self, sim: Simulation, **values: Any) -> Self:
        return super().with_arrays(sim, samples=self.first_samples(sim), **values)

    def first_samples(self, sim: Simulation) -> Samples:
        """Return ``samples`` before the first measurement; check the common settings."""
        # Channels, and the chains of their errors.
        require(
            self.channels, f"expected channels of {type(self).__name__}, got none. Use channels = {{'pos': 3}}, say."
        )
        require(
            self.chains.keys() <= self.channels.keys(),
            f"expected chains of {self.name!r} for channels {', '.join(self.channels)}, got {', '.join(self.chains)}",
        )
        for name, chain in self.chains.items():
            is_chain = isinstance(chain, (list, tuple)) and all(isinstance(link, Link) for link in chain)
            expect(is_chain, f"the chain of {name!r} as a tuple of errors", chain, "Use (White('noise'),), say.")
            names = [x for link in chain for x in vars(link).values() if isinstance(x, str)]
            missing = next((x for x in names if not hasattr(self, x)), None)
            remedy = (
                f"Add {missing}: Param = param(default=0.1) or {missing}: Array = state() to {type(self).__name__}."
            )
            expect(missing is None, f"a number or a state in the chain of {name!r}", missing, remedy)
        # Rows of the queue for the longest delay.
        freq = self.rate(sim.data.core.freq)
        k, shape, max_delay = sum(self.channels.values()), sim.data.states.pos.shape[:2], self._max_delay
        n_rows = math.floor(max_delay * freq + 0.5) + 2 if max_delay > 0 else 0
        require(
            n_rows <= MAX_ROWS,
            f"expected a delay of {self.name!r} of zero to {MAX_ROWS - 2} measurements, with its jitter, got "
            f"{max_delay} s. Use a shorter delay or a lower freq=.",
        )
        delay, jitter = (
            check_parameter(sim, name, getattr(self, name), allowed=range_between(0.0, max_delay))
            for name in ("delay", "jitter")
        )
        dropout = check_parameter(sim, "dropout", self.dropout, allowed=range_between(0.0, 1.0))
        return Samples(
            value=drone_array(sim, 0.0, k),
            taken_step=device_array(np.full((*shape, 1), -1), np.int32),
            delay=delay if n_rows else None,
            jitter=jitter if n_rows else None,
            dropout=dropout if np.any(dropout) else None,
            queue=drone_array(sim, 0.0, n_rows, k) if n_rows else None,
            arrival_steps=device_array(np.full((*shape, n_rows), NEVER_ARRIVES), np.int32) if n_rows else None,
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        end, placements = "increment_steps", []
        condition = None if self.rate(sim.data.core.freq) == sim.data.core.freq else self.is_sampled
        placements.append(StagePlacement(self.stage(self._take_measurement, when=condition), before=end))
        if self.is_late:
            placements.append(
                StagePlacement(self.stage(self._deliver_measurement), before=end, name=f"{self.name}_arrival")
            )
        return placements

    def latest(self, data: SimData) -> Array:
        """Return the latest measurement of one drone; before the first arrives, one without errors. (k,)"""
        self = self.read(data)
        expect(
            data.states.pos.ndim == 1,
            f"the data of one drone in {type(self).__name__}.latest",
            data.states.pos.shape,
            "Use vmap_drones(sensor.latest)(data) of crazysim.engine in one world, as in a task, and "
            "sim.plugins.observations(sim.data) for all worlds.",
        )
        return jnp.where(self.samples.taken_step >= 0, self.samples.value, self.ideal(data))

    def part(self, data: SimData, channel: str) -> Array:
        """Return one of the ``channels`` of the latest measurement of one drone. (k,)"""
        return self.split(self.latest(data))[channel]

    def age(self, data: SimData) -> Array:
        """Return the time since the latest measurement was taken, s; infinite before the first one arrives. (..., 1)"""
        return age_at(data, self.read(data).samples.taken_step)

    def split(self, value: Array) -> dict[str, Array]:
        """Return the parts of a measurement by the names of ``channels``. (..., n) each"""
        require(
            value.shape[-1:] == (sum(self.channels.values()),),
            f"expected measurements of {self.name!r} as in channels, {dict(self.channels)}, got shape {value.shape}. "
            f"Use ideal and measure that return as many numbers.",
        )
        parts, start = {}, 0
        for name, length in self.channels.items():
            parts[name] = value[..., start : start + length]
            start += length
        return parts

    def observations(self, data: SimData) -> dict[str, Array]:
        return self.split(self.latest(data))

    def rate(self, freq: int) -> int:
        """Return the measurements per second in a simulation of ``freq`` steps per second, Hz."""
        return rate_in(self, freq)

    def interval(self, data: SimData) -> float:
        """Return the time between measurements, s."""
        return 1 / self.rate(data.core.freq)

    def is_sampled(self, data: SimData) -> Array | None:
        """Whether the sensor measures in this step; None if it measures in every step."""
        return is_tick(data, self.rate(data.core.freq))

    @property
    def is_late(self) -> bool:
        """Whether measurements arrive after a delay."""
        return bool(self._max_delay) if self.samples is None else self.samples.queue is not None

    @property
    def _max_delay(self) -> float:
        if self.max_delay is not None:
            return float(self.max_delay)
        return float(np.max(np.asarray(self.delay, np.float64)) + np.max(np.asarray(self.jitter, np.float64)))

    def _take_measurement(self, data: SimData) -> SimData:
        key, step = drone_key(data, self.name), data.core.steps
        value, sensor = self.measure(data, key)
        samples: Any = self.samples
        # Loss of this measurement, and jitter of its delay.
        is_lost, jitter_fraction = False, 0.0
        if samples.dropout is not None or samples.queue is not None:
            random_numbers = uniform(drone_key(data, f"{self.name}_arrival"), (2,), value.dtype)
            is_lost = False if samples.dropout is None else random_numbers[:1] < samples.dropout
            jitter_fraction = random_numbers[1:]
        # Without a queue the measurement arrives at once.
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
        return self.write(data, sensor.replace(samples=samples))

    def _deliver_measurement(self, data: SimData) -> SimData:
        samples: Any = self.samples
        step, period = data.core.steps, data.core.freq // self.rate(data.core.freq)
        value, taken_step = samples.value, samples.taken_step
        for row in reversed(range(samples.arrival_steps.shape[0])):  # the newest one last, so that it is kept
            has_arrived = samples.arrival_steps[row] <= step
            value = jnp.where(has_arrived, samples.queue[row], value)
            taken_step = jnp.where(has_arrived, step - step % period - row * period, taken_step)
        return self.write(data, self.replace(samples=samples.replace(value=value, taken_step=taken_step)))


def age_at(data: SimData, taken_step: Array) -> Array:
    """Return the time since a step in which measurements were taken, s; infinite if it is negative. (..., 1)"""
    steps = data.core.steps[..., None] if taken_step.ndim > data.core.steps.ndim else data.core.steps
    return jnp.where(taken_step >= 0, (steps - 1 - taken_step) / data.core.freq, jnp.inf)


def rate_in(plugin: Any, freq: int) -> int:
    """Return the rate of a plugin with ``freq`` and ``name`` in a simulation, Hz: the number of steps for None.

    The default of its class becomes the largest divisor up to it; any other rate has to divide the number of steps.

    Args:
        freq: Steps of the simulation per second, Hz.
    """
    if plugin.freq is None:
        return freq
    if plugin.freq == type(plugin).freq:
        return default_rates(freq, {"freq": plugin.freq}, f" of {plugin.name!r}")["freq"]
    return dividing_rate(f"freq of {plugin.name!r}", plugin.freq, freq)


def mounting_quat(sim: Simulation, rpy: ArrayLike) -> Array:
    """Return the attitude of a sensor, sensor to body, xyzw. (4,) or (n_worlds, n_drones, 4)

    Args:
        rpy: Roll, pitch and yaw of the sensor's frame in the body frame, rad. (3,) or (n_worlds, n_drones, 3)
    """
    return jax.jit(rotation.from_rpy)(check_parameter(sim, "rpy", rpy, (3,)))
