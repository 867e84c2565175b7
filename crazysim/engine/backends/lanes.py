"""Backend that runs programs in XLA. Each scalar of a drone is a vector with one lane per drone.

XLA receives only element-wise arithmetic: within and between fused stages no array has the shape of a small vector or
matrix. An unfused stage receives ordinary arrays, and the step is split around it.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import Run, xla
from crazysim.engine.ir.blocks import Block
from crazysim.engine.ir.program import TABLE_INDEX, Program, Segment, Slot, UnfusedStage
from crazysim.engine.jaxcompat import is_key
from crazysim.engine.passes.schedule import add_barriers
from crazysim.engine.sharding import Location
from crazysim.engine.stage import Phase

BlockRunner = Callable[[Block, Sequence[Any], tuple[int, ...]], Sequence[Any]]
"""Function that runs a block: it takes the block, its inputs and the shape of the lanes, and returns the outputs."""


class LeafValues:
    """Values of the leaves of a program, each as an array, as one vector of lanes per scalar, or as both.

    If a leaf has only one of these forms, the other form is made when it is read. Writing one form removes the other.
    """

    def __init__(self, program: Program, leaves: list[Any], execute: BlockRunner = xla.run_block, library: Any = jnp):
        self.program, self.execute, self.library = program, execute, library
        self.n_worlds, self.n_drones = batch_counts(program, leaves)
        self.arrays: dict[int, Any] = dict(enumerate(leaves))
        self.vectors: dict[Slot, Any] = {}

    def copy(self) -> LeafValues:
        """Return a copy that can be written to without changing this object."""
        values = copy.copy(self)
        values.arrays, values.vectors = dict(self.arrays), dict(self.vectors)
        return values

    @property
    def shape(self) -> tuple[int]:
        """Shape of a vector of lanes: one lane for each drone, world after world."""
        return (self.n_worlds * self.n_drones,)

    def get(self, slot: Slot) -> Any:
        """Return the value of a slot: a vector of lanes, a scalar if it is shared, or a flat table."""
        if slot[1] == TABLE_INDEX:
            return self.arrays[slot[0]].reshape(-1)
        if slot not in self.vectors:
            self._split_leaf(slot[0])
        return self.vectors[slot]

    def set(self, slot: Slot, value: Any) -> None:
        """Write the value of a slot for every drone; a scalar is broadcast to all lanes."""
        if slot not in self.vectors:
            self._split_leaf(slot[0])
        self.vectors[slot] = value if np.shape(value) == self.shape else self.library.broadcast_to(value, self.shape)
        self.arrays.pop(slot[0], None)

    def array(self, leaf: int) -> Any:
        """Return a leaf as an array, as the program takes and returns it."""
        if leaf not in self.arrays:
            description = self.program.leaves[leaf]
            vectors = [self.vectors[leaf, k] for k in range(description.size)]
            self.arrays[leaf] = (
                self.library.stack(vectors) if description.row_leaves else self._stack_vectors(leaf, vectors)
            )
        return self.arrays[leaf]

    def _stack_vectors(self, leaf: int, vectors: list[Any]) -> Any:
        description, is_random_key = self.program.leaves[leaf], is_key(self.program.leaves[leaf])
        shape = (*description.shape[2:], 2) if is_random_key else description.shape[2:]
        array = self.library.stack(vectors, axis=-1).reshape(self.n_worlds, self.n_drones, *shape)
        array = jax.random.wrap_key_data(array) if is_random_key and self.library is jnp else array
        return array[:, :1] if description.scope == "world" else array

    def set_array(self, leaf: int, value: Any) -> None:
        self.arrays[leaf] = value
        for k in range(self.program.leaves[leaf].size):
            self.vectors.pop((leaf, k), None)

    def _split_leaf(self, leaf: int) -> None:
        x, description = self.arrays[leaf], self.program.leaves[leaf]
        size = description.size
        if description.row_leaves or x is None:  # a leaf that is None is written before it is read
            self.vectors.update(((leaf, k), self.library.zeros(self.shape) if x is None else x[k]) for k in range(size))
            return
        if is_key(x):
            x = jax.random.key_data(x)
        if description.scope == "world":
            x = self.library.broadcast_to(x, (self.n_worlds, self.n_drones, *x.shape[2:]))
        batch_axes = self.shape if description.scope in ("drone", "world") else ()
        x = x.reshape(*batch_axes, size)
        self.vectors.update(((leaf, k), x[..., k]) for k in range(size))


def batch_counts(program: Program, leaves: list[Any]) -> tuple[int, int]:
    """Return the numbers of worlds and of drones per world; within a mesh, the numbers on this device."""
    drone_leaf = next(
        i
        for i, (leaf, x) in enumerate(zip(program.leaves, leaves, strict=True))
        if leaf.scope == "drone" and x is not None and not leaf.row_leaves
    )
    return leaves[drone_leaf].shape[0], leaves[drone_leaf].shape[1]


def leaf_shape(program: Program, leaf: int, n_worlds: int) -> jax.ShapeDtypeStruct:
    """Return the shape and type of a leaf that a program writes, for all worlds. Random keys are integers here."""
    description = program.leaves[leaf]
    shape = (n_worlds, *description.shape[1:])
    if leaf in program.rows:
        shape = (program.rows[leaf], n_worlds * program.n_drones)
    return jax.ShapeDtypeStruct((*shape, *([2] if is_key(description) else [])), description.number_type)


MIN_CHECKPOINTED_STEPS = 256
"""Number of steps from which the backward pass stores the carries of only some steps; see ``repeat``."""

HoistedResults = dict[int, Sequence[Any]]
"""Results of hoisted blocks, by the index of their segment among the segments of the phase ``each``."""


def prepare_steps(program: Program, values: LeafValues) -> HoistedResults:
    """Run the segments before the first step, then the hoisted blocks, and return the results of these blocks."""
    run_phase(program, values, "before", {})
    return {
        k: values.execute(s.hoisted, [values.get(slot) for slot in s.hoisted_reads], values.shape)
        for k, s in enumerate(program.phase_segments("each"))
        if isinstance(s, Segment) and s.hoisted.outputs
    }


def run_phase(program: Program, values: LeafValues, phase: Phase, hoisted_results: HoistedResults) -> None:
    for k, segment in enumerate(program.phase_segments(phase)):
        if isinstance(segment, UnfusedStage):
            _run_unfused(segment, values)
        elif segment.scope == "world":
            _run_worlds(segment, values)
        else:
            _run_drones(segment, values, hoisted_results.get(k, []))


def _run_drones(segment: Segment, values: LeafValues, hoisted_results: Sequence[Any]) -> None:
    outs = values.execute(
        segment.block, [*(values.get(slot) for slot in segment.reads), *hoisted_results], values.shape
    )
    for slot, value in zip(segment.writes, outs, strict=True):
        values.set(slot, value)


def _run_worlds(segment: Segment, values: LeafValues) -> None:
    # The slots of the segment in a leaf of drones count the scalars of all drones of a world, drone after drone.
    leaves, shape, library = values.program.leaves, (values.n_worlds, values.n_drones), values.library

    def get_world_value(slot: Slot) -> Any:
        leaf, k = slot
        if leaves[leaf].scope == "drone":
            drone, k = divmod(k, leaves[leaf].size)
            return values.get((leaf, k)).reshape(shape)[:, drone]
        value = values.get(slot)
        return value.reshape(shape)[:, 0] if library.ndim(value) and k != TABLE_INDEX else value

    outs = values.execute(segment.block, [get_world_value(slot) for slot in segment.reads], shape[:1])
    values_by_slot: dict[Slot, dict[int, Any]] = {}  # each: values by index of the drone
    for (leaf, k), value in zip(segment.writes, outs, strict=True):
        value = library.broadcast_to(value, shape[:1])
        if leaves[leaf].scope == "drone":
            drone, k = divmod(k, leaves[leaf].size)
            values_by_slot.setdefault((leaf, k), {})[drone] = value
        else:
            values_by_slot[leaf, k] = dict.fromkeys(range(values.n_drones), value)
    for slot, values_by_drone in values_by_slot.items():
        old = library.broadcast_to(values.get(slot), values.shape).reshape(shape)
        columns = [values_by_drone.get(d, old[:, d]) for d in range(values.n_drones)]
        values.set(slot, library.stack(columns, axis=-1).reshape(values.shape))


def _run_unfused(stage: UnfusedStage, values: LeafValues) -> None:
    outputs = jaxcompat.jaxpr_as_fun(stage.jaxpr)(*(values.array(i) for i in stage.input_leaves))
    for i, value in zip(stage.written_leaves, outputs, strict=True):
        values.set_array(i, value)


def build(program: Program, location: Location) -> Run:
    return functools.partial(run_steps, add_barriers(program) if location.platform == "cpu" else program)


def run_steps(
    program: Program, leaves: list[Any], n_steps: int | Array, execute: BlockRunner = xla.run_block
) -> tuple[list[Any], Array]:
    """Return the written leaves after some steps, and True for worlds that are flagged as not finite. (n_worlds, 1)

    The loop can be differentiated in reverse mode if the number of steps is a Python integer.

    Args:
        leaves: Leaves of all worlds.
    """
    initial_values = LeafValues(program, leaves, execute)
    hoisted_results = prepare_steps(program, initial_values)
    segments = program.phase_segments("each")
    carried_leaves = sorted({i for s in segments if isinstance(s, UnfusedStage) for i in s.written_leaves})
    fused_segments = [s for s in segments if isinstance(s, Segment)]
    written_slots = {slot for s in fused_segments for slot in program.drone_slots(s, s.writes)}
    carried_slots = sorted(slot for slot in written_slots if slot[0] not in carried_leaves)

    def advance(carry: tuple[list[Any], list[Any]]) -> tuple[list[Any], list[Any]]:
        values = unpack_carry(carry)
        run_phase(program, values, "each", hoisted_results)
        return [values.get(slot) for slot in carried_slots], [values.array(leaf) for leaf in carried_leaves]

    def unpack_carry(carry: tuple[list[Any], list[Any]]) -> LeafValues:
        values = initial_values.copy()
        for slot, value in zip(carried_slots, carry[0], strict=True):
            values.set(slot, value)
        for leaf, value in zip(carried_leaves, carry[1], strict=True):
            values.set_array(leaf, value)
        return values

    carry = ([jnp.broadcast_to(initial_values.get(slot), initial_values.shape) for slot in carried_slots],
             [initial_values.array(leaf) for leaf in carried_leaves])  # fmt: skip
    for segment in fused_segments:  # leaves that are only read are split into vectors once, outside the loop
        for slot in program.drone_slots(segment, segment.reads):
            initial_values.get(slot)
    if isinstance(n_steps, int):
        carry = repeat(advance, carry, n_steps)
    else:
        carry = jax.lax.fori_loop(0, n_steps, lambda _, c: advance(c), carry)
    final_values = unpack_carry(carry)
    flagged = nonfinite_worlds(program, final_values)
    run_phase(program, final_values, "after", {})
    return [final_values.array(i) for i in program.written_leaves], flagged


def repeat(iterate: Callable[[Any], Any], carry: Any, n: int) -> Any:
    """Return a carry after ``n`` iterations, computed so that its gradient needs little memory.

    Only the carry before each iteration is stored. The backward pass recomputes all other values, which is faster than
    reading them from memory. From ``MIN_CHECKPOINTED_STEPS`` iterations on, only every k-th carry is stored, where k is
    the square root of n. The memory of a gradient then grows with k, at the price of one more forward pass.
    """
    iterate = jax.checkpoint(iterate, prevent_cse=False)  # a scan prevents it already

    def scan(carry: Any, n: int) -> Any:
        return jax.lax.scan(lambda c, _: (iterate(c), None), carry, length=n)[0]

    if n < MIN_CHECKPOINTED_STEPS:
        return scan(carry, n)
    n_inner = math.isqrt(n)
    inner_scan = jax.checkpoint(lambda c: scan(c, n_inner), prevent_cse=False)
    carry, _ = jax.lax.scan(lambda c, _: (inner_scan(c), None), carry, length=n // n_inner)
    return scan(carry, n % n_inner) if n % n_inner else carry


def nonfinite_worlds(program: Program, values: LeafValues) -> Array:
    """Return True for worlds that were flagged, hold a checked value that is not finite, or took too many steps.

    Returns:
        (n_worlds, 1), False for all worlds if the program has no check
    """
    check = program.check_segment
    if check is None:
        return values.library.zeros((values.n_worlds, 1), bool)
    (flagged,) = values.execute(check.block, [values.get(slot) for slot in check.reads], values.shape)
    flagged = values.library.broadcast_to(flagged, values.shape).reshape(values.n_worlds, values.n_drones)
    return flagged.any(axis=1, keepdims=True)
