"""Programs: the stages of a step as operations on the numbers of one drone or one world.

A program is immutable. ``lower_stages`` makes a program from stages, and each pass (``engine.passes``) returns a new
one. ``listing.list_program`` prints it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir.blocks import Block
from crazysim.engine.jaxcompat import is_key
from crazysim.engine.stage import Phase

Slot = tuple[int, int]
"""Place of a number: the index of its leaf, and the index of the element among the elements of one drone (or world)."""

TABLE_INDEX = -1
"""Element index of a slot that stands for a whole leaf. Such a leaf is a table: operations read it at computed indices.
Only shared leaves are tables."""

PACKED_LEAF_NAME = "packed"
"""Name of the leaf that holds the packed shared leaves."""

Zeros = tuple[tuple[int, frozenset[int]], ...]
"""Pairs of the index of a leaf and the indices of its elements that are known to be zero."""


@dataclasses.dataclass(frozen=True, eq=False)
class Leaf:
    """One array of the data."""

    name: str
    """Path of the field in the record."""
    scope: str
    """Scope of the field: ``drone``, ``world``, ``batch``, ``shared`` or ``opaque``."""
    shape: tuple[int, ...]
    """Shape, for all worlds."""
    dtype: Any
    """Type."""
    row_leaves: tuple[int, ...] = ()
    """Indices of the leaves that are stored as rows of this leaf, in order: each number of a drone (or world) is a row.
    The shape of a leaf with rows is (n_rows, n_lanes). Empty for a leaf without rows."""

    @functools.cached_property
    def size(self) -> int:
        """Number of scalars per drone (or world); a random key is two 32-bit integers."""
        if self.row_leaves:
            return self.shape[0]
        shape = self.shape[2:] if self.scope in ("drone", "world") else self.shape
        return int(np.prod(shape, dtype=int)) * (2 if is_key(self) else 1)

    @functools.cached_property
    def number_type(self) -> np.dtype:
        """Type of the numbers: the dtype, or uint32 for random keys."""
        return np.dtype(np.uint32 if is_key(self) else self.dtype)


@dataclasses.dataclass(frozen=True, eq=False)
class Segment:
    """Stages that run together, as a block of scalar operations."""

    scope: Literal["drone", "world"]
    """Scope of the block: the numbers of one drone, or of one world."""
    stages: tuple[str, ...]
    """Names of the stages."""
    phase: Phase
    """Time within a call at which they run."""
    block: Block
    """The block. Its inputs are ``reads``, then the outputs of ``hoisted``; its outputs are ``writes``."""
    reads: tuple[Slot, ...]
    """Slots of its inputs. In a segment of worlds, the elements of a drone leaf are numbered drone after drone."""
    writes: tuple[Slot, ...]
    """Slots of its outputs."""
    hoisted: Block = dataclasses.field(default_factory=Block)
    """Computations hoisted out of the steps, run once before the first step."""
    hoisted_reads: tuple[Slot, ...] = ()
    """Slots of the inputs of ``hoisted``."""

    @property
    def written_leaves(self) -> list[int]:
        return sorted({leaf for leaf, _ in self.writes})

    @property
    def read_leaves(self) -> set[int]:
        return {leaf for leaf, _ in (*self.reads, *self.hoisted_reads)}

    @functools.cached_property
    def couples_drones(self) -> bool:
        """Whether drones of a world read each other's numbers."""
        return self.scope == "world" or any(op.name == "over_others" for op in self.block.operations)

    @property
    def n_operations(self) -> int:
        return sum(op.name != "barrier" for op in self.block.walk())


@dataclasses.dataclass(frozen=True, eq=False)
class UnfusedStage:
    """A stage that runs as it is written, on the arrays of all worlds."""

    name: str
    """Name of the stage."""
    phase: Phase
    """Time within a call at which it runs."""
    jaxpr: Any
    """The stage, from the leaves in ``input_leaves`` to the leaves in ``written_leaves``."""
    input_leaves: tuple[int, ...]
    """Leaves that it reads."""
    written_leaves: tuple[int, ...]
    """Leaves that it writes."""
    error: UnsupportedError
    """Reason why the stage is not fused."""

    @property
    def stages(self) -> tuple[str, ...]:
        """Name of the stage, in a tuple like the names of a segment."""
        return (self.name,)

    @property
    def read_leaves(self) -> set[int]:
        return set(self.input_leaves)

    @property
    def explanation(self) -> str:
        """Clause that says that the stage is not fused, and why."""
        return f"{self.name!r} is not fused: {self.error.reason}"


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """Program of a step, and of the stages that run before the first step and after the last."""

    leaves: tuple[Leaf, ...]
    """Arrays of the data, followed by the arrays that passes add."""
    n_drones: int
    """Drones of a world."""
    segments: tuple[Segment | UnfusedStage, ...]
    """Segments in order, phase by phase."""
    check_segment: Segment | None = None
    """Segment that runs after the last step and flags drones for which one of its ``reads`` is not finite."""
    scratch: frozenset[int] = frozenset()
    """Leaves that only pass numbers from one stage to another; their values are lost after a call."""
    packed: tuple[int, ...] = ()
    """Shared leaves that are concatenated in one additional leaf."""
    population: str = "drone"
    """Population whose members are the lanes. A program calls them drones, and their scope ``drone``."""
    views: frozenset[int] = frozenset()
    """Leaves of other populations, which the program reads as leaves of the world (``lowering.relative``)."""

    @functools.cached_property
    def fused(self) -> bool:
        """Whether one kernel can run the whole program."""
        return not self.unfused_stages

    @functools.cached_property
    def unfused_stages(self) -> tuple[UnfusedStage, ...]:
        return tuple([s for s in self.segments if isinstance(s, UnfusedStage)])

    @functools.cached_property
    def fused_segments(self) -> tuple[Segment, ...]:
        return tuple([s for s in self.segments if isinstance(s, Segment)])

    @functools.cached_property
    def written_leaves(self) -> list[int]:
        """Indices of the leaves that are written, without scratch."""
        return sorted({i for s in self.segments for i in s.written_leaves} - self.scratch)

    @functools.cached_property
    def read_leaves(self) -> list[int]:
        return sorted({i for s in self.segments for i in s.read_leaves})

    @functools.cached_property
    def ranks(self) -> dict[int, int]:
        """Rank of each leaf among the used leaves.

        Kernels name leaves by rank, so steps that only differ in unused leaves have the same source.
        """
        checked = [leaf for leaf, _ in self.check_segment.reads] if self.check_segment is not None else []
        used = {*checked, *(i for s in self.segments for i in (*s.read_leaves, *s.written_leaves))}
        return {leaf: n for n, leaf in enumerate(sorted(used))}

    @functools.cached_property
    def tables(self) -> set[int]:
        """Leaves that are read as tables."""
        segments = self.fused_segments
        return {leaf for s in segments for leaf, k in (*s.reads, *s.hoisted_reads) if k == TABLE_INDEX}

    @functools.cached_property
    def rows(self) -> dict[int, int]:
        """Number of rows of each leaf that holds other leaves as rows."""
        return {i: leaf.shape[0] for i, leaf in enumerate(self.leaves) if leaf.row_leaves}

    @functools.cached_property
    def group_size(self) -> int:
        """Number of drones that read each other's numbers: all drones of a world if a segment couples them, else 1."""
        return self.n_drones if any(s.couples_drones for s in self.fused_segments) else 1

    def phase_segments(self, phase: Phase) -> list[Any]:
        return [segment for segment in self.segments if segment.phase == phase]

    def drone_slots(self, segment: Segment, slots: Sequence[Slot]) -> list[Slot]:
        """Return slots of a segment as slots of one drone. A segment of worlds has separate slots for each drone."""
        if segment.scope == "drone":
            return list(slots)
        return [(i, k if k == TABLE_INDEX else k % self.leaves[i].size) for i, k in slots]

    def changing_slots(self) -> set[Slot]:
        slots: set[Slot] = set()
        for segment in self.phase_segments("each"):
            if isinstance(segment, Segment):
                slots.update(self.drone_slots(segment, segment.writes))
            else:
                slots.update(
                    (leaf, k) for leaf in segment.written_leaves for k in range(TABLE_INDEX, self.leaves[leaf].size)
                )
        return slots

    @functools.cached_property
    def parts(self) -> tuple[Program, ...]:
        """Parts of the program in order: fused segments that one kernel can run, or one unfused stage.

        If all stages of a step are fused and nothing is checked after the last one, a part has segments of all phases.
        Otherwise the segments of a part have the same phase.
        """
        loops = self.check_segment is None and not any(s.phase == "each" for s in self.unfused_stages)
        groups = itertools.groupby(
            self.segments, lambda s: (loops or s.phase, id(s) if isinstance(s, UnfusedStage) else 0)
        )
        return tuple([
            dataclasses.replace(self, segments=tuple(segments), check_segment=None, scratch=frozenset())
            for _, segments in groups
        ])  # fmt: skip
