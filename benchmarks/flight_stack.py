"""Cost of trajectories, controllers and loads: one JSON line for each case, with its physics steps per second.

    python benchmarks/flight_stack.py [--device gpu] [--worlds 1024] [--cases state follow rod ...] [--operations]

Drones hover, in calls of 100 steps; all cases alternate. ``ratio`` is the time of the case divided by the time of its
reference. The reference is ``state`` for trajectories and controllers, and ``rotor`` for loads.

- state: the default controller, a constant command
- follow: a figure eight for all; starts: the same, with another start time in each world
- slots: the same with 16 trajectories of 60 pieces, one for each world in turn
- geometric: geometric control at 100 Hz along a figure eight
- pid, mellinger: the firmware's controllers, a constant command
- rotor: rotor commands without a load; rod, cable: a load attached to the centre of mass; offset: a rod attached below
  the centre of mass, with damping
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from measure import Flight, report_flights

from crazysim import Sim, SlungLoad
from crazysim.engine.ir.program import Segment
from crazysim.plugins.follow import Follow
from crazysim.trajectories import Trajectory, figure_eight

N_STEPS = 100
"""Steps per call."""
FIGURE_EIGHT_SIZE = (0.4, 0.2)
"""Size of the figure eight that drones follow, m; its period is 5 s."""
N_SLOTS, N_PIECES = 16, 60
"""Number of trajectories, and of the pieces of each trajectory, in the case ``slots``."""
LOAD_SETTINGS = {"mass": 0.0005, "length": 0.3, "in_scene": False}
"""Settings of loads, kg and m: so light that the rotor command of a bare drone holds them up for a while."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--operations", action="store_true", help="report the operations of each step's program too")
    args = parser.parse_args()
    references = [name for name in REFERENCES if any(CASES[case][0] == name for case in args.cases)]
    cases = dict.fromkeys([*references, *args.cases])
    flights = {name: make_flight(args, name) for name in cases}
    counts = {"operations": count_operations} if args.operations else {}
    reference = {name: CASES[name][0] for name in flights}
    report_flights(args.device, flights, args.repeats, reference, benchmark="flight_stack", **counts)


def make_flight(args: argparse.Namespace, name: str) -> Flight:
    reference, settings, add_plugin = CASES[name]
    sim = Sim(args.worlds, device=args.device, engine=args.engine, **settings)
    if add_plugin is not None:
        add_plugin(sim)
    return Flight(sim, "rotor_vel" if reference == "rotor" else "state", N_STEPS, args.device)


def follow_trajectory(sim: Sim) -> None:
    sim.add(Follow(figure_eight(*FIGURE_EIGHT_SIZE), visible=False))


def follow_from_own_starts(sim: Sim) -> None:
    """Make all drones follow one trajectory, with another start time in each world."""
    sim.add(Follow(figure_eight(*FIGURE_EIGHT_SIZE), start=start_times(sim), visible=False))


def follow_slots(sim: Sim) -> None:
    """Make the drones follow 16 trajectories of 60 pieces, with another start time in each world."""
    coefficients = np.random.default_rng(0).normal(0.0, 0.01, (N_PIECES, 4, 8))
    coefficients[:, 2, 0] = 1.0
    pieces = Trajectory.of_pieces(np.full(N_PIECES, 0.1), coefficients)
    index = np.arange(sim.n_worlds)[:, None] % N_SLOTS
    sim.add(Follow([pieces] * N_SLOTS, index=index, start=start_times(sim), visible=False))


def start_times(sim: Sim) -> np.ndarray:
    """Return times at which the drones start their trajectories, s. (n_worlds, 1)"""
    return np.linspace(-1.0, 0.0, sim.n_worlds)[:, None]


def load_adder(**settings: Any) -> Callable[[Sim], Any]:
    """Return a function that adds a load with these settings to a simulation."""
    return lambda sim: sim.add(SlungLoad(**(LOAD_SETTINGS | settings)))


STATE_SETTINGS: dict[str, Any] = {"control": "state"}
ROTOR_SETTINGS: dict[str, Any] = {"control": "rotor_vel"}
REFERENCES = ("state", "rotor")
"""Cases that the other cases are compared with."""
CASES: dict[str, tuple[str, dict[str, Any], Callable[[Sim], Any] | None]] = {
    "state": ("state", STATE_SETTINGS, None),
    "follow": ("state", STATE_SETTINGS, follow_trajectory),
    "starts": ("state", STATE_SETTINGS, follow_from_own_starts),
    "slots": ("state", STATE_SETTINGS, follow_slots),
    "geometric": ("state", STATE_SETTINGS | {"controller": "geometric", "state_freq": 100}, follow_trajectory),
    "pid": ("state", STATE_SETTINGS | {"controller": "pid"}, None),
    "mellinger": ("state", STATE_SETTINGS | {"controller": "mellinger"}, None),
    "rotor": ("rotor", ROTOR_SETTINGS, None),
    "rod": ("rotor", ROTOR_SETTINGS, load_adder()),
    "cable": ("rotor", ROTOR_SETTINGS, load_adder(cable=True)),
    "offset": ("rotor", ROTOR_SETTINGS, load_adder(attach=[0.0, 0.0, -0.02], damping=1e-5)),
}
"""Name of the reference, settings of ``Sim``, and function that adds a plugin to the simulation, of each case."""


def count_operations(sim: Sim) -> dict[str, int]:
    """Return the number of operations of each kind in the program of a step; empty if the step has no program."""
    program = sim.build_step_fn().plan(sim.data).program
    blocks = [segment.block for segment in program.segments if isinstance(segment, Segment)] if program else []
    return dict(Counter(operation.name for block in blocks for operation in block.walk()).most_common())


if __name__ == "__main__":
    main()
