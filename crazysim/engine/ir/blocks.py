"""The intermediate representation: a block of scalar operations in single-assignment form.

The engine does not compile arrays. Every element of every small array is a separate value, constants are folded,
and a common subexpression is computed once. Blocks are immutable; a ``Builder`` makes one. ``ops`` lists the
operations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from crazysim.engine.ir import ops
from crazysim.engine.ir.algebra import constant_key, is_known_zero, simplify

Element = Any
"""A ``Value``, or a NumPy scalar for a constant."""


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class Value:
    """One number that is computed at run time, or a table of numbers; equal only to itself."""

    dtype: np.dtype
    """Type of the number."""
    size: int = 0
    """Number of entries of a table, which only ``lookup`` reads; 0 for a single number."""


class TableEntries:
    """Entries of a table that are known before the program runs. Tables with the same type and bits are equal."""

    def __init__(self, array: np.ndarray):
        self.array = array
        self._key = (array.dtype, array.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TableEntries) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return f"{self.array.dtype}[{self.array.size}]"


class Operation(NamedTuple):
    """Results computed from operands."""

    name: str
    """Name in ``ops.TABLE``."""
    args: tuple[Element, ...]
    """Operands."""
    results: tuple[Value, ...]
    """Values that it defines."""
    params: tuple[tuple[str, Any], ...] = ()
    """Static parameters, as pairs of name and value."""
    blocks: tuple[Block, ...] = ()
    """Blocks that it runs. Their operations may use the values that are defined before this operation."""
    stage: str = ""
    """Stage of the pipeline that the operation was lowered from."""

    def param(self, name: str) -> Any:
        return dict(self.params)[name]

    @property
    def dtype(self) -> np.dtype:
        """Type of the first result."""
        return self.results[0].dtype


@dataclasses.dataclass(frozen=True, eq=False)
class Block:
    """Operations in order, from inputs to outputs. An inner block may use values of the blocks around it."""

    inputs: tuple[Value, ...] = ()
    operations: tuple[Operation, ...] = ()
    outputs: tuple[Element, ...] = ()

    def walk(self) -> Iterator[Operation]:
        """Iterate over all operations, including inner blocks."""
        for operation in self.operations:
            yield operation
            for block in operation.blocks:
                yield from block.walk()

    def blocks(self) -> Iterator[Block]:
        """Iterate over the block and its inner blocks."""
        yield self
        for operation in self.operations:
            for block in operation.blocks:
                yield from block.blocks()

    def used_values(self) -> set[Value]:
        """Return the values that operations and outputs use, including inner blocks."""
        used = {x for x in self.outputs if isinstance(x, Value)}
        for operation in self.operations:
            used.update(x for x in operation.args if isinstance(x, Value))
            for block in operation.blocks:
                used |= block.used_values()
        return used


class Builder:
    """Builder of a block, operation by operation."""

    def __init__(self, outer: Builder | None = None, stage: str = ""):
        self.outer = outer
        self.stage = outer.stage if outer is not None else stage
        self.inputs: list[Value] = []
        self.operations: list[Operation] = []
        self._results_by_key: dict[Any, tuple[Value, ...]] = {}

    def input(self, dtype: DTypeLike, size: int = 0) -> Value:
        """Add an input, a table if a size is given."""
        value = Value(np.dtype(dtype), size)
        self.inputs.append(value)
        return value

    def add(self, name: str, args: Sequence[Element], dtype: DTypeLike, params: tuple = ()) -> Element:
        """Return the result of an operation: a new value, the value of an equal earlier operation, or a constant."""
        args, dtype = tuple(args), np.dtype(dtype)
        simplified = simplify(name, args, dtype, params)
        if simplified is not None:
            return simplified
        if name == "sub" and is_known_zero(args[0]):  # a negative operand costs nothing in a product or a sum
            name, args = "neg", args[1:]
        return self._add(name, args, (dtype,), params)[0]

    def add_many(
        self,
        name: str,
        args: Sequence[Element],
        dtypes: Sequence[Any],
        params: tuple = (),
        blocks: tuple[Block, ...] = (),
    ) -> tuple[Value, ...]:
        """Return the results of an operation that may have several results, or runs blocks."""
        args, types = tuple(args), tuple(map(np.dtype, dtypes))
        return (
            self._append_operation(name, args, types, params, blocks)
            if blocks
            else self._add(name, args, types, params)
        )

    def barrier(self) -> None:
        """Add a barrier: values that are used after it should be computed once, before it."""
        if self.operations and self.operations[-1].name != "barrier":
            self._append_operation("barrier", (), (), (), ())

    def finish(self, outputs: Sequence[Element]) -> Block:
        return Block(tuple(self.inputs), tuple(self.operations), tuple(outputs))

    def _add(self, name: str, args: tuple, dtypes: tuple[np.dtype, ...], params: tuple) -> tuple[Value, ...]:
        # NaN differs from itself, and -0.0 equals 0.0: constants are compared by their bytes.
        key = (name, dtypes, params, *[x if isinstance(x, Value) else constant_key(x) for x in args])
        builder: Builder | None = self
        while builder is not None:
            earlier_results = builder._results_by_key.get(key)
            if earlier_results is not None:
                return earlier_results
            builder = builder.outer
        results = self._results_by_key[key] = self._append_operation(name, args, dtypes, params, ())
        return results

    def _append_operation(
        self, name: str, args: tuple, dtypes: tuple, params: tuple, blocks: tuple
    ) -> tuple[Value, ...]:
        if name not in ops.TABLE:
            raise KeyError(f"operation {name!r} is not in ops.TABLE")
        size = dict(params)["numbers"].array.size if name == "table" else 0
        results = tuple([Value(dtype, size) for dtype in dtypes])
        self.operations.append(Operation(name, args, results, params, blocks, self.stage))
        return results


def constant(value: Any, dtype: DTypeLike) -> np.generic:
    return np.dtype(dtype).type(value)


def is_constant(x: Element) -> bool:
    """Whether an element is known before the program runs."""
    return isinstance(x, np.generic)


def prune(block: Block, keep_inputs: bool = True) -> Block:
    """Return a block without the operations that no output needs."""
    block = _prune(block, set())
    if keep_inputs:
        return block
    used = block.used_values()
    return dataclasses.replace(block, inputs=tuple([x for x in block.inputs if x in used]))


def _prune(block: Block, used: set[Value]) -> Block:
    used.update(x for x in block.outputs if isinstance(x, Value))
    operations = []
    for op in reversed(block.operations):
        if op.name == "barrier":
            operations.append(op)
        elif not used.isdisjoint(op.results):
            op = _drop_results(op, used) if op.name == "when" else op
            used.update(x for x in op.args if isinstance(x, Value))
            if op.blocks:
                blocks = tuple([_prune(inner, used) for inner in op.blocks])
                operations.append(op._replace(blocks=blocks))
            else:
                operations.append(op)
    return dataclasses.replace(block, operations=tuple(operations[::-1]))


def _drop_results(op: Operation, used_values: Collection[Value]) -> Operation:
    (mask, *old_values), (block,) = op.args, op.blocks
    used_indices = [k for k, x in enumerate(op.results) if x in used_values]
    if len(used_indices) == len(op.results):
        return op
    inner = dataclasses.replace(block, outputs=tuple([block.outputs[k] for k in used_indices]))
    args, results = (mask, *(old_values[k] for k in used_indices)), tuple([op.results[k] for k in used_indices])
    return op._replace(args=args, results=results, blocks=(inner,))


def substitute(block: Block, replacements: Mapping[Value, Element]) -> Block:
    """Return a block in which operands and outputs are replaced; the operations that define the old values remain."""

    def map_element(x: Element) -> Element:
        return replacements.get(x, x) if isinstance(x, Value) else x

    operations = [
        op._replace(
            args=tuple([map_element(x) for x in op.args]),
            blocks=tuple([substitute(inner, replacements) for inner in op.blocks]),
        )
        for op in block.operations
    ]
    return Block(block.inputs, tuple(operations), tuple([map_element(x) for x in block.outputs]))


def inline(builder: Builder, block: Block, values: dict[Value, Element]) -> list[Element]:
    """Add a block's operations to a builder, simplified by the constants known there, and return its outputs.

    Args:
        values: Elements for the block's inputs and for values of enclosing blocks. The block's own values are added.
    """

    def map_element(x: Element) -> Element:
        return values.get(x, x) if isinstance(x, Value) else x

    for op in block.operations:
        args = [map_element(x) for x in op.args]
        if op.name == "barrier":
            builder.barrier()
        elif len(op.results) == 1 and not op.blocks:
            (result,) = op.results
            # Operations were simplified when they were built; more is possible only if a value became a constant.
            if any([isinstance(x, np.generic) for x in args]):
                values[result] = builder.add(op.name, args, result.dtype, op.params)
            else:
                (values[result],) = builder.add_many(op.name, args, (result.dtype,), op.params)
        else:
            blocks = tuple([_inline_block(builder, inner, values) for inner in op.blocks])
            results = builder.add_many(op.name, args, [x.dtype for x in op.results], op.params, blocks)
            values.update(zip(op.results, results, strict=True))
    return [map_element(x) for x in block.outputs]


def _inline_block(outer: Builder, block: Block, values: dict[Value, Element]) -> Block:
    builder = Builder(outer)
    inner_values = values | {x: builder.input(x.dtype) for x in block.inputs}
    return builder.finish(inline(builder, block, inner_values))
