"""Physics steps per second: one JSON line for each engine, controller, level, integrator, size and steps per call.

    python benchmarks/step.py [--engine auto plain lanes fused] [--controllers auto crazyflow] [--device gpu]
        [--worlds 1024 16384] [--steps 10 100]

Engines and controllers alternate. ``compile_s`` of ``fused`` includes the compilation of the kernel only in the first
case of a process that needs this kernel; ``scaling.py`` runs each size in its own process. Other scripts:
``compile.py``, ``scaling.py``, ``limits.py``, ``flight_stack.py``, ``versus_crazyflow.py``.
"""

from __future__ import annotations

import argparse
import itertools

import jax
import jax.numpy as jnp
from measure import Flight, engine_name, medians, report, round_digits

from crazysim import Sim, __version__
from crazysim.engine import ENGINES
from crazysim.engine.pytree import scopes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", nargs="+", default=["auto"], choices=ENGINES)
    parser.add_argument("--controllers", nargs="+", default=["auto"])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 16384])
    parser.add_argument("--drones", type=int, nargs="+", default=[1], help="drones per world")
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--integrators", nargs="+", default=["euler", "rk4"])
    parser.add_argument("--steps", type=int, nargs="+", default=[100], help="physics steps per call")
    parser.add_argument("--randomised", action="store_true", help="randomise all parameters per drone")
    parser.add_argument("--no-drag", action="store_true", help="set the drag matrix to zero")
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    for case in itertools.product(args.controls, args.integrators, args.worlds, args.drones):
        measure(args, *case)


def measure(args: argparse.Namespace, control: str, integrator: str, n_worlds: int, n_drones: int) -> None:
    """Print one line for each engine, controller and value of ``--steps``; all these values share one compilation."""
    cases = list(itertools.product(args.engine, args.controllers))
    sims = {case: build_sim(args, *case, control, integrator, n_worlds, n_drones) for case in cases}
    compile_s: dict[tuple[str, str], float] = {}
    for n_steps in args.steps:
        flights = {case: Flight(sim, control, n_steps, args.device) for case, sim in sims.items()}
        durations = medians({case: flight.seconds for case, flight in flights.items()}, args.repeats)
        for case, flight in flights.items():
            flight.require_flying()
            report(
                args.device,
                benchmark="step",
                engine=engine_name(sims[case]),
                controller=case[1],
                control=control,
                integrator=integrator,
                n_worlds=n_worlds,
                n_drones=n_drones,
                n_steps=n_steps,
                randomised=args.randomised,
                drag=not args.no_drag,
                compile_s=compile_s.setdefault(case, round(flight.first_s - durations[case], 2)),
                call_s=round_digits(durations[case]),
                steps_per_s=round_digits(n_worlds * n_drones * n_steps / durations[case]),
                crazysim=__version__,
            )


def build_sim(
    args: argparse.Namespace, engine: str, controller: str, control: str, integrator: str, n_worlds: int, n_drones: int
) -> Sim:
    sim = Sim(
        n_worlds,
        n_drones,
        control=control,
        integrator=integrator,
        controller=controller,
        device=args.device,
        engine=engine,
    )
    if args.no_drag:
        params = sim.data.params
        sim.data = sim.data.replace(params=params.replace(drag_matrix=jnp.zeros_like(params.drag_matrix)))
    if args.randomised:
        randomise_parameters(sim)
    return sim


def randomise_parameters(sim: Sim, max_deviation: float = 1e-4) -> None:
    """Give every drone its own value of every parameter, with so little variation that all drones still hover."""
    batch, key = (sim.n_worlds, sim.n_drones), jax.random.key(0)

    def randomise_leaf(scope: str, x: jax.Array) -> jax.Array:
        if scope != "shared" or not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return x * jax.random.uniform(key, (*batch, *x.shape), x.dtype, 1 - max_deviation, 1 + max_deviation)

    data = sim.data
    params = jax.tree.map(randomise_leaf, scopes(data.params), data.params)
    controls = jax.tree.map(randomise_leaf, scopes(data.controls), data.controls)
    sim.data = data.replace(params=params, controls=controls)


if __name__ == "__main__":
    main()
