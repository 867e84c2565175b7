"""The one way of measuring: compile apart, warm up, wait for the device, repeat, take the median.

Neither program is imported here: the peer's environment, which has no crazysim, measures with this as well.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

COMMANDS = {
    "state": lambda weight, hover_rpm: [0.0, 0.0, 1.0, *[0.0] * 9, 1.0, 0.0, 0.0, 0.0],
    "attitude": lambda weight, hover_rpm: [0.0, 0.0, 0.0, weight],
    "body_rate": lambda weight, hover_rpm: [0.0, 0.0, 0.0, weight],
    "force_torque": lambda weight, hover_rpm: [weight, 0.0, 0.0, 0.0],
    "rotor_vel": lambda weight, hover_rpm: [hover_rpm] * 4,
}
"""A command of each level under which a cf21B_500 hovers: a drone that has crashed is no work to simulate."""

BATCH_STEPS = {"cpu": 100, "gpu": 1000}
"""Steps between two returns to the start. Hovering without a position controller drifts: 7 cm in 1,000 steps."""

PATIENCE = 60.0
"""Seconds after which three repeats are enough."""


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
    command = np.tile(command, (n_worlds, n_drones, 1))
    if control == "state":
        command[..., :3] = pos
    getattr(sim, f"{control}_control")(command)


def still_flies(sim: Any) -> bool:
    """Return whether every drone is still in the air near its start: whether the figure is of flying drones."""
    pos = np.asarray(sim.data.states.pos)
    return bool(np.all(np.isfinite(pos)) and pos[..., 2].min() > 0.5 and pos[..., 2].max() < 2.0)


def engine_of(sim: Any) -> str:
    """Return the engine that steps a simulation of ours, which ``auto`` leaves open."""
    return sim.explain().split()[1]


class Flight:
    """A hovering simulation (ours or the peer's), timed in batches of calls that all begin at the same data.

    On a GPU the calls of a batch are queued back to back, and waited for once at the end. On a CPU every call is
    waited for.
    """

    def __init__(self, sim: Any, control: str, n_steps: int, device: str):
        """Let the drones hover, and step once, which compiles."""
        hovering(sim, control)
        self.sim, self.n_steps, self.start = sim, n_steps, sim.data
        self.queued = device != "cpu"
        self.calls = max(BATCH_STEPS["gpu" if self.queued else "cpu"] // n_steps, 1)
        self.first_s = seconds(self._step)
        self.seconds()  # the peer compiles a second time, for data that a step returned; that is in no figure

    def seconds(self) -> float:
        """Return the seconds a call takes, in one batch of them."""
        self.sim.data = self.start
        jax.block_until_ready(self.sim.data.states.pos)
        begin = time.perf_counter()
        for _ in range(self.calls):
            pos = self._step()
            if not self.queued:
                jax.block_until_ready(pos)
        jax.block_until_ready(self.sim.data.states.pos)
        return (time.perf_counter() - begin) / self.calls

    def require_flying(self) -> None:
        """Refuse a figure of drones that do not fly.

        Raises:
            SystemExit: If one does not.
        """
        if not still_flies(self.sim):
            raise SystemExit(f"{self.sim.control}, {self.sim.integrator}: the drones do not fly any more; no figure")

    def _step(self) -> Any:
        self.sim.step(self.n_steps)
        return self.sim.data.states.pos


def seconds(call: Callable[[], Any]) -> float:
    """Return the seconds a call takes, waiting for the device included."""
    begin = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begin


def medians(measures: dict[str, Callable[[], float]], repeats: int) -> dict[str, float]:
    """Return the median of what each measure returns, taken in turns, so that noise meets all of them alike."""
    found: dict[str, list[float]] = {name: [] for name in measures}
    begin = time.perf_counter()
    for done in range(repeats):
        if done >= 3 and time.perf_counter() - begin > PATIENCE:
            break
        for name, measure in measures.items():
            found[name].append(measure())
    return {name: statistics.median(values) for name, values in found.items()}


def alone(function: Any, *args: Any) -> Any:
    """Return what a function returns in a new process, where nothing is compiled yet."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *args).result()


def digits(value: float, n: int = 3) -> float:
    """Return a figure with the digits that mean something."""
    return float(f"{value:.{n}g}")


def report(device: str, **line: Any) -> None:
    """Print one JSON line with what the figure was made on."""
    print(json.dumps(line | machine(device)), flush=True)


def machine(device: str) -> dict[str, Any]:
    """Return what a figure depends on besides the program."""
    return {
        "device": "cpu" if device == "cpu" else jax.devices(device)[0].device_kind,
        "processor": _processor(),
        "cores": os.cpu_count(),
        "jax": jax.__version__,
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
    }


def _processor() -> str:
    """Return the name of the processor, as far as the system knows it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
