"""Named stages in order: how the step and the reset of a simulation are put together and changed.

A pipeline is an ordered dict from names to functions. Every function here changes it in place; afterwards the
simulation's ``build_step_fn`` or ``build_reset_fn`` makes the change take effect.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from crazysim.errors import UnknownNameError

Pipeline = dict[str, Callable[..., Any]]


def append_fn(pipeline: Pipeline, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage at the end; without a name it is called as the function is.

    Raises:
        ValueError: If the name exists already, or there is none.
    """
    _insert(pipeline, len(pipeline), fn, name)


def prepend_fn(pipeline: Pipeline, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage at the beginning; without a name it is called as the function is.

    Raises:
        ValueError: If the name exists already, or there is none.
    """
    _insert(pipeline, 0, fn, name)


def insert_fn_before(pipeline: Pipeline, anchor: str, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage right before the stage ``anchor``.

    Raises:
        ValueError: If there is no such stage, the name exists already, or there is none.
    """
    _insert(pipeline, _index(pipeline, anchor), fn, name)


def insert_fn_after(pipeline: Pipeline, anchor: str, fn: Callable[..., Any], name: str | None = None) -> None:
    """Add a stage right after the stage ``anchor``.

    Raises:
        ValueError: If there is no such stage, the name exists already, or there is none.
    """
    _insert(pipeline, _index(pipeline, anchor) + 1, fn, name)


def replace_fn(pipeline: Pipeline, fn: Callable[..., Any], name: str) -> None:
    """Exchange the function of the stage ``name``.

    Raises:
        ValueError: If there is no such stage.
    """
    _index(pipeline, name)
    pipeline[name] = fn


def remove_fn(pipeline: Pipeline, name: str) -> None:
    """Take the stage ``name`` out.

    Raises:
        ValueError: If there is no such stage.
    """
    _index(pipeline, name)
    del pipeline[name]


def _index(pipeline: Pipeline, name: str) -> int:
    if name not in pipeline:
        raise UnknownNameError(f"No stage named {name!r} in the pipeline; use one of its stages: {', '.join(pipeline)}")
    return list(pipeline).index(name)


def _insert(pipeline: Pipeline, index: int, fn: Callable[..., Any], name: str | None) -> None:
    if not callable(fn):
        raise ValueError(f"expected a stage as a function, got {fn!r}")
    name = name if name is not None else getattr(fn, "__name__", None)
    if name is None or name == "<lambda>":
        raise ValueError(f"{fn!r} has no name of its own and needs an explicit name; pass name=")
    if name in pipeline:
        raise UnknownNameError(f"a stage named {name!r} already exists; pass another name=, or use replace_fn")
    items = list(pipeline.items())
    items.insert(index, (name, fn))
    pipeline.clear()
    pipeline.update(items)
