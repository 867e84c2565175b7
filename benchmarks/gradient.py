"""Times of gradients and of the steps that they differentiate: a JSON line for each command level and number of worlds.

    python benchmarks/gradient.py [--device gpu] [--worlds 1024 16384 131072] [--controls attitude] [--steps 100]

The gradient is the gradient of the sum of squared distances from the start after ``--steps`` steps, with respect to
the commands. ``jvp_s`` is the time of the sum and its derivative in one direction, in forward mode. ``forward_s`` is
the time of the sum alone. Calls alternate; on a GPU the calls of a batch are queued.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from measure import COMMANDS, medians, report, round_digits, start_hovering

from crazysim import Sim, __version__
from crazysim.core import functional

BATCH_CALLS = {"cpu": 1, "gpu": 10}
"""Number of calls in a batch."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 16384])
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--steps", type=int, nargs="+", default=[100], help="physics steps that are differentiated")
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    for case in itertools.product(args.controls, args.worlds, args.steps):
        measure(args, *case)


def measure(args: argparse.Namespace, control: str, n_worlds: int, n_steps: int) -> None:
    sim = Sim(n_worlds, control=control, device=args.device, engine=args.engine)
    start_hovering(sim, control)
    step, initial_data = sim.build_step_fn().with_zeros_of(sim.data), sim.data
    stage_command = getattr(functional, f"{control}_control")
    hover = jnp.asarray(COMMANDS[control](0.0434 * 9.81, 15864.0), jnp.float32)
    cmd = jax.device_put(jnp.broadcast_to(1.01 * hover, (n_worlds, 1, hover.size)), sim.device)

    def squared_distance(cmd: jax.Array) -> jax.Array:
        final_data = step(stage_command(initial_data, cmd), n_steps)
        return jnp.sum((final_data.states.pos - initial_data.states.pos) ** 2)

    functions = {
        "forward": jax.jit(squared_distance),
        "gradient": jax.jit(jax.grad(squared_distance)),
        "jvp": jax.jit(lambda cmd: jax.jvp(squared_distance, (cmd,), (cmd,))),
    }
    first_s = {name: seconds(fn, cmd, 1) for name, fn in functions.items()}
    batch = BATCH_CALLS["cpu" if args.device == "cpu" else "gpu"]
    durations = medians({name: lambda fn=fn: seconds(fn, cmd, batch) for name, fn in functions.items()}, args.repeats)
    slope = functions["gradient"](cmd)
    if not (jnp.all(jnp.isfinite(slope)) and jnp.any(slope != 0)):
        raise SystemExit("the gradient is zero or not finite; no figure")
    _, derivative = functions["jvp"](cmd)
    if not jnp.allclose(derivative, jnp.sum(slope * cmd), rtol=1e-3):
        raise SystemExit("the gradient and the derivative in one direction differ; no figure")
    report(
        args.device,
        benchmark="gradient",
        control=control,
        n_worlds=n_worlds,
        n_steps=n_steps,
        ran=[line for line in sim.explain().splitlines() if line.startswith(("gradient: ", "jvp: "))],
        compile_s=round_digits(first_s["gradient"] - durations["gradient"]),
        jvp_compile_s=round_digits(first_s["jvp"] - durations["jvp"]),
        forward_s=round_digits(durations["forward"]),
        gradient_s=round_digits(durations["gradient"]),
        jvp_s=round_digits(durations["jvp"]),
        forward_passes=round_digits(durations["gradient"] / durations["forward"]),
        jvp_passes=round_digits(durations["jvp"] / durations["forward"]),
        steps_per_s=round_digits(n_worlds * n_steps / durations["gradient"]),
        crazysim=__version__,
    )


def seconds(fn: Callable[[jax.Array], Any], cmd: jax.Array, n_calls: int) -> float:
    """Return the time of one call in a batch of ``n_calls``, s."""
    start_time = time.perf_counter()
    jax.block_until_ready([fn(cmd) for _ in range(n_calls)])
    return (time.perf_counter() - start_time) / n_calls


if __name__ == "__main__":
    main()
