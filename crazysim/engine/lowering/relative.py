"""Stages and data as seen from one population, whose members an engine computes side by side.

For the engine the members of that population are what drones are otherwise. Leaves of other populations are viewed as
leaves of the world, (n_worlds, 1, n_members, ...), and their stages as stages of the world.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any

import jax

from crazysim.core.stage import Axes, Stage, world_function
from crazysim.pytree import has_members

if TYPE_CHECKING:
    from crazysim.engine.ir.program import Program


class RelativeAxes(Axes):
    """Batch axes of all leaves as seen from one population, whose scope is ``drone`` here."""

    def __init__(self, data: Any, population: str):
        """Take the data of all worlds, not viewed."""
        super().__init__(data)
        self.original = Axes(data)
        """Batch axes as declared."""
        self.views = frozenset(i for i, scope in enumerate(self.scopes) if has_members(scope) and scope != population)
        """Leaves of other populations."""
        self.scopes = [
            "world" if i in self.views else "drone" if scope == population else scope
            for i, scope in enumerate(self.scopes)
        ]

    def stage(self, stage: Stage) -> Stage:
        """Return a stage on viewed data."""
        return stage if self.original.scopes == self.scopes else RelativeStage(stage, self)


class RelativeStage(Stage):
    """A stage on viewed data."""

    def __init__(self, stage: Stage, axes: RelativeAxes):
        """Take a stage on data that is not viewed."""
        self.original, self.axes = stage, axes
        fn, scope, when = stage.fn, stage.scope, stage.when
        if scope == "batch":
            fn = self
        elif scope != "world":
            scopes = {axes.scopes[i] for i, original in enumerate(axes.original.scopes) if original == scope}
            scope = next(iter(scopes))
            if scope == "world":
                fn, when = world_function(stage, axes.original), None
        super().__init__(fn, scope, when, name=stage.__name__, why=stage.why, phase=stage.phase)

    def __call__(self, data: Any) -> Any:
        """Return the viewed data of all worlds after the stage."""
        treedef, views = self.axes.treedef, self.axes.views
        before = jax.tree.leaves(data)
        given = restore_leaves(views, before)
        after, after_treedef = jax.tree.flatten(self.original(treedef.unflatten(given)))
        if after_treedef != treedef:
            return after_treedef.unflatten(after)  # the caller refuses it
        new = view_leaves(views, after)
        unchanged = [x is y for x, y in zip(after, given, strict=True)]
        return treedef.unflatten([old if same else x for old, x, same in zip(before, new, unchanged, strict=True)])


def view_leaves(views: Collection[int], leaves: Sequence[Any]) -> list[Any]:
    """Return leaves with those of other populations as leaves of the world. (n_worlds, 1, n_members, ...)"""
    return [_reshaped(x, (x.shape[0], 1, *x.shape[1:])) if i in views and x is not None else x
            for i, x in enumerate(leaves)]  # fmt: skip


def restore_leaves(views: Collection[int], leaves: Sequence[Any]) -> list[Any]:
    """Return viewed leaves as they are in the data. (n_worlds, n_members, ...)"""
    return [_reshaped(x, (x.shape[0], *x.shape[2:])) if i in views and x is not None else x
            for i, x in enumerate(leaves)]  # fmt: skip


def _reshaped(x: Any, shape: tuple[int, ...]) -> Any:
    return jax.ShapeDtypeStruct(shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x.reshape(shape)


def on_data_leaves(program: Program, run: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that runs a program on leaves as they are in the data, from one on viewed leaves."""
    views, written = program.views, program.written
    if not views:
        return run

    def steps(leaves: Sequence[Any], n_steps: Any) -> Any:
        out, flagged = run(view_leaves(views, leaves), n_steps)
        numbered = dict(zip(written, out, strict=True))
        given = [numbered.get(i) for i in range(len(leaves))]
        back = restore_leaves(views, given)
        return [back[i] for i in written], flagged

    return steps
