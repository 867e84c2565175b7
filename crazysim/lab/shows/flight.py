"""Flights of light shows: all drones of a show in one world."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.core.data import SimData
from crazysim.dynamics import first_principles
from crazysim.errors import ConfigError, require
from crazysim.lab.show_files.show import Show
from crazysim.plugins.follow import Follow
from crazysim.sim.sim import Sim
from crazysim.trajectories import Trajectory

RECORDING_RATES = (50, 25, 10, 5)
"""Rates at which a flight may be recorded, Hz; the first that divides the physics' rate and fits is used."""
MAX_RECORDED_POSES = 20_000_000
"""Largest number of poses in a recording; each pose takes 28 bytes."""
CHUNK_SAMPLES = 250
"""Number of samples that one compiled call simulates."""

Progress = Callable[[Iterable[int], str], Iterable[int]]
"""Function that yields items and shows a progress bar with a label."""


@dataclass(frozen=True, eq=False)
class ShowFlight:
    """A show as it was flown, and as it was planned, at the same times."""

    show: Show
    """The show."""
    sim: Sim
    """The simulation of one world, after the flight."""
    times: NDArray
    """Times of the samples, s; the first is 0. (n,)"""
    pos: NDArray
    """Positions flown, world frame, m. (n, n_drones, 3)"""
    quat: NDArray
    """Attitudes flown, body to world, xyzw. (n, n_drones, 4)"""
    planned: NDArray
    """Positions planned, world frame, m. (n, n_drones, 3)"""
    colors: NDArray
    """Colours of the LEDs, 0 to 1. (n, n_drones, 3)"""
    wall_s: float
    """Time of the computation without compilation, s."""

    @property
    def duration(self) -> float:
        """Duration of the flight, s."""
        return float(self.times[-1])


def fly_show(show: Show, seconds: float | None = None, progress: Progress | None = None, **settings: Any) -> ShowFlight:
    """Fly a show: its drones start hovering at the first points of their trajectories.

    Args:
        seconds: Duration, s; None for the duration of the show.
        progress: Function ``progress(items, label)`` that yields the items and shows a progress bar; None for no bar.
        settings: Further settings of ``Sim``, such as ``drone`` and ``controller``.
    """
    end = show.duration if seconds is None else min(float(seconds), show.duration)
    require(np.isfinite(end) and end > 0, f"expected a positive duration of the flight, s, got {seconds!r}")
    sim = start_simulation(show, settings)
    rate = _recording_rate(sim.freq, end, show.n_drones)
    n = max(int(np.ceil(end * rate - 1e-6)), 1)
    times = np.arange(n + 1) / rate

    fly_chunk = _compile_chunk(sim, sim.freq // rate)
    jax.block_until_ready(planned_positions(show.trajectories, jnp.asarray(times)))  # compile before the clock starts
    show.lights.colors(times)
    start_time = time.perf_counter()
    data = sim.data
    recorded = [[np.asarray(x)[None, 0] for x in _get_poses(data)]]
    chunks = range(0, n, CHUNK_SAMPLES)
    for _ in chunks if progress is None else progress(chunks, "flying"):
        data, samples = fly_chunk(data)
        recorded.append([np.asarray(x)[:, 0] for x in samples])
    sim.data = data
    pos, quat = (np.concatenate(parts)[: n + 1] for parts in zip(*recorded, strict=True))
    planned = np.asarray(planned_positions(show.trajectories, jnp.asarray(times)))
    colors = show.lights.colors(times)
    return ShowFlight(show, sim, times, pos, quat, planned, colors, time.perf_counter() - start_time)


def start_simulation(show: Show, settings: dict[str, Any]) -> Sim:
    """Return a simulation of one world whose drones hover where their trajectories begin."""
    sim = Sim(n_worlds=1, n_drones=show.n_drones, control="state", **settings)
    sim.add(Follow(show.trajectories, index=np.arange(show.n_drones)[None], visible=False))
    start = _start_points(show.trajectories)
    states = sim.data.states
    pos = jnp.asarray(start[None, :, :3], states.pos.dtype)
    half_yaw = start[None, :, 3:] / 2
    zeros = np.zeros((1, show.n_drones, 2))
    quat = jnp.asarray(np.concatenate([zeros, np.sin(half_yaw), np.cos(half_yaw)], axis=-1), states.quat.dtype)
    states = states.replace(pos=pos, quat=quat)
    if isinstance(sim.data.params, first_principles.Params):
        hover = first_principles.hover_rotor_vel(sim.data.params)
        states = states.replace(rotor_vel=jnp.broadcast_to(hover, states.rotor_vel.shape))
    sim.data = sim.data.replace(states=states)
    sim.build_default_data()
    return sim


def _start_points(trajectories: Trajectory) -> NDArray:
    return np.asarray(trajectories.coefficients, float)[:, 0, :, 0]


def _recording_rate(freq: int, seconds: float, n_drones: int) -> int:
    for rate in RECORDING_RATES:
        if freq % rate == 0 and seconds * rate * n_drones <= MAX_RECORDED_POSES:
            return rate
    raise ConfigError(
        f"expected at most {MAX_RECORDED_POSES} recorded poses and freq a multiple of {RECORDING_RATES[-1]} Hz, got "
        f"{seconds:g} s of {n_drones} drones at {freq} Hz. Fly a part of the show with seconds=..."
    )


def _compile_chunk(sim: Sim, n_steps: int) -> Callable[[SimData], tuple[SimData, tuple[Array, Array]]]:
    step = sim.step_fn.with_zeros_of(sim.data)

    def sample(data: SimData, _: None) -> tuple[SimData, tuple[Array, Array]]:
        data = step(data, n_steps)
        return data, _get_poses(data)

    return jax.jit(lambda data: jax.lax.scan(sample, data, length=CHUNK_SAMPLES)).lower(sim.data).compile()


def _get_poses(data: SimData) -> tuple[Array, Array]:
    return data.states.pos, data.states.quat


@jax.jit
def planned_positions(trajectories: Trajectory, times: Array) -> Array:
    """Return planned positions, m. (n, n_drones, 3)"""
    points_at = jax.vmap(lambda trajectory, t: trajectory.derivatives(t, 0)[0][:3], in_axes=(0, None))
    return jax.vmap(points_at, in_axes=(None, 0))(trajectories, times)
