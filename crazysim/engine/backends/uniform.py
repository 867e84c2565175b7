"""Values that all lanes of a vector share, in blocks with loops. The source holds such a value in a scalar variable."""

from __future__ import annotations

from collections.abc import Set

from crazysim.engine.ir.blocks import Block, Element, Operation, Value


def is_shared(x: Element, shared: Set[Value]) -> bool:
    """Whether an element is a constant, a table, or one of the values that are known to be shared."""
    return not isinstance(x, Value) or x.size > 0 or x in shared


def shared_results(op: Operation, shared: Set[Value]) -> list[Value]:
    """Return the results of an operation that all lanes share, given the earlier values that all lanes share."""
    match op.name:
        case "any_lane":
            return list(op.results)
        case "loop" | "while":
            return [
                x for x, is_shared_number in zip(op.results, shared_carry(op, shared), strict=True) if is_shared_number
            ]
        case "custom_jvp":
            (body,) = op.blocks
            shared_inside = _shared_in_body(body, [is_shared(x, shared) for x in op.args], shared)
            return [x for x, out in zip(op.results, body.outputs, strict=True) if is_shared(out, shared_inside)]
        case "when" | "over_others" | "threefry2x32":
            return []
    return list(op.results) if all(is_shared(x, shared) for x in op.args) else []


def shared_carry(op: Operation, shared: Set[Value]) -> list[bool]:
    """Return for each number that a loop carries whether all lanes share it in every iteration."""
    *tests, body = op.blocks
    carry_is_shared = [is_shared(x, shared) for x in op.args]
    while True:
        shared_inside = _shared_in_body(body, carry_is_shared, shared)
        still_shared = [
            was_shared and is_shared(x, shared_inside)
            for was_shared, x in zip(carry_is_shared, body.outputs, strict=True)
        ]
        for test in tests:  # if lanes may stop at different iterations, they share no number that the loop carries
            if not all(is_shared(x, _shared_in_body(test, carry_is_shared, shared)) for x in test.outputs):
                still_shared = [False] * len(carry_is_shared)
        if still_shared == carry_is_shared:
            return carry_is_shared
        carry_is_shared = still_shared


def _shared_in_body(block: Block, inputs_are_shared: list[bool], shared: Set[Value]) -> set[Value]:
    shared_inside = {
        *shared,
        *(x for x, is_shared_input in zip(block.inputs, inputs_are_shared, strict=True) if is_shared_input),
    }
    for op in block.operations:
        shared_inside.update(shared_results(op, shared_inside))
    return shared_inside
