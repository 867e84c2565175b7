"""The reference backend: a pipeline on all worlds at once in XLA, compiled and looped by JAX."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import Run
from crazysim.engine.pytree import leaf_flags, replace_leaves
from crazysim.engine.record import Record, nonfinite_worlds
from crazysim.engine.stage import PHASES, Axes, Phase, Stage


def build(stages: Sequence[Stage], data: Record) -> tuple[Run, list[int]]:
    """Return a function that runs the stages and the loop over steps on leaves, and the leaves that it writes.

    The loop carries only the leaves that a stage of the phase ``each`` writes. All others, mainly parameters, are
    constants.

    Args:
        data: Data with the structure, shapes and types of the data to step.
    """
    axes = Axes(data)

    def run_phase(leaves: list[Any], phase: Phase) -> list[Any]:
        for stage in [stage for stage in stages if stage.phase == phase]:
            with jax.named_scope(stage.__name__):
                data_after = stage(axes.treedef.unflatten(leaves))
                written_leaves = axes.written_leaves(leaves, data_after, stage)
                new_leaves = jax.tree.leaves(data_after)
                # Without the barrier, XLA's CPU backend recomputes these values for each result of a later stage.
                leaves = replace_leaves(
                    leaves, written_leaves, jaxcompat.barrier([new_leaves[i] for i in written_leaves])
                )
        return leaves

    jaxprs = {phase: jax.make_jaxpr(run_phase, static_argnums=1)(jax.tree.leaves(data), phase) for phase in PHASES}
    run_jaxprs = {phase: jaxcompat.jaxpr_as_fun(jaxpr) for phase, jaxpr in jaxprs.items()}  # the stages are traced once
    written_by_phase = {phase: _changed_leaves(jaxpr) for phase, jaxpr in jaxprs.items()}

    def run_steps(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        leaves = run_jaxprs["before"](*leaves)
        loop_leaves = written_by_phase["each"]

        def advance(values: list[Any]) -> list[Any]:
            leaves_after = run_jaxprs["each"](*replace_leaves(leaves, loop_leaves, values))
            return [leaves_after[i] for i in loop_leaves]

        loop_values = [leaves[i] for i in loop_leaves]
        if loop_leaves and isinstance(n_steps, int):
            loop_values, _ = jax.lax.scan(lambda x, _: (advance(x), None), loop_values, length=n_steps)
        elif loop_leaves:
            loop_values = jax.lax.fori_loop(0, n_steps, lambda _, x: advance(x), loop_values)
        leaves = replace_leaves(leaves, loop_leaves, loop_values)
        flagged = nonfinite_worlds(axes.treedef.unflatten(leaves))
        leaves = run_jaxprs["after"](*leaves)
        return [leaves[i] for i in written_leaves], flagged

    scratch = {i for i, x in enumerate(jax.tree.leaves(leaf_flags(data, "scratch"))) if x}
    written_leaves = sorted({i for leaves_of_phase in written_by_phase.values() for i in leaves_of_phase} - scratch)
    return run_steps, written_leaves


def _changed_leaves(jaxpr: jaxcompat.ClosedJaxpr) -> list[int]:
    pairs = zip(jaxpr.jaxpr.invars, jaxpr.jaxpr.outvars, strict=True)
    return [i for i, (before, after) in enumerate(pairs) if before is not after]
