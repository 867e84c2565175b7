"""The reference: a pipeline as batched XLA, jitted and scanned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental.layout import Layout, with_layout_constraint
from jax.extend.core import jaxpr_as_fun

from crazysim.core.data import SimData
from crazysim.core.pipeline import Pipeline
from crazysim.core.stage import Axes, Stage, with_leaves
from crazysim.core.stages import finite

ResetFn = Callable[..., SimData]


def build(
    stages: Sequence[Stage], data: SimData, by_component: bool = True
) -> tuple[Callable[[list[Any], int | Array], tuple[list[Any], Array]], list[int]]:
    """Return a loop over steps on leaves, and which of them it writes.

    Within it only the leaves that some stage writes are carried from step to step; the rest, parameters above
    all, stay constants of the loop.

    Args:
        stages: The stages.
        data: Data of the structure that is stepped.
        by_component: Whether vectors are held component by component. Not for data that is spread over devices:
            XLA gathers whatever a layout is asked for.

    Returns:
        Leaves and a number of steps to the written leaves and which worlds are flagged as not finite (n_worlds, 1);
        the numbers of the written leaves.
    """
    axes = Axes(data)
    by_component = by_component and all(stage.batched for stage in stages)  # not every operation of XLA takes layouts

    def single(leaves: list[Any]) -> list[Any]:
        data = axes.treedef.unflatten(leaves)
        for stage in stages:
            with jax.named_scope(stage.__name__):
                data = _settle(axes, stage, data, stage(data), by_component)
        return jax.tree.leaves(data)

    jaxpr = jax.make_jaxpr(single)(jax.tree.leaves(data))
    step = jaxpr_as_fun(jaxpr)  # so that the stages are traced once
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


def _settle(axes: Axes, stage: Stage, before: SimData, after: SimData, by_component: bool) -> SimData:
    """Return what a stage made, checked, with what it wrote computed once and laid out for the next stage.

    XLA's CPU backend repeats shared arithmetic for every array that needs it, unless a barrier stops it. And it
    keeps vectors as rows of three or four numbers, which no vector unit can be filled with, unless told to hold
    them component by component; their logical shape stays. On two CPU cores the two halve the time of a step.
    """
    written = axes.written(jax.tree.leaves(before), after, stage)
    new = jax.tree.leaves(after)
    for i, value in zip(written, jax.lax.optimization_barrier([new[i] for i in written]), strict=True):
        if by_component and axes.scopes[i] == "drone" and value.ndim == 3:
            many_worlds = value.shape[0] >= value.shape[1]
            value = with_layout_constraint(value, Layout(major_to_minor=(2, 1, 0) if many_worlds else (2, 0, 1)))
        new[i] = value
    return axes.treedef.unflatten(new)


def build_reset(pipeline: Pipeline) -> ResetFn:
    """Return ``reset(data, default_data, mask=None) -> data``, pure, for the stages as they are now.

    What a compiled call returns as it came is copied: for use within another, ``reset.__wrapped__`` is not compiled.
    """
    stages = tuple(pipeline.items())

    @jax.jit
    def reset(data: SimData, default_data: SimData, mask: Array | None = None) -> SimData:
        for name, fn in stages:
            with jax.named_scope(name):
                data = fn(data, default_data, mask)
        return data.replace(core=data.core.replace(mjx_synced=jnp.asarray(False)))

    return reset
