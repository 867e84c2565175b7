"""References to tasks of users, ``FILE.py:NAME`` or ``MODULE:NAME``, and the list of references this user has named.

Loading a task executes its file. The files of a training run contain the reference of its task, and other people may
have written them. Therefore a reference from the files of a run is only loaded if this user has named the same
reference before, in a call or on the command line. A list of the named references is in the user's cache folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Container
from pathlib import Path
from types import ModuleType

from crazysim.engine.cache import caches_folder
from crazysim.envs.task import Task
from crazysim.errors import ConfigError, require
from crazysim.storage import MAX_TEXT_BYTES, make_private_folder, open_file, untrusted_reason

GUIDE = "docs/guides/tasks.md"
_CLASSES_BY_REFERENCE: dict[str, type[Task]] = {}
"""Classes that were passed to ``reference_of`` in this process, by reference."""
_NAMED_REFERENCES: set[str] = set()
"""References that the user has named in this process."""


def is_reference(name: str) -> bool:
    """Whether the name of a task refers to a file or a module."""
    return ":" in name or name.endswith(".py")


def split_reference(reference: str) -> tuple[str, str]:
    """Return the file or module of a reference, and the name in it, which may be empty."""
    if reference.endswith(".py"):
        return reference, ""
    location, _, name = reference.rpartition(":")
    return location, name


def absolute_reference(reference: str) -> str:
    """Return a reference with the absolute path of its file; a reference to a module is unchanged."""
    location, name = split_reference(reference)
    return f"{Path(location).expanduser().resolve()}:{name}" if location.endswith(".py") else reference


def reference_of(task: type[Task]) -> str:
    """Return the reference of a class. If the class is defined in a file, add the reference to the list."""
    module, name = sys.modules.get(task.__module__), task.__qualname__
    file = getattr(module, "__file__", None)
    is_in_file = file is not None and file.endswith(".py") and getattr(module, name, None) is task
    is_in_package = "." in task.__module__
    location = str(Path(file).resolve()) if file is not None and is_in_file and not is_in_package else task.__module__
    reference = f"{location}:{name}"
    _CLASSES_BY_REFERENCE[reference] = task
    if is_in_file:
        _add_to_list(reference)
    return reference


def load_task(reference: str, names: Container[str]) -> type[Task] | str:
    """Execute the file or module of a reference that the user has named, and add the reference to the list.

    Args:
        reference: ``FILE.py:NAME``, ``MODULE:NAME``, or ``FILE.py`` for the only task in it. A name is that of a class,
            or the ``name`` that the class has.
        names: Names of the registered tasks. Executing the file may register more.

    Returns:
        The class, or the name of a registered task if the reference contains such a name.

    Raises:
        ConfigError: If there is no such file, module or task.
    """
    reference = absolute_reference(reference)
    if reference in _CLASSES_BY_REFERENCE:
        return _CLASSES_BY_REFERENCE[reference]
    location, name = split_reference(reference)
    module = _import_file(Path(location)) if location.endswith(".py") else _import_module(location)
    classes = {k: x for k, x in vars(module).items() if _is_task(x) and x.__module__ == module.__name__}
    if not name and len(classes) == 1:
        name = next(iter(classes))
    own_names = {x.name: x for x in classes.values() if name not in names}  # a registered name has options, too
    task_class = (own_names | vars(module)).get(name) if name else None
    if not _is_task(task_class) and name not in names:
        defined = ", ".join(classes) or "none"
        raise ConfigError(
            f"expected the name of a task in {location}, got {name!r}; it defines {defined}. Write {location}:NAME "
            f"with a subclass of Task, or a name that the file registers; {GUIDE} has an example."
        )
    _NAMED_REFERENCES.add(reference)
    _add_to_list(reference)
    return task_class if _is_task(task_class) else name  # type: ignore[return-value]


def load_listed_task(reference: str, names: Container[str]) -> type[Task] | str:
    """Load a task as ``load_task`` does, if this user has named its reference before. For the files of training runs.

    Raises:
        ConfigError: If this user has not named the reference before, if others could have changed its file, or if
            there is no such file, module or task.
    """
    location, name = split_reference(reference)
    if reference in _CLASSES_BY_REFERENCE or reference in _NAMED_REFERENCES:
        return load_task(reference, names)
    remedy = (
        f"Read the code of the task, and name it yourself: --task FILE.py:{name or 'NAME'} in a command, or "
        f"load_policy(folder, task=...)."
    )
    require(
        reference in _read_list(),
        f"expected a task that you have named on this machine, got {reference!r} from the files of a run, which "
        f"others could have made. {remedy}",
    )
    if location.endswith(".py") and (reason := untrusted_reason(Path(location))):
        raise ConfigError(f"expected a file that only you can write, got {location!r}: {reason}. {remedy}")
    return load_task(reference, names)


def code_digest(reference: str) -> str:
    """Return the SHA-256 hash of the file of a reference, hexadecimal; empty if there is no file."""
    location, _ = split_reference(reference)
    with contextlib.suppress(OSError, ConfigError):
        return hashlib.sha256(_read_code(Path(location))).hexdigest() if location.endswith(".py") else ""
    return ""


def _read_code(path: Path) -> bytes:
    with open_file(path, MAX_TEXT_BYTES) as file:
        return file.read()


def _is_task(x: object) -> bool:
    return inspect.isclass(x) and issubclass(x, Task) and x is not Task


def _import_file(path: Path) -> ModuleType:
    try:
        source = _read_code(path)
    except OSError as error:
        raise ConfigError(
            f"expected a file with a task, got {str(path)!r}: {error.strerror}. Write the path of a Python file."
        ) from error
    name = f"{path.stem}_{hashlib.sha256(str(path).encode() + source).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module  # dataclasses look their module up there
    sys.path.insert(0, str(path.parent))
    try:
        exec(compile(source, path, "exec", dont_inherit=True), vars(module))
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        sys.path.remove(str(path.parent))
    return module


def _import_module(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        if Path(name).is_file():
            raise ConfigError(f"expected the file of a task to end with .py, got {name!r}. Rename it.") from error
        if name in sys.modules or error.name not in (name, name.partition(".")[0]):
            raise
        raise ConfigError(
            f"expected a module with a task, got {name!r}, which cannot be imported: {error}. Write FILE.py:NAME, or "
            f"install its package; a task from a notebook or a prompt has to be put into a file."
        ) from error


def _list_path() -> Path:
    return caches_folder() / "tasks"


def _read_list() -> list[str]:
    with contextlib.suppress(ConfigError):
        path = _list_path()
        if path.is_file() and not untrusted_reason(path):
            return path.read_text(encoding="utf-8").splitlines()
    return []


def _add_to_list(reference: str) -> None:
    with contextlib.suppress(OSError, ConfigError):
        path = _list_path()
        make_private_folder(path.parent)
        if untrusted_reason(path.parent) or reference in _read_list():
            return
        with open(path, "a", encoding="utf-8", opener=lambda p, flags: os.open(p, flags, 0o600)) as file:
            file.write(f"{reference}\n")
