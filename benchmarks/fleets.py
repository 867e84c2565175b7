"""Steps per second of mixed fleets: drones with cars, and drones of two airframes in one world.

One JSON line for each case, with the ratio of the rates of a fleet and of a reference, measured alternately. ``cars``:
the fleet has drones and cars, the reference only drones. ``airframes``: two airframes alternate among the drones of the
fleet; the reference has one airframe, and parameters for each drone.

    python benchmarks/fleets.py [--device gpu] [--worlds 4096] [--drones 4] [--cars 2]
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import Flight, engine_name, medians, report, round_digits

from crazysim import Sim, __version__
from crazysim.plugins.vehicles import Cars

LEVELS = ("state", "attitude", "body_rate", "force_torque")
"""Command levels whose controllers have parameters."""
AIRFRAMES = ("cf21B_500", "cf2x_L250")
"""The two airframes of the mixed fleet."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--drones", type=int, default=4, help="drones of a world")
    parser.add_argument("--cars", type=int, default=2, help="cars of a world")
    parser.add_argument("--steps", type=int, default=100, help="physics steps per call")
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    cases = {
        "cars": (make_drones(args), make_drones_and_cars(args)),
        "airframes": (make_drones(args, has_own_params=True), make_two_airframes(args)),
    }
    for case, (reference, fleet) in cases.items():
        flights = {name: Flight(sim, "state", args.steps, args.device)
                   for name, sim in (("reference", reference), ("fleet", fleet))}  # fmt: skip
        durations = medians({name: flight.seconds for name, flight in flights.items()}, args.repeats)
        n_steps = args.worlds * args.drones * args.steps
        rates = {name: round_digits(n_steps / seconds) for name, seconds in durations.items()}
        report(args.device, benchmark="fleets", case=case, n_worlds=args.worlds, n_drones=args.drones,
               n_cars=args.cars * (case == "cars"), n_steps=args.steps, engine=engine_name(fleet),
               drone_steps_per_s=rates,
               ratio=round_digits(durations["reference"] / durations["fleet"]), crazysim=__version__)  # fmt: skip


def make_drones(args: argparse.Namespace, has_own_params: bool = False) -> Sim:
    """Return a simulation of drones, which share their parameters or have separate parameters."""
    sim = Sim(args.worlds, args.drones, control="state", device=args.device)
    if has_own_params:
        shape = sim.data.states.pos.shape[:2]

        def repeat_per_drone(record: Any) -> Any:
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (*shape, *x.shape)), record)

        levels = {level: getattr(sim.data.controls, level) for level in LEVELS}
        changes = {level: x.replace(params=repeat_per_drone(x.params)) for level, x in levels.items() if x is not None}
        sim.data = sim.data.replace(
            params=repeat_per_drone(sim.data.params), controls=sim.data.controls.replace(**changes)
        )
    return sim


def make_two_airframes(args: argparse.Namespace) -> Sim:
    """Return a simulation of drones with two airframes that alternate."""
    airframes = [AIRFRAMES[k % 2] for k in range(args.drones)]
    return Sim(args.worlds, args.drones, drone=airframes, control="state", device=args.device)


def make_drones_and_cars(args: argparse.Namespace) -> Sim:
    """Return a simulation of drones, and of cars that drive circles."""
    sim = make_drones(args)
    cars = sim.add(Cars(args.cars, in_scene=False))
    command = np.tile(np.array([0.08, 0.2], np.float32), (args.worlds, args.cars, 1))
    sim.data = cars.with_command(sim.data, command)
    return sim


if __name__ == "__main__":
    main()
