"""Reverse mode of many steps in one kernel, which turns cotangents after the steps into cotangents before the steps.

The kernel recomputes the steps, stores the state before each step, and goes back from the last step to the first. If
there are more steps than fit in memory, they are split into intervals of ``interval`` steps. It first stores only the
state before each interval, and recomputes the steps of an interval before it goes back through them. Every drone has
its own cotangent of every number; the caller sums the cotangents of leaves that drones share.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from crazysim.engine.backends import kernel
from crazysim.engine.backends.exchange import MAX_DRONES_IN_VECTOR
from crazysim.engine.backends.frame import Kernel
from crazysim.engine.backends.kernel import KernelBody
from crazysim.engine.backends.source import type_name
from crazysim.engine.errors import LimitError
from crazysim.engine.ir.blocks import Block, Builder, Value, constant, inline
from crazysim.engine.ir.program import Leaf, Program, Segment, Slot
from crazysim.engine.lowering.activity import changed_slots, prepare_derivative
from crazysim.engine.lowering.transpose import transpose_block


@dataclasses.dataclass(frozen=True, eq=False)
class ReverseProgram:
    """Transposed derivatives of the segments of a program."""

    program: Program
    """The program without check, with further leaves for the cotangents of every drone."""
    n_leaves: int
    """Number of leaves of the program before the leaves of cotangents."""
    perturbed: tuple[int, ...]
    """Indices of the leaves whose cotangents are computed."""
    backward_segments: dict[Segment, Segment]
    """Segments of the backward pass, by the forward segment."""
    backward_hoisted_segments: dict[Segment, Segment]
    """Segments of the backward pass through hoisted blocks, by the forward segment."""
    carry: tuple[Slot, ...]
    """State of the loop over the steps: numbers that a step uses and that steps change."""
    restored: frozenset[Slot]
    """Slots of ``carry`` whose numbers the backward pass through a step needs."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Indices of the leaves whose cotangents are inputs: the floats that the program writes."""
        return tuple(i for i in self.program.written_leaves if self.program.leaves[i].number_type.kind == "f")

    def slots(self) -> list[Slot]:
        numbers = [(i, k) for i in {*self.seeds, *self.perturbed} for k in range(self.program.leaves[i].size)]
        ct_slots = {(self.n_leaves + i, k) for i, k in numbers}
        for s in (*self.backward_segments.values(), *self.backward_hoisted_segments.values()):
            slots = self.program.drone_slots(s, [*s.reads, *s.writes])
            ct_slots.update(slot for slot in slots if slot[0] >= self.n_leaves)
        return sorted(ct_slots)


def reverse_program(program: Program, perturbed: Collection[int]) -> ReverseProgram:
    """Return the transposed derivatives of a program that one kernel can run.

    Args:
        perturbed: Leaves whose cotangents are computed; only floats have cotangents.

    Raises:
        UnsupportedError: If a part of the program has no derivative in a kernel.
    """
    program, perturbed = prepare_derivative(program, perturbed)
    n_leaves = len(program.leaves)
    # Leaves for the cotangents of leaves and of hoisted numbers.
    cotangents = [Leaf(f"cotangent of {x.name}", "drone", (1, 1, x.size), x.number_type) for x in program.leaves]
    step_segments = [s for s in program.fused_segments if s.phase == "each"]
    hoisted = [
        Leaf("cotangents of hoisted numbers", "drone", (1, 1, len(s.hoisted.outputs)), _float_type(s.hoisted))
        for s in step_segments
    ]
    extended_program = dataclasses.replace(program, leaves=(*program.leaves, *cotangents, *hoisted))
    # Transposed segments of stages, then of hoisted operations.
    changed, hoisted_indices = changed_slots(program, perturbed)
    backward_segments = {}
    for s in program.fused_segments:
        hoisted_leaf = 2 * n_leaves + step_segments.index(s) if s in step_segments else -1
        backward_segments[s] = _reverse_segment(
            extended_program, n_leaves, s, changed, hoisted_indices.get(s, ()), hoisted_leaf
        )
    backward_hoisted_segments = {
        s: _reverse_hoisted(n_leaves, s, changed, hoisted_indices[s], 2 * n_leaves + k)
        for k, s in enumerate(step_segments)
        if hoisted_indices[s]
    }
    # Numbers that steps change, and those that the way back reads.
    used_by_steps = {slot for s in step_segments for slot in program.drone_slots(s, [*s.reads, *s.writes])}
    changing = program.changing_slots()
    if len(step_segments) == 1 and step_segments[0].scope == "drone":
        used_by_steps = set(step_segments[0].reads)
    carry = tuple(sorted(used_by_steps & changing))
    restored = {
        slot
        for s in (*(backward_segments[s] for s in step_segments), *step_segments[:-1])
        for slot in _used_slots(extended_program, s)
    }
    return ReverseProgram(
        extended_program,
        n_leaves,
        perturbed,
        backward_segments,
        backward_hoisted_segments,
        carry,
        frozenset(restored.intersection(carry)),
    )


def _used_slots(program: Program, s: Segment) -> list[Slot]:
    used_values, slots = s.block.used_values(), program.drone_slots(s, s.reads)
    return [slot for x, slot in zip(s.block.inputs, slots, strict=False) if x in used_values]


def _float_type(block: Block) -> np.dtype:
    return next((x.dtype for x in block.outputs if x.dtype.kind == "f"), np.dtype(np.float32))


def _reverse_segment(
    program: Program, n_leaves: int, s: Segment, changed: set[Slot], hoisted_indices: Sequence[int], hoisted_leaf: int
) -> Segment:
    # In a segment of worlds, each drone has its own cotangents of the world's numbers. The returned segment sums the
    # cotangents of the written numbers over the drones, and adds its results to the cotangents of the first drone.
    n_drones, is_world_segment = program.n_drones, s.scope == "world"
    reads = program.drone_slots(s, s.reads)
    input_indices = [k for k, (x, slot) in enumerate(zip(s.block.inputs, reads, strict=False))
              if slot in changed and x.dtype.kind == "f" and not x.size]  # fmt: skip
    hoisted_input_indices = [len(reads) + k for k in hoisted_indices]
    float_outputs = [k for k, x in enumerate(s.block.outputs) if x.dtype.kind == "f"]
    pullback = transpose_block(s.block, [s.block.inputs[k] for k in (*input_indices, *hoisted_input_indices)])
    n_inputs = len(s.block.inputs)

    def cotangent_slots(slot: Slot) -> list[Slot]:
        # In a segment of worlds, a number that drones share has one cotangent for each drone. Other numbers have one.
        i, k = slot
        if not is_world_segment or program.leaves[i].scope == "drone":
            return [(n_leaves + i, k)]
        return [(n_leaves + i, d * program.leaves[i].size + k) for d in range(n_drones)]

    builder = Builder(stage=f"gradient of {', '.join(s.stages)}")
    ct_inputs: dict[Slot, Value] = {}
    ct_outputs: dict[Slot, object] = {}

    def read_cotangent(slot: Slot, dtype: np.dtype) -> Value:
        if slot not in ct_inputs:
            ct_inputs[slot] = builder.input(dtype)
        return ct_inputs[slot]

    def sum_copies(slot: Slot, dtype: np.dtype) -> object:
        copies = [read_cotangent(c, dtype) for c in cotangent_slots(slot)]
        result: object = copies[0]
        for x in copies[1:]:
            result = builder.add("add", (result, x), dtype)
        return result

    primal = [builder.input(x.dtype, x.size) for x in s.block.inputs]
    seeds = [sum_copies(s.writes[k], s.block.outputs[k].dtype) for k in float_outputs]
    contributions = inline(builder, pullback, dict(zip(pullback.inputs, [*primal, *seeds], strict=True)))
    # The segment overwrites these numbers, so the numbers after it depend on the old ones only through its inputs.
    for k in float_outputs:
        zero = constant(0, s.block.outputs[k].dtype)
        ct_outputs.update(dict.fromkeys(cotangent_slots(s.writes[k]), zero))
    for k, contribution in zip(input_indices, contributions, strict=False):
        ct_slot, dtype = cotangent_slots(s.reads[k])[0], s.block.inputs[k].dtype
        old_ct = ct_outputs[ct_slot] if ct_slot in ct_outputs else read_cotangent(ct_slot, dtype)
        ct_outputs[ct_slot] = builder.add("add", (old_ct, contribution), dtype)
    for k, contribution in zip(hoisted_indices, contributions[len(input_indices) :], strict=True):
        ct_slot, dtype = (hoisted_leaf, k), s.block.inputs[len(reads) + k].dtype
        ct_outputs[ct_slot] = builder.add("add", (read_cotangent(ct_slot, dtype), contribution), dtype)
    read_inputs, hoisted_inputs = primal[: len(reads)], primal[len(reads) : n_inputs]
    block = Block(
        (*read_inputs, *ct_inputs.values(), *hoisted_inputs), tuple(builder.operations), tuple(ct_outputs.values())
    )
    return Segment(s.scope, s.stages, s.phase, block, (*s.reads, *ct_inputs), tuple(ct_outputs))


def _reverse_hoisted(
    n_leaves: int, s: Segment, changed: set[Slot], hoisted_indices: Sequence[int], hoisted_leaf: int
) -> Segment:
    reads = s.hoisted_reads
    input_indices = [k for k, (x, slot) in enumerate(zip(s.hoisted.inputs, reads, strict=True))
              if slot in changed and x.dtype.kind == "f"]  # fmt: skip
    pullback = transpose_block(s.hoisted, [s.hoisted.inputs[k] for k in input_indices])
    builder = Builder(stage=f"gradient of {', '.join(s.stages)}")
    primal = [builder.input(x.dtype, x.size) for x in s.hoisted.inputs]
    seeds, ct_slots = [], []
    for k, x in enumerate(s.hoisted.outputs):
        if x.dtype.kind == "f" and k in hoisted_indices:
            seeds.append(builder.input(x.dtype))
            ct_slots.append((hoisted_leaf, k))
        elif x.dtype.kind == "f":
            seeds.append(constant(0, x.dtype))
    old_cts = [builder.input(s.hoisted.inputs[k].dtype) for k in input_indices]
    cts = [x for x in seeds if isinstance(x, Value)]
    contributions = inline(builder, pullback, dict(zip(pullback.inputs, [*primal, *seeds], strict=True)))
    sums = [builder.add("add", (a, b), a.dtype) for a, b in zip(old_cts, contributions, strict=True)]
    targets = tuple((n_leaves + reads[k][0], reads[k][1]) for k in input_indices)
    block = Block((*primal, *cts, *old_cts), tuple(builder.operations), tuple(sums))
    return Segment("drone", s.stages, "each", block, (*reads, *ct_slots, *targets), targets)


def needed_leaves(reverse: ReverseProgram) -> tuple[int, ...]:
    """Return the leaves that the kernel reads. Its further inputs are the cotangents of ``seeds``."""
    return kernel.needed_leaves(reverse.program)


def write_kernel(reverse: ReverseProgram, target: str) -> Kernel:
    """Return the source of the reverse-mode kernel.

    Its inputs are the leaves that the program needs, then the cotangents of the floats that it writes. Its outputs are
    the cotangents of the perturbed leaves, for every drone.

    Args:
        target: ``"cuda"`` or ``"host"``.
    """
    program, n = reverse.program, reverse.n_leaves
    if target == "host" and program.group_size > MAX_DRONES_IN_VECTOR:
        raise LimitError(
            f"gradients of worlds of more than {MAX_DRONES_IN_VECTOR} drones that act on each other have no kernel"
        )
    program_to_check = dataclasses.replace(program, segments=(*program.segments, *reverse.backward_segments.values()))
    kernel.require_source(program_to_check)
    kernel_body = KernelBody(program, target)
    writer, rank = kernel_body.writer, program.ranks
    constants = kernel_body.write_loads()
    names = kernel_body.names

    def slot_type(slot: Slot) -> str:
        if slot[0] >= 2 * n:
            s = [s for s in program.fused_segments if s.phase == "each"][slot[0] - 2 * n]
            return type_name(s.hoisted.outputs[slot[1]].dtype)
        return type_name(program.leaves[slot[0]].number_type)

    # Cotangents: given ones of the seeds, else zeros.
    for i in reverse.seeds:
        writer.write_line(
            kernel.rows_line(f"s{rank[i]}", type_name(program.leaves[i].number_type), program.leaves[i].size), 1
        )
    for i, k in reverse.slots():
        primal_leaf = i - n
        name = f"g{i - 2 * n}_{k}" if i >= 2 * n else f"c{rank[primal_leaf]}_{k}"
        seed = f"{slot_type((i, k))}(0)"
        if i < 2 * n and primal_leaf in reverse.seeds:
            seed = f"LOAD({program.leaves[primal_leaf].size}, 1, s{rank[primal_leaf]}, {k})"
        writer.write_line(f"auto {name} = {slot_type((i, k))}_lanes({seed});", 1)
        names[i, k] = name

    carry = reverse.carry
    types = [type_name(program.leaves[i].number_type) for i, _ in carry]

    def write_states(state: str, slots: Collection[Slot], depth: int) -> None:
        for k, (slot, ctype) in enumerate(zip(carry, types, strict=True)):
            if slot in slots:
                writer.write_line(f"STORE_STATE({ctype}, {state}, {k}, {names[slot]})", depth)

    last_segments, step_segments, first_segments = (
        program.phase_segments(phase) for phase in ("after", "each", "before")
    )
    writer.write_line("const int n_intervals = n_steps > 0 ? (n_steps + interval - 1) / interval : 1;", 1)
    writer.write_line("for (int visit = 0; visit < 2 * n_intervals - 1; ++visit) {", 1)  # forward, then back
    writer.write_line("const bool is_backward = visit >= n_intervals - 1;", 2)
    writer.write_line("const int part = is_backward ? 2 * (n_intervals - 1) - visit : visit;", 2)
    writer.write_line("const int n_left = n_steps - part * interval;", 2)
    writer.write_line("const int n_part_steps = n_left < interval ? n_left : interval;", 2)
    writer.write_line("if (visit < n_intervals) {", 2)
    write_states("interval + part", carry, 3)
    writer.write_line("}", 2)
    # Forward: steps of an interval, whose states are stored.
    writer.write_line("for (int step = 0; step < n_part_steps; ++step) {", 2)
    write_states("step", reverse.restored, 3)
    if not last_segments:  # without stages after the steps, the result of the last step is not needed
        writer.write_line("if (is_backward && step == n_part_steps - 1) break;", 3)
    for segment, segment_constants in zip(step_segments, constants, strict=True):
        kernel.write_segment(writer, program, segment, names, segment_constants, 3)
    writer.write_line("}", 2)
    writer.write_line("if (!is_backward) continue;", 2)
    # Backward: stages after the steps, then the steps.
    if last_segments:
        writer.write_line("if (part == n_intervals - 1) {", 2)
        _write_backward(kernel_body, reverse, last_segments, [()] * len(last_segments), dict(names), 3)
        writer.write_line("}", 2)
    writer.write_line("for (int step = n_part_steps - 1; step >= 0; --step) {", 2)
    names_before = dict(names)
    for k, (slot, ctype) in enumerate(zip(carry, types, strict=True)):
        if slot not in reverse.restored:
            continue
        names_before[slot] = writer.new_name("b")
        writer.write_line(f"const auto {names_before[slot]} = LOAD_STATE({ctype}, step, {k});", 3)
    _write_backward(kernel_body, reverse, step_segments, constants, names_before, 3)
    writer.write_line("}", 2)
    # State before the previous interval.
    writer.write_line("const int previous_state = interval + (part > 0 ? part - 1 : 0);", 2)
    for k, (slot, ctype) in enumerate(zip(carry, types, strict=True)):
        writer.write_line(f"{names[slot]} = LOAD_STATE({ctype}, previous_state, {k});", 2)
    writer.write_line("}", 1)
    # Backward: hoisted numbers, and stages before the steps.
    for s in step_segments:
        if s in reverse.backward_hoisted_segments:
            kernel.write_segment(writer, program, reverse.backward_hoisted_segments[s], names, (), 1)
    if first_segments:
        _write_backward(
            kernel_body, reverse, first_segments, [()] * len(first_segments), names | kernel_body.initial_values, 1
        )
    # Pointers to inputs, and the results.
    pointers = [f"const {type_name(program.leaves[i].number_type)}* __restrict__ "
                f"p{rank[i]}"
                for i in kernel.needed_leaves(program)]  # fmt: skip
    pointers += [f"const {type_name(program.leaves[i].number_type)}* __restrict__ s{rank[i]}" for i in reverse.seeds]
    for i in reverse.perturbed:
        ctype, pointer = type_name(program.leaves[i].number_type), f"d{rank[i]}"
        pointers.append(f"{ctype}* __restrict__ {pointer}")
        values = [names[n + i, k] for k in range(program.leaves[i].size)]
        kernel.write_results(writer, pointer, ctype, 1, values, 1)
    blocks = [
        *(s.block for s in step_segments for _ in range(2)),
        *(reverse.backward_segments[s].block for s in step_segments),
    ]
    n_stored = max(len(carry), 1)  # a part of a step may change nothing that it reads
    return kernel_body.finish_kernel(pointers, needed_leaves(reverse), (), (), blocks, n_stored)


def _write_backward(
    kernel_body: KernelBody,
    reverse: ReverseProgram,
    segments: Sequence[Segment],
    constants: Sequence[Sequence[str]],
    names: dict[Slot, str],
    depth: int,
) -> None:
    program, writer = reverse.program, kernel_body.writer
    names_by_segment = []
    for s, segment_constants in zip(segments, constants, strict=True):
        names_by_segment.append(dict(names))
        if s is not segments[-1]:
            for slot in dict.fromkeys(program.drone_slots(s, s.writes)):
                name, ctype = writer.new_name("a"), type_name(program.leaves[slot[0]].number_type)
                writer.write_line(f"auto {name} = {ctype}_lanes({names[slot]});", depth)
                names[slot] = name
            kernel.write_segment(writer, program, s, names, segment_constants, depth)
    for s, segment_constants, names_before in reversed(list(zip(segments, constants, names_by_segment, strict=True))):
        kernel.write_segment(writer, program, reverse.backward_segments[s], names_before, segment_constants, depth)
