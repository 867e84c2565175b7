"""Checks that a program is well formed, for tests of passes and for authors of passes."""

from __future__ import annotations

import numpy as np

from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Block, Element, Operation, Value
from crazysim.engine.ir.program import TABLE_INDEX, Program, Segment, Slot
from crazysim.engine.stage import PHASES


class VerificationError(AssertionError):
    """Error of a program that is not well formed, because of a defect of the engine."""


def verify(program: Program) -> Program:
    """Return a program unchanged, or raise an error that says what is wrong with it.

    Values are defined once, before they are used. Operands and results have the types of the table of operations, and
    inputs and outputs the types of their slots. No slot is read or written twice. Hoisted blocks, which run
    once before the first step, read no number that steps change.

    Raises:
        VerificationError: If the program is not well formed.
    """
    phases = [PHASES.index(s.phase) for s in program.segments]
    _require(phases == sorted(phases), "segments are not in the order of their phases")
    changing = program.changing_slots()
    for segment in [*program.fused_segments, *([program.check_segment] if program.check_segment else [])]:
        name = " + ".join(segment.stages)
        try:
            _verify_segment(program, segment, changing)
        except VerificationError as error:
            raise VerificationError(f"segment {name}: {error}") from None
    return program


def verify_block(block: Block) -> Block:
    """Return a block unchanged, or raise an error that says what is wrong with it."""
    _verify_block(block, set())
    return block


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise VerificationError(message)


def _verify_segment(program: Program, segment: Segment, changing: set[Slot]) -> None:
    if segment is not program.check_segment:
        _verify_slots(program, segment, segment.writes, segment.block.outputs, "output")
    _verify_slots(program, segment, segment.reads, segment.block.inputs[: len(segment.reads)], "input")
    _verify_slots(program, segment, segment.hoisted_reads, segment.hoisted.inputs, "input of the hoisted block")
    constants = segment.block.inputs[len(segment.reads) :]
    _require(
        [x.dtype for x in constants] == [x.dtype for x in segment.hoisted.outputs],
        f"{len(constants)} further inputs for {len(segment.hoisted.outputs)} hoisted outputs",
    )
    _require(changing.isdisjoint(segment.hoisted_reads), "a hoisted number changes from step to step")
    verify_block(segment.hoisted)
    verify_block(segment.block)


def _verify_slots(
    program: Program, segment: Segment, slots: tuple[Slot, ...], elements: tuple[Element, ...], role: str
) -> None:
    _require(len(slots) == len(elements), f"{len(elements)} {role}s for {len(slots)} slots")
    _require(len(set(slots)) == len(slots), f"a slot occurs twice as {role}")
    for (i, k), x in zip(slots, elements, strict=True):
        leaf = program.leaves[i]
        if k == TABLE_INDEX:
            has_size_of_leaf = x.size == leaf.size and x.dtype == leaf.number_type
            is_table = role != "output" and leaf.scope == "shared" and has_size_of_leaf
            _require(is_table, f"{role} is {leaf.name} as a table, which it is not")
            continue
        n_drones = program.n_drones if segment.scope == "world" and leaf.scope == "drone" else 1
        _require(0 <= k < leaf.size * n_drones, f"{role} {k} of {leaf.name}, which has {leaf.size * n_drones} numbers")
        _require(x.dtype == leaf.number_type, f"{role} of type {x.dtype} for {leaf.name} of type {leaf.number_type}")


def _verify_block(block: Block, defined: set[Value]) -> None:
    visible = set(defined)

    def define(values: tuple[Value, ...]) -> None:
        for x in values:
            _require(x not in defined, "a value is defined twice")
            defined.add(x)
            visible.add(x)

    def use(x: Element, role: str) -> None:
        _require(isinstance(x, np.generic) or x in visible, f"{role} uses a value before it is defined")

    define(block.inputs)
    for op in block.operations:
        for x in op.args:
            use(x, f"operation {op.name!r}")
        _verify_types(op)
        for inner in op.blocks:
            _verify_block(inner, defined)
            defined_inside = {x for b in inner.blocks() for x in _definitions(b)}
            visible -= defined_inside
        define(op.results)
    for x in block.outputs:
        use(x, "an output")
        _require(not isinstance(x, Value) or not x.size, "an output is a table")


def _definitions(block: Block) -> list[Value]:
    return [*block.inputs, *(x for op in block.operations for x in op.results)]


def _verify_types(op: Operation) -> None:
    _require(op.name in ops.TABLE, f"operation {op.name!r} is not in the table")
    row, dtypes, results = ops.TABLE[op.name], [x.dtype for x in op.args], [x.dtype for x in op.results]
    description = f"operation {op.name!r} of {', '.join(map(str, dtypes))} to {', '.join(map(str, results))}"
    _require(all(x in ops.DTYPES for x in (*dtypes, *results)), f"{description}: a type that the engine does not have")
    tables = [x for x in op.args[op.name == "lookup" :] if isinstance(x, Value) and x.size]
    _require(not tables, f"{description}: a table, which only 'lookup' reads")
    match op.name:
        case "table":
            numbers = op.param("numbers").array
            _require((numbers.dtype, numbers.size) == (results[0], op.results[0].size), description)
        case "lookup":
            table, offset = op.args[0], op.param("offset")
            _require(isinstance(table, Value) and 0 <= offset < table.size, f"{description}: no entry {offset}")
            _require(dtypes[1] == np.dtype(np.int32) and results == [table.dtype], description)
        case "when":
            (block,) = op.blocks
            outs = [x.dtype for x in block.outputs]
            _require(dtypes[:1] == [np.dtype(bool)] and dtypes[1:] == results == outs and not block.inputs, description)
        case "loop" | "while":
            *test, body = op.blocks
            _require(len(test) == (op.name == "while"), description)
            carried = [[x.dtype for x in values] for values in (body.inputs, body.outputs, *(t.inputs for t in test))]
            _require(all(x == dtypes == results for x in carried), description)
            _require(all([x.dtype for x in t.outputs] == [np.dtype(bool)] for t in test), description)
        case "over_others":
            (block,) = op.blocks
            _require([x.dtype for x in block.inputs] == [*dtypes, np.dtype(bool)], description)
            names = op.param("reduce")
            outs = [np.dtype(np.int32) if name in ops.INDEX_REDUCTIONS else x.dtype
                    for name, x in zip(names, block.outputs, strict=False)]  # fmt: skip
            _require(outs == results and len(names) == len(results) == len(block.outputs), description)
        case "custom_jvp":
            (block,) = op.blocks
            _require([x.dtype for x in block.inputs] == dtypes, description)
            _require([x.dtype for x in block.outputs] == results, description)
        case _:
            _require(not op.blocks and row.accepts(dtypes), description)
            shared = next((x for x, letter in zip(dtypes, row.operands, strict=True) if letter == "T"), None)
            expected = {"T": shared, "b": np.dtype(bool), "u": np.dtype(np.uint32)}
            are_expected = [
                letter == "*" or x == expected[letter] for x, letter in zip(results, row.results, strict=False)
            ]
            _require(len(results) == len(row.results) and all(are_expected), description)
