"""The smallest or largest number over other drones, in a form that has derivatives.

The derivative is the derivative of the number of the first drone that has the smallest or largest number, as
``crazysim.engine.pair_reductions`` defines it. That drone is identified by its index, not by comparing numbers, since
numbers that are computed twice may be rounded differently.
"""

from __future__ import annotations

from crazysim.engine.ir.blocks import Block, Builder, Element, Operation, Value, constant, inline, prune

INDEX_REDUCTION_OF = {"min": "argmin", "max": "argmax"}
"""Reduction that finds the drone with the smallest or largest number (``ops.INDEX_REDUCTIONS``)."""


def add_selections(block: Block) -> Block:
    """Return a block with two further loops for each operation with minima or maxima over other drones.

    The first loop finds the drones that have the minima or maxima. The second loop selects the numbers of these drones.
    """
    if not any(map(_selected_results, block.operations)):
        return block
    builder = Builder()
    values: dict[Value, Element] = {x: builder.input(x.dtype, x.size) for x in block.inputs}
    for op in block.operations:
        builder.stage = op.stage
        inline(builder, Block((), (op,), ()), values)
        if indices := _selected_results(op):
            values.update(
                zip([op.results[k] for k in indices], _add_selection(builder, op, indices, values), strict=True)
            )
    outputs = [values.get(x, x) if isinstance(x, Value) else x for x in block.outputs]
    return Block(tuple([values[x] for x in block.inputs]), tuple(builder.operations), tuple(outputs))


def _selected_results(op: Operation) -> list[int]:
    if op.name != "over_others":
        return []
    pairs = zip(op.param("reduce"), op.results, strict=True)
    return [k for k, (name, x) in enumerate(pairs) if name in INDEX_REDUCTION_OF and x.dtype.kind == "f"]


def _add_selection(
    builder: Builder, op: Operation, indices: list[int], values: dict[Value, Element]
) -> tuple[Value, ...]:
    (body,) = op.blocks
    args = [values.get(x, x) if isinstance(x, Value) else x for x in op.args]
    dtypes, n_members = [op.results[k].dtype for k in indices], ("n_members", op.param("n_members"))

    def copy_body(n_extra: int) -> tuple[Builder, list[Value], list[Element]]:
        # The copy has ``n_extra`` further inputs for published integers, before the input that marks the drone itself.
        inner = Builder(builder)
        new_inputs = [inner.input(x.dtype) for x in body.inputs[:-1]] + [inner.input("int32") for _ in range(n_extra)]
        is_self = inner.input(bool)
        pair_inputs = [*new_inputs[: len(args)], is_self]
        outs = inline(inner, body, values | dict(zip(body.inputs, pair_inputs, strict=True)))
        return inner, [*new_inputs[len(args) :], is_self], [outs[k] for k in indices]

    inner, (is_self,), candidates = copy_body(0)
    one, zero = (constant(x, dtypes[0]) for x in (1, 0))
    # The argmax of this number is the index of the drone itself.
    is_self_number = inner.add("select_n", (is_self, zero, one), dtypes[0])
    reductions = (*(INDEX_REDUCTION_OF[op.param("reduce")[k]] for k in indices), "argmax")
    block = prune(inner.finish([*candidates, is_self_number]))
    params = (("reduce", reductions), n_members)
    *selected_indices, own_index = builder.add_many("over_others", args, ["int32"] * len(reductions), params, (block,))

    inner, (other_index, _), candidates = copy_body(1)
    terms = [inner.add("select_n", (inner.add("eq", (other_index, index), bool), constant(0, x.dtype), x), x.dtype)
             for index, x in zip(selected_indices, candidates, strict=True)]  # fmt: skip
    params = (("reduce", ("add",) * len(indices)), n_members)
    return builder.add_many("over_others", [*args, own_index], dtypes, params, (prune(inner.finish(terms)),))
