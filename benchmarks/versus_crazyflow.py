"""Both programs in one run: crazysim here, Crazyflow 0.4.0 in an environment that this script makes.

Each runs in a process of its own with the same JAX; the two are timed in turns, a call each, so that the noise of
a shared machine meets both. Medians, and the ratio of medians, are printed.

    python benchmarks/versus_crazyflow.py [--worlds 1024 16384] [--controls attitude rotor_vel]
"""

from __future__ import annotations

import argparse
import importlib
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PEER = HERE.parent / ".cache" / "crazyflow"
N_STEPS = 100


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 16384])
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--peer-python", type=Path, help="interpreter that has Crazyflow 0.4.0; made if left out")
    parser.add_argument("--worker", choices=["crazysim", "crazyflow"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        work(args.worker)
        return
    pythons = {"crazysim": sys.executable, "crazyflow": str(args.peer_python or peer_environment())}
    first_steps(pythons, args.device)
    workers = {name: Worker(python, name) for name, python in pythons.items()}
    for control in args.controls:
        for n_worlds in args.worlds:
            compare(workers, control, n_worlds, args.device, args.repeats)
    for worker in workers.values():
        worker.close()


def compare(workers: dict[str, Worker], control: str, n_worlds: int, device: str, repeats: int) -> None:
    """Print both programs' steps per second and compile time, and the ratios."""
    first = {
        name: worker.ask(do="build", control=control, n_worlds=n_worlds, device=device)["seconds"]
        for name, worker in workers.items()
    }
    seconds: dict[str, list[float]] = {name: [] for name in workers}
    for _ in range(repeats):
        for name, worker in workers.items():
            seconds[name].append(worker.ask(do="time")["seconds"])
    for name, worker in workers.items():
        if not worker.ask(do="flies")["flies"]:
            raise SystemExit(f"{name}: the drones do not fly any more; no figure")
    rate = {name: n_worlds * N_STEPS / statistics.median(times) for name, times in seconds.items()}
    line = {"benchmark": "versus_crazyflow", "control": control, "integrator": "euler", "n_worlds": n_worlds}
    for name in workers:
        line[f"{name}_steps_per_s"] = float(f"{rate[name]:.3g}")
        line[f"{name}_compile_s"] = round(first[name] - statistics.median(seconds[name]), 2)
    line["ratio"] = round(rate["crazysim"] / rate["crazyflow"], 2)
    print(json.dumps(line | workers["crazysim"].ask(do="machine")), flush=True)


def first_steps(pythons: dict[str, str], device: str, repeats: int = 3) -> None:
    """Print the time from Sim(n_worlds=1) to its first step, each in a fresh process, in turns."""
    times: dict[str, list[dict[str, float]]] = {name: [] for name in pythons}
    for _ in range(repeats):
        for name, python in pythons.items():
            worker = Worker(python, name)
            times[name].append(worker.ask(do="first_step", device=device))
            worker.close()
    line: dict[str, Any] = {"benchmark": "first_step", "n_worlds": 1}
    for name, runs in times.items():
        for key in runs[0]:
            line[f"{name}_{key}"] = round(statistics.median(run[key] for run in runs), 2)
    print(json.dumps(line), flush=True)


class Worker:
    """One program in a process of its own, asked by JSON lines."""

    def __init__(self, python: str, name: str):
        """Start the process."""
        command = [python, __file__, "--worker", name]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._in, self._out = self._process.stdin, self._process.stdout

    def ask(self, **request: Any) -> dict[str, Any]:
        """Return the answer to a request."""
        self._in.write(json.dumps(request) + "\n")
        self._in.flush()
        for line in self._out:
            if line.startswith("{"):  # whatever the packages print on import is no answer
                return json.loads(line)
        raise SystemExit("a worker ended without an answer; its error stands above")

    def close(self) -> None:
        """End the process."""
        self._in.close()
        self._process.wait()


def work(package: str) -> None:
    """Answer requests for one of the packages until standard input ends."""
    begin = time.perf_counter()
    module = importlib.import_module(f"{package}.sim")
    import jax
    from measure import first_call, hovering, machine, still_flies

    import_s = time.perf_counter() - begin
    sim: Any = None

    def run() -> Any:
        sim.step(N_STEPS)
        return sim.data.states.pos

    for line in sys.stdin:
        request = json.loads(line)
        answer: dict[str, Any] = {}
        if request["do"] == "first_step":
            begin = time.perf_counter()
            sim = module.Sim(n_worlds=1, device=request["device"])
            sim.step()
            jax.block_until_ready(sim.data.states.pos)
            answer = {"import_s": import_s, "to_first_step_s": time.perf_counter() - begin}
        elif request["do"] == "build":
            sim = module.Sim(n_worlds=request["n_worlds"], control=request["control"], device=request["device"])
            hovering(sim, request["control"])
            answer = {"seconds": first_call(run)}
            first_call(run)  # the peer compiles a second time; that is in neither figure
        elif request["do"] == "time":
            answer = {"seconds": first_call(run)}
        elif request["do"] == "flies":
            answer = {"flies": still_flies(sim)}
        elif request["do"] == "machine":
            answer = machine()
        print(json.dumps(answer), flush=True)


def peer_environment() -> Path:
    """Return the interpreter of an environment with Crazyflow 0.4.0 and our JAX, made at first use."""
    import jax

    python = PEER / "bin" / "python"
    if not python.exists():
        print(f"making an environment for Crazyflow 0.4.0 in {PEER} ...", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", PEER], check=True)
        packages = ["crazyflow==0.4.0", f"jax=={jax.__version__}"]
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    return python


if __name__ == "__main__":
    main()
