"""Passes that change where the numbers of a program are stored."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from crazysim.engine.ir.program import PACKED_LEAF_NAME, Leaf, Program, Segment, Slot
from crazysim.engine.jaxcompat import is_key


def pack_shared(program: Program) -> Program:
    """Read the numbers that all drones share from one additional leaf, which concatenates the shared leaves.

    A call of a compiled step takes longer the more arrays it has. Leaves stay separate if an unfused stage reads them,
    if a stage writes them, if they are read as tables, or if their type differs from the type of the first leaf.
    """
    leaves = program.leaves
    separate_leaves = {leaf for stage in program.unfused_stages for leaf in stage.input_leaves} | program.tables
    shared_leaves = [
        i
        for i in program.read_leaves
        if leaves[i].scope == "shared" and i not in separate_leaves and i not in program.written_leaves
    ]
    shared_leaves = [i for i in shared_leaves if leaves[i].dtype == leaves[0].dtype]
    if not shared_leaves:
        return program
    starts, size = {}, 0
    for i in shared_leaves:
        starts[i] = size
        size += leaves[i].size
    packed_leaf = Leaf(PACKED_LEAF_NAME, "shared", (size,), leaves[0].dtype)
    moved_program = _move_slots(
        program, lambda slot: (len(leaves), starts[slot[0]] + slot[1]) if slot[0] in starts else slot
    )
    return dataclasses.replace(moved_program, leaves=(*leaves, packed_leaf), packed=tuple(shared_leaves))


def pack_rows(program: Program, select_rows: Callable[[list[int]], list[int]]) -> Program:
    """Store leaves of drones and worlds as rows of additional leaves, one for each scope and type.

    A row holds one number of all drones, in the order of a kernel's lanes.

    Args:
        select_rows: Function from the written leaves to the leaves that become rows; random keys are never moved.
    """
    leaves = list(program.leaves)
    row_leaves = [i for i in sorted(select_rows(program.written_leaves)) if not is_key(leaves[i])]
    # If a world has one drone, leaves of the world can be stored with the leaves of drones.
    row_types = {i: ("drone" if program.n_drones == 1 else leaves[i].scope, leaves[i].dtype) for i in row_leaves}
    positions: dict[int, tuple[int, int, int]] = {}
    for row_type in dict.fromkeys(row_types.values()):
        source_leaves = tuple([i for i in row_leaves if row_types[i] == row_type])
        n_rows = sum(leaves[i].size for i in source_leaves)
        first_row = 0
        for i in source_leaves:
            positions[i] = (len(leaves), first_row, n_rows)
            first_row += leaves[i].size
        n_lanes = leaves[source_leaves[0]].shape[0] * program.n_drones
        leaves.append(Leaf("rows", row_type[0], (n_rows, n_lanes), row_type[1], source_leaves))

    def move_slot(slot: Slot) -> Slot:
        leaf, k = slot
        if leaf not in positions:
            return slot
        new_leaf, first_row, n_rows = positions[leaf]
        drone, k = divmod(k, program.leaves[leaf].size)
        return new_leaf, drone * n_rows + first_row + k

    return dataclasses.replace(_move_slots(program, move_slot), leaves=tuple(leaves))


class PackedRows(NamedTuple):
    """A leaf of rows, which are the numbers of other leaves. Arrays have the shapes of the program's leaves."""

    program: Program
    """The program, after ``pack_rows``."""
    leaf: int
    """Index of the leaf of rows."""

    @property
    def source_leaves(self) -> tuple[int, ...]:
        """Indices of the leaves whose numbers are the rows, in order."""
        return self.program.leaves[self.leaf].row_leaves

    def pack(self, leaves: Sequence[Any]) -> Array:
        """Return the rows. (n_rows, n_lanes)"""
        n_drones = self.program.n_drones

        def rows_of_leaf(x: Any) -> Array:
            x = jnp.broadcast_to(x, (x.shape[0], n_drones, *x.shape[2:]))
            return x.reshape(x.shape[0] * n_drones, -1).T

        return jnp.concatenate([rows_of_leaf(leaves[i]) for i in self.source_leaves])

    def unpack(self, rows: Array, leaf: int) -> Array:
        sizes = {i: self.program.leaves[i].size for i in self.source_leaves}
        source, n_before = self.program.leaves[leaf], self.source_leaves.index(leaf)
        first_row = sum(sizes[i] for i in self.source_leaves[:n_before])
        x = rows[first_row : first_row + source.size].T.reshape(-1, self.program.n_drones, *source.shape[2:])
        return x[:, :1] if source.scope == "world" else x


def packed_rows(program: Program) -> list[PackedRows]:
    return [PackedRows(program, i) for i, leaf in enumerate(program.leaves) if leaf.row_leaves]


def _move_slots(program: Program, move_slot: Callable[[Slot], Slot]) -> Program:
    def move_segment(s: Segment) -> Segment:
        reads, writes, hoisted = ([move_slot(slot) for slot in x] for x in (s.reads, s.writes, s.hoisted_reads))
        return dataclasses.replace(s, reads=tuple(reads), writes=tuple(writes), hoisted_reads=tuple(hoisted))

    segments = tuple([move_segment(s) if isinstance(s, Segment) else s for s in program.segments])
    return dataclasses.replace(
        program, segments=segments, check_segment=program.check_segment and move_segment(program.check_segment)
    )
