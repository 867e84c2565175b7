"""One kernel for many steps: the source of a program, from loads to stores.

The numbers of one drone stay in variables, which are registers as long as there are enough, from the first step to
the last.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from importlib import resources

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.program import TABLE, Phase, Program, Segment, Slot
from crazysim.engine.source import TYPES, Writer, require, type_name

UNBOUNDED = "1 /* blocks at least */"

BLOCK = 64
"""Threads of a block on a GPU."""


@dataclasses.dataclass(frozen=True)
class Kernel:
    """Source, with its inputs and outputs."""

    text: str
    """The source."""
    inputs: tuple[int, ...]
    """Leaves that it reads."""
    outputs: tuple[int, ...]
    """Leaves that it writes; behind them comes one bool per drone, whether its world is flagged, if that is checked."""
    in_place: tuple[int, ...] = ()
    """Leaves of rows that it updates in place: input and output of each must be the same memory."""
    group: int = 1
    """Neighbouring drones that must be in one warp or vector, because they read each other's numbers."""
    samples: tuple[int, ...] = ()
    """Leaves of which it also writes samples, behind all other outputs."""

    def aliases(self) -> dict[int, int]:
        """Return the result that each operand in place is, by number; two numbers precede the operands."""
        return {2 + self.inputs.index(i): self.outputs.index(i) for i in self.in_place}

    def with_blocks(self, n: int) -> Kernel:
        """Return the kernel with registers for at least ``n`` blocks on a GPU's multiprocessor at once."""
        return dataclasses.replace(self, text=self.text.replace(UNBOUNDED, f"{n}"))


def preamble(target: str) -> str:
    """Return the types and functions of a target."""
    files = resources.files("crazysim.engine").joinpath("targets")
    text = files.joinpath(f"{target}.h").read_text()
    return text.replace('#include "scalar.h"\n', files.joinpath("scalar.h").read_text())


def epilogue(target: str) -> str:
    """Return the code through which a target calls the kernel."""
    if target == "cuda":
        return ""
    return resources.files("crazysim.engine").joinpath("targets", "host_call.h").read_text()


def write(program: Program, target: str, samples: Sequence[int] = ()) -> Kernel:
    """Return the source of a program for ``cuda`` or ``host``.

    A kernel takes the number of steps as an array of one number. One that writes samples takes a second number, and
    repeats the steps that often: after each repetition it writes the sampled leaves.

    Args:
        program: The program.
        target: ``"cuda"`` or ``"host"``.
        samples: Leaves of drones or worlds to sample, which the program writes.

    Raises:
        UnsupportedError: If there is no source for an operation or a type; the error names the stage.
    """
    _require(program)
    writer = Writer()
    check = program.check
    segments = program.fused_segments
    each = [s for s in segments if s.phase == "each"]
    checked = check.reads if check else ()
    written = dict.fromkeys(slot for s in segments for slot in program.per_drone(s, s.writes))
    inside = dict.fromkeys(slot for s in segments for slot in [*program.per_drone(s, s.reads), *s.hoisted_reads])
    outputs, stored = tuple(program.written), _stored(program)
    slots = dict.fromkeys([*inside, *written, *checked, *stored])
    loaded = _loaded(program)
    inputs = needed(program)

    names = {slot: f"x{slot[0]}_{slot[1]}" for slot in slots}
    for slot in slots:
        kind, access = _type(program, slot[0]), _load(program, slot)
        if slot[1] == TABLE:
            names[slot] = f"p{slot[0]}"
        elif slot not in loaded:
            writer.line(f"auto {names[slot]} = {kind}_lanes({kind}(0));", 1)
        elif slot in written:
            writer.line(f"auto {names[slot]} = {kind}_lanes({access});", 1)
        elif slot not in stored and _is_deferred(program, slot):
            names[slot] = access
        else:
            writer.line(f"const auto {names[slot]} = {access};", 1)
    _write_phase(writer, program, "first", names, 1)
    hoisted = [writer.block(s.hoisted, [names[slot] for slot in s.hoisted_reads], 1) for s in each]
    if samples:
        writer.line("for (int sample = 0; sample < n_samples; ++sample) {", 1)
    writer.line("for (int step = 0; step < n_steps; ++step) {", 1)
    for segment, constants in zip(each, hoisted, strict=True):
        _write_segment(writer, program, segment, names, constants, 2)
    writer.line("}", 1)
    for leaf in samples:
        kind, size, n_drones = _type(program, leaf), program.leaves[leaf].size, _drones(program, leaf)
        writer.line(f"{kind}* const r{leaf} = s{leaf} + sample * (n_lanes / {n_drones} * {size}ll);", 1)
        for k in range(size):
            writer.line(f"STORE({size}, {n_drones}, r{leaf}, {k}, {kind}_lanes({names[leaf, k]}))", 1)
    if samples:
        writer.line("}", 1)
    if check is not None:
        (flagged,) = writer.block(check.block, [names[slot] for slot in checked], 1)
        writer.line(f"STORE(1, 1, flagged, 0, b1_lanes({flagged}))", 1)
    _write_phase(writer, program, "last", names, 1)
    for slot in stored:
        writer.line(_store(program, slot, f"{_type(program, slot[0])}_lanes({names[slot]})"), 1)

    pointers = [f"const {_type(program, i)}* __restrict__ p{i}" for i in inputs]
    pointers += [f"{_type(program, i)}* __restrict__ q{i}" for i in outputs]
    pointers += ["b1* __restrict__ flagged"] if check is not None else []
    pointers += [f"{_type(program, i)}* __restrict__ s{i}" for i in samples]
    frame = {"cuda": _cuda, "host": _host}[target]
    widest = 8 if any(_type(program, i) == "f64" for i in (*inputs, *outputs)) else 4
    n_operations = sum(s.n_operations for s in each)
    defines = f"#define WIDEST {widest}\n#define GROUP {program.group}\n#define OPERATIONS {n_operations}\n"
    defines += f"#define SAMPLES {'count[1]' if samples else 1}\n"
    tables = "".join(f"{line}\n" for line in writer.tables)
    text = defines + preamble(target) + tables + frame(pointers, "\n".join(writer.lines)) + epilogue(target)
    in_place = tuple(i for i in inputs if i in outputs and i in program.rows)
    return Kernel(text, inputs, outputs, in_place, program.group, tuple(samples))


def _require(program: Program) -> None:
    """Check that a program has source.

    Raises:
        UnsupportedError: If it has none; the error names the stage.
    """
    for segment in program.fused_segments:
        require(segment.hoisted)
        require(segment.block)
        for i in {*segment.read, *segment.written}:
            leaf = program.leaves[i]
            if leaf.number not in TYPES:
                why = f"kernels have no numbers of type {leaf.number}, which {leaf.name} has"
                raise UnsupportedError(why, stage=", ".join(segment.stages))


def needed(program: Program) -> tuple[int, ...]:
    """Return the leaves that a kernel reads."""
    return tuple(sorted({leaf for leaf, _ in _loaded(program)}))


def _stored(program: Program) -> list[Slot]:
    """Return the numbers that a kernel writes: all of a leaf of which some are written."""
    return [(leaf, k) for leaf in program.written for k in range(program.leaves[leaf].size)]


def _loaded(program: Program) -> set[Slot]:
    """Return the slots whose numbers at the beginning matter: they are used before they are written for certain."""
    loaded: set[Slot] = set()
    known: set[Slot] = set()

    def use(slots: Iterable[Slot]) -> None:
        loaded.update(slot for slot in slots if slot not in known)

    def run(segment: Segment) -> None:
        use(program.per_drone(segment, segment.reads))
        drones: dict[Slot, int] = {}
        for (leaf, _), slot in zip(segment.writes, program.per_drone(segment, segment.writes), strict=True):
            of_world = segment.scope == "world" and program.leaves[leaf].scope == "drone"
            drones[slot] = drones.get(slot, 0) + (1 if of_world else program.n_drones)
        known.update(slot for slot, n in drones.items() if n >= program.n_drones)

    for segment in program.of("first"):
        run(segment)
    for segment in program.of("each"):  # there may be no step
        use([*program.per_drone(segment, [*segment.reads, *segment.writes]), *segment.hoisted_reads])
    if program.check is not None:
        use(program.check.reads)
    for segment in program.of("last"):
        run(segment)
    use(_stored(program))
    return loaded


def _write_phase(writer: Writer, program: Program, phase: Phase, names: dict[Slot, str], depth: int) -> None:
    for segment in program.of(phase):
        _write_segment(writer, program, segment, names, [], depth)


def _write_segment(
    writer: Writer, program: Program, segment: Segment, names: dict[Slot, str], constants: Sequence[str], depth: int
) -> None:
    inputs = [names[slot] for slot in program.per_drone(segment, segment.reads)]
    if segment.scope == "world":  # a drone's numbers come from its lane
        for k, (leaf, number) in enumerate(segment.reads):
            if program.leaves[leaf].scope == "drone":
                name = writer.new()
                writer.line(f"const auto {name} = of_drone({inputs[k]}, {number // program.leaves[leaf].size});", depth)
                inputs[k] = name
    outs = writer.block(segment.block, [*inputs, *constants], depth)
    fresh = [writer.new() for _ in outs]
    for name, out in zip(fresh, outs, strict=True):
        writer.line(f"const auto {name} = {out};", depth)
    for (leaf, number), slot, new in zip(
        segment.writes, program.per_drone(segment, segment.writes), fresh, strict=True
    ):
        kind, name = _type(program, leaf), names[slot]
        if segment.scope == "world" and program.leaves[leaf].scope == "drone":  # every lane computes all of them
            mine = f"eq_(own, i32({number // program.leaves[leaf].size}))"
            writer.line(f"{name} = select_n_({mine}, {name}, {kind}_lanes({new}));", depth)
        else:
            writer.line(f"{name} = {kind}_lanes({new});", depth)


def _is_deferred(program: Program, slot: Slot) -> bool:
    """Return True where only stages below the step rate, or the check behind the loop, use a number that never changes.

    It is loaded there, and takes no register in between.
    """
    check = program.check
    in_check = check is not None and slot in check.reads
    in_blocks = False
    for segment in program.fused_segments:
        if slot in segment.hoisted_reads:
            return False
        block = segment.block
        now = {x for op in block.operations for x in op.args} | set(block.outputs)
        for x, read in zip(block.inputs, program.per_drone(segment, segment.reads), strict=False):
            if read == slot:
                if segment.scope == "world" or x in now:
                    return False
                in_blocks = True
    return in_blocks != in_check


def _type(program: Program, leaf: int) -> str:
    return type_name(program.leaves[leaf].number)


def _load(program: Program, slot: Slot) -> str:
    leaf, k = slot
    if program.leaves[leaf].scope not in ("drone", "world"):
        return f"p{leaf}[{k}]"
    if leaf in program.rows:
        return f"LOAD_ROW({'q' if leaf in program.written else 'p'}{leaf}, {k})"
    return f"LOAD({program.leaves[leaf].size}, {_drones(program, leaf)}, p{leaf}, {k})"


def _store(program: Program, slot: Slot, value: str) -> str:
    leaf, k = slot
    if leaf in program.rows:
        return f"STORE_ROW(q{leaf}, {k}, {value})"
    return f"STORE({program.leaves[leaf].size}, {_drones(program, leaf)}, q{leaf}, {k}, {value})"


def _drones(program: Program, leaf: int) -> int:
    """Return how many lanes have the same number of a leaf."""
    return program.n_drones if program.leaves[leaf].scope == "world" else 1


def _cuda(pointers: Sequence[str], body: str) -> str:
    scalars = ["const int* __restrict__ sizes", "const int* __restrict__ count"]
    arguments = ", ".join([*scalars, *pointers])
    return f"""
extern "C" __global__ void __launch_bounds__({BLOCK}, {UNBOUNDED}) advance({arguments}) {{
  const int n_lanes = sizes[0], n_steps = count[0], n_samples = SAMPLES;
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
static void advance_block(int64_t first, int64_t n_lanes, int n_steps, int n_samples, {arguments}) {{
  const int n_active = n_lanes - first < LANES ? int(n_lanes - first) : LANES;
  const i32v own = numbers() % GROUP;
{body}
}}

static void advance(XLA_FFI_Buffer** in, XLA_FFI_Buffer** out) {{
  const int64_t n_lanes = *(int*)in[0]->data;
  const int* count = (int*)in[1]->data;
  const int n_steps = count[0], n_samples = SAMPLES;
  const auto run = [=](int64_t begin, int64_t end) {{
    for (int64_t first = begin; first < end; first += LANES)
      advance_block(first, n_lanes, n_steps, n_samples, {", ".join(buffers)});
  }};
  in_parallel(n_lanes, int64_t(n_steps) * n_samples, run);
}}
"""
