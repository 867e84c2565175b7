"""The one way of measuring: compile apart, warm up, wait for the device, repeat, take the median."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

COMMANDS = {
    "attitude": lambda weight, hover_rpm: [0.0, 0.0, 0.0, weight],
    "rotor_vel": lambda weight, hover_rpm: [hover_rpm] * 4,
    "state": lambda weight, hover_rpm: [0.0, 0.0, 1.0, *[0.0] * 9, 1.0, 0.0, 0.0, 0.0],
}
"""A command of each level under which a cf21B_500 hovers: a drone that has crashed is no work to simulate."""


def hovering(sim: Any, control: str) -> None:
    """Put every drone of a simulation (ours or the peer's) at 1 m with its rotors at hover, and command it so.

    A weight of 0.0434 kg * 9.81 m/s^2 over four rotors needs 15,864 rpm each by the airframe's thrust curve.
    """
    n_worlds, n_drones = sim.n_worlds, sim.n_drones
    states = sim.data.states
    pos, rotor_vel = np.array(states.pos), np.array(states.rotor_vel)
    pos[..., 2], rotor_vel[...] = 1.0, 15864.0
    put = lambda value: jax.device_put(np.float32(value), states.pos.sharding)  # noqa: E731
    sim.data = sim.data.replace(states=states.replace(pos=put(pos), rotor_vel=put(rotor_vel)))
    command = np.asarray(COMMANDS[control](0.0434 * 9.81, 15864.0), np.float32)
    getattr(sim, f"{control}_control")(np.tile(command, (n_worlds, n_drones, 1)))


def still_flies(sim: Any) -> bool:
    """Return whether every drone is still in the air near its start: whether the figure is of flying drones."""
    pos = np.asarray(sim.data.states.pos)
    return bool(np.all(np.isfinite(pos)) and pos[..., 2].min() > 0.5 and pos[..., 2].max() < 2.0)


def first_call(fn: Callable[[], Any]) -> float:
    """Return the seconds a call takes the first time, compilation included."""
    begin = time.perf_counter()
    jax.block_until_ready(fn())
    return time.perf_counter() - begin


def median_seconds(fns: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Return the median seconds of each function, called in turns, so that noise meets all of them alike."""
    seconds: dict[str, list[float]] = {name: [] for name in fns}
    for _ in range(repeats):
        for name, fn in fns.items():
            begin = time.perf_counter()
            jax.block_until_ready(fn())
            seconds[name].append(time.perf_counter() - begin)
    return {name: statistics.median(times) for name, times in seconds.items()}


def report(**line: Any) -> None:
    """Print one JSON line with what the figure was made on."""
    print(json.dumps(line | machine()), flush=True)


def machine() -> dict[str, Any]:
    """Return what a figure depends on besides the program."""
    return {
        "device": jax.devices()[0].device_kind if jax.default_backend() != "cpu" else "cpu",
        "cores": os.cpu_count(),
        "jax": jax.__version__,
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
    }
