"""The first stage after which two engines differ.

``first_difference(sim.step_pipeline, sim.data, engines=("plain", "fused"))`` finds the stage, the field and the world,
and, if an engine runs programs, the operation.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from crazysim.engine import Step
from crazysim.engine.backends import Build, fused, interpret, lanes
from crazysim.engine.ir import listing
from crazysim.engine.ir.blocks import Block, Operation, Value
from crazysim.engine.ir.program import Leaf, Program
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.passes.schedule import fuse
from crazysim.engine.sharding import Location
from crazysim.engine.stage import Axes, as_stages

TOLERANCE = 1e-5
"""Largest difference that may be due to rounding, relative to the largest component of a drone's vector."""


@dataclasses.dataclass(frozen=True)
class Difference:
    stage: str
    """First stage after which the engines differ."""
    leaf: str
    """Field that the stage wrote."""
    index: tuple[int, ...]
    """Index of the element that differs most."""
    values: tuple[Any, Any]
    """Values of that element, by the first engine and by the second engine."""
    engines: tuple[str, str]
    """Names of the engines."""
    operation: str = ""
    """First operation of the stage whose result differs from the interpreter's result. Empty if there is no such
    operation, if neither engine compiles programs, or if the stage is not fused."""

    def __str__(self) -> str:
        (a, b), (x, y) = self.engines, self.values
        location = f"{self.leaf}{list(self.index)}"
        text = f"stage {self.stage!r}: {location} is {x} by {a!r} and {y} by {b!r}"
        return f"{text}; first at {self.operation}" if self.operation else text


def first_difference(
    pipeline: Mapping[str, Callable[..., Any]],
    data: Any,
    engines: tuple[str, str] = ("plain", "fused"),
    tolerance: float = TOLERANCE,
) -> Difference | None:
    """Return the first difference between two engines in one step, or None.

    Both engines run each stage on the data that the first engine computed so far, so a difference is due to that stage
    alone. To find the operation, an engine that compiles programs then runs the stage again and returns every value.
    """
    axes = Axes(data)
    for name, stage in pipeline.items():
        results = [Step({name: stage}, engine)(data, jnp.int32(1)) for engine in engines]
        for i, (x, y) in enumerate(zip(*map(jax.tree.leaves, results), strict=True)):
            index = _find_largest_difference(x, y, tolerance)
            if index is not None:
                values = (np.asarray(x)[index], np.asarray(y)[index])
                operation = _find_operation(pipeline[name], name, data, engines, tolerance)
                return Difference(name, axes.names[i], index, values, engines, operation)
        data = results[0]
    return None


def _find_largest_difference(x: Any, y: Any, tolerance: float) -> tuple[int, ...] | None:
    """Return the index at which arrays differ most, or None if no difference exceeds the tolerance."""
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        x, y = jax.random.key_data(x), jax.random.key_data(y)
    x, y = np.asarray(x), np.asarray(y)
    if x.dtype.kind != "f":
        difference = np.asarray(x != y, float)
    else:
        magnitude = np.where(np.isfinite(x), np.abs(x), 0)
        scale = magnitude.max(axis=-1, keepdims=True) if x.ndim > 2 else magnitude
        with np.errstate(all="ignore"):
            relative_error = np.abs(x.astype(np.float64) - y) / np.maximum(scale, np.finfo(x.dtype).tiny)
        relative_error = np.where(np.isnan(relative_error), np.inf, relative_error)
        is_equal = (x == y) | (np.isnan(x) & np.isnan(y)) | (relative_error <= tolerance)
        difference = np.where(is_equal, 0.0, relative_error)
    if not difference.any():
        return None
    return tuple(int(k) for k in np.unravel_index(int(difference.argmax()), difference.shape))


def _find_operation(stage: Any, name: str, data: Any, engines: Sequence[str], tolerance: float) -> str:
    """Return the first operation of a stage whose result differs from the interpreter's; empty if there is none."""
    program = fuse(lower_stages(as_stages({name: stage}), data))
    builders: dict[str, Build] = {"lanes": lanes.build, "fused": fused.build, "auto": fused.build}
    for engine in engines:
        if engine in builders and program.fused and program.segments:
            operation_text = first_operation(program, jax.tree.leaves(data), builders[engine], tolerance)
            if operation_text is not None:
                return f"{engine}: {operation_text}"
    return ""


def first_operation(program: Program, leaves: list[Any], build: Build, tolerance: float = TOLERANCE) -> str | None:
    """Return the listing of the first operation whose result differs from the interpreter's, or None."""
    exposed_program, operations = expose_values(program)
    n_worlds = lanes.batch_counts(program, leaves)[0]
    zero_leaves = [jnp.zeros((n_worlds, *leaf.shape[1:]), leaf.dtype) for leaf in exposed_program.leaves[len(leaves) :]]
    location = Location("cpu" if jax.default_backend() == "cpu" else "gpu")
    written = [
        builder(exposed_program, location)([*leaves, *zero_leaves], 1)[0] for builder in (interpret.build, build)
    ]
    results = [dict(zip(exposed_program.written_leaves, arrays, strict=True)) for arrays in written]
    (segment,) = exposed_program.fused_segments
    for op, (leaf, _) in zip(operations, segment.writes, strict=True):
        expected, actual = (np.asarray(result[leaf]) for result in results)
        index = _find_largest_difference(expected, actual, tolerance)
        if index is not None:
            numbers = f"{expected[index]} by 'interpret' and {actual[index]} by the engine"
            return f"{listing.list_operation(program, op)} ({numbers}, index {list(index)})"
    return None


def expose_values(program: Program) -> tuple[Program, list[Operation]]:
    """Return a program of one segment with a new leaf for every result in it, and the operations of these results.

    Results inside the blocks of operations are left out, because a block may not run.
    """
    (segment,) = program.fused_segments
    operations = [op for op in segment.block.operations for _ in op.results]
    values: list[Value] = [x for op in segment.block.operations for x in op.results]
    n_worlds = next(leaf.shape[0] for leaf in program.leaves if leaf.scope == "drone")
    shape = (n_worlds, program.n_drones if segment.scope == "drone" else 1)
    value_leaves = [Leaf(f"value {k}", segment.scope, shape, x.dtype) for k, x in enumerate(values)]
    n_leaves = len(program.leaves)
    exposed_segment = dataclasses.replace(
        segment,
        block=Block(segment.block.inputs, segment.block.operations, tuple(values)),
        writes=tuple([(n_leaves + k, 0) for k in range(len(values))]),
    )
    return dataclasses.replace(
        program, leaves=(*program.leaves, *value_leaves), segments=(exposed_segment,)
    ), operations
