"""Files: written completely or not at all, read within limits of size, and in folders that only this user can write."""

from __future__ import annotations

import errno
import functools
import glob
import hashlib
import io
import itertools
import math
import os
import platform
import re
import shutil
import stat
import time
import tomllib
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, DamagedFileError, require

PICTURE_SUFFIXES = (".png", ".jpg", ".svg", ".pdf")
"""Suffixes of the formats in which figures are saved."""
MAX_TOML_BYTES = 2**20
"""Largest TOML file, bytes; the built-in ones have up to 12,000."""
MAX_TEXT_BYTES = 2**24
"""Largest text that people write, such as a list of points or the code of a task, bytes."""
MAX_FILE_BYTES = 2**36
"""Largest file that is read in parts or unpacked, bytes: recorded flights and checkpoints."""
MAX_ARRAYS = 10_000
"""Largest number of arrays in an ``.npz`` file."""
MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO = 2**30, 100
"""Limit of the bytes unpacked from an ``.npz`` file: the larger of ``MAX_UNPACKED_BYTES`` and ``MAX_UNPACKED_RATIO``
times the size of the file."""
FOLDER_REMEDY = "Remove it, since its files may not be yours, or use another."
"""End of the message for a folder that is refused."""
UNFINISHED_SUFFIX = ".part"
"""Suffix of files that are being written."""
ABANDONMENT_AGE = 86400.0
"""Age at which remains of processes on other machines are removed, s."""
SYSTEM_USERS = (0, 65534)
"""Ids of users that may own parent folders: root, and the user that containers show instead of an unmapped root."""


def as_path(path: str | Path) -> Path:
    """Return a path, after checking that it is a text or a path."""
    require(
        isinstance(path, (str, os.PathLike)),
        f"expected the path of a file or folder, got {path!r}. Use a text, such as 'out/hover'.",
    )
    return Path(path)


def is_file(path: str | Path) -> bool:
    """Whether a file of that path exists; False for what cannot be a path."""
    try:
        return Path(path).is_file()
    except (OSError, TypeError, ValueError):
        return False


PART_BYTES = 2**20
"""Size of the parts in which ``read_bytes`` reads a file, bytes."""


def read_bytes(path: str | Path, max_bytes: int) -> bytes:
    """Return the contents of a file.

    Args:
        max_bytes: Largest size, bytes.
    """
    try:
        parts, size = [], 0
        with open_file(path, max_bytes) as file:
            # In parts, because a read reserves memory for all bytes that it may return.
            while size <= max_bytes and (part := file.read(min(PART_BYTES, max_bytes + 1))):
                parts.append(part)
                size += len(part)
        content = b"".join(parts)
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise ConfigError(f"expected an existing file, got {str(path)[:200]!r}") from None
    except OSError as error:
        raise ConfigError(f"expected a file that can be read, got {str(path)[:200]!r}: {error}") from error
    _check_size(path, len(content), max_bytes)  # a file may grow, and those of /proc state no size
    return content


def open_file(path: str | Path, max_bytes: int = MAX_FILE_BYTES) -> BinaryIO:
    """Open a file of data for reading, after the check of ``check_file``.

    Raises:
        OSError: If it does not exist, is a folder, or cannot be read.
    """
    check_file(path, max_bytes)
    return open(path, "rb")


def check_file(path: str | Path, max_bytes: int = MAX_FILE_BYTES) -> None:
    """Check a file that is opened elsewhere: devices and pipes may wait for ever, or have no end.

    Raises:
        OSError: If it does not exist, or is a folder.
    """
    try:
        status = os.stat(os.fspath(path))
    except (TypeError, ValueError):  # not a path at all, or a null byte, for example
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path)) from None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError(f"expected a file, got the device or pipe {str(path)[:200]!r}. Save its contents to a file.")
    _check_size(path, status.st_size, max_bytes)


def _check_size(path: str | Path, size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise ConfigError(f"expected a file of at most {max_bytes} bytes, got {size} in {str(path)[:200]}")


def read_text(path: str | Path, max_bytes: int) -> str:
    """Return the contents of a text file, without a byte order mark.

    Args:
        max_bytes: Largest size, bytes.
    """
    try:
        text = read_bytes(path, max_bytes).decode("utf-8-sig")
        require("\0" not in text, f"expected text in UTF-8 in {path}, got zero bytes, as in UTF-16. Save it as UTF-8.")
        return text
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"expected text in {path}, got bytes that are not UTF-8: {error}. Save it as UTF-8."
        ) from error


def read_toml(path: str | Path, guide: str) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Args:
        guide: Page that describes the format, for messages.
    """
    text = read_text(path, MAX_TOML_BYTES)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also of dates that do not exist
        raise ConfigError(f"{path} is not valid TOML: {error}; see {guide} for the format") from error


@contextmanager
def wrap_read_errors(path: str | Path, content: str, remedy: str) -> Iterator[None]:
    """Convert errors raised in a block that reads a file to errors of crazysim that name the file.

    Damaged files raise errors of almost any type in the libraries that read them. A ``ConfigError``, and the
    ``ImportError`` of a missing library, are passed on.

    Args:
        content: Description of the file's contents, such as ``"a recorded flight"``.
        remedy: Sentence about what to do.

    Raises:
        ConfigError: If the file does not exist.
        DamagedFileError: If it exists, and the block raises an error other than ``ConfigError`` and ``ImportError``.
    """
    try:
        yield
    except (ConfigError, ImportError):
        raise
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise ConfigError(f"expected an existing file with {content}, got {str(path)!r}. {remedy}") from None
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:100]}"
        raise DamagedFileError(
            f"expected {content}, got {str(path)!r}, which is damaged or a file of another kind ({reason}). {remedy}"
        ) from error


_unfinished_numbers = itertools.count()


def unfinished_path(path: Path) -> Path:
    """Return a new path for the file that replaces ``path`` once it is complete.

    Processes and threads that write the same file at the same time get different paths. What processes that were
    killed have left of ``path`` is removed.
    """
    remove_abandoned_files(path.parent, f"{glob.escape(path.name)}.*{UNFINISHED_SUFFIX}")
    return path.with_name(f"{path.name}.{process_name()}-{next(_unfinished_numbers)}{UNFINISHED_SUFFIX}")


def process_name() -> str:
    """Return the name of this process for the names of its files: machine and process ID."""
    return f"{_machine()}-{os.getpid()}"


@functools.cache
def _machine() -> str:
    try:
        pid_namespace = os.readlink("/proc/self/ns/pid")
    except OSError:
        pid_namespace = ""
    return hashlib.sha256(f"{platform.node()} {pid_namespace}".encode()).hexdigest()[:8]


def remove_abandoned_files(folder: Path, pattern: str) -> None:
    """Remove this user's files and folders of processes that have ended without removing them."""
    for path in folder.glob(pattern):
        with suppress(OSError):
            status = path.lstat()
            is_own = not hasattr(os, "geteuid") or status.st_uid == os.geteuid()
            if not is_own or not _is_abandoned(path.name, time.time() - status.st_mtime):
                continue
            if stat.S_ISDIR(status.st_mode):
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def _is_abandoned(name: str, age: float) -> bool:
    matches = re.findall(r"[.-]([0-9a-f]{8})-(\d+)-", name)
    if not matches:
        return False
    machine, pid = matches[-1]
    if machine != _machine() or os.name == "nt":  # on Windows the call below would end the process
        return age > ABANDONMENT_AGE
    try:
        os.kill(int(pid), 0)
    except (OSError, OverflowError):  # there is no such process, or it belongs to another user
        return True
    return False


def write_private_file(path: Path, content: bytes) -> None:
    """Write a file that only this user can read or write, as a whole or not at all.

    Raises:
        OSError: If the folder cannot be written, or its disk is full.
    """
    temporary_path = unfinished_path(path)
    try:
        temporary_path.touch(mode=0o700)
        temporary_path.write_bytes(content)
        temporary_path.replace(path)
    finally:
        temporary_path.unlink(missing_ok=True)


@contextmanager
def open_replacement(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file for writing that takes the place of ``path`` at the end of the block.

    If writing fails, or the block raises an error, ``path`` is unchanged, and no other file is left.

    Raises:
        ConfigError: If the folder does not exist, or the file cannot be written, for example on a full disk.
    """
    path = as_path(path)
    require(path.parent.is_dir(), f"expected an existing folder, got {str(path.parent)!r} for {path.name!r}")
    if path.exists() and not path.is_file():
        kind = "folder" if path.is_dir() else "device or pipe"
        raise ConfigError(
            f"expected a file that can be written, got the {kind} {str(path)!r}. Give the name of a file."
        )
    temporary_path = unfinished_path(path)
    try:
        with temporary_path.open("wb") as file:
            yield file
        os.replace(temporary_path, path)
    except BaseException as error:
        temporary_path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise ConfigError(
                f"expected a file that can be written, got {str(path)!r}: {error}. Use another folder, or make room."
            ) from error
        raise


def write_file(path: str | Path, content: bytes | str) -> None:
    """Write a file as a whole or not at all, text in UTF-8.

    Raises:
        ConfigError: If the folder does not exist, or the file cannot be written.
    """
    with open_replacement(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def write_figure(figure: Any, path: str | Path, dpi: float) -> None:
    """Write a figure of matplotlib as a whole or not at all; the suffix of the file is the format.

    Raises:
        ConfigError: If the suffix is not in ``PICTURE_SUFFIXES``, the folder does not exist, or the file cannot be
            written.
    """
    check_writable(path, PICTURE_SUFFIXES)
    with open_replacement(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower(), dpi=dpi, bbox_inches="tight")


class _NothingToWriteError(Exception):
    """Raised to leave a file unchanged."""


def check_writable(path: str | Path, suffixes: Sequence[str] = ()) -> None:
    """Check that a file can be written, before the work that produces its contents; an existing file is not changed.

    Args:
        suffixes: Accepted endings of the file's name; empty for any.

    Raises:
        ConfigError: If its name has another ending, the folder does not exist, or it cannot be written.
    """
    require(
        not suffixes or as_path(path).suffix.lower() in suffixes,
        f"expected the name of a file that ends with {' or '.join(suffixes)}, got {str(path)!r}. Use another name.",
    )
    with suppress(_NothingToWriteError), open_replacement(path):
        raise _NothingToWriteError


class ZipReader:
    """A zip archive from which files are unpacked within limits of number and size."""

    def __init__(self, file: BinaryIO, name: str, max_files: int, max_file_bytes: int, max_total_bytes: int):
        self._zip, self._name = zipfile.ZipFile(file), name
        self._max_file_bytes, self._max_total_bytes = max_file_bytes, max_total_bytes
        self._n_unpacked_bytes = 0
        members = self._zip.infolist()
        require(len(members) <= max_files, f"expected at most {max_files} files, got {len(members)} in {name}")
        self._members = {str(PurePosixPath(member.filename)): member for member in members}
        self.names = self._members.keys()
        """Names of the files."""

    def read(self, name: str) -> bytes:
        """Return the contents of a file of the archive.

        Raises:
            ConfigError: If the file is too large, or all files read so far are too large together.
            Exception: Of any type, if it is damaged; see ``wrap_read_errors``.
        """
        member = self._members[name]
        self._n_unpacked_bytes += member.file_size
        if member.file_size > self._max_file_bytes or self._n_unpacked_bytes > self._max_total_bytes:
            raise ConfigError(
                f"expected files of at most {self._max_file_bytes} bytes, {self._max_total_bytes} in all, got more in "
                f"{self._name}: {name}"
            )
        with self._zip.open(member) as file:
            return file.read(member.file_size)  # the length limits what is unpacked, if the archive states a wrong size


def read_arrays(file: BinaryIO, name: str) -> dict[str, NDArray]:
    """Return the arrays of an ``.npz`` file by name, after comparing their checksums.

    Raises:
        Exception: Of any type, if it is damaged; see ``wrap_read_errors``.
    """
    limit = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * file.seek(0, os.SEEK_END))
    archive = ZipReader(file, name, MAX_ARRAYS, limit, limit)
    # A whole member is read before NumPy parses it: the checksum of a member is compared only at its end.
    return {
        member.removesuffix(".npy"): _parse_array(archive.read(member), f"{name}: {member}") for member in archive.names
    }


def _parse_array(content: bytes, name: str) -> NDArray:
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    stated_bytes, following_bytes = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    if min(shape, default=0) < 0 or (stated_bytes > following_bytes and not dtype.hasobject):
        raise ConfigError(
            f"expected an array of the {following_bytes} bytes that follow its header, "
            f"got a header of shape {shape} in {name}. Write the file again."
        )
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def make_folder(folder: Path) -> None:
    """Make the output folder of a command, and its parents; it may exist.

    Raises:
        ConfigError: If it cannot be made, or is a file.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "which is a file" if folder.is_file() else str(error)
        raise ConfigError(f"expected a folder, got {str(folder)!r}: {reason}. Use another --out.") from error


def make_private_folder(folder: Path) -> None:
    """Make a folder that only this user can enter, and its parents with default permissions; it may exist.

    Raises:
        OSError: If it cannot be made.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)


def untrusted_reason(path: Path) -> str:
    """Return the reason why another user could have written a file or folder, for a message; empty if none could.

    Groups that can write to a parent folder are trusted.

    Args:
        path: The file or folder. One that cannot be read is not trusted.
    """
    if not hasattr(os, "geteuid"):
        return ""
    try:
        status = path.stat()
    except OSError as error:
        return f"it cannot be read ({error.strerror})"
    if status.st_uid != os.geteuid():
        return f"it belongs to the user {status.st_uid}"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "other users can write to it"
    for parent in path.resolve().parents:
        status = parent.stat()
        if status.st_uid not in (os.geteuid(), *SYSTEM_USERS):
            return f"the user {status.st_uid} can replace it, who owns {parent}"
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"other users can replace it, as they can write to {parent}"
    return ""


class Closeable:
    """Base class of files and connections that a ``with`` block closes."""

    def close(self) -> None:
        """Close the file or connection."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
