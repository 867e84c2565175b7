"""How far from what the machine allows? A floor for each case, and the measured time over it.

The floor is the longer of two times that no program with this arithmetic can beat: that of its operations at the rate
of multiply-adds measured here, through the same engine, and that of its data, each number that a call reads or writes
moved once, at the bandwidth of a copy measured here. Both limits are the best of all repeats, the time over them is a
median. Data that fits into a cache may move faster than the copy, which does not.

Operations are counted from the program of one drone (``Plan.program``), in multiply-adds: see ``WEIGHTS``. The count
errs to the low side, so the floor does too.

    python benchmarks/limits.py [--engine auto plain lanes] [--device gpu] [--worlds 1048576] [--steps 1 10 100]
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from measure import Flight, digits, engine_of, medians, report, seconds

from crazysim import PyTree, Sim, __version__, leaf
from crazysim.core.stage import stage
from crazysim.engine import fused
from crazysim.engine.ir import Block, Value
from crazysim.engine.step import ENGINES

WEIGHTS = (
    dict.fromkeys("barrier item input eq ne lt le gt ge neg abs custom_jvp when loop while".split(), 0)
    | {"rsqrt": 2}
    | dict.fromkeys("div sqrt cbrt floor ceil round integer_pow".split(), 4)
    | dict.fromkeys("exp exp2 log rem sin cos logistic tanh".split(), 8)
    | dict.fromkeys("expm1 log1p tan asin acos atan atan2 sinh cosh asinh acosh atanh erf erfc erf_inv pow".split(), 16)
    | {"threefry2x32": 60}
)
"""What an operation costs, in multiply-adds; what is not named, 1.

Comparisons are counted with the selections that they decide (one instruction, where that is a limit), signs with what
takes them. Functions are those of hardware that approximates them and a step that refines, or the shortest polynomial
that is exact to float32; twenty rounds of add, rotate and xor make a random number. What contains a block costs as
much as that does (``operations``).
"""

BIG = {"cpu": 2**26, "gpu": 2**28}
"""Numbers of float32 in the copy that the bandwidth is measured by: beyond any cache."""

MANY = {"cpu": 2**14, "gpu": 2**20}
"""Drones, and worlds by default, that fill every core."""

CHAINS, LENGTH = 8, 32
"""Chains of multiply-adds that do not wait for each other, and how long each is in a step."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", nargs="+", default=["auto"], choices=ENGINES)
    parser.add_argument("--worlds", type=int, nargs="+", help=f"by default {MANY}")
    parser.add_argument("--controls", nargs="+", default=["rotor_vel", "attitude", "state"])
    parser.add_argument("--integrators", nargs="+", default=["euler", "rk4"])
    parser.add_argument("--steps", type=int, nargs="+", default=[100], help="physics steps a call")
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    platform = "cpu" if args.device == "cpu" else "gpu"
    machine = Machine(
        bytes_per_s=copy_bandwidth(args.device, BIG[platform], args.repeats),
        multiply_adds_per_s=arithmetic_rate(args.device, MANY[platform], args.repeats),
    )
    figures = {name: digits(value) for name, value in machine._asdict().items()}
    report(args.device, benchmark="limits/machine", engine=fastest(args.device), **figures, crazysim=__version__)
    worlds = args.worlds or [MANY[platform]]
    for case in itertools.product(args.controls, args.integrators, worlds, args.steps, args.engine):
        measure(args, machine, *case)


class Machine(NamedTuple):
    """What a machine was seen to reach."""

    bytes_per_s: float
    """Bytes read and written."""
    multiply_adds_per_s: float
    """Multiply-adds of float32."""


def measure(
    args: argparse.Namespace, machine: Machine, control: str, integrator: str, n_worlds: int, n_steps: int, engine: str
) -> None:
    """Print floor and measured time of one case."""
    sim = Sim(n_worlds, control=control, integrator=integrator, device=args.device, engine=engine)
    flight = Flight(sim, control, n_steps, args.device)
    measured = medians({"step": flight.seconds}, args.repeats)["step"]
    flight.require_flying()
    each_step, each_call, n_bytes = work(sim)
    arithmetic = n_worlds * (each_step * n_steps + each_call) / machine.multiply_adds_per_s
    memory = n_worlds * n_bytes / machine.bytes_per_s
    report(
        args.device,
        benchmark="limits",
        engine=engine_of(sim),
        control=control,
        integrator=integrator,
        n_worlds=n_worlds,
        n_steps=n_steps,
        operations_a_step=round(each_step),
        bytes_a_call=n_bytes,
        arithmetic_s=digits(arithmetic),
        memory_s=digits(memory),
        floor_s=digits(max(arithmetic, memory)),
        measured_s=digits(measured),
        ratio=round(measured / max(arithmetic, memory), 2),
        crazysim=__version__,
    )


def work(sim: Sim) -> tuple[float, float, int]:
    """Return multiply-adds of a drone's step, those of its call besides, and the bytes its call reads and writes.

    Whichever engine runs, the program is what ``lanes`` makes of the pipeline: with one world, for it is all the same.

    Raises:
        SystemExit: If a stage is not in the program, so that its work is unknown.
    """
    one = Sim(1, control=sim.control, integrator=sim.integrator, engine="lanes")
    program = one.build_step_fn().plan(one.data).program
    assert program is not None
    if any(segment.scope == "batch" for segment in program.segments):
        raise SystemExit("a stage of the pipeline is not written out; its operations cannot be counted")
    often = sim.control_freq / sim.freq  # the one condition in the built-in pipelines is the state controller's rate
    each_step = sum(operations(segment.block, often) for segment in program.segments)
    blocks = [s.before for s in program.segments if s.before] + ([program.check.block] if program.check else [])
    each_call = sum(operations(block, often) for block in blocks)
    batched = [i for i, scope in enumerate(program.axes.scopes) if scope in ("drone", "world")]
    read, written = (sum(program.leaves[i].nbytes for i in batched if i in leaves)
                     for leaves in (program.read, program.written))  # fmt: skip
    return each_step, each_call, read + written


def operations(block: Block, often: float) -> float:
    """Return the operations of a block, in multiply-adds; what a condition guards is counted as often as it acts."""
    total = -float(_contracted(block))
    for value in block.values:
        turns = {"when": often, "loop": dict(value.params).get("length", 1)}.get(value.op, 1)
        total += WEIGHTS.get(value.op, 1) + turns * sum(operations(inner, often) for inner in value.blocks)
    return total


def _contracted(block: Block) -> int:
    """Return how many products cost nothing, being taken up by the sums they go into: one by each sum."""
    users: dict[int, list[Value]] = {}
    for value in block.walk():
        for x in value.args:
            users.setdefault(id(x), []).append(value)
    kept = Counter(id(x) for inner in (block, *(b for v in block.walk() for b in v.blocks)) for x in inner.outputs)
    full: set[int] = set()
    contracted = 0
    for value in block.values:
        sums = {id(user): user for user in users.get(id(value), [])}
        fits = all(u.op in ("add", "sub") and k not in full for k, u in sums.items())
        if value.op == "mul" and value.dtype.kind == "f" and sums and fits and not kept[id(value)]:
            full |= sums.keys()
            contracted += 1
    return contracted


def copy_bandwidth(device: str, size: int, repeats: int) -> float:
    """Return bytes per second, read and written, of a copy: in place, so that no memory is asked for."""
    copy = jax.jit(lambda x: x + 1, donate_argnums=0)
    x = jax.device_put(jnp.zeros(size, jnp.float32), jax.devices(device)[0])
    times = 10

    def run() -> jax.Array:
        nonlocal x
        for _ in range(times):
            x = copy(x)
        return x

    seconds(run)
    return 2 * x.nbytes * times / min(seconds(run) for _ in range(repeats))


class Chain(PyTree):
    """Numbers to multiply and add to."""

    x: Array = leaf("drone", 1)
    """The numbers. (n_worlds, n_drones, CHAINS)"""


@stage("drone")
def multiply_adds(data: Any) -> Any:
    """Turn every number ``LENGTH`` times; what one step of a chain needs is the number before."""
    items = [data.plugins["chain"].x[k] for k in range(CHAINS)]
    for _ in range(LENGTH):
        items = [0.99 * x + 0.01 for x in items]
    return data.replace(plugins={"chain": Chain(jnp.stack(items))})


def arithmetic_rate(device: str, n_worlds: int, repeats: int, n_steps: int = 1000) -> float:
    """Return multiply-adds per second of a pipeline that does nothing else, on the fastest engine there is."""
    sim = Sim(n_worlds, device=device, engine=fastest(device))
    sim.data = sim.data.replace(plugins={"chain": Chain(jnp.zeros((n_worlds, 1, CHAINS)))})
    sim.step_pipeline = {"multiply_adds": multiply_adds}
    sim.build_step_fn()

    def run() -> jax.Array:
        sim.step(n_steps)
        return sim.data.plugins["chain"].x

    seconds(run)
    return n_worlds * n_steps * CHAINS * LENGTH / min(seconds(run) for _ in range(repeats))


def fastest(device: str) -> str:
    """Return the engine whose arithmetic is the machine's."""
    return "lanes" if fused.missing("cpu" if device == "cpu" else "gpu") else "fused"


if __name__ == "__main__":
    main()
