"""Time to the first step: building, tracing and compiling, for each command level and integrator.

Each case runs in its own process, so that nothing is cached. ``trace_s`` includes the C++ or CUDA compiler of
``fused``, which runs while the step is lowered.

    python benchmarks/compile.py [--engine auto plain lanes fused] [--device gpu] [--worlds 1 1024 16384]
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from typing import Any

import jax.numpy as jnp
from measure import describe_machine, engine_name, run_in_process, start_hovering

from crazysim import Sim, __version__
from crazysim.engine import ENGINES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", nargs="+", default=["auto"], choices=ENGINES)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 1024, 16384])
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--integrators", nargs="+", default=["euler", "rk4"])
    args = parser.parse_args()
    for case in itertools.product(args.controls, args.integrators, args.worlds, args.engine):
        print(json.dumps(run_in_process(measure, *case, args.device)), flush=True)


def measure(control: str, integrator: str, n_worlds: int, engine: str, device: str) -> dict[str, Any]:
    """Return the line of one case, with the times to build, trace and compile it."""
    start_time = time.perf_counter()
    sim = Sim(n_worlds=n_worlds, control=control, integrator=integrator, engine=engine, device=device)
    start_hovering(sim, control)
    build_end = time.perf_counter()
    lowered = sim.build_step_fn().lower(sim.data, jnp.int32(1))
    trace_end = time.perf_counter()
    lowered.compile()
    end_time = time.perf_counter()
    return {
        "benchmark": "compile",
        "engine": engine_name(sim),
        "control": control,
        "integrator": integrator,
        "n_worlds": n_worlds,
        "build_s": round(build_end - start_time, 4),
        "trace_s": round(trace_end - build_end, 4),
        "compile_s": round(end_time - trace_end, 4),
        "crazysim": __version__,
        **describe_machine(device),
    }


if __name__ == "__main__":
    main()
