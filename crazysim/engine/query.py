"""Functions of one drone or one world, evaluated for all drones and worlds by one kernel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.engine.backends import fused
from crazysim.engine.lowering.relative import adapt_to_data_leaves
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.optimise import optimise
from crazysim.engine.pytree import leaf, replace_leaves
from crazysim.engine.record import Record, Roles
from crazysim.engine.sharding import Location
from crazysim.engine.stage import Axes, Stage

Query = tuple[Literal["drone", "world"], Callable[[Any], Any]]
"""Scope of a function, and the function. A function of one drone returns any tree of arrays. A function of one world
returns a tree of arrays with a leading axis for the drones."""


class _Queried(Record):
    """Data with the results of all queries, flattened to one axis for each drone."""

    data: Any
    arrays: dict[str, Array] = leaf("drone", 1)
    """Results by name: the number of the query, and the number of the array in its result. (n_worlds, n_drones, k)
    each"""

    def roles(self) -> Roles:
        return self.data.roles()  # the leaves of the data come first


def query(queries: Sequence[Query], data: Record, platform: str) -> list[Any]:
    """Return the results of some functions for every drone. (n_worlds, n_drones, ...) each

    Args:
        queries: The functions. They receive data of one drone or one world, as stages do.
        platform: ``"cpu"`` or ``"gpu"``.

    Raises:
        UnsupportedError: If the engine does not support one of the functions.
    """
    leaves, axes = jax.tree.leaves(data), Axes(data)
    n_worlds, n_drones = leaves[axes.scopes.index("drone")].shape[:2]
    # One stage for each query, which writes arrays of its results.
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
        stages.append(Stage(_make_writer(fn, scope, n_drones, names), scope, name=f"query {number}", phase="after"))
    # One program for all queries.
    extended_data = _Queried(data, arrays)
    extended_leaves, treedef = jax.tree.flatten(extended_data)
    program = optimise(lower_stages(stages, extended_data))
    if program.unfused_stages:
        raise program.unfused_stages[0].error
    packed = [jnp.concatenate([extended_leaves[i].ravel() for i in program.packed])] if program.packed else []
    written_arrays, _ = adapt_to_data_leaves(program, fused.build(program, Location(platform)))(
        [*extended_leaves, *packed], 0
    )
    data_after = treedef.unflatten(replace_leaves(extended_leaves, program.written_leaves, written_arrays))
    arrays = data_after.arrays
    return [
        query_treedef.unflatten(
            [arrays[name].reshape(n_worlds, n_drones, *shape) for name, shape in query_shapes.items()]
        )
        for query_treedef, query_shapes in zip(treedefs, shapes, strict=True)
    ]


def _make_writer(fn: Callable[[Any], Any], scope: str, n_drones: int, names: list[str]) -> Callable[[Any], Any]:
    shape = (n_drones, -1) if scope == "world" else (-1,)

    def write(queried: _Queried) -> _Queried:
        results = jax.tree.leaves(fn(queried.data))
        new_arrays = {name: x.reshape(shape) for name, x in zip(names, results, strict=True)}
        return queried.replace(arrays=queried.arrays | new_arrays)

    return write
