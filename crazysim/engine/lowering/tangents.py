"""Forward mode: the tangents of a program's numbers, computed along with the numbers.

The result is an ordinary program. Its tangents are additional leaves, and the derivative of each operation follows the
operation, in the same loops and conditions.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import numpy as np

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import ops
from crazysim.engine.ir.algebra import known_zero
from crazysim.engine.ir.blocks import Block, Builder, Element, Operation, Value, constant, inline, prune
from crazysim.engine.ir.program import Leaf, Program, Segment, Slot
from crazysim.engine.lowering.activity import apply_operation, changed_slots, prepare_derivative
from crazysim.engine.lowering.jaxprs import lower_function
from crazysim.engine.lowering.selections import add_selections
from crazysim.engine.pytree import replace_leaves

Values = dict[Value, Element]
"""Elements of a builder by the values of the block that is differentiated."""


def add_tangents(program: Program, perturbed: Collection[int]) -> Program:
    """Return a program that computes the tangents of a program's numbers in addition to the numbers.

    Leaf ``len(program.leaves) + i`` is the tangent of leaf ``i``; each world has its own tangent of a leaf that all
    drones share. The program reads the tangents of the perturbed leaves and writes the tangents of leaves that depend
    on them. The leaves themselves are scratch: their values after the steps are not kept.

    Args:
        perturbed: Leaves whose tangents are given; leaves that are not floats are ignored.

    Raises:
        UnsupportedError: If a part of the program has no derivative in a kernel.
    """
    program, perturbed = prepare_derivative(program, perturbed)
    n_leaves = len(program.leaves)
    changed, hoisted_indices = changed_slots(program, perturbed)
    segments = [
        _add_segment_tangents(program, n_leaves, s, changed, hoisted_indices.get(s, ())) for s in program.fused_segments
    ]
    written_tangents = [
        i for s in segments for i in s.written_leaves if i >= n_leaves and i - n_leaves not in perturbed
    ]
    zero_slots = dict.fromkeys((i, k) for i in written_tangents for k in range(program.leaves[i - n_leaves].size))
    zeros = [constant(0, program.leaves[i - n_leaves].number_type) for i, _ in zero_slots]
    zero_segment = Segment("drone", ("tangents",), "before", Block((), (), tuple(zeros)), (), tuple(zero_slots))
    return dataclasses.replace(
        program,
        leaves=(*program.leaves, *map(_tangent_leaf, program.leaves)),
        segments=(zero_segment, *segments) if zero_slots else tuple(segments),
        scratch=program.scratch | set(program.written_leaves),
    )


def _tangent_leaf(leaf: Leaf) -> Leaf:
    has_world_axis = leaf.scope in ("drone", "world")
    scope, shape = (leaf.scope, leaf.shape) if has_world_axis else ("world", (1, 1, *leaf.shape))
    return Leaf(f"tangent of {leaf.name}", scope, shape, leaf.dtype)


def _add_segment_tangents(
    program: Program, n_leaves: int, s: Segment, changed: set[Slot], hoisted_indices: Sequence[int]
) -> Segment:
    reads, n_reads = program.drone_slots(s, s.reads), len(s.reads)
    input_indices = [k for k, slot in enumerate(reads) if slot in changed and s.block.inputs[k].dtype.kind == "f"]
    input_indices = [k for k in input_indices if not s.block.inputs[k].size]
    block = add_block_tangents(
        s.block, [s.block.inputs[k] for k in (*input_indices, *(n_reads + k for k in hoisted_indices))]
    )
    primal, input_tangents = block.inputs[: len(s.block.inputs)], block.inputs[len(s.block.inputs) :]
    inputs = (
        *primal[:n_reads],
        *input_tangents[: len(input_indices)],
        *primal[n_reads:],
        *input_tangents[len(input_indices) :],
    )
    floats = [k for k, x in enumerate(s.block.outputs) if x.dtype.kind == "f"]
    output_tangents = [(k, x) for k, x in zip(floats, block.outputs[len(s.writes) :], strict=True)
              if program.drone_slots(s, [s.writes[k]])[0] in changed]  # fmt: skip
    hoisted_slots = [slot for slot, x in zip(s.hoisted_reads, s.hoisted.inputs, strict=True)
              if slot in changed and x.dtype.kind == "f" and not x.size]  # fmt: skip
    hoisted, n_hoisted = s.hoisted, len(s.hoisted.outputs)
    if hoisted_indices:
        pairs = zip(s.hoisted.inputs, s.hoisted_reads, strict=True)
        perturbed_inputs = [x for x, slot in pairs if slot in hoisted_slots]
        hoisted = add_block_tangents(s.hoisted, perturbed_inputs)
        indices = [k for k, x in enumerate(s.hoisted.outputs) if x.dtype.kind == "f"]
        hoisted_tangents = [hoisted.outputs[n_hoisted + indices.index(k)] for k in hoisted_indices]
        hoisted = dataclasses.replace(hoisted, outputs=(*hoisted.outputs[:n_hoisted], *hoisted_tangents))
    return dataclasses.replace(
        s,
        block=Block(inputs, block.operations, (*block.outputs[: len(s.writes)], *(x for _, x in output_tangents))),
        reads=(*s.reads, *((n_leaves + s.reads[k][0], s.reads[k][1]) for k in input_indices)),
        writes=(*s.writes, *((n_leaves + s.writes[k][0], s.writes[k][1]) for k, _ in output_tangents)),
        hoisted=hoisted,
        hoisted_reads=(*s.hoisted_reads, *((n_leaves + i, k) for i, k in hoisted_slots))
        if hoisted_indices
        else s.hoisted_reads,
    )


def add_block_tangents(block: Block, perturbed: Sequence[Value]) -> Block:
    """Return the block that computes tangents of a block's outputs as well.

    Args:
        perturbed: Inputs whose tangents are given, floats.

    Returns:
        The extended block. Its inputs are the inputs of ``block``, followed by the tangents of ``perturbed``. Its
        outputs are the outputs of ``block``, followed by a tangent for each output that is a float.
    """
    indices = [block.inputs.index(x) for x in perturbed]
    block = add_selections(block)
    perturbed = [block.inputs[k] for k in indices]
    builder = Builder()
    values: Values = {x: builder.input(x.dtype, x.size) for x in block.inputs}
    tangents: Values = {x: builder.input(x.dtype) for x in perturbed}
    outputs = _add_with_tangents(builder, block, values, tangents)
    return prune(builder.finish([*outputs, *_collect_tangents(block.outputs, tangents)]))


def _collect_tangents(elements: Sequence[Element], tangents: Values) -> list[Element]:
    return [_get_tangent(x, tangents) for x in elements if x.dtype.kind == "f"]


def _get_tangent(x: Element, tangents: Values) -> Element:
    zero = known_zero(x.dtype)  # terms with this zero are left out
    return tangents.get(x, zero) if isinstance(x, Value) else zero


def _add_with_tangents(builder: Builder, block: Block, values: Values, tangents: Values) -> list[Element]:
    for op in block.operations:
        builder.stage = op.stage
        rule = STRUCTURED_RULES.get(op.name)
        if rule is not None:
            rule(builder, op, values, tangents)
            continue
        inline(builder, Block((), (op,), ()), values)
        if not op.results or op.dtype.kind != "f" or not any(isinstance(x, Value) and x in tangents for x in op.args):
            continue
        if ops.TABLE[op.name].structured:
            raise UnsupportedError("it has no derivative in a kernel", op.name, op.stage)
        derivative = _derivative_block(op.name, tuple([x.dtype for x in op.args]), op.dtype, op.params)
        operands = [*(_map_element(x, values) for x in op.args), *_collect_tangents(op.args, tangents)]
        results = inline(builder, derivative, dict(zip(derivative.inputs, operands, strict=True)))
        _store_tangents(op.results, results, tangents)
    return [_map_element(x, values) for x in block.outputs]


def _map_element(x: Element, values: Values) -> Element:
    return values.get(x, x) if isinstance(x, Value) else x


def _store_tangents(results: Sequence[Value], elements: Sequence[Element], tangents: Values) -> None:
    tangents.update((x, t) for x, t in zip(results, elements, strict=True) if isinstance(t, Value) or t != 0)


@functools.lru_cache(maxsize=1024)
def _derivative_block(name: str, dtypes: tuple[np.dtype, ...], dtype: np.dtype, params: tuple) -> Block:
    floats = [k for k, x in enumerate(dtypes) if x.kind == "f"]

    def tangent(*args: Any) -> Any:
        operands, tangents = args[: len(dtypes)], args[len(dtypes) :]

        def primal(*float_operands: Any) -> Any:
            return apply_operation(name, replace_leaves(operands, floats, float_operands), dtype, params)

        return jax.jvp(primal, tuple([operands[k] for k in floats]), tangents)[1]

    return lower_function(tangent, *[jax.ShapeDtypeStruct((), x) for x in (*dtypes, *(dtypes[k] for k in floats))])


def _when(builder: Builder, op: Operation, values: Values, tangents: Values) -> None:
    mask, *old_values = op.args
    (block,) = op.blocks
    inner, inner_tangents = Builder(builder), dict(tangents)
    outputs = _add_with_tangents(inner, block, dict(values), inner_tangents)
    new_tangents = [_get_tangent(x, inner_tangents) for x in block.outputs]
    old_tangents = [_get_tangent(x, tangents) for x in old_values]
    indices = [
        k
        for k, pair in enumerate(zip(old_tangents, new_tangents, strict=True))
        if any(isinstance(x, Value) for x in pair)
    ]
    old_elements = [_map_element(x, values) for x in old_values]
    args = [_map_element(mask, values), *old_elements, *(old_tangents[k] for k in indices)]
    new_block = inner.finish([*outputs, *(new_tangents[k] for k in indices)])
    results = builder.add_many("when", args, [x.dtype for x in args[1:]], op.params, (new_block,))
    values.update(zip(op.results, results, strict=False))
    _store_tangents([op.results[k] for k in indices], results[len(old_values) :], tangents)


def _custom_jvp(builder: Builder, op: Operation, values: Values, tangents: Values) -> None:
    (block,) = op.blocks
    args = [_map_element(x, values) for x in op.args]
    results = inline(builder, block, values | dict(zip(block.inputs, args, strict=True)))
    values.update(zip(op.results, results, strict=True))
    if not any(isinstance(x, Value) and x in tangents for x in op.args):
        return
    derivative = op.param("derivative")()
    arg_tangents = [_get_tangent(x, tangents) if x.dtype.kind == "f" else constant(0, x.dtype) for x in op.args]
    result_tangents = inline(builder, derivative, dict(zip(derivative.inputs, [*args, *arg_tangents], strict=True)))
    float_tangents = [x for x, out in zip(result_tangents, derivative.outputs, strict=True) if out.dtype.kind == "f"]
    _store_tangents([x for x in op.results if x.dtype.kind == "f"], float_tangents, tangents)


def _loop(builder: Builder, op: Operation, values: Values, tangents: Values) -> None:
    *tests, body = op.blocks
    if not any(isinstance(x, Value) and x in tangents for x in (*op.args, *body.used_values())):
        inline(builder, Block((), (op,), ()), values)
        return
    inner = Builder(builder)
    inner_values = values | {x: inner.input(x.dtype) for x in body.inputs}
    inner_tangents = tangents | {x: inner.input(x.dtype) for x in body.inputs if x.dtype.kind == "f"}
    outputs = _add_with_tangents(inner, body, inner_values, inner_tangents)
    blocks = [inner.finish([*outputs, *_collect_tangents(body.outputs, inner_tangents)])]
    args = [*(_map_element(x, values) for x in op.args), *_collect_tangents(op.args, tangents)]
    for block in tests:
        inner = Builder(builder)
        inner_values = values | {x: inner.input(x.dtype) for x in block.inputs}
        for x in args[len(op.args) :]:
            inner.input(x.dtype)
        blocks.insert(0, inner.finish(inline(inner, block, inner_values)))
    results = builder.add_many(op.name, args, [x.dtype for x in args], op.params, tuple(blocks))
    values.update(zip(op.results, results, strict=False))
    _store_tangents([x for x in op.results if x.dtype.kind == "f"], results[len(op.args) :], tangents)


def _over_others(builder: Builder, op: Operation, values: Values, tangents: Values) -> None:
    (body,) = op.blocks
    *other_inputs, is_self = body.inputs
    inner = Builder(builder)
    inner_values = values | {x: inner.input(x.dtype) for x in other_inputs}
    published = [(x, y) for x, y in zip(op.args, other_inputs, strict=True) if isinstance(x, Value) and x in tangents]
    inner_tangents = tangents | {y: inner.input(y.dtype) for _, y in published}
    inner_values[is_self] = inner.input(is_self.dtype)
    outputs = _add_with_tangents(inner, body, inner_values, inner_tangents)
    names = op.param("reduce")
    body_tangents = [_get_tangent(x, inner_tangents) for x in body.outputs]
    summed_indices = [k for k, x in enumerate(body_tangents) if names[k] == "add" and isinstance(x, Value)]
    block = inner.finish([*outputs, *(body_tangents[k] for k in summed_indices)])
    args = [*(_map_element(x, values) for x in op.args), *(tangents[x] for x, _ in published)]
    dtypes = [x.dtype for x in op.results] + [op.results[k].dtype for k in summed_indices]
    params = (("reduce", (*names, *("add" for _ in summed_indices))), ("n_members", op.param("n_members")))
    results = builder.add_many("over_others", args, dtypes, params, (block,))
    values.update(zip(op.results, results, strict=False))
    _store_tangents([op.results[k] for k in summed_indices], results[len(op.results) :], tangents)


STRUCTURED_RULES: dict[str, Callable[[Builder, Operation, Values, Values], None]] = {
    "when": _when,
    "custom_jvp": _custom_jvp,
    "loop": _loop,
    "while": _loop,
    "over_others": _over_others,
}
"""Functions that add structured operations together with their tangents, by name."""
