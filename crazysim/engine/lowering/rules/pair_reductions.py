"""Rule for reductions over the drones of a world."""

from __future__ import annotations

import dataclasses
from typing import Any

from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Value, constant, is_constant
from crazysim.engine.jaxcompat import JaxprEqn
from crazysim.engine.lowering.jaxprs import ElementArray, Lowering, UnsupportedError, as_elements, rule, scalars


@rule("reduce_over_others")
def _reduce_over_others(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    # A drone publishes only the numbers that the function uses and that may differ between drones.
    n_captured, n = eqn.params["n_captured"], ctx.n_members
    if not n:
        raise UnsupportedError("it needs a stage with scope 'drone'")
    if ctx.builder.outer is not None:
        raise UnsupportedError(
            "it is in a loop, in a function with a custom derivative, or in the function of another reduction"
        )
    if n == 1:
        return ctx.lower(eqn.params["jaxpr"], [*args, as_elements([constant(True, bool)], ())])
    published = [x for x in scalars(*args[n_captured:]) if not is_constant(x)]
    shared_numbers = _shared_numbers(ctx)
    inner = ctx.make_inner()
    other_inputs = {x: inner.builder.input(x.dtype) for x in dict.fromkeys(published) if x not in shared_numbers}
    is_self = inner.builder.input(bool)
    other_elements = [_replace_elements(x, other_inputs) for x in args[n_captured:]]
    results = inner.lower(eqn.params["jaxpr"], [*args[:n_captured], *other_elements, as_elements([is_self], ())])
    block = inner.finish(results)
    used = block.used_values()  # numbers that the block does not use are not published
    pairs = [(x, y) for x, y in other_inputs.items() if y in used]
    block = dataclasses.replace(block, inputs=(*(y for _, y in pairs), is_self))
    types = [x.dtype for x in block.outputs]
    name = ops.REDUCTIONS[eqn.params["reduce"]]
    names = tuple([ops.BOOLEAN_FORM[name][0] if dtype.kind == "b" else name for dtype in types])
    outs = iter(
        ctx.builder.add_many(
            "over_others", [x for x, _ in pairs], types, (("reduce", names), ("n_members", n)), (block,)
        )
    )
    return [as_elements([next(outs) for _ in scalars(x)], x.shape) for x in results]


def _replace_elements(x: ElementArray, replacements: dict[Value, Value]) -> ElementArray:
    def replace(item: Any) -> Any:
        if isinstance(item, tuple):
            return tuple(map(replace, item))
        return replacements.get(item, item) if isinstance(item, Value) else item

    return as_elements([replace(item) for item in x.reshape(-1)], x.shape)


def _shared_numbers(ctx: Lowering) -> set[Value]:
    shared = set(ctx.shared)
    for op in ctx.builder.operations:
        if op.results and not op.blocks and all([is_constant(x) or x in shared for x in op.args]):
            shared.update(op.results)
    return shared
