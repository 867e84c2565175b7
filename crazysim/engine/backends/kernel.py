"""One kernel for many steps: the source of a program, from loads to stores.

From the first step to the last, the numbers of one drone stay in variables, which are registers if there are enough.
If a world has more coupled drones than fit into a vector, kernels on the host keep these numbers in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from crazysim.engine.backends.exchange import make_exchange
from crazysim.engine.backends.frame import Kernel, make_kernel
from crazysim.engine.backends.source import TYPE_NAMES, Writer, require_block_source, type_name
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir.blocks import Block
from crazysim.engine.ir.program import TABLE_INDEX, Program, Segment, Slot
from crazysim.engine.stage import Phase

MAX_REGISTERS = 255
"""Maximum number of registers of a GPU thread."""


def write_kernel(program: Program, target: str) -> Kernel:
    """Return the source of a program for ``cuda`` or ``host``.

    A kernel takes the number of steps as an array of one number.

    Args:
        target: ``"cuda"`` or ``"host"``.
    """
    require_source(program)
    body = KernelBody(program, target)
    hoisted = body.write_loads(MAX_REGISTERS if target == "cuda" else None)
    body.write_loop(hoisted)
    body.write_stores()

    inputs, outputs, rank = needed_leaves(program), tuple(program.written_leaves), program.ranks
    pointers = [f"const {_type_name(program, i)}* __restrict__ p{rank[i]}" for i in inputs]
    pointers += [f"{_type_name(program, i)}* __restrict__ q{rank[i]}" for i in outputs]
    pointers += ["b1* __restrict__ flagged"] if program.check_segment is not None else []
    in_place = tuple(i for i in inputs if i in outputs and i in program.rows)
    return body.finish_kernel(pointers, inputs, outputs, in_place, [s.block for s in body.step_segments])


class KernelBody:
    """The code of a kernel between its braces: loads, stages before the steps, the loop, checks and stores."""

    def __init__(self, program: Program, target: str):
        self.program, self.target = program, target
        self.exchange = make_exchange(target, program.group_size)
        self.writer = Writer(self.exchange)
        self.step_segments = [s for s in program.fused_segments if s.phase == "each"]
        self.stored_slots = _written_slots(program)
        """Slots whose numbers are stored at the end."""
        self._depth = 1 + self.exchange.depth
        self.names: dict[Slot, str] = {}
        """Expression of each number in the source."""
        self.initial_values: dict[Slot, str] = {}
        """Expression of the initial value of each number that stages write."""
        self._n_shared_lines = 0
        """Number of lines before the loop over lanes."""

    def write_loads(self, registers: int | None = None) -> list[list[str]]:
        """Write loads and the stages before the steps, and return the names of hoisted values by segment of the loop.

        Args:
            registers: Number of registers of a lane. If the kernel uses more numbers, it reads each number that all
                lanes share where it is used. None for no limit.
        """
        program, exchange, writer, names = self.program, self.exchange, self.writer, self.names
        written_slots, slots = self._collect_slots()
        is_read_at_use = registers is not None and len(slots) > registers
        loaded_slots, rank = _loaded_slots(program), program.ranks
        deferred_slots = set() if exchange.depth else _deferred_slots(program)
        names.update({(leaf, k): f"x{rank[leaf]}_{k}" for leaf, k in slots})
        shared_slots = [slot for slot in slots if program.leaves[slot[0]].scope not in ("drone", "world")]
        # Numbers that all lanes share.
        for slot in shared_slots:
            if slot[1] == TABLE_INDEX:
                names[slot] = f"p{rank[slot[0]]}"
            elif slot in self.stored_slots or not (is_read_at_use or slot in deferred_slots):
                writer.write_line(f"const auto {names[slot]} = {_load_expression(program, slot)};", 1)
            else:
                names[slot] = (
                    f"SHARED(p{rank[slot[0]]}, {slot[1]})" if is_read_at_use else _load_expression(program, slot)
                )
        self._n_shared_lines = len(writer.lines)
        exchange.open_loop(writer, 1)
        # Numbers of each lane: its rows, then their entries.
        lane_slots = [
            slot for slot in slots if slot not in shared_slots and (slot not in written_slots or slot in loaded_slots)
        ]
        for i in dict.fromkeys(i for i, _ in lane_slots if i not in program.rows):
            size, n_sharing = program.leaves[i].size, _n_sharing_lanes(program, i)
            writer.write_line(rows_line(f"p{rank[i]}", _type_name(program, i), size, n_sharing), self._depth)
        for slot in slots:
            ctype, load = _type_name(program, slot[0]), _load_expression(program, slot)
            if slot in shared_slots:
                continue
            if slot in written_slots:
                initial = load if slot in loaded_slots else f"{ctype}(0)"
                self.initial_values[slot] = f"{ctype}_lanes({initial})"
                names[slot] = exchange.define_variable(
                    writer, names[slot], ctype, self.initial_values[slot], self._depth
                )
            elif slot not in self.stored_slots and slot in deferred_slots:
                names[slot] = load
            else:
                names[slot] = exchange.define_constant(writer, names[slot], ctype, load, self._depth)
        # Stages before the steps, and what no step changes.
        self._write_phase("before")
        hoisted = [self._write_hoisted(segment) for segment in self.step_segments]
        exchange.close_loop(writer, 1)
        return hoisted

    def write_loop(self, hoisted: list[list[str]]) -> None:
        self.writer.write_line("for (int step = 0; step < n_steps; ++step) {", 1)
        self.exchange.open_loop(self.writer, 2)
        for segment, constants in zip(self.step_segments, hoisted, strict=True):
            write_segment(self.writer, self.program, segment, self.names, constants, 1 + self._depth)
        self.exchange.close_loop(self.writer, 2)
        self.writer.write_line("}", 1)

    def write_stores(self) -> None:
        """Write the check, the stages after the steps, and the stores."""
        program, writer, check = self.program, self.writer, self.program.check_segment
        self.exchange.open_loop(writer, 1)
        if check is not None:
            (flagged,) = writer.write_block(check.block, [self.names[slot] for slot in check.reads], self._depth)
            write_results(writer, "flagged", "b1", 1, [flagged], self._depth)
        self._write_phase("after")
        for leaf in program.written_leaves:
            ctype, pointer = _type_name(program, leaf), f"q{program.ranks[leaf]}"
            values = [self.names[leaf, k] for k in range(program.leaves[leaf].size)]
            if leaf in program.rows:
                for k, x in enumerate(values):
                    writer.write_line(f"STORE_ROW({pointer}, {k}, {ctype}_lanes({x}))", self._depth)
            else:
                write_results(writer, pointer, ctype, _n_sharing_lanes(program, leaf), values, self._depth)
        self.exchange.close_loop(writer, 1)

    def finish_kernel(
        self,
        pointers: Sequence[str],
        inputs: tuple[int, ...],
        outputs: tuple[int, ...],
        in_place: tuple[int, ...],
        blocks: Sequence[Block],
        n_stored: int | None = None,
    ) -> Kernel:
        """Return the kernel of the lines that were written.

        Args:
            pointers: Declarations of inputs and outputs.
            inputs: Indices of the leaves that it reads.
            outputs: Indices of the leaves that it writes.
            in_place: Indices of the leaves that it updates in place.
            blocks: Blocks of a step, whose operations are counted.
            n_stored: Numbers that each lane stores for each step; None for a kernel without backward pass.
        """
        shared, code = self.writer.lines[: self._n_shared_lines], self.writer.lines[self._n_shared_lines :]
        return make_kernel(
            self.target, pointers, shared, code, blocks, [*self.writer.tables, *self.exchange.declarations],
            inputs=inputs, outputs=outputs, in_place=in_place, group_size=self.program.group_size,
            in_memory=self.exchange.depth > 0, n_stored=n_stored,
        )  # fmt: skip

    def _collect_slots(self) -> tuple[dict[Slot, None], dict[Slot, None]]:
        program, segments = self.program, self.program.fused_segments
        written_slots = dict.fromkeys(slot for s in segments for slot in program.drone_slots(s, s.writes))
        read_slots = dict.fromkeys(
            slot for s in segments for slot in [*program.drone_slots(s, s.reads), *s.hoisted_reads]
        )
        checked_slots = program.check_segment.reads if program.check_segment else ()
        return written_slots, dict.fromkeys([*read_slots, *written_slots, *checked_slots, *self.stored_slots])

    def _write_hoisted(self, segment: Segment) -> list[str]:
        writer, define_constant = self.writer, self.exchange.define_constant
        outs = writer.write_block(segment.hoisted, [self.names[slot] for slot in segment.hoisted_reads], self._depth)
        ctypes = [type_name(x.dtype) for x in segment.hoisted.outputs]
        return [
            define_constant(writer, writer.new_name("h"), ctype, x, self._depth)
            for ctype, x in zip(ctypes, outs, strict=True)
        ]

    def _write_phase(self, phase: Phase) -> None:
        for segment in self.program.phase_segments(phase):
            write_segment(self.writer, self.program, segment, self.names, [], self._depth)


def require_source(program: Program) -> None:
    """Raise ``UnsupportedError`` if an operation or type of a program cannot be written in the source of a kernel."""
    for segment in program.fused_segments:
        require_block_source(segment.hoisted)
        require_block_source(segment.block)
        for i in {*segment.read_leaves, *segment.written_leaves}:
            leaf = program.leaves[i]
            if leaf.number_type not in TYPE_NAMES:
                cause = f"kernels have no numbers of type {leaf.number_type}, which {leaf.name} has"
                raise UnsupportedError(cause, stage=", ".join(segment.stages))


def needed_leaves(program: Program) -> tuple[int, ...]:
    return tuple(sorted({leaf for leaf, _ in _loaded_slots(program)}))


def input_leaves(program: Program) -> list[int]:
    """Return the leaves that the kernel reads, and one of the drones, whose shape gives the number of worlds."""
    in_rows = {i for leaf in program.leaves for i in leaf.row_leaves}
    leaves, needed = enumerate(program.leaves), needed_leaves(program)
    drone_leaves = [i for i, x in leaves if x.scope == "drone" and not x.row_leaves and i not in in_rows]
    return [*needed, next((i for i in drone_leaves if i in needed), drone_leaves[0])]


def _written_slots(program: Program) -> list[Slot]:
    return [(leaf, k) for leaf in program.written_leaves for k in range(program.leaves[leaf].size)]


def _loaded_slots(program: Program) -> set[Slot]:
    loaded_slots: set[Slot] = set()
    written_slots: set[Slot] = set()

    def use_slots(slots: Iterable[Slot]) -> None:
        loaded_slots.update(slot for slot in slots if slot not in written_slots)

    def run_segment(segment: Segment) -> None:
        use_slots(program.drone_slots(segment, segment.reads))
        n_written: dict[Slot, int] = {}
        for (leaf, _), slot in zip(segment.writes, program.drone_slots(segment, segment.writes), strict=True):
            is_one_drone = segment.scope == "world" and program.leaves[leaf].scope == "drone"
            n_written[slot] = n_written.get(slot, 0) + (1 if is_one_drone else program.n_drones)
        written_slots.update(slot for slot, n in n_written.items() if n >= program.n_drones)

    for segment in program.phase_segments("before"):
        run_segment(segment)
    for segment in program.phase_segments("each"):  # writes too: with zero steps the initial numbers are stored
        use_slots([*program.drone_slots(segment, [*segment.reads, *segment.writes]), *segment.hoisted_reads])
    if program.check_segment is not None:
        use_slots(program.check_segment.reads)
    for segment in program.phase_segments("after"):
        run_segment(segment)
    use_slots(_written_slots(program))
    return loaded_slots


def write_segment(
    writer: Writer, program: Program, segment: Segment, names: dict[Slot, str], constants: Sequence[str], depth: int
) -> None:
    """Write the operations of a segment, and assign the results to the variables of the numbers that it writes.

    Args:
        names: Expression of each number.
        constants: Expressions of the hoisted numbers.
        depth: Depth of the lines.
    """
    inputs = [names[slot] for slot in program.drone_slots(segment, segment.reads)]
    if segment.scope == "world":  # the numbers of each drone are read from its lane
        for k, (leaf, number) in enumerate(segment.reads):
            if program.leaves[leaf].scope == "drone":
                name = writer.new_name()
                writer.write_line(
                    f"const auto {name} = read_drone({inputs[k]}, {number // program.leaves[leaf].size});", depth
                )
                inputs[k] = name
    outs = writer.write_block(segment.block, [*inputs, *constants], depth)
    new_names = [writer.new_name() for _ in outs]
    for name, value in zip(new_names, outs, strict=True):
        writer.write_line(f"const auto {name} = {value};", depth)
    for (leaf, number), slot, new_name in zip(
        segment.writes, program.drone_slots(segment, segment.writes), new_names, strict=True
    ):
        ctype, name = _type_name(program, leaf), names[slot]
        if segment.scope == "world" and program.leaves[leaf].scope == "drone":  # every lane computes all drones
            is_own_drone = f"eq_(own_drone, i32({number // program.leaves[leaf].size}))"
            writer.write_line(f"{name} = select_n_({is_own_drone}, {name}, {ctype}_lanes({new_name}));", depth)
        else:
            writer.write_line(f"{name} = {ctype}_lanes({new_name});", depth)


def _deferred_slots(program: Program) -> set[Slot]:
    # Unless a stage writes them, they are loaded where they are used, and take no register in between.
    slots_of_ticks: set[Slot] = set()
    slots_of_each_step: set[Slot] = set()
    for segment in program.fused_segments:
        block = segment.block
        used_at_each_step = {x for op in block.operations for x in op.args} | set(block.outputs)
        used_at_each_step = used_at_each_step.union(
            *(x.used_values() for op in block.operations if op.name == "over_others" for x in op.blocks)
        )
        slots_of_each_step.update(segment.hoisted_reads)
        for x, slot in zip(block.inputs, program.drone_slots(segment, segment.reads), strict=False):
            (slots_of_each_step if segment.scope == "world" or x in used_at_each_step else slots_of_ticks).add(slot)
    slots_of_check = set(program.check_segment.reads) if program.check_segment is not None else set()
    return (slots_of_ticks ^ slots_of_check) - slots_of_each_step


def _type_name(program: Program, leaf: int) -> str:
    return type_name(program.leaves[leaf].number_type)


def _load_expression(program: Program, slot: Slot) -> str:
    (leaf, k), rank = slot, program.ranks[slot[0]]
    if program.leaves[leaf].scope not in ("drone", "world"):
        return f"p{rank}[{k}]"
    if leaf in program.rows:
        return f"LOAD_ROW({'q' if leaf in program.written_leaves else 'p'}{rank}, {k})"
    return f"LOAD({program.leaves[leaf].size}, {_n_sharing_lanes(program, leaf)}, p{rank}, {k})"


def rows_line(pointer: str, ctype: str, size: int, n_sharing: int = 1) -> str:
    """Return the source line that locates the row of each lane in an input. It precedes the loads.

    Args:
        pointer: The input.
        ctype: Type of its numbers.
        size: Numbers of a row.
        n_sharing: Number of lanes that share a row.
    """
    return f"ROWS({ctype}, {size}, {n_sharing}, {pointer})"


def write_results(writer: Writer, pointer: str, ctype: str, n_sharing: int, values: Sequence[str], depth: int) -> None:
    """Write the stores of all numbers of an output.

    Args:
        pointer: The output.
        ctype: Type of its numbers.
        n_sharing: Number of lanes that share the same numbers.
        values: Expressions of the numbers of a lane.
        depth: Depth of the lines.
    """
    size = len(values)
    writer.write_line(f"DECLARE_RESULT({ctype}, {size}, {pointer})", depth)
    for k, x in enumerate(values):
        writer.write_line(f"STORE({size}, {n_sharing}, {pointer}, {k}, {ctype}_lanes({x}))", depth)
    writer.write_line(f"STORE_RESULT({size}, {n_sharing}, {pointer})", depth)


def _n_sharing_lanes(program: Program, leaf: int) -> int:
    return program.n_drones if program.leaves[leaf].scope == "world" else 1
