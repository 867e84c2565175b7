"""Tables: shared arrays and constants in memory, which are read at computed indices.

Elements of a small array are selected in registers instead.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crazysim.engine.ir.blocks import Element, TableEntries, Value, constant, is_constant
from crazysim.engine.lowering.jaxprs import MAX_UNROLL, ElementArray, Lowering, TableEntry, as_elements

MAX_SELECTED = 4
"""Maximum number of elements from which an entry of a shared array is selected: they are already in registers."""
MAX_SELECTED_CONSTANTS = 8
"""Maximum number of constants from which an entry is selected: they are parts of instructions."""

ZERO_INDEX = constant(0, np.int32)


class TableView:
    """An array whose elements are entries of a table in memory, each at a computed base plus a constant offset."""

    def __init__(self, ctx: Lowering, entry: TableEntry, offsets: np.ndarray, strides: dict[int, int]):
        self.ctx, self.table, self.base, self.offsets, self.strides = ctx, entry.table, entry.base, offsets, strides
        self.aligned = entry.aligned and all(stride % 4 == 0 for stride in strides.values())
        self.constants_by_offset: dict[int, Element] = {}
        """Constants that are equal along the indexed axes, by the offset of the first; they are not looked up."""

    def get_base(self, index: Sequence[Element], limits: Sequence[int]) -> Element:
        """Return the base of the elements at an index along the axes. Each part of it is clamped to 0 and its limit."""
        base = self.base
        for i, limit, stride in zip(index, limits, self.strides.values(), strict=True):
            if limit == 0:
                continue
            largest = constant(min(limit, np.iinfo(i.dtype).max), i.dtype)
            clamped = self.ctx.scalar("clamp", constant(0, i.dtype), i, largest)
            integer = self.ctx.scalar("convert_element_type", clamped, dtype=np.int32)
            increment = self.ctx.scalar("mul", integer, constant(stride, np.int32))
            base = self.ctx.scalar("add", base, increment)
        return base

    def look_up(self, offsets: np.ndarray, bases: Sequence[Element]) -> ElementArray:
        """Return the entries at some offsets, each relative to its base."""
        flat_offsets = [int(k) for k in offsets.reshape(-1)]
        numbers = [
            self.constants_by_offset[k]
            if k in self.constants_by_offset
            else self.ctx.lookup(self.table, base, k, self.aligned)
            for k, base in zip(flat_offsets, bases, strict=True)
        ]
        return as_elements(numbers, offsets.shape)


def find_table(ctx: Lowering, x: ElementArray, axes: Sequence[int], n_indices: int) -> TableView | None:
    """Return an array as a view of a table in which an index along some axes moves all entries by the same offset.

    Return None if it is not such a view, or if it has so few elements that selecting among them is faster.

    Args:
        axes: The axes along which it is indexed.
        n_indices: Number of positions that an index may take.
    """
    items = x.reshape(-1)
    if not len(items) or isinstance(items[0], tuple):
        return None
    if all(map(is_constant, items)):
        return _table_of_constants(ctx, x, axes) if n_indices > MAX_SELECTED_CONSTANTS else None
    locations = [ctx.entries.get(item) if isinstance(item, Value) else None for item in items]
    first_location = locations[0]
    if first_location is None or not all(
        x is not None and x.table is first_location.table and x.base is first_location.base for x in locations
    ):
        return None
    if n_indices <= MAX_SELECTED and first_location.table.size <= MAX_UNROLL:
        return None
    offsets = np.array([entry.offset for entry in locations if entry is not None]).reshape(x.shape)
    strides = _strides(offsets, axes)
    return None if strides is None else TableView(ctx, first_location, offsets, strides)


def _table_of_constants(ctx: Lowering, x: ElementArray, axes: Sequence[int]) -> TableView | None:
    numbers = np.array([item.item() for item in x.reshape(-1)], x.reshape(-1)[0].dtype)
    if not np.all(np.isfinite(numbers)):
        return None
    offsets = np.arange(x.size).reshape(x.shape)
    (value,) = ctx.builder.add_many("table", (), (numbers.dtype,), (("numbers", TableEntries(numbers)),))
    table = TableView(ctx, TableEntry(value, ZERO_INDEX, 0), offsets, _strides(offsets, axes) or {})
    first_rows = tuple([slice(0, 1) if axis in axes else slice(None) for axis in range(x.ndim)])
    bits = numbers.view(f"u{numbers.itemsize}").reshape(x.shape)
    is_equal = np.all(bits == bits[first_rows], tuple(axes), keepdims=True)
    table.constants_by_offset = {int(k): x.reshape(-1)[k] for k in offsets[first_rows][is_equal]}
    return table


def _strides(offsets: np.ndarray, axes: Sequence[int]) -> dict[int, int] | None:
    strides = {}
    for axis in axes:
        steps = np.diff(offsets, axis=axis)
        strides[axis] = int(steps.reshape(-1)[0]) if steps.size else 0
        if np.any(steps != strides[axis]):
            return None
    return strides
