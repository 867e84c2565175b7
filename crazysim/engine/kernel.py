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
    """Leaves that it writes; behind them comes one bool per drone, whether it is finite."""
    n_drones: int
    """Drones of a world."""
    block: int = BLOCK
    """Threads of a block on a GPU: whole worlds."""

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


def write(program: Program, target: str, block: int = BLOCK) -> Kernel:
    """Return the source of a program for ``cuda`` or ``host``.

    Raises:
        NoRuleError: If an operation or a type has no source.
    """
    writer = Writer()
    segments = [s for s in program.segments if s.scope != "batch"]
    slots = dict.fromkeys(slot for s in segments for slot in _of_drone(program, s, [*s.reads, *s.constants]))
    written = list(dict.fromkeys(slot for s in segments for slot in _of_drone(program, s, s.writes)))
    check = program.check
    slots.update(dict.fromkeys([*written, *(check.reads if check else [])]))
    inputs = tuple(sorted({leaf for leaf, _ in slots}))
    outputs = tuple(sorted({leaf for leaf, _ in written}))
    # A leaf of which some numbers are written goes out whole.
    whole = [(leaf, k) for leaf in outputs for k in range(program.sizes(leaf))]
    slots.update(dict.fromkeys(whole))

    names = {slot: f"x{slot[0]}_{slot[1]}" for slot in slots}
    late = _used_when_needed(segments, {*written, *(check.reads if check else [])})
    for slot in slots:
        if slot in late:
            names[slot] = _load(program, slot)
            continue
        kind = type_name(_dtype(program, slot))
        access = _load(program, slot)
        changes = slot in set(written)
        writer.line(f"auto {names[slot]} = {kind}_lanes({access});" if changes
                    else f"const auto {names[slot]} = {access};", 1)  # fmt: skip
    before = [writer.block(s.before, [names[slot] for slot in s.constants], 1) if s.before else [] for s in segments]
    writer.line("for (int step = 0; step < n_steps; ++step) {", 1)
    for segment, constants in zip(segments, before, strict=True):
        _step(writer, program, segment, names, constants)
    writer.line("}", 1)
    if check is not None:
        (fine,) = writer.block(check.block, [names[slot] for slot in check.reads], 1)
        writer.line(f"STORE(finite, lane, b1_lanes({fine}))", 1)
    for slot in whole:
        writer.line(_store(program, slot, f"{type_name(_dtype(program, slot))}_lanes({names[slot]})"), 1)

    pointers = [f"const {_kind(program, i)}* __restrict__ p{i}" for i in inputs]
    pointers += [f"{_kind(program, i)}* __restrict__ q{i}" for i in outputs]
    body = "\n".join(writer.lines)
    n_drones = program.n_drones
    block = max(block // n_drones, 1) * n_drones
    frame = {"cuda": _cuda, "host": _host}[target]
    text = preamble(target) + frame(pointers, body, n_drones, block) + epilogue(target)
    return Kernel(text, inputs, outputs, n_drones, block)


def _used_when_needed(segments: Sequence[Segment], needed: set[Slot]) -> set[Slot]:
    """Return the constants that only stages below the step rate use: they are loaded there, and take no register."""
    late: set[Slot] = set()
    for segment in segments:
        block = segment.block
        now = {id(x) for v in block.values for x in v.args} | {id(x) for x in block.outputs}
        late |= {slot for x, slot in zip(block.inputs, segment.reads, strict=False) if id(x) not in now}
        needed |= {slot for x, slot in zip(block.inputs, segment.reads, strict=False) if id(x) in now}
        needed |= set(segment.constants)
    return late - needed


def _of_drone(program: Program, segment: Segment, slots: Sequence[Slot]) -> list[Slot]:
    """Return numbers of a world as numbers of its drones."""
    if segment.scope == "drone":
        return list(slots)
    return [(leaf, k % program.sizes(leaf)) if program.axes.scopes[leaf] == "drone" else (leaf, k) for leaf, k in slots]


def _step(writer: Writer, program: Program, segment: Segment, names: dict[Slot, str], constants: Sequence[str]) -> None:
    writer.line("{", 2)
    outs = writer.block(segment.block, [*(names[slot] for slot in segment.reads), *constants], 3)
    fresh = [writer.new() for _ in outs]
    for name, out in zip(fresh, outs, strict=True):
        writer.line(f"const auto {name} = {out};", 3)
    for slot, name in zip(segment.writes, fresh, strict=True):
        writer.line(f"{names[slot]} = {type_name(_dtype(program, slot))}_lanes({name});", 3)
    writer.line("}", 2)


def _dtype(program: Program, slot: Slot) -> object:
    leaf = program.leaves[slot[0]]
    return np.uint32 if is_key(leaf) else leaf.dtype


def _kind(program: Program, leaf: int) -> str:
    return type_name(_dtype(program, (leaf, 0)))


def _load(program: Program, slot: Slot) -> str:
    leaf, k = slot
    match program.axes.scopes[leaf]:
        case "drone":
            return f"LOAD(p{leaf}, lane * {program.sizes(leaf)} + {k})"
        case "world":
            return f"LOAD(p{leaf}, world * {program.sizes(leaf)} + {k})"
    return f"p{leaf}[{k}]"


def _store(program: Program, slot: Slot, value: str) -> str:
    leaf, k = slot
    if program.axes.scopes[leaf] == "world":
        return f"STORE_WORLD(q{leaf}, world * {program.sizes(leaf)} + {k}, {value})"
    return f"STORE(q{leaf}, lane * {program.sizes(leaf)} + {k}, {value})"


def _cuda(pointers: Sequence[str], body: str, n_drones: int, block: int) -> str:
    scalars = ["const int* __restrict__ sizes", "const int* __restrict__ count"]
    arguments = ", ".join([*scalars, *pointers, "b1* __restrict__ finite"])
    return f"""
#define STORE_WORLD(p, index, value) if (active && lane % {n_drones} == 0) p[index] = value;
extern "C" __global__ void __launch_bounds__({block}, {UNBOUNDED}) advance({arguments}) {{
  const int n_lanes = sizes[0], n_steps = count[0];
  const int thread = blockIdx.x * {block} + threadIdx.x;
  const bool active = thread < n_lanes;
  const int lane = active ? thread : n_lanes - 1;
  const int world = lane / {n_drones};
{body}
}}
"""


def _host(pointers: Sequence[str], body: str, n_drones: int, _block: int) -> str:
    arguments = ", ".join(pointers)
    kinds = [p.split("*")[0].removeprefix("const ") for p in pointers]
    n_in = sum(p.startswith("const") for p in pointers)
    buffers = [f"({kind}*)in[{k + 2}]->data" if k < n_in else f"({kind}*)out[{k - n_in}]->data"
               for k, kind in enumerate(kinds)]  # fmt: skip
    n_out = len(pointers) - n_in
    return f"""
static void advance_block(int64_t first, int64_t n_lanes, int n_steps, {arguments}, b1* __restrict__ finite) {{
  const int n_active = n_lanes - first < W ? int(n_lanes - first) : W;
  places lane, world;
  for (int i = 0; i < W; ++i) {{
    lane.at[i] = first + i < n_lanes ? first + i : n_lanes - 1;
    world.at[i] = lane.at[i] / {n_drones};
  }}
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
