"""Values that all lanes of a vector share, in blocks with loops: a scalar variable is enough for such a value."""

from __future__ import annotations

from collections.abc import Set

from crazysim.engine.ir.blocks import Block, Element, Operation, Value


def is_shared(x: Element, shared: Set[Value]) -> bool:
    """Return True where an element is a constant, a table, or one of the values that are known to be shared."""
    return not isinstance(x, Value) or x.size > 0 or x in shared


def shared_results(op: Operation, shared: Set[Value]) -> list[Value]:
    """Return the results of an operation that all lanes share, given the earlier values that they share."""
    match op.name:
        case "any_lane":
            return list(op.results)
        case "loop" | "while":
            return [x for x, same in zip(op.results, shared_carry(op, shared), strict=True) if same]
        case "custom_jvp":
            (body,) = op.blocks
            inside = _shared_in_body(body, [is_shared(x, shared) for x in op.args], shared)
            return [x for x, out in zip(op.results, body.outputs, strict=True) if is_shared(out, inside)]
        case "when" | "over_others" | "threefry2x32":
            return []
    return list(op.results) if all(is_shared(x, shared) for x in op.args) else []


def shared_carry(op: Operation, shared: Set[Value]) -> list[bool]:
    """Return for each number that a loop carries whether all lanes share it in every iteration."""
    *tests, body = op.blocks
    is_same = [is_shared(x, shared) for x in op.args]
    while True:
        inside = _shared_in_body(body, is_same, shared)
        after = [same and is_shared(x, inside) for same, x in zip(is_same, body.outputs, strict=True)]
        for test in tests:  # if lanes may stop at different iterations, they share no number that the loop carries
            if not all(is_shared(x, _shared_in_body(test, is_same, shared)) for x in test.outputs):
                after = [False] * len(is_same)
        if after == is_same:
            return is_same
        is_same = after


def _shared_in_body(block: Block, inputs: list[bool], shared: Set[Value]) -> set[Value]:
    """Return the values that lanes share at the end of a block, given which of its inputs they share."""
    inside = {*shared, *(x for x, same in zip(block.inputs, inputs, strict=True) if same)}
    for op in block.operations:
        inside.update(shared_results(op, inside))
    return inside
