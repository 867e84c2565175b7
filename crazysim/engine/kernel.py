"""One kernel for many steps: the source of a whole program, from loads to stores.

What one drone has stays in variables, registers for as long as there are enough, from the first step to the last.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from importlib import resources

import numpy as np

from crazysim.engine.program import Program, Segment, Slot, is_key
from crazysim.engine.source import Writer, type_name

UNBOUNDED = "1 /* blocks at least */"

BLOCK = 64
"""Threads of a block on a GPU."""


@dataclasses.dataclass(frozen=True)
class Kernel:
    """Source with what goes in and what comes out."""

    text: str
    """The source."""
    inputs: tuple[int, ...]
    """Leaves that it reads."""
    outputs: tuple[int, ...]
    """Leaves that it writes; behind them comes one bool per drone, whether its world is flagged."""

    def with_blocks(self, n: int) -> Kernel:
        """Return the kernel with registers for at least ``n`` blocks on a GPU's multiprocessor at once."""
        return dataclasses.replace(self, text=self.text.replace(UNBOUNDED, f"{n}"))


def preamble(target: str) -> str:
    """Return what the types and functions of a target are."""
    files = resources.files("crazysim.engine").joinpath("targets")
    text = files.joinpath(f"{target}.h").read_text()
    return text.replace('#include "scalar.h"\n', files.joinpath("scalar.h").read_text())


def epilogue(target: str) -> str:
    """Return what makes the kernel callable."""
    if target == "cuda":
        return ""
    return resources.files("crazysim.engine").joinpath("targets", "host_call.h").read_text()


def write(program: Program, target: str) -> Kernel:
    """Return the source of a program for ``cuda`` or ``host``.

    Raises:
        NoRuleError: If an operation or a type has no source.
    """
    writer = Writer()
    (segment,) = program.segments
    slots = dict.fromkeys([*segment.reads, *segment.constants])
    written = segment.writes
    check = program.check
    slots.update(dict.fromkeys([*written, *(check.reads if check else [])]))
    inputs = tuple(sorted({leaf for leaf, _ in slots}))
    outputs = tuple(sorted({leaf for leaf, _ in written}))
    # A leaf of which some numbers are written goes out whole.
    whole = [(leaf, k) for leaf in outputs for k in range(program.sizes(leaf))]
    slots.update(dict.fromkeys(whole))

    names = {slot: f"x{slot[0]}_{slot[1]}" for slot in slots}
    checked = set(check.reads if check else [])
    # What only the check needs is loaded there, behind the loop.
    late = _used_when_needed(segment, {*written, *checked}) | (checked - {*segment.reads, *segment.constants, *whole})
    for slot in slots:
        if slot in late:
            names[slot] = _load(program, slot)
            continue
        kind = type_name(_dtype(program, slot))
        access = _load(program, slot)
        changes = slot in set(written)
        writer.line(f"auto {names[slot]} = {kind}_lanes({access});" if changes
                    else f"const auto {names[slot]} = {access};", 1)  # fmt: skip
    constants = [names[slot] for slot in segment.constants]
    before = writer.block(segment.before, constants, 1) if segment.before is not None else []
    writer.line("for (int step = 0; step < n_steps; ++step) {", 1)
    outs = writer.block(segment.block, [*(names[slot] for slot in segment.reads), *before], 2)
    fresh = [writer.new() for _ in outs]
    for name, out in zip(fresh, outs, strict=True):
        writer.line(f"const auto {name} = {out};", 2)
    for slot, name in zip(written, fresh, strict=True):
        writer.line(f"{names[slot]} = {type_name(_dtype(program, slot))}_lanes({name});", 2)
    writer.line("}", 1)
    if check is not None:
        (flagged,) = writer.block(check.block, [names[slot] for slot in check.reads], 1)
        writer.line(f"STORE(1, 1, flagged, 0, b1_lanes({flagged}))", 1)
    for slot in whole:
        writer.line(_store(program, slot, f"{type_name(_dtype(program, slot))}_lanes({names[slot]})"), 1)

    pointers = [f"const {_kind(program, i)}* __restrict__ p{i}" for i in inputs]
    pointers += [f"{_kind(program, i)}* __restrict__ q{i}" for i in outputs]
    frame = {"cuda": _cuda, "host": _host}[target]
    widest = 8 if any(_kind(program, i) == "f64" for i in (*inputs, *outputs)) else 4
    text = f"#define WIDEST {widest}\n" + preamble(target) + frame(pointers, "\n".join(writer.lines)) + epilogue(target)
    return Kernel(text, inputs, outputs)


def _used_when_needed(segment: Segment, needed: set[Slot]) -> set[Slot]:
    """Return the constants that only stages below the step rate use: they are loaded there, and take no register."""
    block = segment.block
    now = {id(x) for v in block.values for x in v.args} | {id(x) for x in block.outputs}
    pairs = list(zip(block.inputs, segment.reads, strict=False))
    needed = needed | {slot for x, slot in pairs if id(x) in now} | set(segment.constants)
    return {slot for _, slot in pairs} - needed


def _dtype(program: Program, slot: Slot) -> object:
    leaf = program.leaves[slot[0]]
    return np.uint32 if is_key(leaf) else leaf.dtype


def _kind(program: Program, leaf: int) -> str:
    return type_name(_dtype(program, (leaf, 0)))


def _load(program: Program, slot: Slot) -> str:
    leaf, k = slot
    scope = program.axes.scopes[leaf]
    if scope not in ("drone", "world"):
        return f"p{leaf}[{k}]"
    return f"LOAD({program.sizes(leaf)}, {_drones(program, leaf)}, p{leaf}, {k})"


def _store(program: Program, slot: Slot, value: str) -> str:
    leaf, k = slot
    return f"STORE({program.sizes(leaf)}, {_drones(program, leaf)}, q{leaf}, {k}, {value})"


def _drones(program: Program, leaf: int) -> int:
    """Return how many lanes have the same number of a leaf."""
    return program.n_drones if program.axes.scopes[leaf] == "world" else 1


def _cuda(pointers: Sequence[str], body: str) -> str:
    scalars = ["const int* __restrict__ sizes", "const int* __restrict__ count"]
    arguments = ", ".join([*scalars, *pointers, "b1* __restrict__ flagged"])
    return f"""
extern "C" __global__ void __launch_bounds__({BLOCK}, {UNBOUNDED}) advance({arguments}) {{
  const int n_lanes = sizes[0], n_steps = count[0];
  const int thread = blockIdx.x * {BLOCK} + threadIdx.x;
  const bool active = thread < n_lanes;
  const int lane = active ? thread : n_lanes - 1;
{body}
}}
"""


def _host(pointers: Sequence[str], body: str) -> str:
    arguments = ", ".join(pointers)
    kinds = [p.split("*")[0].removeprefix("const ") for p in pointers]
    n_in = sum(p.startswith("const") for p in pointers)
    buffers = [f"({kind}*)in[{k + 2}]->data" if k < n_in else f"({kind}*)out[{k - n_in}]->data"
               for k, kind in enumerate(kinds)]  # fmt: skip
    n_out = len(pointers) - n_in
    return f"""
static void advance_block(int64_t first, int64_t n_lanes, int n_steps, {arguments}, b1* __restrict__ flagged) {{
  const int n_active = n_lanes - first < W ? int(n_lanes - first) : W;
{body}
}}

static void advance(XLA_FFI_Buffer** in, XLA_FFI_Buffer** out) {{
  const int64_t n_lanes = *(int*)in[0]->data;
  const int n_steps = *(int*)in[1]->data;
  const auto run = [=](int64_t begin, int64_t end) {{
    for (int64_t first = begin; first < end; first += W)
      advance_block(first, n_lanes, n_steps, {", ".join(buffers)}, (b1*)out[{n_out}]->data);
  }};
  in_parallel(n_lanes, n_steps, run);
}}
"""
