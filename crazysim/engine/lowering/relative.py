"""Stages and data for an engine whose lanes are the members of one population.

The engine treats the members of that population as drones. Leaves of other populations become leaves of the world,
(n_worlds, 1, n_members, ...), and their stages become stages of the world.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any

import jax

from crazysim.engine.pytree import has_members
from crazysim.engine.stage import Axes, Stage, world_function

if TYPE_CHECKING:
    from crazysim.engine.ir.program import Program


class RelativeAxes(Axes):
    """Batch axes of all leaves if the members of one population are treated as drones, with scope ``drone``.

    Leaves of other populations have scope ``world``, with the shapes that ``view_leaves`` returns.
    """

    def __init__(self, data: Any, population: str):
        super().__init__(data)
        self.original = Axes(data)
        """Batch axes as declared."""
        self.views = frozenset(i for i, scope in enumerate(self.scopes) if has_members(scope) and scope != population)
        """Indices of the leaves of other populations."""
        self.scopes = [
            "world" if i in self.views else "drone" if scope == population else scope
            for i, scope in enumerate(self.scopes)
        ]

    def stage(self, stage: Stage) -> Stage:
        """Return a stage for data from ``view_leaves``."""
        return stage if self.original.scopes == self.scopes else RelativeStage(stage, self)


class RelativeStage(Stage):
    """A stage for data from ``view_leaves``, made from a stage for the original data."""

    def __init__(self, stage: Stage, axes: RelativeAxes):
        self.original, self.axes = stage, axes
        fn, scope, when = stage.fn, stage.scope, stage.when
        if scope == "batch":
            fn = self
        elif scope != "world":
            scopes = {axes.scopes[i] for i, original in enumerate(axes.original.scopes) if original == scope}
            scope = next(iter(scopes))
            if scope == "world":
                fn, when = world_function(stage, axes.original), None
        super().__init__(fn, scope, when, name=stage.__name__, unfused_reason=stage.unfused_reason, phase=stage.phase)

    def __call__(self, data: Any) -> Any:
        treedef, views = self.axes.treedef, self.axes.views
        leaves_before = jax.tree.leaves(data)
        restored_leaves = restore_leaves(views, leaves_before)
        leaves_after, after_treedef = jax.tree.flatten(self.original(treedef.unflatten(restored_leaves)))
        if after_treedef != treedef:
            return after_treedef.unflatten(leaves_after)  # the caller raises an error
        new_leaves = view_leaves(views, leaves_after)
        unchanged_flags = [x is y for x, y in zip(leaves_after, restored_leaves, strict=True)]
        return treedef.unflatten(
            [
                old if is_unchanged else new
                for old, new, is_unchanged in zip(leaves_before, new_leaves, unchanged_flags, strict=True)
            ]
        )


def view_leaves(views: Collection[int], leaves: Sequence[Any]) -> list[Any]:
    """Return leaves, with leaves of other populations reshaped to leaves of the world. (n_worlds, 1, n_members, ...)"""
    return [_reshape(x, (x.shape[0], 1, *x.shape[1:])) if i in views and x is not None else x
            for i, x in enumerate(leaves)]  # fmt: skip


def restore_leaves(views: Collection[int], leaves: Sequence[Any]) -> list[Any]:
    """Return leaves with the shapes that they had before ``view_leaves``. (n_worlds, n_members, ...)"""
    return [_reshape(x, (x.shape[0], *x.shape[2:])) if i in views and x is not None else x
            for i, x in enumerate(leaves)]  # fmt: skip


def _reshape(x: Any, shape: tuple[int, ...]) -> Any:
    return jax.ShapeDtypeStruct(shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x.reshape(shape)


def adapt_to_data_leaves(program: Program, run: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function of leaves from ``view_leaves`` as a function of the leaves of the data."""
    views, written = program.views, program.written_leaves
    if not views:
        return run

    def run_steps(leaves: Sequence[Any], n_steps: Any) -> Any:
        results, flagged = run(view_leaves(views, leaves), n_steps)
        new_leaves = dict(zip(written, results, strict=True))
        partial_leaves = [new_leaves.get(i) for i in range(len(leaves))]
        restored = restore_leaves(views, partial_leaves)
        return [restored[i] for i in written], flagged

    return run_steps
