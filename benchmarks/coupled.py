"""Drone steps per second of worlds whose drones act on each other, compared with the same worlds without an effect.

One JSON line for each number of drones per world, with the same total number of drones. ``downwash`` adds up the jets
of all drones of a world at each drone; ``uncoupled`` is the same simulation without an effect. Both simulations are
measured alternately.

    python benchmarks/coupled.py [--device gpu] [--total 262144] [--drones 4 8 16 64 256] [--check]
"""

from __future__ import annotations

import argparse
from typing import Any

import jax.numpy as jnp
import numpy as np
from measure import Flight, engine_name, medians, report, round_digits

from crazysim import Downwash, Sim, __version__

MAX_CHECKED_WORLDS = 100
"""Largest number of worlds in a comparison of engines."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--control", default="attitude")
    parser.add_argument("--integrator", default="euler")
    parser.add_argument("--total", type=int, default=262144, help="drones of all worlds")
    parser.add_argument("--drones", nargs="+", type=int, default=[4, 8, 16, 64, 256], help="drones of a world")
    parser.add_argument("--steps", type=int, default=20, help="physics steps per call")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--check", action="store_true", help="compare with engine 'plain' instead of measuring")
    args = parser.parse_args()
    for n_drones in args.drones:
        n_worlds = max(args.total // n_drones, 1)
        if args.check:
            n_worlds = min(n_worlds, MAX_CHECKED_WORLDS)
        case = {"control": args.control, "integrator": args.integrator, "n_worlds": n_worlds, "n_drones": n_drones}
        line = check_agreement(case, args) if args.check else measure(case, args)
        report(args.device, benchmark="coupled", **case, n_steps=args.steps, crazysim=__version__, **line)


def measure(case: dict[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """Return the drone steps per second with and without downwash."""
    sims = {name: Sim(**case, device=args.device) for name in ("uncoupled", "downwash")}
    sims["downwash"].add(Downwash())
    flights = {name: Flight(sim, args.control, args.steps, args.device) for name, sim in sims.items()}
    durations = medians({name: flight.seconds for name, flight in flights.items()}, args.repeats)
    n_drone_steps = case["n_worlds"] * case["n_drones"] * args.steps
    rates = {name: round_digits(n_drone_steps / seconds) for name, seconds in durations.items()}
    return {"engine": engine_name(sims["downwash"]), "steps_per_s": rates}


def check_agreement(case: dict[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """Return the largest difference of a velocity component between two engines, and the largest component, m/s."""
    pos = np.random.default_rng(0).uniform(-1, 1, (case["n_worlds"], case["n_drones"], 3))
    vels, engines = [], []
    for engine in ("auto", "plain"):
        sim = Sim(**case, device=args.device, engine=engine)
        sim.add(Downwash())
        states = sim.data.states
        hover = jnp.full_like(states.rotor_vel, 15864.0)
        sim.data = sim.data.replace(states=states.replace(pos=jnp.asarray(pos, states.pos.dtype) + 2, rotor_vel=hover))
        sim.step(args.steps)
        vels.append(np.asarray(sim.data.states.vel))
        engines.append(engine_name(sim))
    return {"engine": engines[0], "max_vel_difference": float(np.abs(vels[0] - vels[1]).max()),
            "max_vel": float(np.abs(vels[1]).max())}  # fmt: skip


if __name__ == "__main__":
    main()
