"""Functions of an index and tables, evaluated for all indices by one kernel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import crazysim.engine.lowering.rules  # noqa: F401  (fills the table of rules)
from crazysim.engine import jaxcompat
from crazysim.engine.backends.frame import Kernel, make_kernel
from crazysim.engine.backends.kernel import write_results
from crazysim.engine.backends.native import Launch
from crazysim.engine.backends.platforms import TARGETS, compile_kernel, launch_p
from crazysim.engine.backends.source import Writer, require_block_source, type_name
from crazysim.engine.ir.blocks import Block, prune
from crazysim.engine.lowering.jaxprs import Lowering, TableRows, as_elements
from crazysim.engine.sharding import Location

Function = Callable[..., Sequence[Array]]
"""``fn(index, *tables)`` returns single numbers for an index, int32 (). It may read tables only by ``table_row``."""


class MapKernels:
    """Kernels of one function, compiled when they are first needed."""

    def __init__(self, block: Block):
        self._block = block
        self._launches: dict[str, Launch] = {}

    def get_launch(self, platform: str) -> Launch:
        if platform not in self._launches:
            self._launches[platform] = compile_kernel(write_map(self._block, TARGETS[platform]), Location(platform))
        return self._launches[platform]

    def n_lanes(self, n: int) -> int:
        """Return the number of indices."""
        return n

    def result_shapes(self, n: int) -> list[jax.ShapeDtypeStruct]:
        """Return shapes and types of the results for ``n`` indices."""
        return [jax.ShapeDtypeStruct((n,), x.dtype) for x in self._block.outputs]


def map_indices(
    fn: Function, n: int, tables: Sequence[Array], platform: str | None, compile_now: bool = True
) -> list[Array]:
    """Return the results of a function for the indices 0 to ``n - 1``. (n,) each

    The results have no derivative. Under ``vmap`` the kernel is called for one batch at a time.

    Args:
        tables: The tables that the function reads. (n_rows, k) each
        platform: Platform of the kernel, ``"cpu"`` or ``"gpu"``; None for XLA without a kernel.
        compile_now: False to compile the kernel only when JAX compiles a program that uses the results.

    Raises:
        UnsupportedError: If the engine does not support the function, or its compiler refuses the kernel.
    """
    if platform is None:
        indices = jnp.arange(n, dtype=np.int32)
        return list(jax.vmap(lambda i: fn(i, *tables))(indices))
    kernels = MapKernels(lower_map(fn, tables))
    if compile_now:
        kernels.get_launch(platform)

    def run(tables: list[Array]) -> list[Array]:
        return list(launch_p.bind(jnp.zeros(1, np.int32), *tables, kernels=kernels, n=n))

    def batching_rule(size: int, in_batched: Any, tables: list[Array]) -> Any:
        del size
        (is_batched,) = in_batched

        def run_next(batched: list[Array]) -> list[Array]:
            rest = iter(batched)
            return run([next(rest) if b else x for x, b in zip(tables, is_batched, strict=True)])

        batched = [x for x, b in zip(tables, is_batched, strict=True) if b]
        return jax.lax.map(run_next, batched), [True] * len(kernels.result_shapes(n))

    return jaxcompat.add_vmap_rule(run, batching_rule)(list(tables))


def map_tangents(
    fns: tuple[Function, Function], tables: Sequence[Array], tangents: Array, platform: str | None
) -> Array:
    """Return the results of a function that is linear in its last table, for the index of each row. (n, m)

    Args:
        fns: The function, whose last table has the tangents, and its transpose, whose last table has the cotangents of
            the results, and which returns those of the tangents.
        tables: The other tables, as in ``map_indices``.
        tangents: The tangents. (n, k)
        platform: As in ``map_indices``.
    """
    return linear_map_p.bind(*tables, tangents, fns=fns, platform=platform, n_nonlinear=len(tables))[0]


def _map_rows(fn: Function, platform: str | None, *tables: Array) -> list[Array]:
    return [jnp.stack(map_indices(fn, len(tables[-1]), tables, platform, compile_now=False), axis=-1)]


def _map_linear(*args: Any, fns: Any, platform: str | None, **_: Any) -> list[Array]:
    return _map_rows(fns[0], platform, *args)


def _map_transposed(tables: Any, cotangents: Any, fns: Any, platform: str | None, **_: Any) -> list[Array]:
    return _map_rows(fns[1], platform, *tables, *cotangents)


linear_map_p = jaxcompat.primitive_by_platform(
    "crazysim_linear_map",
    lambda *args, **params: jax.eval_shape(partial(_map_linear, **params), *args),
    {"": _map_linear},
    transpose_rule=_map_transposed,
    batching_rule=jaxcompat.make_vmap_rule(_map_linear),
)
"""Primitive of ``map_tangents``."""


def lower_map(fn: Function, tables: Sequence[Any]) -> Block:
    """Return the block of a function of an index and tables; its inputs are the index and the tables.

    Args:
        tables: Tables, or their shapes and types.
    """
    avals = [jax.ShapeDtypeStruct((max(len(x.shape) and x.shape[0], 2), *x.shape[1:]), x.dtype) for x in tables]
    lowering = Lowering()
    index = as_elements([lowering.builder.input(np.int32)], ())
    rows: list[Any] = [TableRows(lowering.builder, x) for x in avals]
    jaxpr = jax.make_jaxpr(lambda i, *tables: list(fn(i, *tables)))(jax.ShapeDtypeStruct((), np.int32), *avals)
    return prune(lowering.finish(lowering.lower(jaxpr, [index, *rows])))


def write_map(block: Block, target: str) -> Kernel:
    """Return the kernel of a function of an index and tables; each lane computes the results for one index.

    Args:
        block: The function: its inputs are the index and the tables, its outputs single numbers.
        target: ``"cuda"`` or ``"host"``.
    """
    require_block_source(block)
    writer, tables = Writer(), block.inputs[1:]
    inputs, outputs = ([type_name(x.dtype) for x in values_of_kind] for values_of_kind in (tables, block.outputs))
    pointers = [f"const {ctype}* __restrict__ p{k}" for k, ctype in enumerate(inputs)]
    pointers += [f"{ctype}* __restrict__ q{k}" for k, ctype in enumerate(outputs)]
    values = writer.write_block(block, ["LANE", *(f"p{k}" for k in range(len(tables)))], 2)
    for k, (ctype, x) in enumerate(zip(outputs, values, strict=True)):
        write_results(writer, f"q{k}", ctype, 1, [x], 2)
    input_indices, output_indices = tuple(range(len(inputs))), tuple(range(len(outputs)))
    return make_kernel(
        target, pointers, [], writer.lines, [block], writer.tables, inputs=input_indices, outputs=output_indices
    )
