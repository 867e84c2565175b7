"""Names of the last release, found under their new ones with a warning."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any

REMOVED_IN = "0.3"
"""Release in which deprecated names disappear."""


def renamed(module: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a module some of whose names have moved.

    Args:
        module: Name of the module, ``__name__``.
        names: New place of each old name, as ``"package.module:name"``.
    """

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        place, _, new = names[name].partition(":")
        _warn(f"{module}.{name}", f"{place}.{new}")
        return getattr(importlib.import_module(place), new)

    return find


def moved(module: str, new: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a module that has moved as a whole.

    Args:
        module: Name of the module, ``__name__``.
        new: Name of the module that holds its contents now.
    """

    def find(name: str) -> Any:
        if name.startswith("__") or not hasattr(target := importlib.import_module(new), name):
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(f"{module}.{name}", f"{new}.{name}")
        return getattr(target, name)

    return find


def warn_renamed(old: str, new: str) -> None:
    """Warn the caller's caller that ``old`` is deprecated in favour of ``new``."""
    _warn(old, new, stacklevel=4)


def _warn(old: str, new: str, stacklevel: int = 3) -> None:
    message = f"{old} is deprecated and will be removed in {REMOVED_IN}; use {new}"
    warnings.warn(message, DeprecationWarning, stacklevel=stacklevel)
