"""Comparison of crazysim with Crazyflow 0.4.0, which runs in a virtual environment that this script creates.

Each program runs in its own process with the same JAX. Batches of calls of the two programs alternate, so that the
noise of a shared machine affects both. Medians are printed. A ``ratio`` of times is Crazyflow's over ours; the ratio of
``memory`` is ours over Crazyflow's, and that of ``swarm`` is the time of the single drones over that of the swarm.
Steps, loops, calls and gradients are measured with each controller of ``--controllers``; ``crazyflow`` is the
controller of Crazyflow. The cases:

    first_step  from Sim(n_worlds=1) to its first step, in fresh processes
    step        100 physics steps per call, for each command level, integrator and number of worlds
    loop        a command from NumPy, 5 steps, the positions into NumPy, for attitude and state commands
    call        one step(1) of one world, for each command level
    gradient    gradient of 100 attitude steps with respect to their commands, 1,024 worlds
    swarm       64 drones in 1,024 worlds compared with as many single drones, crazysim only
    contacts    contact query after a step, 4,096 worlds of 4 drones with 8 objects
    depth       64 x 64 depth of 1,024 worlds with 8 objects
    swarm_build Sim(n_drones=1024)
    gym         steps of the Gymnasium environments that reach a position, 4,096 worlds, 50 Hz at 500 Hz physics
    memory      bytes per world after a contact query, for one drone and four, with 8 objects

    python benchmarks/versus_crazyflow.py [--only step call] [--engine auto lanes] [--worlds 1024 16384]
    python benchmarks/versus_crazyflow.py --device gpu --peer-python PATH/OF/python
"""

from __future__ import annotations

import argparse
import functools
import importlib.metadata
import itertools
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
from measure import medians, round_digits

FOLDER = Path(__file__).parent
PEER_FOLDER = FOLDER.parent / ".cache" / "crazyflow"
"""Virtual environment with Crazyflow, the peer, on a CPU."""
CASES = ("first_step", "step", "loop", "call", "gradient", "swarm", "contacts", "depth", "swarm_build", "gym", "memory")
LEVELS = ("rotor_vel", "force_torque", "body_rate", "attitude", "state")
CONTROLLED_LEVELS = ("body_rate", "attitude", "state")
"""Command levels at which a controller runs."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CASES, default=CASES, help="cases to run")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", nargs="+", default=["auto"], help="engines of crazysim")
    parser.add_argument("--controllers", nargs="+", default=["auto", "crazyflow"], help="controllers of crazysim")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 16384], help="values for 'step'")
    parser.add_argument("--loop-worlds", type=int, nargs="+", default=[1, 64, 1024, 16384], help="values for 'loop'")
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"], help="values for 'step'")
    parser.add_argument("--integrators", nargs="+", default=["euler", "rk4"], help="values for 'step'")
    parser.add_argument("--batch-worlds", type=int, default=1024, help="worlds of 'gradient' and 'swarm'")
    parser.add_argument("--swarm", type=int, default=64, help="drones per world of 'swarm'")
    parser.add_argument("--gym-worlds", type=int, default=4096, help="worlds of 'gym'")
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument(
        "--peer-python", type=Path, help="interpreter with Crazyflow 0.4.0; by default a new environment"
    )
    args = parser.parse_args()
    pythons = {"crazysim": sys.executable}
    if set(args.only) != {"swarm"}:
        pythons["crazyflow"] = str(args.peer_python or peer_interpreter(args.device))
    if "first_step" in args.only:
        compare_first_steps(pythons, args.device)
    workers = {name: Worker(python, name) for name, python in pythons.items()}
    comparison = Comparison(workers, args.engine, args.controllers, args.device, args.repeats)
    if "step" in args.only:
        for control, integrator, n_worlds in itertools.product(args.controls, args.integrators, args.worlds):
            comparison.compare_rates("step", control=control, integrator=integrator, n_worlds=n_worlds, n_steps=100)
    if "loop" in args.only:
        for control, n_worlds in itertools.product(("attitude", "state"), args.loop_worlds):
            comparison.compare_rates("loop", control=control, integrator="euler", n_worlds=n_worlds, n_steps=5)
    if "call" in args.only:
        for control in LEVELS:
            comparison.compare_rates("call", control=control, integrator="euler", n_worlds=1, n_steps=1)
    if "gradient" in args.only:
        case = {"control": "attitude", "integrator": "euler", "n_worlds": args.batch_worlds, "n_steps": 100}
        comparison.compare_rates("gradient", **case)
    if "swarm" in args.only:
        comparison.compare_swarm(args.batch_worlds, args.swarm)
    for task, case in (
        ("contacts", {"n_worlds": 4096, "n_drones": 4, "n_steps": 1}),
        ("depth", {"n_worlds": 1024, "n_drones": 1, "n_steps": 1}),
        ("swarm_build", {"n_worlds": 1, "n_drones": 1024, "n_steps": 1}),
    ):
        if task in args.only:
            comparison.compare_query(task, **case)
    if "gym" in args.only:
        comparison.compare_query("gym", n_worlds=args.gym_worlds, n_drones=1, n_steps=100, freq=50)
    if "memory" in args.only:
        comparison.compare_memory()
    for worker in workers.values():
        worker.close()


class Comparison:
    """Comparison of engines and controllers of crazysim with Crazyflow."""

    def __init__(
        self, workers: dict[str, Worker], engines: list[str], controllers: list[str], device: str, repeats: int
    ):
        self.workers, self.engines, self.controllers = workers, engines, controllers
        self.device, self.repeats = device, repeats
        self.machine = workers["crazysim"].request(do="machine", device=device)

    def compare_rates(self, benchmark: str, **case: Any) -> None:
        """Print steps per second and compile time of each engine and controller and of Crazyflow, and the ratio."""
        ours, peer = self.workers["crazysim"], self.workers["crazyflow"]
        controllers = self.controllers if case["control"] in CONTROLLED_LEVELS else self.controllers[:1]
        variants = [
            {"engine": engine, "controller": controller} for engine in self.engines for controller in controllers
        ]
        contestants = {json.dumps(variant): (ours, case | variant) for variant in variants}
        durations = self._measure(benchmark, contestants | {"crazyflow": (peer, case)})
        steps = case["n_worlds"] * case["n_steps"]
        for variant in variants:
            line: dict[str, Any] = {"benchmark": f"versus_crazyflow/{benchmark}", **variant, **case}
            variant_duration = durations[json.dumps(variant)]
            for name, (seconds, compile_s) in (("crazysim", variant_duration), ("crazyflow", durations["crazyflow"])):
                line[f"{name}_call_s"] = round_digits(seconds)
                line[f"{name}_steps_per_s"] = round_digits(steps / seconds)
                line[f"{name}_compile_s"] = round(compile_s, 2)
            line["ratio"] = round(durations["crazyflow"][0] / variant_duration[0], 2)
            print(json.dumps(line | self.machine), flush=True)

    def compare_query(self, task: str, **case: Any) -> None:
        """Print the time of a task in both programs: a scene query, the build of a swarm, or environment steps."""
        durations = self._measure(task, {name: (worker, case) for name, worker in self.workers.items()})
        line: dict[str, Any] = {"benchmark": f"versus_crazyflow/{task}", **case}
        for name, (seconds, compile_s) in durations.items():
            line[f"{name}_s"] = round_digits(seconds)
            line[f"{name}_compile_s"] = round(compile_s, 2)
        line["ratio"] = round(durations["crazyflow"][0] / durations["crazysim"][0], 2)
        print(json.dumps(line | self.machine), flush=True)

    def compare_memory(self, min_worlds: int = 64, max_worlds: int = 1088) -> None:
        """Print the bytes per additional world after a contact query."""
        for n_drones in (1, 4):
            line: dict[str, Any] = {"benchmark": "versus_crazyflow/memory", "n_drones": n_drones}
            for name, worker in self.workers.items():
                first_bytes, last_bytes = (
                    worker.request(do="memory", n_worlds=n, n_drones=n_drones, device=self.device)["bytes"]
                    for n in (min_worlds, max_worlds)
                )
                line[f"{name}_bytes_per_world"] = round((last_bytes - first_bytes) / (max_worlds - min_worlds))
            line["ratio"] = round(line["crazysim_bytes_per_world"] / line["crazyflow_bytes_per_world"], 4)
            print(json.dumps(line | self.machine), flush=True)

    def compare_swarm(self, n_worlds: int, n_drones: int) -> None:
        """Print the rates of drones that share worlds and of as many drones in separate worlds, and their ratio."""
        case = {"control": "attitude", "integrator": "euler", "n_steps": 100}
        sizes = {"swarm": (n_worlds, n_drones), "single": (n_worlds * n_drones, 1)}
        for engine in self.engines:
            contestants = {
                name: (self.workers["crazysim"], case | {"engine": engine, "n_worlds": worlds, "n_drones": drones})
                for name, (worlds, drones) in sizes.items()
            }
            durations = self._measure("step", contestants)
            line = {"benchmark": "swarm", "engine": engine, **case, "n_worlds": n_worlds, "n_drones": n_drones}
            for name, (seconds, compile_s) in durations.items():
                line[f"{name}_steps_per_s"] = round_digits(n_worlds * n_drones * case["n_steps"] / seconds)
                line[f"{name}_compile_s"] = round(compile_s, 2)
            line["ratio"] = round(durations["single"][0] / durations["swarm"][0], 2)
            print(json.dumps(line | self.machine), flush=True)

    def _measure(self, task: str, contestants: dict[str, tuple[Worker, Any]]) -> dict[str, tuple[float, float]]:
        first_durations = {
            name: worker.request(do="build", task=task, name=name, device=self.device, case=case)["seconds"]
            for name, (worker, case) in contestants.items()
        }
        measures = {name: functools.partial(worker.time, name) for name, (worker, _) in contestants.items()}
        seconds = medians(measures, self.repeats)
        for name, (worker, _) in contestants.items():
            worker.request(do="end", name=name)
        return {name: (seconds[name], first_durations[name] - seconds[name]) for name in contestants}


def compare_first_steps(pythons: dict[str, str], device: str, repeats: int = 3) -> None:
    """Print the times of imports and from Sim(n_worlds=1) to its first step, in alternating fresh processes."""
    times: dict[str, list[dict[str, float]]] = {name: [] for name in pythons}
    for _ in range(repeats):
        for name, python in pythons.items():
            worker = Worker(python, name)
            times[name].append(worker.request(do="first_step", device=device))
            worker.close()
    line: dict[str, Any] = {"benchmark": "versus_crazyflow/first_step", "n_worlds": 1}
    for name, runs in times.items():
        for key in runs[0]:
            line[f"{name}_{key}"] = round(statistics.median(run[key] for run in runs), 2)
    print(json.dumps(line), flush=True)


class Worker:
    """Client of one program in its own process, with JSON lines as protocol."""

    def __init__(self, python: str, name: str):
        command = [python, FOLDER / "contestant.py", name]
        # Two processes share one GPU, so each preallocates less than half of its memory instead of three quarters.
        env = {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.45"} | os.environ
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env)
        self._in, self._out = self._process.stdin, self._process.stdout

    def request(self, **request: Any) -> dict[str, Any]:
        self._in.write(json.dumps(request) + "\n")
        self._in.flush()
        for line in self._out:
            if line.startswith("{"):  # skip anything that the packages print on import
                return json.loads(line)
        raise SystemExit("a worker ended without an answer; its error is above")

    def time(self, name: str) -> float:
        """Return the time of a call of the case that was built under a name, s."""
        return self.request(do="time", name=name)["seconds"]

    def close(self) -> None:
        """End the process."""
        self._in.close()
        self._process.wait()
        self._out.close()


def peer_interpreter(device: str) -> Path:
    """Return the interpreter of an environment with Crazyflow 0.4.0 and the version of JAX that is installed here.

    The environment is created at the first use.
    """
    folder = PEER_FOLDER if device == "cpu" else PEER_FOLDER.with_name(f"{PEER_FOLDER.name}-{device}")
    python = folder / "bin" / "python"
    if not python.exists():
        print(f"making an environment for Crazyflow 0.4.0 in {folder} ...", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        packages = ["crazyflow==0.4.0", f"jax{_jax_extra(device)}=={jax.__version__}"]
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    return python


def _jax_extra(device: str) -> str:
    if device == "cpu":
        return ""
    installed = {d.metadata["Name"] for d in importlib.metadata.distributions()}
    return "[cuda13]" if "jax-cuda13-plugin" in installed else "[cuda12]"


if __name__ == "__main__":
    main()
