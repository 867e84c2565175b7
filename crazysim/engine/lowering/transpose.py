"""Reverse mode on blocks: from the cotangents of a block's outputs to the cotangents of its inputs.

The derivatives of operations come from JAX: the VJP of an operation is traced once for each combination of types, and
lowered like any other function. The returned block first computes the whole block forward. The backward pass then goes
through the block part by part. For each part but the last, it recomputes the results that the derivatives need.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Block, Builder, Element, Operation, Value, constant, inline, prune
from crazysim.engine.lowering.activity import active_values, apply_operation
from crazysim.engine.lowering.jaxprs import lower_function
from crazysim.engine.lowering.selections import add_selections
from crazysim.engine.pytree import replace_leaves

MAX_UNROLLED_OPERATIONS = 4096
"""Maximum number of operations, over all iterations, of a loop that is unrolled for its derivative. A longer loop is
reversed as a loop, whose iteration k recomputes the k iterations before it."""
MAX_REVERSED_ITERATIONS = 64
"""Maximum number of iterations of a loop that is reversed as a loop."""

Cotangents = dict[Value, Element]
"""Cotangents by the values of the block that is differentiated."""


def transpose_block(block: Block, perturbed: Sequence[Value]) -> Block:
    """Return the block that computes cotangents of a block's inputs.

    Args:
        perturbed: Inputs whose cotangents are computed, floats.

    Returns:
        The block that computes the cotangents of ``perturbed``. Its inputs are the inputs of ``block``, followed by a
        cotangent for each output that is a float.
    """
    indices = [block.inputs.index(x) for x in perturbed]
    block = _unroll_loops(add_selections(block))
    perturbed = [block.inputs[k] for k in indices]
    active_set = active_values(block, perturbed)
    builder = Builder()
    values: dict[Value, Element] = {x: builder.input(x.dtype, x.size) for x in block.inputs}
    parts = _split_into_parts(block)
    for part in parts:
        inline(builder, part, values)
    cotangents: Cotangents = {}
    for x in block.outputs:
        if x.dtype.kind == "f":
            ct = builder.input(x.dtype)
            if isinstance(x, Value) and x in active_set:
                _accumulate(builder, cotangents, x, ct)
    for k, part in reversed(list(enumerate(parts))):
        elements = values if k == len(parts) - 1 else _recompute(builder, part, k, values, active_set)
        _add_cotangents(builder, part, elements, active_set, cotangents)
    return prune(builder.finish([cotangents.get(x, constant(0, x.dtype)) for x in perturbed]))


OPERATIONS_PER_PART = 60
"""Operations in a part of a block. Of 60, 100, 150, 250 and all, 60 and 100 left the most numbers in registers."""


def _split_into_parts(block: Block) -> list[Block]:
    operations = [op for op in block.operations if op.name != "barrier"]
    return [
        Block((), tuple(operations[k : k + OPERATIONS_PER_PART]))
        for k in range(0, len(operations), OPERATIONS_PER_PART)
    ]


def _recompute(
    builder: Builder, part: Block, part_number: int, values: dict[Value, Element], active_set: set[Value]
) -> dict[Value, Element]:
    # Without this, all results of the forward pass would take registers until the backward pass needs them. Reductions
    # over other drones and loops are not recomputed.
    operations = [op for op in part.operations if op.name not in ("over_others", "loop", "while")]
    recomputed, used_values = {x for op in operations for x in op.results}, part.used_values()
    inputs = [
        x
        for x in values
        if x in used_values and x in active_set and x not in recomputed and isinstance(values[x], Value)
    ]
    copies = {x: builder.add("opaque_copy", (values[x],), x.dtype, (("part", part_number),)) for x in inputs}
    elements = values | copies
    inline(builder, Block((), tuple(operations)), elements)
    return elements


def _add_cotangents(
    builder: Builder, block: Block, values: dict[Value, Element], active_set: set[Value], cts: Cotangents
) -> None:
    def map_element(x: Element) -> Element:
        return values.get(x, x) if isinstance(x, Value) else x

    for op in reversed(block.operations):
        result_cts = [cts.pop(x, None) for x in op.results]
        if all(ct is None for ct in result_cts) or not any(x in active_set for x in op.results):
            continue
        builder.stage = op.stage
        rule = STRUCTURED_RULES.get(op.name)
        if rule is not None:
            rule(builder, op, values, active_set, result_cts, cts)
            continue
        if ops.TABLE[op.name].structured:
            raise UnsupportedError("it has no derivative in a kernel", op.name, op.stage)
        derivative = _derivative_block(op.name, tuple([x.dtype for x in op.args]), op.dtype, op.params)
        operands = [*map(map_element, op.args), result_cts[0]]
        contributions = inline(builder, derivative, dict(zip(derivative.inputs, operands, strict=True)))
        floats = [x for x in op.args if x.dtype.kind == "f"]
        for x, contribution in zip(floats, contributions, strict=True):
            if isinstance(x, Value) and x in active_set:
                _accumulate(builder, cts, x, contribution)


def _accumulate(builder: Builder, cts: Cotangents, x: Value, contribution: Element) -> None:
    cts[x] = builder.add("add", (cts[x], contribution), x.dtype) if x in cts else contribution


@functools.lru_cache(maxsize=1024)
def _derivative_block(name: str, dtypes: tuple[np.dtype, ...], dtype: np.dtype, params: tuple) -> Block:
    floats = [k for k, x in enumerate(dtypes) if x.kind == "f"]

    def cotangents(*args: Any) -> list[Any]:
        *operands, ct = args

        def primal(float_operands: list[Any]) -> Any:
            return apply_operation(name, replace_leaves(operands, floats, float_operands), dtype, params)

        return jax.vjp(primal, [operands[k] for k in floats])[1](ct)[0]

    return lower_function(cotangents, *[jax.ShapeDtypeStruct((), x) for x in (*dtypes, dtype)])


ResultCotangents = Sequence[Element | None]
"""Cotangents of the results of an operation; None for unused results."""


def _when(
    builder: Builder, op: Operation, values: dict, active_set: set[Value], result_cts: ResultCotangents, cts: Cotangents
) -> None:
    mask, *old_values = op.args
    mask = values.get(mask, mask)
    (block,) = op.blocks
    inner, inner_values, inner_cts = Builder(builder), dict(values), Cotangents()
    inline(inner, block, inner_values)
    for x, old, ct in zip(block.outputs, old_values, result_cts, strict=True):
        if ct is None:
            continue
        if isinstance(old, Value) and old in active_set:
            masked_ct = builder.add("select_n", (mask, ct, constant(0, ct.dtype)), ct.dtype)
            _accumulate(builder, cts, old, masked_ct)
        if isinstance(x, Value) and x in active_set:
            _accumulate(inner, inner_cts, x, ct)
    _add_cotangents(inner, block, inner_values, active_set, inner_cts)
    old_cts = [cts.get(x, constant(0, x.dtype)) for x in inner_cts]
    sums = [inner.add("add", (a, inner_cts[x]), x.dtype) for a, x in zip(old_cts, inner_cts, strict=True)]
    if inner_cts:
        results = builder.add_many("when", (mask, *old_cts), [x.dtype for x in inner_cts], (), (inner.finish(sums),))
        cts.update(zip(inner_cts, results, strict=True))


def _custom_jvp(
    builder: Builder, op: Operation, values: dict, active_set: set[Value], result_cts: ResultCotangents, cts: Cotangents
) -> None:
    derivative = _transpose_derivative(op.param("derivative")())
    args = [values.get(x, x) if isinstance(x, Value) else x for x in op.args]
    seeds = [constant(0, x.dtype) if ct is None else ct for x, ct in zip(op.results, result_cts, strict=True)
             if x.dtype.kind == "f"]  # fmt: skip
    operands = [*args, *(constant(0, x.dtype) for x in args), *seeds]
    contributions = inline(builder, derivative, dict(zip(derivative.inputs, operands, strict=True)))
    for x, contribution in zip([x for x in op.args if x.dtype.kind == "f"], contributions, strict=True):
        if isinstance(x, Value) and x in active_set:
            _accumulate(builder, cts, x, contribution)


@functools.lru_cache(maxsize=256)
def _transpose_derivative(derivative: Block) -> Block:
    tangents = derivative.inputs[len(derivative.inputs) // 2 :]
    return transpose_block(derivative, [x for x in tangents if x.dtype.kind == "f"])


def _over_others(
    builder: Builder, op: Operation, values: dict, active_set: set[Value], result_cts: ResultCotangents, cts: Cotangents
) -> None:
    known_cts = [ct for ct in result_cts if ct is not None]
    names = [name for name, ct in zip(op.param("reduce"), result_cts, strict=True) if ct is not None]
    if any(name != "add" for name in names):  # see ``selections``
        raise UnsupportedError(f"{', '.join(names)} over other drones has no derivative in a kernel", op.name)
    (body,) = op.blocks
    used = body.used_values()
    # A list, not a set, so that the order is always the same.
    captured = [x for x in values if x in used and not x.size and isinstance(values[x], Value)]
    published = [values.get(x, x) for x in op.args]

    def add_reverse_loop(
        read_values: Sequence[Value],
        own_values: dict,
        perturbed: Sequence[Value],
        published_elements: Sequence[Element],
    ) -> None:
        inner, inner_values, inner_cts = Builder(builder), dict(values), Cotangents()
        new_inputs = [inner.input(x.dtype) for x in (*read_values, body.inputs[-1])]
        inner_values.update(own_values)
        inner_values.update(zip((*read_values, body.inputs[-1]), new_inputs, strict=True))
        inline(inner, body, inner_values)
        for x, ct in zip(body.outputs, result_cts, strict=True):
            if ct is not None and isinstance(x, Value) and x in active_set:
                _accumulate(inner, inner_cts, x, inner_values.get(ct, ct) if isinstance(ct, Value) else ct)
        _add_cotangents(inner, body, inner_values, active_set, inner_cts)
        perturbed = [x for x in perturbed if x in inner_cts]
        if not perturbed:
            return
        block = prune(inner.finish([inner_cts[x] for x in perturbed]))
        used_inside = block.used_values()
        pairs = [(y, s) for y, s in zip(new_inputs, published_elements, strict=False) if y in used_inside]
        block = Block((*(y for y, _ in pairs), new_inputs[-1]), block.operations, block.outputs)
        params = (("reduce", ("add",) * len(perturbed)), ("n_members", op.param("n_members")))
        sums = builder.add_many("over_others", [s for _, s in pairs], [x.dtype for x in perturbed], params, (block,))
        for x, contribution in zip(perturbed, sums, strict=True):
            target = dict(zip(body.inputs, op.args, strict=False)).get(x, x)
            if isinstance(target, Value) and target in active_set:
                _accumulate(builder, cts, target, contribution)

    other_inputs = body.inputs[:-1]
    add_reverse_loop(other_inputs, {}, [x for x in captured if x in active_set], published)
    seeds = [ct for ct in known_cts if isinstance(ct, Value)]
    add_reverse_loop(
        (*captured, *seeds),
        dict(zip(other_inputs, published, strict=True)),
        [x for x in other_inputs if x in active_set],
        [*(values[x] for x in captured), *seeds],
    )


def _loop(
    builder: Builder, op: Operation, values: dict, active_set: set[Value], result_cts: ResultCotangents, cts: Cotangents
) -> None:
    (body,), length = op.blocks, op.param("length")
    start = [values.get(x, x) if isinstance(x, Value) else x for x in op.args]
    carried = [k for k, x in enumerate(body.inputs) if x in active_set]
    used = body.used_values()
    captured = [x for x in values if x in used and x in active_set]
    inner = Builder(builder)
    iteration = inner.input("int32")  # from the last one to the first
    carried_cts = [inner.input(body.inputs[k].dtype) for k in carried]
    sums = [inner.input(x.dtype) for x in captured]
    # The numbers with which the iteration began.
    test, again = Builder(inner), Builder(inner)
    count, *_ = [test.input(x) for x in ("int32", *(x.dtype for x in start))]
    is_earlier = test.finish([test.add("lt", (count, iteration), bool)])
    count, *numbers = [again.input(x) for x in ("int32", *(x.dtype for x in start))]
    outputs = inline(again, body, values | dict(zip(body.inputs, numbers, strict=True)))
    repeat = again.finish([again.add("add", (count, constant(1, "int32")), "int32"), *outputs])
    first = (constant(0, "int32"), *start)
    _, *numbers = inner.add_many("while", first, [x.dtype for x in first], (), (is_earlier, repeat))
    # The iteration itself, and its derivative.
    inner_values, inner_cts = values | dict(zip(body.inputs, numbers, strict=True)), Cotangents()
    inline(inner, body, inner_values)
    for k, ct in zip(carried, carried_cts, strict=True):
        if isinstance(x := body.outputs[k], Value) and x in active_set:
            _accumulate(inner, inner_cts, x, ct)
    _add_cotangents(inner, body, inner_values, active_set, inner_cts)
    results = [inner_cts.get(body.inputs[k], constant(0, body.inputs[k].dtype)) for k in carried]
    results += [inner.add("add", (a, inner_cts[x]), x.dtype) if x in inner_cts else a
                for a, x in zip(sums, captured, strict=True)]  # fmt: skip
    block = inner.finish([inner.add("sub", (iteration, constant(1, "int32")), "int32"), *results])
    args = [constant(length - 1, "int32")]
    args += [constant(0, op.results[k].dtype) if result_cts[k] is None else result_cts[k] for k in carried]
    args += [constant(0, x.dtype) for x in captured]
    _, *totals = builder.add_many("loop", args, [x.dtype for x in args], op.params, (block,))
    for x, total in zip([*(op.args[k] for k in carried), *captured], totals, strict=True):
        if isinstance(x, Value) and x in active_set:
            _accumulate(builder, cts, x, total)


Rule = Callable[[Builder, Operation, dict, set[Value], ResultCotangents, Cotangents], None]
"""Function that adds the cotangents of the values that a structured operation uses."""
STRUCTURED_RULES: dict[str, Rule] = {
    "when": _when,
    "custom_jvp": _custom_jvp,
    "over_others": _over_others,
    "loop": _loop,
}


def _unroll_loops(block: Block) -> Block:
    # Loops that carry no float have no derivative and are not unrolled.
    if not any(_is_unrolled(op) for inner in block.blocks() for op in inner.operations):
        return block
    builder = Builder()
    values: dict[Value, Element] = {x: builder.input(x.dtype, x.size) for x in block.inputs}
    outputs = _unroll(builder, block, values)
    return Block(tuple(values[x] for x in block.inputs), tuple(builder.operations), tuple(outputs))


def _is_unrolled(op: Operation) -> bool:
    if op.name != "loop" or not any(x.dtype.kind == "f" for x in op.results):
        return False
    (body,), length = op.blocks, op.param("length")
    if length * sum(1 for _ in body.walk()) <= MAX_UNROLLED_OPERATIONS:
        return True
    if length > MAX_REVERSED_ITERATIONS:
        raise UnsupportedError(
            f"a loop of {length} iterations is too long to be reversed; jax.jvp and jax.jacfwd have a kernel",
            op.name,
            op.stage,
        )
    return False


def _unroll(builder: Builder, block: Block, values: dict[Value, Element]) -> list[Element]:
    def map_element(x: Element) -> Element:
        return values.get(x, x) if isinstance(x, Value) else x

    for op in block.operations:
        builder.stage = op.stage
        if _is_unrolled(op):
            (body,), carry = op.blocks, [map_element(x) for x in op.args]
            for _ in range(op.param("length")):
                inner_values = values | dict(zip(body.inputs, carry, strict=True))
                carry = _unroll(builder, body, inner_values)
            values.update(zip(op.results, carry, strict=True))
        elif op.name in ("when", "over_others"):
            blocks = []
            for inner in op.blocks:
                inner_builder = Builder(builder)
                inner_values = values | {x: inner_builder.input(x.dtype) for x in inner.inputs}
                blocks.append(inner_builder.finish(_unroll(inner_builder, inner, inner_values)))
            args = [map_element(x) for x in op.args]
            results = builder.add_many(op.name, args, [x.dtype for x in op.results], op.params, tuple(blocks))
            values.update(zip(op.results, results, strict=True))
        else:
            inline(builder, Block((), (op,), ()), values)
    return [map_element(x) for x in block.outputs]
