"""One kernel for many steps: the source of a whole program, from loads to stores.

What one drone has stays in variables, registers for as long as there are enough, from the first step to the last.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
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
    """Leaves that it writes; behind them comes one bool per drone, whether its world is flagged, if that is checked."""
    in_place: tuple[int, ...] = ()
    """Leaves of rows that it reads where it then writes them: of each, input and output must be the same memory."""
    group: int = 1
    """Drones next to each other that must be in one warp or vector, for they look at each other's numbers."""

    def aliases(self) -> dict[int, int]:
        """Return which operand of a call, behind two numbers, is which of its results."""
        return {2 + self.inputs.index(i): self.outputs.index(i) for i in self.in_place}

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
        UnsupportedError: If an operation or a type has no source.
    """
    writer = Writer()
    segments, check = program.segments, program.check
    each = program.of("each")
    checked = check.reads if check else []
    written = dict.fromkeys(slot for s in segments for slot in program.own(s, s.writes))
    inside = dict.fromkeys(slot for s in segments for slot in [*program.own(s, s.reads), *s.constants])
    outputs, whole = tuple(program.written), _whole(program)
    slots = dict.fromkeys([*inside, *written, *checked, *whole])
    loaded = _loaded(program)
    inputs = needed(program)

    names = {slot: f"x{slot[0]}_{slot[1]}" for slot in slots}
    for slot in slots:
        kind, access = type_name(_dtype(program, slot)), _load(program, slot)
        if slot not in loaded:
            writer.line(f"auto {names[slot]} = {kind}_lanes({kind}(0));", 1)
        elif slot in written:
            writer.line(f"auto {names[slot]} = {kind}_lanes({access});", 1)
        elif slot not in whole and _is_late(program, slot):
            names[slot] = access
        else:
            writer.line(f"const auto {names[slot]} = {access};", 1)
    for segment in program.of("first"):
        _advance(writer, program, segment, names, [], 1)
    constants = [
        writer.block(s.before, [names[slot] for slot in s.constants], 1) if s.before is not None else [] for s in each
    ]
    writer.line("for (int step = 0; step < n_steps; ++step) {", 1)
    for segment, before in zip(each, constants, strict=True):
        _advance(writer, program, segment, names, before, 2)
    writer.line("}", 1)
    if check is not None:
        (flagged,) = writer.block(check.block, [names[slot] for slot in checked], 1)
        writer.line(f"STORE(1, 1, flagged, 0, b1_lanes({flagged}))", 1)
    for segment in program.of("last"):
        _advance(writer, program, segment, names, [], 1)
    for slot in whole:
        writer.line(_store(program, slot, f"{type_name(_dtype(program, slot))}_lanes({names[slot]})"), 1)

    pointers = [f"const {_kind(program, i)}* __restrict__ p{i}" for i in inputs]
    pointers += [f"{_kind(program, i)}* __restrict__ q{i}" for i in outputs]
    pointers += ["b1* __restrict__ flagged"] if check is not None else []
    frame = {"cuda": _cuda, "host": _host}[target]
    widest = 8 if any(_kind(program, i) == "f64" for i in (*inputs, *outputs)) else 4
    defines = f"#define WIDEST {widest}\n#define GROUP {program.group}\n"
    text = defines + preamble(target) + frame(pointers, "\n".join(writer.lines)) + epilogue(target)
    in_place = tuple(i for i in inputs if i in outputs and i in program.rows)
    return Kernel(text, inputs, outputs, in_place, program.group)


def needed(program: Program) -> tuple[int, ...]:
    """Return the leaves that a kernel reads."""
    return tuple(sorted({leaf for leaf, _ in _loaded(program)}))


def _whole(program: Program) -> list[Slot]:
    """Return what goes out: a leaf of which some numbers are written goes whole."""
    return [(leaf, k) for leaf in program.written for k in range(program.sizes(leaf))]


def _loaded(program: Program) -> set[Slot]:
    """Return the slots whose numbers at the beginning matter: they are used before they are written for certain."""
    loaded: set[Slot] = set()
    known: set[Slot] = set()

    def use(slots: Iterable[Slot]) -> None:
        loaded.update(slot for slot in slots if slot not in known)

    def run(segment: Segment) -> None:
        use(program.own(segment, segment.reads))
        drones: dict[Slot, int] = {}
        for (leaf, _), slot in zip(segment.writes, program.own(segment, segment.writes), strict=True):
            of_world = segment.scope == "world" and program.axes.scopes[leaf] == "drone"
            drones[slot] = drones.get(slot, 0) + (1 if of_world else program.n_drones)
        known.update(slot for slot, n in drones.items() if n >= program.n_drones)

    for segment in program.of("first"):
        run(segment)
    for segment in program.of("each"):  # there may be no step
        use([*program.own(segment, [*segment.reads, *segment.writes]), *segment.constants])
    if program.check is not None:
        use(program.check.reads)
    for segment in program.of("last"):
        run(segment)
    use(_whole(program))
    return loaded


def _advance(
    writer: Writer, program: Program, segment: Segment, names: dict[Slot, str], constants: Sequence[str], depth: int
) -> None:
    """Write what a segment does."""
    own = program.own(segment, segment.reads)
    inputs = [names[slot] for slot in own]
    if segment.scope == "world":  # a drone's numbers are asked of the lane that has them
        for k, (leaf, number) in enumerate(segment.reads):
            if program.axes.scopes[leaf] == "drone":
                name = writer.new()
                writer.line(f"const auto {name} = of_drone({inputs[k]}, {number // program.sizes(leaf)});", depth)
                inputs[k] = name
    outs = writer.block(segment.block, [*inputs, *constants], depth)
    fresh = [writer.new() for _ in outs]
    for name, out in zip(fresh, outs, strict=True):
        writer.line(f"const auto {name} = {out};", depth)
    for (leaf, number), slot, new in zip(segment.writes, program.own(segment, segment.writes), fresh, strict=True):
        kind, name = type_name(_dtype(program, slot)), names[slot]
        if (
            segment.scope == "world" and program.axes.scopes[leaf] == "drone"
        ):  # every lane has them all, and keeps its own
            mine = f"eq_(own, i32({number // program.sizes(leaf)}))"
            writer.line(f"{name} = select_n_({mine}, {name}, {kind}_lanes({new}));", depth)
        else:
            writer.line(f"{name} = {kind}_lanes({new});", depth)


def _is_late(program: Program, slot: Slot) -> bool:
    """Return whether only stages below the step rate, or the check behind the loop, need a number that never changes.

    It is loaded there, and takes no register.
    """
    check = program.check
    in_check = check is not None and slot in check.reads
    in_blocks = False
    for segment in program.segments:
        if slot in segment.constants:
            return False
        block = segment.block
        now = {id(x) for v in block.values for x in v.args} | {id(x) for x in block.outputs}
        for x, read in zip(block.inputs, program.own(segment, segment.reads), strict=False):
            if read == slot:
                if segment.scope == "world" or id(x) in now:
                    return False
                in_blocks = True
    return in_blocks != in_check


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
    if leaf in program.rows:
        return f"LOAD_ROW({'q' if leaf in program.written else 'p'}{leaf}, {k})"
    return f"LOAD({program.sizes(leaf)}, {_drones(program, leaf)}, p{leaf}, {k})"


def _store(program: Program, slot: Slot, value: str) -> str:
    leaf, k = slot
    if leaf in program.rows:
        return f"STORE_ROW(q{leaf}, {k}, {value})"
    return f"STORE({program.sizes(leaf)}, {_drones(program, leaf)}, q{leaf}, {k}, {value})"


def _drones(program: Program, leaf: int) -> int:
    """Return how many lanes have the same number of a leaf."""
    return program.n_drones if program.axes.scopes[leaf] == "world" else 1


def _cuda(pointers: Sequence[str], body: str) -> str:
    scalars = ["const int* __restrict__ sizes", "const int* __restrict__ count"]
    arguments = ", ".join([*scalars, *pointers])
    return f"""
extern "C" __global__ void __launch_bounds__({BLOCK}, {UNBOUNDED}) advance({arguments}) {{
  const int n_lanes = sizes[0], n_steps = count[0];
  const int thread = blockIdx.x * {BLOCK} + threadIdx.x;
  const int wanted = thread / 32 * LANES + thread % 32;
  const bool active = thread % 32 < LANES && wanted < n_lanes;
  const int lane = wanted < n_lanes ? wanted : n_lanes - 1;
  const int own = lane % GROUP;
{body}
}}
"""


def _host(pointers: Sequence[str], body: str) -> str:
    arguments = ", ".join(pointers)
    kinds = [p.split("*")[0].removeprefix("const ") for p in pointers]
    n_in = sum(p.startswith("const") for p in pointers)
    buffers = [f"({kind}*)in[{k + 2}]->data" if k < n_in else f"({kind}*)out[{k - n_in}]->data"
               for k, kind in enumerate(kinds)]  # fmt: skip
    return f"""
static void advance_block(int64_t first, int64_t n_lanes, int n_steps, {arguments}) {{
  const int n_active = n_lanes - first < LANES ? int(n_lanes - first) : LANES;
  const i32v own = numbers() % GROUP;
{body}
}}

static void advance(XLA_FFI_Buffer** in, XLA_FFI_Buffer** out) {{
  const int64_t n_lanes = *(int*)in[0]->data;
  const int n_steps = *(int*)in[1]->data;
  const auto run = [=](int64_t begin, int64_t end) {{
    for (int64_t first = begin; first < end; first += LANES)
      advance_block(first, n_lanes, n_steps, {", ".join(buffers)});
  }};
  in_parallel(n_lanes, n_steps, run);
}}
"""
