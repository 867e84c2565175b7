"""Shared timing: compile separately, warm up, synchronise, repeat, take the median.

This module imports neither crazysim nor Crazyflow, because it runs in the environments of both.
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
"""Function from weight, N, and rotor speed, rpm, to the hover command of a cf21B_500, by level. Drones hover in all
measurements, since a crashed drone costs less to simulate."""

BATCH_STEPS = {"cpu": 100, "gpu": 1000}
"""Steps after which a flight restarts. Without a position controller, hovering drones drift by 7 cm in 1,000 steps."""

REPEATS_TIME_LIMIT = 60.0
"""Duration after which three repeats are enough, s."""


def start_hovering(sim: Any, control: str) -> None:
    """Place every drone of a simulation of either program at 1 m with hovering rotors, and command it to hover.

    A weight of 0.0434 kg * 9.81 m/s^2 needs 15,864 rpm of each of four rotors by the thrust curve of the airframe.
    """
    n_worlds, n_drones = sim.n_worlds, sim.n_drones
    states = sim.data.states
    pos, rotor_vel = states.pos.at[..., 2].set(1.0), states.rotor_vel.at[:].set(15864.0)
    sim.data = sim.data.replace(states=states.replace(pos=pos, rotor_vel=rotor_vel))
    command = np.asarray(COMMANDS[control](0.0434 * 9.81, 15864.0), np.float32)
    command = np.tile(command, (n_worlds, n_drones, 1))
    if control == "state":
        command[..., :3] = pos
    getattr(sim, f"{control}_control")(command)


def is_flying(sim: Any) -> bool:
    """Return True if every drone is still flying near its start."""
    pos = np.asarray(sim.data.states.pos)
    return bool(np.all(np.isfinite(pos)) and pos[..., 2].min() > 0.5 and pos[..., 2].max() < 2.0)


def engine_name(sim: Any) -> str:
    """Return the engine that steps a simulation of crazysim, as chosen by ``auto``."""
    return sim.explain().split()[1]


class Flight:
    """Hovering simulation of either program, timed in batches of calls that start from the same data.

    On a GPU the calls of a batch are queued, and the program waits once at the end. On a CPU it waits for every call.
    """

    def __init__(self, sim: Any, control: str, n_steps: int, device: str):
        start_hovering(sim, control)
        self.sim, self.n_steps, self.start_data = sim, n_steps, sim.data
        self.is_queued = device != "cpu"
        self.n_calls = max(BATCH_STEPS["gpu" if self.is_queued else "cpu"] // n_steps, 1)
        self.first_s = seconds(self._step)
        """Time of the first call with compilation, s."""
        self.seconds()  # Crazyflow compiles again for data that a step returned; no figure includes this

    def seconds(self) -> float:
        """Return the time of one call in a batch, s."""
        self.sim.data = self.start_data
        jax.block_until_ready(self.sim.data.states.pos)
        start_time = time.perf_counter()
        for _ in range(self.n_calls):
            pos = self._step()
            if not self.is_queued:
                jax.block_until_ready(pos)
        jax.block_until_ready(self.sim.data.states.pos)
        return (time.perf_counter() - start_time) / self.n_calls

    def require_flying(self) -> None:
        """Check that the drones still fly.

        Raises:
            SystemExit: If a drone does not fly.
        """
        if not is_flying(self.sim):
            raise SystemExit(f"{self.sim.control}, {self.sim.integrator}: the drones do not fly any more; no figure")

    def _step(self) -> Any:
        self.sim.step(self.n_steps)
        return self.sim.data.states.pos


def seconds(call: Callable[[], Any]) -> float:
    """Return the time of a call including synchronisation, s."""
    start_time = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start_time


def medians(measures: dict[Any, Callable[[], float]], repeats: int) -> dict[Any, float]:
    """Return the median of each measurement. Measurements alternate, so that noise affects all of them equally."""
    durations: dict[Any, list[float]] = {name: [] for name in measures}
    start_time = time.perf_counter()
    for n_done in range(repeats):
        if n_done >= 3 and time.perf_counter() - start_time > REPEATS_TIME_LIMIT:
            break
        for name, measure in measures.items():
            durations[name].append(measure())
    return {name: statistics.median(values) for name, values in durations.items()}


def report_flights(
    device: str,
    flights: dict[str, Flight],
    repeats: int,
    references: dict[str, str],
    **entries: Any,
) -> None:
    """Time flights alternately, and print a line for each, with its rate and the ratio of its time to a reference.

    Args:
        device: Platform, ``"cpu"`` or ``"gpu"``.
        flights: Flights by name of the case.
        repeats: Number of times that each flight is measured.
        references: Name of the reference of each flight.
        entries: Further entries of each line. A function is called with the simulation and returns the entry.
    """
    durations = medians({name: flight.seconds for name, flight in flights.items()}, repeats)
    for name, flight in flights.items():
        flight.require_flying()
        sim, reference = flight.sim, references[name]
        report(
            device,
            case=name,
            engine=engine_name(sim),
            n_worlds=sim.n_worlds,
            n_drones=sim.n_drones,
            first_s=round_digits(flight.first_s),
            call_s=round_digits(durations[name]),
            steps_per_s=round_digits(sim.n_worlds * sim.n_drones * flight.n_steps / durations[name]),
            reference=reference,
            ratio=round_digits(durations[name] / durations[reference]),
            **{key: value(sim) if callable(value) else value for key, value in entries.items()},
        )


def run_in_process(function: Any, *args: Any) -> Any:
    """Return the result of a function in a new process, where nothing is compiled yet."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *args).result()


def round_digits(value: float, n: int = 3) -> float:
    """Return a number rounded to ``n`` significant digits."""
    return float(f"{value:.{n}g}")


def report(device: str, **line: Any) -> None:
    """Print one JSON line with the results and the machine."""
    print(json.dumps(line | describe_machine(device)), flush=True)


def describe_machine(device: str) -> dict[str, Any]:
    """Return device, processor and versions."""
    return {
        "device": "cpu" if device == "cpu" else jax.devices(device)[0].device_kind,
        "processor": _processor(),
        "vectors": _vectors(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "jax": jax.__version__,
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
    }


def _processor() -> str:
    return _cpu_info("model name") or platform.machine()


def _vectors() -> str:
    features = [x for x in _cpu_info("flags").split() if f"-mno-{x}" not in os.environ.get("CXXFLAGS", "")]
    return next((name for flag, name in (("avx512f", "AVX-512"), ("avx2", "AVX2")) if flag in features), "128 bit")


def _cpu_info(key: str) -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")
