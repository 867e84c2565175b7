"""The folder in which compiled programs and kernels are kept between processes.

By default, the folder holds the kernels of the engine and the XLA programs that crazysim compiles itself
(``keep_programs``). ``enable_cache`` keeps all programs of the process, including the user's own. A cache folder in
JAX's configuration takes precedence, also for kernels. Only ``enable_cache`` changes that configuration.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import shutil
import stat
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from crazysim.engine import jaxcompat
from crazysim.errors import ConfigError, require, warn
from crazysim.storage import (
    FOLDER_REMEDY,
    UNFINISHED_SUFFIX,
    make_private_folder,
    remove_abandoned_files,
    untrusted_reason,
    write_private_file,
)

CACHE_VARIABLE = "CRAZYSIM_CACHE"
"""Environment variable with the folder to use, or ``off``."""
MAX_CACHE_BYTES = 1_000_000_000
"""Largest size of all files, bytes: about 5,000 programs. If a folder exceeds it when a process first uses the folder,
the least recently used files are removed."""
TRIMMED_FRACTION = 0.8
"""Fraction of ``MAX_CACHE_BYTES`` to which a removal reduces the size, so that not every process removes files."""
MIN_FREE_BYTES = 50_000_000
"""Smallest free space on the disk of the cache, bytes: the size of the programs of a few simulations."""
CACHE_FILE_PATTERNS = ("*-cache", "*-atime", "xla_gpu_per_fusion_autotune_cache_dir/*", "xla_gpu_kernel_cache_file",
            "crazysim/*.so", "crazysim/*.ptx", "crazysim/*.cubin")  # fmt: skip
"""Names of the files that JAX, XLA and the engine write; other files in the folder are never removed."""
CPU_INFO = Path("/proc/cpuinfo")
"""File in which Linux lists the features of the CPU."""


def caches_folder() -> Path:
    """Return crazysim's folder of caches: ``$XDG_CACHE_HOME/crazysim`` or ``~/.cache/crazysim``."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    if Path(home).is_absolute():
        return Path(home) / "crazysim"
    try:
        return Path.home() / ".cache" / "crazysim"
    except RuntimeError:
        raise ConfigError(
            "expected a home folder for compiled programs, got none. "
            f"Set XDG_CACHE_HOME, or {CACHE_VARIABLE}, to a folder."
        ) from None


def default_folder() -> Path | None:
    """Return the folder that is used by default; None where ``CRAZYSIM_CACHE`` is ``off``.

    XLA's programs are machine code, but their names do not depend on the features of the CPU. Therefore each kind of
    CPU has a separate subfolder.

    Raises:
        ConfigError: If the path depends on a home folder that does not exist.
    """
    root = _root_folder()
    return None if root is None else root / f"cpu-{hashlib.sha256(cpu_features().encode()).hexdigest()[:8]}"


def _root_folder() -> Path | None:
    variable = os.environ.get(CACHE_VARIABLE, "")
    if variable.lower() in ("off", "0", "false", "no"):
        return None
    if not variable:
        return caches_folder() / "jax"
    try:
        return Path(variable).expanduser().absolute()  # the working directory may change
    except RuntimeError:
        raise ConfigError(
            f"expected a folder in {CACHE_VARIABLE}, got {variable!r}, whose user has no home folder. "
            "Use an absolute path."
        ) from None


def cpu_features() -> str:
    """Return the architecture of the CPU and, where the system lists them, its features."""
    try:
        lines = CPU_INFO.read_text().splitlines()
    except OSError:
        lines = []
    feature_line = next((line for line in lines if line.split(":")[0].strip().lower() in ("flags", "features")), "")
    return f"{platform.machine()} {feature_line}"


def folder() -> Path | None:
    """Return the folder that this process uses: the one in JAX's configuration, or else the default; None for neither.

    A default folder that cannot be used is reported on stderr, once; the process then keeps no programs.
    """
    configured_folder = jaxcompat.cache_folder()
    if configured_folder is not None:
        return Path(configured_folder)
    return _usable_default_folder()


def _usable_default_folder() -> Path | None:
    return _prepared_default_folder(*map(os.environ.get, (CACHE_VARIABLE, "XDG_CACHE_HOME", "HOME")))


@functools.cache
def _prepared_default_folder(*environment: str | None) -> Path | None:
    del environment  # the key under which the result is cached
    try:
        path = default_folder()
        if path is not None:
            _prepare_folder(path.parent, path)
    except ConfigError as error:
        message = f"compiled programs are not kept: {error}"
        print(
            message if CACHE_VARIABLE in message else f"{message} Set {CACHE_VARIABLE} to its path, or to off.",
            file=sys.stderr,
        )
        return None
    return path


def _prepare_folder(root: Path, path: Path) -> None:
    try:
        for private_folder in (root, path):
            make_private_folder(private_folder)
        free_bytes = shutil.disk_usage(path).free
    except OSError as error:
        raise ConfigError(
            f"expected a folder for compiled programs, got {str(path)!r}: {error}. Use another."
        ) from error
    if reason := untrusted_reason(path):
        raise ConfigError(
            f"expected a folder that only this user can write, got {str(path)!r}: {reason}. {FOLDER_REMEDY}"
        )
    require(
        os.access(path, os.R_OK | os.W_OK | os.X_OK),
        f"expected a folder that can be written, got {str(path)!r}. Use another.",
    )
    if free_bytes < MIN_FREE_BYTES:
        raise ConfigError(
            f"expected {MIN_FREE_BYTES / 1e6:g} MB of free space for compiled programs, got {free_bytes / 1e6:.1f} MB "
            f"in {str(path)!r}. Free some, or use another folder."
        )
    remove_abandoned_files(path, f"*{UNFINISHED_SUFFIX}")
    trim(root)
    jaxcompat.use_cache(str(path), CheckedPrograms)


class CheckedPrograms:
    """JAX's cache in a folder that crazysim has chosen, in files that JAX's own cache can read.

    JAX's own cache never replaces a file: a damaged one stays, and a warning in every process. It does not notice a
    changed bit, because the frames of Zstandard that it writes have no checksum, and it loads files of other users.
    Here each file ends with a checksum, which JAX's own skips. A file without it, or that others can write, is not
    loaded, and is replaced when its program has been compiled.
    """

    def __init__(self, path: str):
        self._path = Path(path)
        self._has_warned = False

    def get(self, key: str) -> bytes | None:
        """Return the intact program of a key; None if there is none."""
        path = self._file(key)
        if not path.is_file() or untrusted_reason(path):
            return None
        try:
            content = path.read_bytes()
        except OSError:
            return None
        program = content[:-CHECKSUM_BYTES]
        return program if content == program + _checksum(key, program) else None

    def put(self, key: str, value: bytes) -> None:
        """Write the program of a key, or warn once that it cannot be written."""
        try:
            write_private_file(self._file(key), value + _checksum(key, value))
        except OSError as error:
            if not self._has_warned:
                self._has_warned = True
                warn(
                    f"expected room for compiled programs in {str(self._path)!r}, got: {error}. Later processes "
                    f"compile them again. Make room, or set {CACHE_VARIABLE} to another folder."
                )

    def _file(self, key: str) -> Path:
        return self._path / f"{key}-cache"


def _checksum(key: str, program: bytes) -> bytes:
    digest = hashlib.sha256(key.encode() + b"\0" + program).digest()
    return 0x184D2A50.to_bytes(4, "little") + len(digest).to_bytes(4, "little") + digest


CHECKSUM_BYTES = len(_checksum("", b""))
"""Length of the end of a file that holds its checksum."""


def enable_cache(
    cache_path: str | Path | None = None,
    min_entry_size_bytes: int = -1,
    min_compile_time_secs: float = 0.0,
    enable_xla_caches: bool = False,
) -> Path | None:
    """Keep all programs that this process compiles from now on, including your own, and return the folder.

    Programs that crazysim compiles itself are kept without this call. The contents of the folder are executed, so only
    this user may write to it. If it holds more than ``MAX_CACHE_BYTES``, the least recently used files are removed.

    Args:
        cache_path: Folder. None for the folder in the environment variable ``CRAZYSIM_CACHE``, or else ``crazysim/jax``
            in the user's folder of caches; in it, each kind of CPU has a subfolder. If the variable is ``off``, or if
            the default folder cannot be used, no programs are kept and None is returned. A line on stderr reports a
            folder that cannot be used.
        min_entry_size_bytes: Smallest program to keep; -1 for all.
        min_compile_time_secs: Smallest duration of a compilation to keep its program, s.
        enable_xla_caches: Whether to let XLA keep files, too, in addition to JAX's.
    """
    if cache_path is None:
        path = _usable_default_folder()
    else:
        path = Path(cache_path).absolute()
        _prepare_folder(path, path)
    if path is None:
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", min_entry_size_bytes)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", min_compile_time_secs)
    if enable_xla_caches:
        jax.config.update("jax_persistent_cache_enable_xla_caches", "all")
    return path


class keep_programs(contextlib.ContextDecorator):
    """Context manager or decorator that keeps the programs that this thread compiles in a block or function.

    If JAX has a cache already, nothing changes.
    """

    _thread_state = threading.local()

    def __init__(self, enabled: bool = True):
        self._enabled = enabled

    def __enter__(self) -> None:
        stack = self._thread_state.__dict__.setdefault("stack", [])
        context = None
        if self._enabled and not any(stack) and jaxcompat.cache_folder() is None and (path := folder()) is not None:
            context = jaxcompat.compilation_cache(str(path))
            context.__enter__()
        stack.append(context)

    def __exit__(self, *error: Any) -> None:
        context = self._thread_state.stack.pop()
        if context is not None:
            context.__exit__(*error)


def enable_for_command() -> None:
    """Keep all programs of a command, unless JAX has a cache already, and print a line when its folder is made."""
    if jaxcompat.cache_folder() is not None:
        return
    try:
        path = default_folder()
        is_new = path is not None and not path.exists()
    except ConfigError:
        is_new = False
    path = enable_cache()
    if path is not None and is_new:
        print(
            f"compiled programs are kept in {path}, {MAX_CACHE_BYTES / 1e9:g} GB at most; "
            f"{CACHE_VARIABLE}=off keeps none",
            file=sys.stderr,
        )


ANNOUNCE_DELAY = 1.0
"""Default time after which unfinished work is announced, s."""

_announced_work: set[str] = set()
"""Names of the work that has been announced in this process."""


def announce(work: str, duration: str) -> None:
    """Print a line on stderr before work that takes long, once in a process for each kind of work.

    Args:
        work: Name of the work, such as ``"compiling the gradient"``.
        duration: Duration on two cores, such as ``"10 to 40 s"``.
    """
    if work in _announced_work:
        return
    _announced_work.add(work)
    suffix = "" if folder() is None else ", less in later runs"
    print(f"{work}: {duration} on two cores{suffix}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def announce_if_slow(work: str, duration: str, delay: float = ANNOUNCE_DELAY) -> Iterator[None]:
    """Keep the programs of long work, and announce the work if it has not ended after some time.

    Args:
        work: Name of the work, such as ``"compiling the gradient"``.
        duration: Duration on two cores, such as ``"10 to 40 s"``.
        delay: Time after which the work is announced, s.
    """
    timer = threading.Timer(delay, announce, (work, duration))
    timer.daemon = True
    timer.start()
    try:
        with keep_programs():
            yield
    finally:
        timer.cancel()


def trim(root: Path, limit: int = MAX_CACHE_BYTES) -> None:
    """Remove the least recently used programs of a folder and its subfolders if they take more than ``limit`` bytes.

    Args:
        limit: Largest size of all programs, bytes.
    """
    files = []
    for pattern in CACHE_FILE_PATTERNS:
        for path in (*root.glob(pattern), *root.glob(f"cpu-*/{pattern}")):
            with contextlib.suppress(OSError):  # another process has removed it
                status = path.lstat()
                if stat.S_ISREG(status.st_mode):
                    files.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    size = sum(n for _, n, _ in files)
    if size <= limit:
        return
    for _, n, path in sorted(files):
        with contextlib.suppress(OSError):
            path.unlink()
        size -= n
        if size <= TRIMMED_FRACTION * limit:
            return
