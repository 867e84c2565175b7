"""Passes that change when numbers are computed: they join segments and ticks, hoist values, and add barriers."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any

from crazysim.engine.ir import ops
from crazysim.engine.ir.algebra import constant_key, fold
from crazysim.engine.ir.blocks import (
    Block,
    Builder,
    Element,
    Operation,
    Value,
    constant,
    inline,
    is_constant,
    prune,
    substitute,
)
from crazysim.engine.ir.program import Program, Segment, Slot, UnfusedStage


def fuse(program: Program) -> Program:
    """Join neighbouring segments with the same phase and scope.

    A number that one stage writes and the next stage reads is then passed on as a value. Common subexpressions are
    computed once.
    """
    segments: list[Segment | UnfusedStage] = []
    groups = itertools.groupby(program.segments, lambda s: (s.scope, s.phase) if isinstance(s, Segment) else id(s))
    for _, group in groups:
        segment_group = list(group)
        fusible = [s for s in segment_group if isinstance(s, Segment)]
        segments += [_join_segments(fusible)] if fusible else segment_group
    return dataclasses.replace(program, segments=tuple(segments))


def _join_segments(segments: list[Segment]) -> Segment:
    builder = Builder()
    inputs: dict[Slot, Value] = {}
    outputs: dict[Slot, Element] = {}
    for segment in segments:
        (builder.stage,) = segment.stages
        values: dict[Value, Element] = {}
        for x, slot in zip(segment.block.inputs, segment.reads, strict=True):
            if slot not in outputs:
                outputs[slot] = inputs[slot] = builder.input(x.dtype, x.size)
            values[x] = outputs[slot]
        outputs.update(zip(segment.writes, inline(builder, segment.block, values), strict=True))
        builder.barrier()
    writes = {slot: x for slot, x in outputs.items() if x is not inputs.get(slot)}
    slots = {x: slot for slot, x in inputs.items()}
    block = prune(builder.finish(tuple(writes.values())), keep_inputs=False)
    stages = tuple([name for segment in segments for name in segment.stages])
    reads = tuple([slots[x] for x in block.inputs])
    return Segment(segments[0].scope, stages, segments[0].phase, block, reads, tuple(writes))


def join_ticks(program: Program) -> Program:
    """Join neighbouring stages that run at the same ticks.

    A number that one stage writes and the next stage reads is then passed on without selecting between its old and its
    new value. A constant remains a constant.
    """
    segments = [
        dataclasses.replace(s, block=_join_block_ticks(s.block)) if isinstance(s, Segment) else s
        for s in program.segments
    ]
    return dataclasses.replace(program, segments=tuple(segments))


def _join_block_ticks(block: Block) -> Block:
    operations: list[Operation] = []
    for op in block.operations:
        last = next((i for i in reversed(range(len(operations))) if operations[i].name != "barrier"), None)
        if last is not None and op.name == operations[last].name == "when" and op.args[0] is operations[last].args[0]:
            operations[last:] = [_join_two_ticks(operations[last], op)]
        else:
            operations.append(op)
    return dataclasses.replace(block, operations=tuple(operations))


def _join_two_ticks(first: Operation, second: Operation) -> Operation:
    builder = Builder(stage=first.stage)
    new_values = inline(builder, first.blocks[0], {})
    builder.barrier()
    builder.stage = second.stage
    new_values += inline(builder, second.blocks[0], dict(zip(first.results, new_values, strict=True)))
    old_by_result = dict(zip(first.results, first.args[1:], strict=True))
    old_values = [old_by_result.get(x, x) if isinstance(x, Value) else x for x in second.args[1:]]
    args, results = (*first.args, *old_values), (*first.results, *second.results)
    return first._replace(args=args, results=results, blocks=(prune(builder.finish(new_values)),))


BARRIER_INTERVAL = 40
"""Operations between two barriers of ``add_barriers``. Of 20, 30, 40, 60, 80 and 150, the values from 20 to 40 gave the
fastest gradients on two cores with JAX 0.11.2; smaller values take longer to compile."""


def add_barriers(program: Program) -> Program:
    """Put a barrier after every ``BARRIER_INTERVAL`` operations, for lanes on a CPU.

    XLA's CPU backend recomputes a value in every fusion that uses it, also in the backward pass of a gradient. With a
    barrier, it computes the values that later operations need only once. Kernels ignore barriers.
    """
    return dataclasses.replace(
        program,
        segments=tuple([
            dataclasses.replace(s, block=_add_barriers_to_block(s.block)) if isinstance(s, Segment) else s
            for s in program.segments
        ]),
    )  # fmt: skip


def _add_barriers_to_block(block: Block) -> Block:
    operations: list[Operation] = []
    for k, op in enumerate(block.operations):
        if k and k % BARRIER_INTERVAL == 0 and op.name != "barrier":
            operations.append(Operation("barrier", (), (), stage=op.stage))
        operations.append(op)
    return dataclasses.replace(block, operations=tuple(operations))


def hoist(program: Program) -> Program:
    """Move expensive values that no step changes out of the loop over steps.

    A division of a changing value by a constant, or by a value that no step changes, becomes a product with the
    inverse. This adds one rounding error.
    """
    changing = program.changing_slots()
    return dataclasses.replace(
        program,
        segments=tuple([
            _hoist_segment(s, changing) if isinstance(s, Segment) and (s.scope, s.phase) == ("drone", "each") else s
            for s in program.segments
        ]),
    )  # fmt: skip


def _hoist_segment(segment: Segment, changing: set[Slot]) -> Segment:
    block, slots = segment.block, dict(zip(segment.block.inputs, segment.reads, strict=True))
    fixed_values = {x for x, slot in slots.items() if slot not in changing}
    hoistable: set[Value] = set()
    operations: list[Operation] = []
    for op in _replace_divisions(block, fixed_values):
        operations.append(op)
        if op.results and not op.blocks and all([is_constant(x) or x in fixed_values for x in op.args]):
            fixed_values.update(op.results)
            if ops.TABLE[op.name].cost >= ops.EXPENSIVE_COST or not hoistable.isdisjoint(op.args):
                hoistable.update(op.results)
    step_block = Block(
        block.inputs, tuple([op for op in operations if hoistable.isdisjoint(op.results)]), block.outputs
    )
    step_uses = step_block.used_values()
    hoisted_values = [x for op in operations for x in op.results if x in hoistable and x in step_uses]
    if not hoisted_values:
        return segment
    # Cheap operations that depend on no hoisted value stay in the step; the hoisted block repeats them if needed.
    fixed_operations = [op for op in operations if op.results and fixed_values.issuperset(op.results)]
    hoisted_block = prune(Block(block.inputs, tuple(fixed_operations), tuple(hoisted_values)), keep_inputs=False)
    new_inputs = {x: Value(x.dtype) for x in hoisted_values}
    step_block = prune(substitute(step_block, new_inputs), keep_inputs=False)
    return dataclasses.replace(
        segment,
        block=dataclasses.replace(step_block, inputs=(*step_block.inputs, *new_inputs.values())),
        reads=tuple([slots[x] for x in step_block.inputs]),
        hoisted=hoisted_block,
        hoisted_reads=tuple([slots[x] for x in hoisted_block.inputs]),
    )


def _replace_divisions(block: Block, fixed_values: set[Value]) -> Iterable[Operation]:
    # The caller adds to ``fixed_values`` while it iterates.
    inverses: dict[Any, Element] = {}
    for op in block.operations:
        if op.name != "div" or op.dtype.kind != "f":
            yield op
            continue
        a, b = op.args
        if (not is_constant(b) and b not in fixed_values) or is_constant(a) or a in fixed_values:
            yield op
            continue
        unit, key = constant(1, op.dtype), constant_key(b) if is_constant(b) else b
        if key not in inverses and is_constant(b):
            inverses[key] = fold("div", (unit, b), op.dtype, ())
        elif key not in inverses:
            inverses[key] = Value(op.dtype)
            yield Operation("div", (unit, b), (inverses[key],), stage=op.stage)
        yield Operation("mul", (a, inverses[key]), op.results, stage=op.stage)
