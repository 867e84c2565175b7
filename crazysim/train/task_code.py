"""Hash of the code of a task: its classes, and what its observations use."""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import sys
import textwrap
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any

import jax
import numpy as np

from crazysim.envs.task import Task

CONSTANTS = (bool, int, float, str, tuple, np.ndarray, jax.Array)
"""Types of global values that are part of the hash."""


@functools.cache
def task_digest(task: type[Task]) -> str | None:
    """Return the hash of a task's classes, and of the functions, classes and constants that ``observe`` uses.

    Comments, docstrings, layout and installed libraries do not count. It is None without a source, as for a class that
    was typed at a prompt.
    """
    classes = [base for base in task.__mro__ if issubclass(base, Task) and base is not Task]
    libraries = {"crazysim", *(base.__module__.partition(".")[0] for base in classes)}
    texts: set[str] = set()
    found: list[Any] = [*classes, task.observe]
    try:
        for part in found:  # grows
            texts.add(_without_comments(inspect.getsource(part)))
            for name, value in _values_used_by(part, task):
                value = inspect.unwrap(value) if callable(value) else value
                if isinstance(value, (FunctionType, type)):
                    if _is_own(value.__module__, libraries) and not any(value is x for x in found):
                        found.append(value)
                elif isinstance(value, CONSTANTS):
                    text = f"{name} = {value.tolist() if isinstance(value, (np.ndarray, jax.Array)) else value!r}"
                    texts.add(text if " at 0x" not in text else name)
    except (OSError, TypeError, ValueError):
        return None
    return hashlib.sha256("\n".join(sorted(texts)).encode()).hexdigest()


def _values_used_by(function: Any, task: type[Task]) -> Iterator[tuple[str, Any]]:
    if not isinstance(function, FunctionType):
        return
    names = _names(function.__code__)
    yield from zip(
        function.__code__.co_freevars, [cell.cell_contents for cell in function.__closure__ or ()], strict=True
    )
    for name in sorted(names):
        method = inspect.getattr_static(task, name, None)
        yield name, getattr(method, "fget", getattr(method, "func", method))
        value = function.__globals__.get(name)
        yield name, value
        if isinstance(value, ModuleType) and value.__name__.partition(".")[0] not in ("jax", "numpy"):
            yield from ((member, getattr(value, member)) for member in sorted(names) if hasattr(value, member))


def _names(code: CodeType) -> set[str]:
    return set(code.co_names).union(*(_names(x) for x in code.co_consts if isinstance(x, CodeType)))


def _is_own(module_name: str, libraries: set[str]) -> bool:
    root, file = module_name.partition(".")[0], getattr(sys.modules.get(module_name), "__file__", None)
    return root in libraries or (file is not None and root not in sys.stdlib_module_names and "-packages" not in file)


def _without_comments(source: str) -> str:
    try:
        tree = ast.parse(textwrap.dedent(source))
    except SyntaxError:  # part of an expression, such as a lambda
        return source
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [x for x in body if not (isinstance(x, ast.Expr) and isinstance(x.value, ast.Constant))]  # type: ignore[attr-defined]
    return ast.unparse(tree)
