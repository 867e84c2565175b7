"""Lanes: every number of a drone is a vector over drones, so that XLA sees element-wise arithmetic only.

Between stages that are written out (``program``) nothing has the shape of a small vector or matrix. A stage that is
not is given ordinary arrays, and takes the step apart at its place.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend import core

from crazysim.engine import xla
from crazysim.engine.program import Phase, Program, Segment, Slot, is_key


class Lanes:
    """Leaves of all drones, each as an array or as lanes, whichever was asked for last."""

    def __init__(self, program: Program, leaves: list[Any]):
        """Hold leaves as arrays."""
        self.program = program
        self.n_worlds, self.n_drones = batch(program, leaves)
        self.arrays: dict[int, Any] = dict(enumerate(leaves))
        self.lanes: dict[Slot, Any] = {}

    def copy(self) -> Lanes:
        """Return the same leaves, to be written to."""
        new = copy.copy(self)
        new.arrays, new.lanes = dict(self.arrays), dict(self.lanes)
        return new

    @property
    def shape(self) -> tuple[int]:
        """Shape of the lanes: one for each drone, world after world."""
        return (self.n_worlds * self.n_drones,)

    def get(self, slot: Slot) -> Any:
        """Return a number of every drone, or the one number that all share."""
        if slot not in self.lanes:
            self._split(slot[0])
        return self.lanes[slot]

    def set(self, slot: Slot, value: Any) -> None:
        """Write a number of every drone."""
        if slot not in self.lanes:
            self._split(slot[0])
        self.lanes[slot] = jnp.broadcast_to(value, self.shape)
        self.arrays.pop(slot[0], None)

    def array(self, leaf: int) -> Any:
        """Return a leaf as the array that it is outside."""
        if leaf not in self.arrays:
            example = self.program.leaves[leaf]
            items = [self.lanes[leaf, k] for k in range(self.program.sizes(leaf))]
            if leaf in self.program.rows:
                self.arrays[leaf] = jnp.stack(items)
                return self.arrays[leaf]
            array = jnp.stack(items, axis=-1).reshape(self.n_worlds, self.n_drones, *example.shape[2:])
            self.arrays[leaf] = array[:, :1] if self.program.axes.scopes[leaf] == "world" else array
        return self.arrays[leaf]

    def set_array(self, leaf: int, value: Any) -> None:
        """Write a leaf."""
        self.arrays[leaf] = value
        for k in range(self.program.sizes(leaf)):
            self.lanes.pop((leaf, k), None)

    def _split(self, leaf: int) -> None:
        x, scope = self.arrays[leaf], self.program.axes.scopes[leaf]
        size = self.program.sizes(leaf)
        if leaf in self.program.rows or x is None:  # what is not given is written before it is read
            self.lanes.update(((leaf, k), jnp.zeros(self.shape) if x is None else x[k]) for k in range(size))
            return
        if is_key(x):
            x = jax.random.key_data(x)
        if scope == "world":
            x = jnp.broadcast_to(x, (self.n_worlds, self.n_drones, *x.shape[2:]))
        batch = self.shape if scope in ("drone", "world") else ()
        x = x.reshape(*batch, size)
        self.lanes.update(((leaf, k), x[..., k]) for k in range(size))


def batch(program: Program, leaves: list[Any]) -> tuple[int, int]:
    """Return the number of worlds and drones: under a mesh, of those on this device."""
    drone = next(
        i
        for i, scope in enumerate(program.axes.scopes)
        if scope == "drone" and leaves[i] is not None and i not in program.rows
    )
    return leaves[drone].shape[0], leaves[drone].shape[1]


LONG = 256
"""Steps from which on a gradient keeps few of their beginnings."""

Constants = dict[int, list[Any]]
"""What has been computed before the first step, by the segment that needs it."""


def prepare(program: Program, lanes: Lanes) -> Constants:
    """Run what comes before the first step, and compute what no step changes."""
    run(program, lanes, "first", {})
    return {
        k: xla.run(s.before, [lanes.get(slot) for slot in s.constants], lanes.shape)
        for k, s in enumerate(program.of("each"))
        if s.before is not None
    }


def run(program: Program, lanes: Lanes, phase: Phase, constants: Constants) -> None:
    """Run the segments of a phase."""
    for k, segment in enumerate(program.of(phase)):
        match segment.scope:
            case "drone":
                _run_drones(segment, lanes, constants.get(k, []))
            case "world":
                _run_worlds(segment, lanes)
            case "batch":
                _run_batch(segment, lanes)


def _run_drones(segment: Segment, lanes: Lanes, constants: list[Any]) -> None:
    outs = xla.run(segment.block, [*(lanes.get(slot) for slot in segment.reads), *constants], lanes.shape)
    for slot, value in zip(segment.writes, outs, strict=True):
        lanes.set(slot, value)


def _run_worlds(segment: Segment, lanes: Lanes) -> None:
    """Run a program of worlds: a drone's numbers are those of its world, at its place."""
    program, shape = lanes.program, (lanes.n_worlds, lanes.n_drones)

    def of_world(slot: Slot) -> Any:
        leaf, k = slot
        if program.axes.scopes[leaf] == "drone":
            drone, k = divmod(k, program.sizes(leaf))
            return lanes.get((leaf, k)).reshape(shape)[:, drone]
        value = lanes.get(slot)
        return value.reshape(shape)[:, 0] if jnp.ndim(value) else value

    outs = xla.run(segment.block, [of_world(slot) for slot in segment.reads], shape[:1])
    new: dict[Slot, dict[int, Array]] = {}
    for (leaf, k), value in zip(segment.writes, outs, strict=True):
        value = jnp.broadcast_to(value, shape[:1])
        if program.axes.scopes[leaf] == "drone":
            drone, k = divmod(k, program.sizes(leaf))
            new.setdefault((leaf, k), {})[drone] = value
        else:
            new[leaf, k] = dict.fromkeys(range(lanes.n_drones), value)
    for slot, columns in new.items():
        old = lanes.get(slot)
        old = jnp.broadcast_to(old, lanes.shape).reshape(shape)
        rows = [columns.get(d, old[:, d]) for d in range(lanes.n_drones)]
        lanes.set(slot, jnp.stack(rows, axis=-1).reshape(lanes.shape))


def _run_batch(segment: Segment, lanes: Lanes) -> None:
    after = core.jaxpr_as_fun(segment.fn)(*(lanes.array(i) for i in segment.used))
    for i, value in zip(segment.written, after, strict=True):
        lanes.set_array(i, value)


def steps(program: Program, leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
    """Return the written leaves after some steps, and which worlds are flagged as not finite. (n_worlds, 1)

    A step count that is a Python number makes a loop that can be differentiated.
    """
    start = Lanes(program, leaves)
    constants = prepare(program, start)
    each = program.of("each")
    by_array = sorted({i for s in each if s.scope == "batch" for i in s.written})
    by_lanes = sorted({slot for s in each for slot in program.own(s, s.writes) if slot[0] not in by_array})

    def turn(carry: tuple[list[Any], list[Any]]) -> tuple[list[Any], list[Any]]:
        lanes = after(carry)
        run(program, lanes, "each", constants)
        return [lanes.get(slot) for slot in by_lanes], [lanes.array(leaf) for leaf in by_array]

    def after(carry: tuple[list[Any], list[Any]]) -> Lanes:
        lanes = start.copy()
        for slot, value in zip(by_lanes, carry[0], strict=True):
            lanes.set(slot, value)
        for leaf, value in zip(by_array, carry[1], strict=True):
            lanes.set_array(leaf, value)
        return lanes

    carry = ([jnp.broadcast_to(start.get(slot), start.shape) for slot in by_lanes],
             [start.array(leaf) for leaf in by_array])  # fmt: skip
    for segment in each:  # what is only read is taken apart once, outside the loop
        for slot in program.own(segment, segment.reads):
            start.get(slot)
    if isinstance(n_steps, int):
        carry = repeat(turn, carry, n_steps)
    else:
        carry = jax.lax.fori_loop(0, n_steps, lambda _, c: turn(c), carry)
    end = after(carry)
    flagged = nonfinite(program, end)
    run(program, end, "last", {})
    return [end.array(i) for i in program.written], flagged


def repeat(turn: Callable[[Any], Any], carry: Any, n: int) -> Any:
    """Return what ``n`` turns make of a carry, for gradients that remember little.

    Of a step only what it begins with is kept, and the rest computed again on the way back, which costs less than
    fetching it from memory. From ``LONG`` steps on only every k-th beginning is kept, k being the root of n: the
    memory of a gradient then grows with the root of the horizon, at the price of one more pass.
    """
    turn = jax.checkpoint(turn, prevent_cse=False)  # a scan keeps them apart anyway

    def turns(carry: Any, n: int) -> Any:
        return jax.lax.scan(lambda c, _: (turn(c), None), carry, length=n)[0]

    if n < LONG:
        return turns(carry, n)
    inner = math.isqrt(n)
    whole = jax.checkpoint(lambda c: turns(c, inner), prevent_cse=False)
    carry, _ = jax.lax.scan(lambda c, _: (whole(c), None), carry, length=n // inner)
    return turns(carry, n % inner)


def nonfinite(program: Program, lanes: Lanes) -> Array:
    """Return which worlds were flagged before, or have a NaN or infinity in what is watched. (n_worlds, 1)"""
    check = program.check
    if check is None:
        return jnp.zeros((lanes.n_worlds, 1), bool)
    (flagged,) = xla.run(check.block, [lanes.get(slot) for slot in check.reads], lanes.shape)
    flagged = jnp.broadcast_to(flagged, lanes.shape).reshape(lanes.n_worlds, lanes.n_drones)
    return jnp.any(flagged, axis=1, keepdims=True)
