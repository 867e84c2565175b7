"""Programs as readable text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import numpy as np

from crazysim.engine.ir.blocks import Block, Element, Operation, Value
from crazysim.engine.ir.program import PACKED_LEAF_NAME, Program, Segment, Slot, UnfusedStage

INDENT = "  "


def list_program(program: Program) -> str:
    """Return a program as text: the inputs, operations and outputs of each segment, with the names of fields."""
    lines = []
    for segment in program.segments:
        lines.append("")
        if segment in program.unfused_stages:
            stage = cast(UnfusedStage, segment)
            lines.append(f"{stage.phase} stage {stage.name} of all worlds, unfused: {stage.error.reason}")
            lines += [f"{INDENT}reads {program.leaves[i].name}" for i in stage.input_leaves]
            lines += [f"{INDENT}writes {program.leaves[i].name}" for i in stage.written_leaves]
        else:
            lines += _list_segment(program, cast(Segment, segment), _Names())
    if program.check_segment is not None:
        lines += ["", *_list_segment(program, program.check_segment, _Names())]
    return "\n".join(lines[1:]) + "\n"


def list_operation(program: Program, operation: Operation) -> str:
    for segment in program.fused_segments:
        names = _Names()
        list(_list_segment(program, segment, names))
        if any(op is operation for op in segment.block.walk()):
            return f"{_operation_line(operation, names)} of stage {operation.stage!r}"
    raise ValueError("expected an operation of the program, got one of another program")


def slot_name(program: Program, segment: Segment, slot: Slot) -> str:
    """Return a slot as the field and the element, such as ``states.pos[2]``; in a segment of worlds, with the drone."""
    (i, k), leaf = slot, program.leaves[slot[0]]
    if k < 0:  # the whole leaf, read as a table
        return f"{leaf.name}[:]"
    drone = ""
    if segment.scope == "world" and leaf.scope == "drone":
        number, k = divmod(k, leaf.size)
        drone = f" of drone {number}"
    source_leaves = program.packed if leaf.name == PACKED_LEAF_NAME else leaf.row_leaves
    for source in source_leaves:  # the number is an element of one of the leaves that are packed in this leaf
        if k < program.leaves[source].size:
            return f"{program.leaves[source].name}[{k}]{drone}"
        k -= program.leaves[source].size
    return f"{program.leaves[i].name}[{k}]{drone}"


def _list_segment(program: Program, segment: Segment, names: _Names) -> Iterator[str]:
    phase_text = {"before": "before the first step", "each": "at each step", "after": "after the last step"}[
        segment.phase
    ]
    yield f"segment of one {segment.scope}, {phase_text}: {', '.join(segment.stages)}"
    if segment.hoisted.outputs:
        yield f"{INDENT}hoisted, once before the first step:"
        for x, slot in zip(segment.hoisted.inputs, segment.hoisted_reads, strict=True):
            yield f"{INDENT * 2}{names.new_name(x)}: {_type_text(x)} = {slot_name(program, segment, slot)}"
        yield from _list_operations(segment.hoisted, names, 2)
        for x, y in zip(segment.block.inputs[len(segment.reads) :], segment.hoisted.outputs, strict=True):
            yield f"{INDENT * 2}{names.new_name(x)} = {names.name(y)}"
    for x, slot in zip(segment.block.inputs, segment.reads, strict=False):
        yield f"{INDENT}{names.new_name(x)}: {_type_text(x)} = {slot_name(program, segment, slot)}"
    yield from _list_operations(segment.block, names, 1)
    if segment is program.check_segment:
        yield f"{INDENT}flagged = {names.name(segment.block.outputs[0])}"
        return
    for x, slot in zip(segment.block.outputs, segment.writes, strict=True):
        yield f"{INDENT}{slot_name(program, segment, slot)} = {names.name(x)}"


def _type_text(x: Value) -> str:
    return f"{x.dtype}[{x.size}]" if x.size else f"{x.dtype}"


class _Names:
    """Names of values, in order of definition."""

    def __init__(self) -> None:
        self._names: dict[Value, str] = {}

    def new_name(self, x: Value) -> str:
        return self._names.setdefault(x, f"%{len(self._names)}")

    def name(self, x: Element) -> str:
        return self._names.get(x, "%?") if isinstance(x, Value) else _constant_text(x)


def _constant_text(x: np.generic) -> str:
    return f"{x.item()!r}" if x.dtype.kind != "b" else str(bool(x)).lower()


def _list_operations(block: Block, names: _Names, depth: int) -> Iterator[str]:
    stage = ""
    for op in block.operations:
        if op.name == "barrier":
            yield f"{INDENT * depth}barrier"
            continue
        if depth == 1 and op.stage != stage:
            stage = op.stage
            yield f"{INDENT * depth}# {stage}"
        inner = [line for b in op.blocks for line in _list_inner(b, names, depth + 1)]
        yield f"{INDENT * depth}{_operation_line(op, names)}" + (" {" if inner else "")
        yield from inner
        if inner:
            yield f"{INDENT * depth}}}"


def _operation_line(op: Operation, names: _Names) -> str:
    params = [f"{k}={v}" for k, v in op.params if not callable(v)]
    results = ", ".join(f"{names.new_name(x)}: {_type_text(x)}" for x in op.results)
    return f"{results} = {op.name}({', '.join([*map(names.name, op.args), *params])})"


def _list_inner(block: Block, names: _Names, depth: int) -> Iterator[str]:
    if block.inputs:
        yield f"{INDENT * depth}block({', '.join(names.new_name(x) for x in block.inputs)})"
    yield from _list_operations(block, names, depth)
    yield f"{INDENT * depth}return {', '.join(names.name(x) for x in block.outputs)}"
