"""MJX, imported when it is first used: that takes over a second, and only contacts need it."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from crazysim.cache import announce

if TYPE_CHECKING:
    from mujoco.mjx import Data, Model, camlight, collision, com_pos, kinematics, put_data, put_model

__all__ = ["Data", "Model", "camlight", "collision", "com_pos", "kinematics", "put_data", "put_model"]


def load() -> ModuleType:
    """Return the module ``mujoco.mjx``."""
    if "mujoco.mjx" not in sys.modules:
        announce("importing MJX and compiling contacts", "4 to 7 s")
    # MJX prints two lines when NVIDIA Warp, which nothing here needs, is not installed.
    with contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(load(), name)
