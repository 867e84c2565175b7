"""The loop of every script: send a command, take a control step of 5 physics steps, read the positions into NumPy.

    python benchmarks/loop.py [--device gpu] [--worlds 1 64 1024 16384] [--controls state attitude]

One JSON line for each command level and number of worlds, with the median time of an iteration.
"""

from __future__ import annotations

import argparse
import itertools

import numpy as np
from measure import hovering, medians, report, seconds, still_flies

from crazysim import Sim

STEPS = 5
"""Physics steps per command: 100 commands per second at 500 Hz."""
ITERATIONS = 50
"""Iterations of a repeat, 0.5 s of flight."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64, 1024, 16384])
    parser.add_argument("--controls", nargs="+", default=["state", "attitude"])
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    for control, n_worlds in itertools.product(args.controls, args.worlds):
        sim = Sim(n_worlds, control=control, device=args.device)
        hovering(sim, control)
        start, command = sim.data, np.asarray(getattr(sim.data.controls, control).staged_cmd)
        setter = getattr(sim, f"{control}_control")

        def loop(sim: Sim = sim, start=start, command=command, setter=setter) -> None:
            sim.data = start
            for _ in range(ITERATIONS):
                setter(command)
                sim.step(STEPS)
                np.asarray(sim.data.states.pos)

        loop()
        taken = medians({"loop": lambda loop=loop: seconds(loop)}, args.repeats)["loop"]
        if not still_flies(sim):
            raise RuntimeError("the drones crashed; a crashed drone costs less to simulate")
        step_s = taken / ITERATIONS
        flown_s = STEPS / sim.freq * n_worlds
        report(
            args.device,
            benchmark="loop",
            control=control,
            n_worlds=n_worlds,
            iteration_s=step_s,
            realtime=flown_s / step_s,
        )


if __name__ == "__main__":
    main()
