"""Activity analysis: it finds the numbers that depend differentiably on some leaves, for both modes of derivatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from jax import lax

from crazysim.engine.errors import LimitError, UnsupportedError
from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Block, Value
from crazysim.engine.ir.program import Program, Segment, Slot


def prepare_derivative(program: Program, perturbed: Collection[int]) -> tuple[Program, tuple[int, ...]]:
    """Return a program without its check, and the perturbed leaves that it uses and that are floats.

    Raises:
        UnsupportedError: If the program has no derivative in a kernel.
    """
    if program.rows:
        raise LimitError("rows of packed leaves have no gradient in a kernel")
    program = dataclasses.replace(program, check_segment=None)
    floats = tuple(sorted(i for i in perturbed if program.leaves[i].number_type.kind == "f" and i in program.ranks))
    if tables := program.tables.intersection(floats):
        names = ", ".join(program.leaves[i].name for i in sorted(tables))
        raise UnsupportedError(f"{names} is read as a table, which has no derivative in a kernel")
    return program, floats


def changed_slots(program: Program, perturbed: Sequence[int]) -> tuple[set[Slot], dict[Segment, tuple[int, ...]]]:
    """Return the numbers that depend differentiably on the perturbed leaves.

    Returns:
        The slots of these numbers, and the indices of the hoisted numbers that depend on the perturbed leaves, by
        segment of the steps.
    """
    changed = {(i, k) for i in perturbed for k in range(program.leaves[i].size)}
    hoisted_indices: dict[Segment, tuple[int, ...]] = {}

    def find_active_outputs(block: Block, slots: Sequence[Slot], active_hoisted: Sequence[int] = ()) -> list[int]:
        active_inputs = [
            x for x, slot in zip(block.inputs, slots, strict=False) if slot in changed and x.dtype.kind == "f"
        ]
        active_inputs += [block.inputs[len(slots) + k] for k in active_hoisted]
        active = active_values(block, active_inputs)
        return [k for k, x in enumerate(block.outputs) if isinstance(x, Value) and x in active]

    def propagate(s: Segment) -> None:
        written_slots = program.drone_slots(s, s.writes)
        reads = program.drone_slots(s, s.reads)
        changed.update(written_slots[k] for k in find_active_outputs(s.block, reads, hoisted_indices.get(s, ())))

    for s in program.phase_segments("before"):
        propagate(s)
    for s in program.phase_segments("each"):
        hoisted_indices[s] = tuple(find_active_outputs(s.hoisted, s.hoisted_reads))
    while True:  # numbers that become dependent in one step may affect other numbers in the next step
        n_changed_before = len(changed)
        for s in program.phase_segments("each"):
            propagate(s)
        if len(changed) == n_changed_before:
            break
    for s in program.phase_segments("after"):
        propagate(s)
    return changed, hoisted_indices


def active_values(block: Block, perturbed: Collection[Value]) -> set[Value]:
    """Return the values of a block and of its inner blocks that depend differentiably on some of its inputs."""
    active = set(perturbed)
    _propagate(block, active)
    return active


def _propagate(block: Block, active: set[Value]) -> None:
    for op in block.operations:
        if op.name == "over_others":
            (body,) = op.blocks
            active.update(x for x, arg in zip(body.inputs, op.args, strict=False) if arg in active)
        if op.name in ("loop", "while"):  # an active number may affect all floats of the next iteration
            has_active = any(x in active for x in (*op.args, *op.blocks[-1].used_values()))
            if has_active:
                active.update(x for x in op.blocks[-1].inputs if x.dtype.kind == "f")
        if op.name == "custom_jvp":
            if any(isinstance(x, Value) and x in active for x in op.args):
                active.update(x for x in op.results if x.dtype.kind == "f")
            continue
        for inner in op.blocks:
            _propagate(inner, active)
        sources = (*op.args, *(x for inner in op.blocks for x in inner.outputs))
        if any(isinstance(x, Value) and x in active for x in sources):
            active.update(x for x in op.results if x.dtype.kind == "f")


def apply_operation(name: str, args: Sequence[Any], dtype: np.dtype, params: tuple) -> Any:
    """Return the result of an operation, computed by JAX, which can differentiate it."""
    if name in ("convert_element_type", "bitcast_convert_type"):
        return getattr(lax, name)(args[0], dtype)
    fn = ops.TABLE[name].xla or name
    return (getattr(lax, fn) if isinstance(fn, str) else fn)(*args, **dict(params))
