"""Pipelines: the named stages of a step or a reset in order, and functions that edit them.

A pipeline is an ordered dict from names to functions. The functions here change it in place; the change takes effect
at the simulation's next step or reset. Functions that ``build_step_fn`` or ``build_reset_fn`` returned do not change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import is_
from typing import Any, Generic, TypeVar

from crazysim.errors import ConfigError, UnknownNameError, expect, require, short_repr

Pipeline = dict[str, Callable[..., Any]]
"""Functions of the stages by name, in order."""
F = TypeVar("F")


def check_pipeline(name: str, pipeline: object) -> Pipeline:
    """Check and return a pipeline that a user assigns."""
    expect(
        isinstance(pipeline, dict) and pipeline,
        f"{name} as a dict with a function for each name of a stage",
        pipeline,
        "Use insert_fn_before or remove_fn of crazysim.core.pipeline to edit the present one.",
    )
    for stage, fn in pipeline.items():  # type: ignore[attr-defined]  # checked
        if not isinstance(stage, str) or not callable(fn):
            raise ConfigError(f"expected names and functions in {name}, got {short_repr(stage)}: {short_repr(fn)}")
    return pipeline  # type: ignore[return-value]  # checked


def append_fn(pipeline: Pipeline, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage at the end, under the function's name if none is given."""
    _insert(pipeline, len(pipeline), fn, name)


def prepend_fn(pipeline: Pipeline, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage at the beginning, under the function's name if none is given."""
    _insert(pipeline, 0, fn, name)


def insert_fn_before(pipeline: Pipeline, anchor: str, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage right before the stage ``anchor``."""
    _insert(pipeline, _index(pipeline, anchor), fn, name)


def insert_fn_after(pipeline: Pipeline, anchor: str, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage right after the stage ``anchor``."""
    _insert(pipeline, _index(pipeline, anchor) + 1, fn, name)


def replace_fn(pipeline: Pipeline, fn: Callable[..., Any], name: str) -> None:
    """Replace the function of the stage ``name``."""
    _index(pipeline, name)
    pipeline[name] = fn


def remove_fn(pipeline: Pipeline, name: str) -> None:
    """Remove the stage ``name``."""
    _index(pipeline, name)
    del pipeline[name]


class BuiltPipeline(Generic[F]):
    """A pipeline and the function that runs it; an edit of the pipeline builds a new function."""

    def __init__(self, name: str, stages: Pipeline, build_fn: Callable[[Pipeline], F]):
        self._name, self._stages, self._build_fn = name, stages, build_fn
        self._last_build: tuple[Sequence[Callable[..., Any]], F]
        self.build()

    @property
    def stages(self) -> Pipeline:
        return self._stages

    @stages.setter
    def stages(self, stages: Pipeline) -> None:
        self._stages = check_pipeline(self._name, stages)

    def fn(self) -> F:
        """Return the function that runs the pipeline as it is now; without an edit, this call takes 0.3 us."""
        built_stages, fn = self._last_build
        is_unedited = len(self._stages) == len(built_stages) and all(map(is_, self._stages.values(), built_stages))
        return fn if is_unedited else self.build()

    def build(self) -> F:
        """Build, keep and return the function that runs the pipeline as it is now."""
        stages = dict(self._stages)
        fn = self._build_fn(stages)
        self._last_build = list(stages.values()), fn
        return fn


def _index(pipeline: Pipeline, name: str) -> int:
    require(
        name in pipeline,
        f"No stage named {name!r} exists in the pipeline. Use one of {', '.join(pipeline)}.",
        UnknownNameError,
    )
    return list(pipeline).index(name)


def _insert(pipeline: Pipeline, index: int, fn: Callable[..., Any], name: str | None) -> None:
    expect(callable(fn), "a function as a stage", fn, "Use a function from SimData to SimData.")
    name = name if name is not None else getattr(fn, "__name__", None)
    expect(name not in (None, "<lambda>"), "a name of a stage that is not a named function", fn, "Use name='...'.")
    require(
        name not in pipeline,
        f"a stage named {name!r} already exists. Use another name=, or replace_fn.",
        UnknownNameError,
    )
    items = list(pipeline.items())
    items.insert(index, (name, fn))  # type: ignore[arg-type]  # checked
    pipeline.clear()
    pipeline.update(items)
