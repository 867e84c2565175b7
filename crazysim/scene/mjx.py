"""MJX, imported on first use: the import takes more than half a second, and only contacts need it.

It is imported without NVIDIA Warp: nothing here runs MJX on Warp, whose import would take two more seconds. A program
that runs MJX on Warp imports ``mujoco.mjx`` or ``warp`` itself, before the first contacts.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mujoco.mjx import Data, Model, camlight, collision, com_pos, kinematics, put_data, put_model

__all__ = ["Data", "Model", "camlight", "collision", "com_pos", "kinematics", "put_data", "put_model"]


def load_module() -> ModuleType:
    """Return the module ``mujoco.mjx``."""
    # MJX prints two lines when Warp cannot be imported.
    with _hide_warp(), contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


@contextlib.contextmanager
def _hide_warp() -> Iterator[None]:
    """Make imports of Warp fail, unless it has been imported."""
    if "warp" in sys.modules or "mujoco.mjx" in sys.modules:
        yield
        return
    sys.modules["warp"] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules["warp"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(load_module(), name)
