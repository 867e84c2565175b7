"""Files of compiled kernels, which processes and machines of one user can safely share.

The name of a file consists of its key, a hash of everything that the code depends on, and the hash of its contents. A
truncated or damaged file does not match its name and is not used. Two processes may write the same kernel at the same
time: files are renamed when they are complete.

Loading a file executes it. A folder or file that another user could have written is therefore not used.

The names of unfinished files and of temporary folders contain the name of their process, so that later processes can
remove the remains of processes that were killed.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from crazysim.engine import cache
from crazysim.errors import warn
from crazysim.storage import (
    FOLDER_REMEDY,
    UNFINISHED_SUFFIX,
    make_private_folder,
    process_name,
    remove_abandoned_files,
    untrusted_reason,
    write_private_file,
)

DIGEST_LENGTH = 24
"""Hexadecimal digits of a hash in a name: 96 bits."""


def digest(*parts: str | bytes) -> str:
    """Return the hash of some texts, which depends on their order and on the boundaries between them."""
    state = hashlib.sha256()
    for part in parts:
        raw = part.encode() if isinstance(part, str) else part
        state.update(len(raw).to_bytes(8, "little") + raw)
    return state.hexdigest()[:DIGEST_LENGTH]


def folder() -> Path:
    """Return the folder of compiled kernels: inside the folder of compiled programs, or a temporary one."""
    programs = cache.folder()
    if programs is not None:
        kernel_folder = programs / "crazysim"
        with contextlib.suppress(OSError):
            make_private_folder(kernel_folder)
        if kernel_folder.is_dir():
            if reason := untrusted_reason(kernel_folder):
                _warn_once(kernel_folder, reason)
            elif os.access(kernel_folder, os.W_OK | os.R_OK):
                _remove_abandoned_files_once(kernel_folder)
                return kernel_folder
    return temporary_folder()


@functools.cache
def _warn_once(kernel_folder: Path, reason: str) -> None:
    warn(
        f"expected a folder of kernels that only this user can write, got {str(kernel_folder)!r}: {reason}, so kernels "
        f"are compiled again in every process. {FOLDER_REMEDY}"
    )


@functools.cache
def _remove_abandoned_files_once(kernel_folder: Path) -> None:
    remove_abandoned_files(kernel_folder, f"*{UNFINISHED_SUFFIX}")


def temporary_folder() -> Path:
    """Return a folder of this process, which is removed when the process ends. A forked process has its own folder."""
    folder = _make_temporary_folder(os.getpid())
    make_private_folder(folder)  # again, in case the system has removed it
    return folder


@functools.cache
def _make_temporary_folder(pid: int) -> Path:
    parent = Path(tempfile.gettempdir())
    remove_abandoned_files(parent, "crazysim-*")
    folder = Path(tempfile.mkdtemp(prefix=f"crazysim-{process_name()}-", dir=parent))

    def remove() -> None:
        if os.getpid() == pid:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def find_files(cache_folder: Path, key: str) -> Iterator[Path]:
    """Yield the intact files of a key. Damaged files are removed, and files of other users are left out."""
    for path in sorted(cache_folder.glob(f"{key}-*")):
        if path.suffix == UNFINISHED_SUFFIX or untrusted_reason(path):
            continue
        try:
            is_intact = path.stem == f"{key}-{digest(path.read_bytes())}"
        except OSError:
            continue
        if is_intact:
            yield path
        else:
            with contextlib.suppress(OSError):
                path.unlink()


def store_file(cache_folder: Path, key: str, content: bytes, suffix: str) -> Path:
    """Write a file into a folder, under the name of its key and contents, and return it.

    Args:
        suffix: Suffix of the name, such as ``".so"``.

    Raises:
        OSError: If the folder cannot be written, or its disk is full.
    """
    path = cache_folder / f"{key}-{digest(content)}{suffix}"
    write_private_file(path, content)
    return path
