"""Lower bound of the time of each case on this machine, and the measured time relative to it.

The lower bound is the larger of two times. One is the time of the operations at the rate of multiply-adds that the same
engine reaches on this machine. The other is the time to move each number once that a call reads or writes, at the
bandwidth of a copy on this machine. Both rates are the best of all repeats; the measured time is a median. The copy is
larger than the caches. Data that fits into a cache may move faster.

Operations are counted in multiply-adds in the program of one drone (``Plan.program``), see ``ops.TABLE``. The count is
never too high, so the lower bound is valid.

    python benchmarks/limits.py [--engine auto plain lanes] [--device gpu] [--worlds 1048576] [--steps 1 10 100]
"""

from __future__ import annotations

import argparse
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from measure import Flight, engine_name, medians, report, round_digits, seconds

from crazysim import PyTree, Sim, __version__, leaf
from crazysim.engine import ENGINES
from crazysim.engine.backends import fused
from crazysim.engine.ir.blocks import Block, Operation, Value
from crazysim.engine.ir.ops import TABLE
from crazysim.engine.stage import stage

COPY_SIZES = {"cpu": 2**26, "gpu": 2**28}
"""Number of float32 in the copy that measures the bandwidth, larger than any cache."""

DEFAULT_WORLDS = {"cpu": 2**14, "gpu": 2**20}
"""Number of worlds of one drone that fill every core; also the default of --worlds."""

N_CHAINS, CHAIN_LENGTH = 8, 32
"""Number of independent chains of multiply-adds, and their length in one step."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", nargs="+", default=["auto"], choices=ENGINES)
    parser.add_argument("--worlds", type=int, nargs="+", help=f"by default {DEFAULT_WORLDS}")
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--integrators", nargs="+", default=["euler", "rk4"])
    parser.add_argument("--steps", type=int, nargs="+", default=[100], help="physics steps per call")
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    platform = "cpu" if args.device == "cpu" else "gpu"
    machine = Machine(
        bytes_per_s=copy_bandwidth(args.device, COPY_SIZES[platform], args.repeats),
        multiply_adds_per_s=arithmetic_rate(args.device, DEFAULT_WORLDS[platform], args.repeats),
    )
    figures = {name: round_digits(value) for name, value in machine._asdict().items()}
    report(args.device, benchmark="limits/machine", engine=fastest_engine(args.device), **figures, crazysim=__version__)
    worlds = args.worlds or [DEFAULT_WORLDS[platform]]
    for case in itertools.product(args.controls, args.integrators, worlds, args.steps, args.engine):
        measure(args, machine, *case)


class Machine(NamedTuple):
    """Measured rates of a machine."""

    bytes_per_s: float
    """Bandwidth, bytes read and written per second."""
    multiply_adds_per_s: float
    """Multiply-adds of float32 per second."""


def measure(
    args: argparse.Namespace, machine: Machine, control: str, integrator: str, n_worlds: int, n_steps: int, engine: str
) -> None:
    """Print lower bound and measured time of one case."""
    sim = Sim(n_worlds, control=control, integrator=integrator, device=args.device, engine=engine)
    flight = Flight(sim, control, n_steps, args.device)
    measured_s = medians({"step": flight.seconds}, args.repeats)["step"]
    flight.require_flying()
    step_operations, call_operations, n_bytes = count_work(sim)
    arithmetic_s = n_worlds * (step_operations * n_steps + call_operations) / machine.multiply_adds_per_s
    memory_s = n_worlds * n_bytes / machine.bytes_per_s
    report(
        args.device,
        benchmark="limits",
        engine=engine_name(sim),
        control=control,
        integrator=integrator,
        n_worlds=n_worlds,
        n_steps=n_steps,
        operations_a_step=round(step_operations),
        bytes_a_call=n_bytes,
        arithmetic_s=round_digits(arithmetic_s),
        memory_s=round_digits(memory_s),
        floor_s=round_digits(max(arithmetic_s, memory_s)),
        measured_s=round_digits(measured_s),
        ratio=round(measured_s / max(arithmetic_s, memory_s), 2),
        crazysim=__version__,
    )


def count_work(sim: Sim) -> tuple[float, float, int]:
    """Return three numbers of one drone: multiply-adds per step, multiply-adds per call, and bytes that a call moves.

    The program is taken from ``lanes`` with one world, whichever engine runs.

    Raises:
        SystemExit: If a stage is not part of the program, so that its operations cannot be counted.
    """
    reference_sim = Sim(1, control=sim.control, integrator=sim.integrator, engine="lanes")
    program = reference_sim.build_step_fn().plan(reference_sim.data).program
    assert program is not None
    if program.unfused_stages:
        stage = program.unfused_stages[0]
        raise SystemExit(f"{stage.explanation}; its operations cannot be counted. Remove the stage.")
    when_rate = sim.control_freq / sim.freq  # the only condition in the built-in pipelines is the tick of a controller
    step_operations = sum(count_operations(segment.block, when_rate) for segment in program.fused_segments)
    blocks = [s.hoisted for s in program.fused_segments] + (
        [program.check_segment.block] if program.check_segment else []
    )
    call_operations = sum(count_operations(block, when_rate) for block in blocks)
    world_leaves = [i for i, leaf in enumerate(program.leaves) if leaf.scope in ("drone", "world")]
    sizes = {i: program.leaves[i].size * program.leaves[i].number_type.itemsize for i in world_leaves}
    read_bytes, written_bytes = (
        sum(sizes[i] for i in world_leaves if i in leaves) for leaves in (program.read_leaves, program.written_leaves)
    )
    return step_operations, call_operations, read_bytes + written_bytes


def count_operations(block: Block, when_rate: float) -> float:
    """Return the operations of a block in multiply-adds.

    Args:
        block: The block.
        when_rate: Fraction of the steps at which conditional blocks run.
    """
    total = -float(_count_contracted(block))
    for op in block.operations:
        count = {"when": when_rate, "loop": dict(op.params).get("length", 1)}.get(op.name, 1)
        total += TABLE[op.name].cost + count * sum(count_operations(inner, when_rate) for inner in op.blocks)
    return total


def _count_contracted(block: Block) -> int:
    users: dict[Value, list[Operation]] = {}
    for op in block.walk():
        for x in op.args:
            if isinstance(x, Value):
                users.setdefault(x, []).append(op)
    outputs = {x for inner in block.blocks() for x in inner.outputs}
    contracted_sums: set[Value] = set()
    contracted = 0
    for op in block.operations:
        sums = {user.results[0]: user for x in op.results for user in users.get(x, []) if user.results}
        is_summed = all(user.name in ("add", "sub") and x not in contracted_sums for x, user in sums.items())
        if op.name == "mul" and op.dtype.kind == "f" and sums and is_summed and op.results[0] not in outputs:
            contracted_sums |= sums.keys()
            contracted += 1
    return contracted


def copy_bandwidth(device: str, size: int, repeats: int) -> float:
    """Return the bandwidth of an in-place copy, bytes read and written per second."""
    copy = jax.jit(lambda x: x + 1, donate_argnums=0)
    x = jax.device_put(jnp.zeros(size, jnp.float32), jax.devices(device)[0])
    n_copies = 10

    def run() -> jax.Array:
        nonlocal x
        for _ in range(n_copies):
            x = copy(x)
        return x

    seconds(run)
    return 2 * x.nbytes * n_copies / min(seconds(run) for _ in range(repeats))


class Chain(PyTree):
    """State of the chains of multiply-adds."""

    x: Array = leaf("drone", 1)
    """Current value of each chain. (n_worlds, n_drones, N_CHAINS)"""


@stage("drone")
def multiply_adds(data: Any) -> Any:
    """Advance every chain by ``CHAIN_LENGTH`` dependent multiply-adds."""
    values = [data.plugins["chain"].x[k] for k in range(N_CHAINS)]
    for _ in range(CHAIN_LENGTH):
        values = [0.99 * x + 0.01 for x in values]
    return data.replace(plugins={"chain": Chain(jnp.stack(values))})


def arithmetic_rate(device: str, n_worlds: int, repeats: int, n_steps: int = 1000) -> float:
    """Return the multiply-adds per second of a pipeline of only multiply-adds, on the fastest engine."""
    sim = Sim(n_worlds, device=device, engine=fastest_engine(device))
    sim.data = sim.data.replace(plugins={"chain": Chain(jnp.zeros((n_worlds, 1, N_CHAINS)))})
    sim.step_pipeline = {"multiply_adds": multiply_adds}
    sim.build_step_fn()

    def run() -> jax.Array:
        sim.step(n_steps)
        return sim.data.plugins["chain"].x

    seconds(run)
    return n_worlds * n_steps * N_CHAINS * CHAIN_LENGTH / min(seconds(run) for _ in range(repeats))


def fastest_engine(device: str) -> str:
    """Return the engine that reaches the arithmetic rate of the machine."""
    return "lanes" if fused.unavailable_reason("cpu" if device == "cpu" else "gpu") else "fused"


if __name__ == "__main__":
    main()
