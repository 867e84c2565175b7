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
import platform
import re
import shutil
import stat
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from crazysim import cache
from crazysim.errors import warn
from crazysim.storage import FOLDER_REMEDY, make_private_folder, untrusted_reason

DIGEST_LENGTH = 24
"""Hexadecimal digits of a hash in a name: 96 bits."""

ABANDONMENT_AGE = 86400.0
"""Age at which remains of processes on other machines are removed, s."""


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
    """Warn, once, that a folder is not used."""
    warn(
        f"expected a folder of kernels that only this user can write, got {str(kernel_folder)!r}: {reason}, so kernels "
        f"are compiled again in every process. {FOLDER_REMEDY}"
    )


@functools.cache
def _remove_abandoned_files_once(kernel_folder: Path) -> None:
    """Remove unfinished files of processes that have ended from a folder, once."""
    remove_abandoned_files(kernel_folder, "*.tmp")


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


def process_name() -> str:
    """Return the name of this process for the names of its files: machine and process ID."""
    return f"{_machine()}-{os.getpid()}"


@functools.cache
def _machine() -> str:
    """Return a short name of this machine and its namespace of process IDs, such as a container."""
    try:
        pid_namespace = os.readlink("/proc/self/ns/pid")
    except OSError:
        pid_namespace = ""
    return digest(platform.node(), pid_namespace)[:8]


def remove_abandoned_files(cache_folder: Path, pattern: str) -> None:
    """Remove files and folders of processes that have ended without removing them.

    Args:
        cache_folder: Folder that holds them.
        pattern: Pattern of their names.
    """
    for path in cache_folder.glob(pattern):
        with contextlib.suppress(OSError):
            status = path.lstat()
            if not _is_abandoned(path.name, time.time() - status.st_mtime) or untrusted_reason(path):
                continue
            if stat.S_ISDIR(status.st_mode):
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def _is_abandoned(name: str, age: float) -> bool:
    """Return True if no process needs a file or folder any more.

    Args:
        name: Its name, which contains the name of its process.
        age: Time since it was written, s.
    """
    match = re.search(r"[.-]([0-9a-f]{8})-(\d+)-", name)
    if match is None:
        return name.endswith(".tmp") and age > ABANDONMENT_AGE
    machine, pid = match.groups()
    if machine != _machine() or os.name == "nt":  # on Windows the call below would end the process
        return age > ABANDONMENT_AGE
    try:
        os.kill(int(pid), 0)
    except OSError:  # there is no such process, or it belongs to another user
        return True
    return False


def find_files(cache_folder: Path, key: str) -> Iterator[Path]:
    """Yield the intact files of a key. Damaged files are removed, and files of other users are left out."""
    for path in sorted(cache_folder.glob(f"{key}-*")):
        if path.suffix == ".tmp" or untrusted_reason(path):
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
        cache_folder: The folder.
        key: The key.
        content: Contents.
        suffix: Suffix of the name, such as ``".so"``.

    Raises:
        OSError: If the folder cannot be written, or its disk is full.
    """
    path = cache_folder / f"{key}-{digest(content)}{suffix}"
    unfinished_path = cache_folder / f"{path.stem}.{process_name()}-{threading.get_ident()}.tmp"
    try:
        unfinished_path.touch(mode=0o700)
        unfinished_path.write_bytes(content)
        unfinished_path.replace(path)
    finally:
        unfinished_path.unlink(missing_ok=True)
    return path
