"""How many physics steps a second? One JSON line for each command level, integrator and number of worlds.

python benchmarks/step.py [--device cpu] [--worlds 1024 16384] [--controls attitude rotor_vel state]
"""

from __future__ import annotations

import argparse

from measure import first_call, hovering, median_seconds, report, still_flies

from crazysim import Sim


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 16384])
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--integrators", nargs="+", default=["euler", "rk4"])
    parser.add_argument("--steps", type=int, default=100, help="physics steps a call")
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    for control in args.controls:
        for integrator in args.integrators:
            for n_worlds in args.worlds:
                measure(control, integrator, n_worlds, args.device, args.steps, args.repeats)


def measure(control: str, integrator: str, n_worlds: int, device: str, n_steps: int, repeats: int) -> None:
    sim = Sim(n_worlds=n_worlds, control=control, integrator=integrator, device=device)
    hovering(sim, control)

    def run() -> object:
        sim.step(n_steps)
        return sim.data.states.pos

    first = first_call(run)
    seconds = median_seconds({"step": run}, repeats)["step"]
    if not still_flies(sim):
        raise SystemExit(f"{control}, {integrator}: the drones do not fly any more; no figure")
    report(
        benchmark="step",
        control=control,
        integrator=integrator,
        n_worlds=n_worlds,
        n_steps=n_steps,
        compile_s=round(first - seconds, 2),
        steps_per_s=float(f"{n_worlds * n_steps / seconds:.3g}"),
    )


if __name__ == "__main__":
    main()
