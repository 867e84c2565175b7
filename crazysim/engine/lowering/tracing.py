"""Tracing of stages to jaxprs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax

from crazysim.eager import explain_traced_values
from crazysim.engine import jaxcompat
from crazysim.engine.ir import dump
from crazysim.engine.stage import Axes, Stage


class TracedStage:
    """A stage as jaxprs on flat lists of leaves: its function, and its condition if it has one."""

    def __init__(self, stage: Stage, axes: Axes, leaves: Sequence[Any]):
        self.avals = axes.unbatched_shapes(list(leaves), stage.scope)
        """Shapes and types of all leaves, as the stage receives them."""
        self.written_leaves: list[int] = []
        """Indices of the leaves that it writes: the outputs of ``fn``."""

        def apply(values: list[Any]) -> list[Any]:
            with explain_traced_values(f"stage {stage.__name__!r}"):
                data_after = stage.fn(axes.treedef.unflatten(values))
            self.written_leaves = axes.written_leaves(values, data_after, stage)
            leaves_after = jax.tree.leaves(data_after)
            return [leaves_after[i] for i in self.written_leaves]

        def condition(values: list[Any]) -> list[Any]:
            mask = stage.when(axes.treedef.unflatten(values)) if stage.when is not None else None
            return [] if mask is None else [mask]

        fn = jax.make_jaxpr(apply)(self.avals)
        when = jax.make_jaxpr(condition)(self.avals) if stage.when is not None else None
        if when is not None and not when.jaxpr.outvars:  # the stage acts at every step
            when = None
        used = _used_inputs(fn) | (_used_inputs(when) if when is not None else set())
        self.input_leaves = sorted(used)
        """Indices of the leaves that it reads: the inputs of ``fn`` and ``when``."""
        self.fn = jaxcompat.select_inputs(fn, self.input_leaves)
        """Jaxpr of the function, from ``input_leaves`` to ``written_leaves``."""
        self.when = jaxcompat.select_inputs(when, self.input_leaves) if when is not None else None
        """Jaxpr of the condition, a function of ``input_leaves``; None if the stage acts at every step."""
        self.segments: dict[Any, Any] = {}
        """Segments that the stage was lowered to. The keys hold everything else that lowering depends on."""

    def dump(self, name: str) -> None:
        """Write the jaxprs into the folder that ``CRAZYSIM_DUMP`` names, if it is set."""
        if dump.is_enabled():
            dump.write(f"{name}.jaxpr", f"{self.fn}\n" + (f"\nwhen\n{self.when}\n" if self.when else ""))


class Tracer:
    """Cache of traced stages. A stage is traced once for leaves of the same shapes and types."""

    def __init__(self) -> None:
        self._traced: dict[Any, tuple[Stage, TracedStage]] = {}  # with the stage, so that ids in keys stay valid

    def __call__(self, stage: Stage, axes: Axes, leaves: Sequence[Any]) -> TracedStage:
        shapes = tuple([(x.shape, x.dtype) for x in axes.unbatched_shapes(list(leaves), stage.scope)])
        key = (id(stage.fn), id(stage.when), axes.treedef, shapes)  # a callable object may have no hash
        if key not in self._traced:
            if stage.trace_once:
                traced = _get_shared_trace(stage, axes, leaves, shapes)
            else:
                traced = TracedStage(stage, axes, leaves)
            traced.dump(stage.__name__)
            self._traced[key] = stage, traced
        return self._traced[key][1]


_TRACED_STAGES: dict[Any, TracedStage] = {}
"""Traced stages with ``trace_once``, for all simulations of this process."""
MAX_TRACED_STAGES = 256
"""Maximum number of traced stages in ``_TRACED_STAGES``."""


def _get_shared_trace(stage: Stage, axes: Axes, leaves: Sequence[Any], shapes: Any) -> TracedStage:
    # The stage must not read what ``Record.without_sizes`` leaves out.
    data = axes.treedef.unflatten(leaves)
    structure = jax.tree.structure(data.without_sizes())
    key = (stage.fn, stage.when, structure, tuple(axes.scopes), shapes, jax.config.jax_enable_x64)
    traced = _TRACED_STAGES.get(key)
    if traced is None:
        traced = _TRACED_STAGES[key] = TracedStage(stage, axes, leaves)
        for oldest in list(_TRACED_STAGES)[:-MAX_TRACED_STAGES]:
            _TRACED_STAGES.pop(oldest, None)
    return traced


def _used_inputs(jaxpr: jaxcompat.ClosedJaxpr) -> set[int]:
    inner = jaxpr.jaxpr
    used = {v for eqn in inner.eqns for v in eqn.invars if not isinstance(v, jaxcompat.Literal)}
    used |= {v for v in inner.outvars if not isinstance(v, jaxcompat.Literal)}
    return {i for i, v in enumerate(inner.invars) if v in used}
