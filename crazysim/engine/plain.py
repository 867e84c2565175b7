"""The reference: a pipeline as batched XLA, jitted and scanned."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental.layout import Layout, with_layout_constraint
from jax.extend.core import jaxpr_as_fun

from crazysim.pytree import check_axes
from crazysim.sim.data import SimData
from crazysim.sim.pipeline import Pipeline
from crazysim.sim.stage import Axes, Stage, as_stages
from crazysim.sim.stages import flag_nonfinite

StepFn = Callable[..., SimData]
ResetFn = Callable[..., SimData]


def build_step(pipeline: Pipeline, by_component: bool = True) -> StepFn:
    """Return ``step(data, n_steps=1) -> data``, pure, for the stages as they are now.

    Within it only the leaves that some stage writes are carried from step to step; the rest, parameters above
    all, stay constants of the loop and come back as the very arrays that went in. With ``n_steps`` a Python
    number the loop can be differentiated; with an array one compilation serves every number of steps.

    Args:
        pipeline: The stages.
        by_component: Whether vectors are held component by component. Not for data that is spread over devices:
            XLA gathers whatever a layout is asked for.
    """
    stages = as_stages(pipeline)

    def single(data: SimData) -> SimData:
        axes = Axes(data)
        for stage in stages:
            with jax.named_scope(stage.__name__):
                data = _settle(axes, stage, data, stage(data), by_component)
        return data

    @jax.jit
    def dynamic(data: SimData, n_steps: Array) -> list[Any]:
        leaves, carried, body = _loop_body(single, data)
        out = jax.lax.fori_loop(0, n_steps, lambda _, x: body(x), [leaves[i] for i in carried])
        return _finish(data, carried, out)

    @jax.jit(static_argnames="n_steps")
    def unrolled(data: SimData, n_steps: int) -> list[Any]:
        leaves, carried, body = _loop_body(single, data)
        out, _ = jax.lax.scan(lambda x, _: (body(x), None), [leaves[i] for i in carried], length=n_steps)
        return _finish(data, carried, out)

    def step(data: SimData, n_steps: int | Array = 1) -> SimData:
        written = unrolled(data, n_steps) if isinstance(n_steps, int) else dynamic(data, n_steps)
        leaves, treedef = jax.tree.flatten(data)
        return treedef.unflatten(x if new is None else new for x, new in zip(leaves, written, strict=True))

    step.jitted = (dynamic, unrolled)  # type: ignore[attr-defined]
    step._cache_size = lambda: dynamic._cache_size() + unrolled._cache_size()  # type: ignore[attr-defined]
    return step


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


def _loop_body(
    single: Callable[[SimData], SimData], data: SimData
) -> tuple[list[Any], list[int], Callable[[list[Any]], list[Any]]]:
    """Return the leaves, the positions of those that a step writes, and a step on these alone."""
    check_axes(data, *data.states.pos.shape[:2])
    leaves = jax.tree.leaves(data)
    jaxpr = jax.make_jaxpr(single)(data)
    pairs = zip(jaxpr.jaxpr.invars, jaxpr.jaxpr.outvars, strict=True)
    carried = [i for i, (before, after) in enumerate(pairs) if before is not after]
    step = jaxpr_as_fun(jaxpr)

    def body(values: list[Any]) -> list[Any]:
        full = list(leaves)
        for i, value in zip(carried, values, strict=True):
            full[i] = value
        after = step(*full)
        return [after[i] for i in carried]

    return leaves, carried, body


def _finish(data: SimData, carried: list[int], values: list[Any]) -> list[Any]:
    """Return the written leaves in their places, None for the others, with the flags set."""
    leaves, treedef = jax.tree.flatten(data)
    for i, value in zip(carried, values, strict=True):
        leaves[i] = value
    out = flag_nonfinite(treedef.unflatten(leaves))
    out = out.replace(core=out.core.replace(mjx_synced=jnp.asarray(False)))
    return [None if new is old else new for old, new in zip(jax.tree.leaves(data), jax.tree.leaves(out), strict=True)]


def build_reset(pipeline: Pipeline) -> ResetFn:
    """Return ``reset(data, default_data, mask=None) -> data``, pure, for the stages as they are now."""
    stages = tuple(pipeline.items())

    @jax.jit
    def reset(data: SimData, default_data: SimData, mask: Array | None = None) -> SimData:
        for name, fn in stages:
            with jax.named_scope(name):
                data = fn(data, default_data, mask)
        return data.replace(core=data.core.replace(mjx_synced=jnp.asarray(False)))

    return reset
