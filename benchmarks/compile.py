"""How long until the first step? Building, tracing and compiling apart, for each command level and integrator.

python benchmarks/compile.py [--device cpu] [--worlds 1 1024 16384]
"""

from __future__ import annotations

import argparse
import time

import jax
import jax.numpy as jnp
from measure import hovering, report

from crazysim import Sim


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 1024, 16384])
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--integrators", nargs="+", default=["euler", "rk4"])
    args = parser.parse_args()
    for control in args.controls:
        for integrator in args.integrators:
            for n_worlds in args.worlds:
                measure(control, integrator, n_worlds, args.device)


def measure(control: str, integrator: str, n_worlds: int, device: str) -> None:
    jax.clear_caches()
    begin = time.perf_counter()
    sim = Sim(n_worlds=n_worlds, control=control, integrator=integrator, device=device)
    hovering(sim, control)
    built = time.perf_counter()
    step = jax.jit(lambda data: sim.build_step_fn()(data, jnp.int32(1)))
    lowered = step.lower(sim.data)
    traced = time.perf_counter()
    compiled = lowered.compile()
    done = time.perf_counter()
    jax.block_until_ready(compiled(sim.data))
    report(
        benchmark="compile",
        control=control,
        integrator=integrator,
        n_worlds=n_worlds,
        build_s=round(built - begin, 2),
        trace_s=round(traced - built, 2),
        compile_s=round(done - traced, 2),
    )


if __name__ == "__main__":
    main()
