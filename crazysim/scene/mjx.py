"""MJX, imported on first use, since only its contact slots, ``mjx_model`` and ``mjx_data`` need it.

MJX is imported without NVIDIA Warp: nothing here runs MJX on Warp, and the import of Warp would take two more seconds.
A program that runs MJX on Warp must import ``mujoco.mjx`` or ``warp`` itself, before the first contacts. MJX calls
trimesh and ``scipy.spatial`` only for scenes with meshes. Their import takes almost a second, so it is deferred to the
first call.
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
    # MJX prints two lines when Warp cannot be imported.
    with _defer_imports(), contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


class _DeferredModule(ModuleType):
    """Placeholder of a module. Its attributes are functions that import the module and call its member of that name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *args, **kwargs: getattr(importlib.import_module(self.__name__), name)(*args, **kwargs)


@contextlib.contextmanager
def _defer_imports() -> Iterator[None]:
    replacements = {"warp": None, **{name: _DeferredModule(name) for name in ("trimesh", "scipy.spatial")}}
    replacements = (
        {} if "mujoco.mjx" in sys.modules else {k: x for k, x in replacements.items() if k not in sys.modules}
    )
    sys.modules.update(replacements)  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in replacements:
            del sys.modules[name]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(load_module(), name)
