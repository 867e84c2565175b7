"""Functions of one drone or one world, evaluated for all drones and worlds by one kernel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.sharding import Location
from crazysim.core.stage import Axes, Stage
from crazysim.engine.backends import fused
from crazysim.engine.lowering.relative import adapt_to_data_leaves
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.optimise import optimise
from crazysim.pytree import PyTree, leaf, replace_leaves

RECORD_NAME = "results"
"""Name of the record of results in ``data.plugins`` while the kernel runs."""

Query = tuple[Literal["drone", "world"], Callable[[SimData], Any]]
"""Scope of a function, and the function. A function of one drone returns any tree of arrays. A function of one world
returns a tree of arrays with a leading axis for the drones."""


class QueryResults(PyTree):
    """Results of all queries, flattened to one axis for each drone."""

    arrays: dict[str, Array] = leaf("drone", 1)
    """Results by name: the number of the query, and the number of the array in its result. (n_worlds, n_drones, k)
    each"""


def query(queries: Sequence[Query], data: SimData, platform: str) -> list[Any]:
    """Return the results of some functions for every drone. (n_worlds, n_drones, ...) each

    Args:
        queries: The functions. They receive data of one drone or one world, as stages do, but without records of
            plugins.
        data: The simulation.
        platform: ``"cpu"`` or ``"gpu"``.

    Raises:
        UnsupportedError: If the engine does not support one of the functions.
    """
    n_worlds, n_drones = data.states.pos.shape[:2]
    leaves, axes = jax.tree.leaves(data), Axes(data)
    arrays: dict[str, Array] = {}
    shapes, treedefs, stages = [], [], []
    for number, (scope, fn) in enumerate(queries):
        template = axes.treedef.unflatten(axes.unbatched_shapes(leaves, scope))
        results, treedef = jax.tree.flatten(jax.eval_shape(fn, template))
        names = [f"{number} {k}" for k in range(len(results))]
        drone_shapes = [x.shape[1:] if scope == "world" else x.shape for x in results]
        for name, x, shape in zip(names, results, drone_shapes, strict=True):
            arrays[name] = jnp.zeros((n_worlds, n_drones, *shape), x.dtype).reshape(n_worlds, n_drones, -1)
        shapes.append(dict(zip(names, drone_shapes, strict=True)))
        treedefs.append(treedef)
        stages.append(Stage(_make_writer(fn, names, scope), scope, name=f"query {number}", phase="after"))
    extended_data = data.replace(plugins={RECORD_NAME: QueryResults(arrays)})
    extended_leaves, treedef = jax.tree.flatten(extended_data)
    program = optimise(lower_stages(stages, extended_data))
    if program.unfused_stages:
        raise program.unfused_stages[0].error
    packed = [jnp.concatenate([extended_leaves[i].ravel() for i in program.packed])] if program.packed else []
    written_arrays, _ = adapt_to_data_leaves(program, fused.build(program, Location(platform)))(
        [*extended_leaves, *packed], 0
    )
    data_after = treedef.unflatten(replace_leaves(extended_leaves, program.written_leaves, written_arrays))
    arrays = data_after.plugins[RECORD_NAME].arrays
    return [
        query_treedef.unflatten(
            [arrays[name].reshape(n_worlds, n_drones, *shape) for name, shape in query_shapes.items()]
        )
        for query_treedef, query_shapes in zip(treedefs, shapes, strict=True)
    ]


def _make_writer(fn: Callable[[SimData], Any], names: list[str], scope: str) -> Callable[[SimData], SimData]:
    """Return the function of a stage that writes the results of ``fn`` to the data."""

    def write(data: SimData) -> SimData:
        arrays = data.plugins[RECORD_NAME].arrays
        results = jax.tree.leaves(fn(data.replace(plugins={})))
        shape = (data.core.n_drones, -1) if scope == "world" else (-1,)
        new_arrays = {name: x.reshape(shape) for name, x in zip(names, results, strict=True)}
        return data.replace(plugins={RECORD_NAME: QueryResults(arrays | new_arrays)})

    return write
