"""The reference: a pipeline as batched XLA, jitted and scanned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim import jaxcompat
from crazysim.core.data import SimData
from crazysim.core.pipeline import Pipeline
from crazysim.core.stage import Axes, Stage, with_leaves
from crazysim.core.stages import finite
from crazysim.engine.barriers import compute_once
from crazysim.pytree import has_members

ResetFn = Callable[..., SimData]


def build(
    stages: Sequence[Stage], data: SimData, by_component: bool = True, barriers: bool = True
) -> tuple[Callable[[list[Any], int | Array], tuple[list[Any], Array]], list[int]]:
    """Return a loop over steps on leaves, and which of them it writes.

    The loop carries only the leaves that some stage writes. The others, parameters above all, are its constants.

    Args:
        stages: The stages.
        data: Data of the structure that is stepped.
        by_component: True to store vectors component by component. Not for data that is spread over devices: XLA
            gathers an array whose layout is set.
        barriers: True to compute costly values of a stage once (``barriers``). For XLA's CPU backend.

    Returns:
        The function from leaves and a number of steps to the written leaves and the worlds that are flagged as not
        finite, (n_worlds, 1), and the numbers of the written leaves.
    """
    axes = Axes(data)
    by_component = by_component and all(stage.batched for stage in stages)  # XLA gives some operations no layout

    def barrier(value: Any) -> Any:
        return _stored(jax.lax.optimization_barrier(value), by_component)

    def single(leaves: list[Any]) -> list[Any]:
        data = axes.treedef.unflatten(leaves)
        for stage in stages:
            with jax.named_scope(stage.__name__):
                fn = compute_once(stage, data, data.core.n_worlds, barrier) if barriers else stage
                data = _finish_stage(axes, stage, data, fn(data), by_component)
        return jax.tree.leaves(data)

    jaxpr = jax.make_jaxpr(single)(jax.tree.leaves(data))
    step = jaxcompat.jaxpr_as_fun(jaxpr)  # the stages are traced once
    pairs = zip(jaxpr.jaxpr.invars, jaxpr.jaxpr.outvars, strict=True)
    written = [i for i, (before, after) in enumerate(pairs) if before is not after]

    def steps(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        def turn(values: list[Any]) -> list[Any]:
            after = step(*with_leaves(leaves, written, values))
            return [after[i] for i in written]

        start = [leaves[i] for i in written]
        if isinstance(n_steps, int):
            out, _ = jax.lax.scan(lambda x, _: (turn(x), None), start, length=n_steps)
        else:
            out = jax.lax.fori_loop(0, n_steps, lambda _, x: turn(x), start)
        data = axes.treedef.unflatten(with_leaves(leaves, written, out))
        return out, data.core.nonfinite | ~finite(data)

    return steps, written


def _finish_stage(axes: Axes, stage: Stage, before: SimData, after: SimData, by_component: bool) -> SimData:
    """Return the data after a stage, checked; the leaves that it wrote are computed once and stored by component.

    XLA's CPU backend repeats shared arithmetic for every array that depends on it, unless a barrier prevents that.
    It also stores vectors as rows of three or four numbers, which do not fill a vector unit; stored component by
    component they do, and their logical shape stays. On two CPU cores the two halve the time of a step.
    """
    written = axes.written(jax.tree.leaves(before), after, stage)
    new = jax.tree.leaves(after)
    for i, value in zip(written, jax.lax.optimization_barrier([new[i] for i in written]), strict=True):
        new[i] = _stored(value, by_component and has_members(axes.scopes[i]))
    return axes.treedef.unflatten(new)


def _stored(value: Any, by_component: bool) -> Any:
    """Return a value, stored by component if it has vectors: (n_worlds, n_drones, n)."""
    if not by_component or value.ndim != 3:
        return value
    many_worlds = value.shape[0] >= value.shape[1]
    return jaxcompat.with_major_to_minor(value, (2, 1, 0) if many_worlds else (2, 0, 1))


def build_reset(pipeline: Pipeline) -> ResetFn:
    """Return ``reset(data, default_data, mask=None) -> data``, pure, for the stages as they are now.

    A compiled call copies the arrays that it returns unchanged. For use inside another compiled function,
    ``reset.__wrapped__`` is not compiled itself.
    """
    stages = tuple(pipeline.items())

    @jax.jit
    def reset(data: SimData, default_data: SimData, mask: Array | None = None) -> SimData:
        for name, fn in stages:
            with jax.named_scope(name):
                data = fn(data, default_data, mask)
        return data.replace(core=data.core.replace(mjx_synced=jnp.asarray(False)))

    return reset
