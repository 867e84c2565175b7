"""Commands per second of sampling model-predictive control for one drone, with one compiled call per command.

    python benchmarks/mppi.py [--device gpu] [--samples 1024 16384] [--horizon 50] [--substeps 2] [--knots 10]

A call flies all samples over the horizon from the present state, weights them, and returns the first command of their
weighted mean. On a GPU the state stays on the device, and the program waits for every command.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
from measure import medians, report, round_digits, seconds, start_hovering

from crazysim import Sim
from crazysim.control import Setpoint
from crazysim.lab.control.mppi import MPPI

DEFAULT_SAMPLES = {"cpu": (1024,), "gpu": (16384,)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--control", default="attitude", help="command level that is sampled")
    parser.add_argument("--samples", type=int, nargs="+", help="numbers of rollouts")
    parser.add_argument("--horizon", type=int, default=50, help="control steps")
    parser.add_argument("--substeps", type=int, default=2, help="physics steps of a control step")
    parser.add_argument(
        "--knots", type=int, default=10, help="sampled commands in the horizon, joined by straight lines"
    )
    parser.add_argument("--freq", type=int, default=125, help="physics steps per second of the rollouts")
    parser.add_argument("--repeats", type=int, default=50)
    args = parser.parse_args()
    for samples in args.samples or DEFAULT_SAMPLES["cpu" if args.device == "cpu" else "gpu"]:
        report_rate(samples, args)


def report_rate(samples: int, args: argparse.Namespace) -> None:
    sim = Sim(control=args.control, device=args.device)
    start_hovering(sim, args.control)
    settings = {"substeps": args.substeps, "knots": args.knots, "freq": args.freq}
    mppi = MPPI(sim, args.horizon, samples, **settings)
    zero_vector, zero_angle = jnp.zeros(3), jnp.zeros(1)
    setpoint = jax.device_put(Setpoint(jnp.array([0.5, 0, 1.0]), *[zero_vector] * 4, *[zero_angle] * 3), sim.device)
    compile_s = seconds(lambda: mppi.command(sim.data, setpoint))
    mppi.command(sim.data, setpoint)
    command_s = medians({"command": lambda: seconds(lambda: mppi.command(sim.data, setpoint))}, args.repeats)["command"]
    report(
        args.device,
        benchmark="mppi",
        control=args.control,
        samples=samples,
        horizon=args.horizon,
        n_substeps=args.substeps,
        knots=args.knots,
        engine=mppi.engine,
        compile_s=round(compile_s, 2),
        commands_per_s=round_digits(1 / command_s),
    )


if __name__ == "__main__":
    main()
