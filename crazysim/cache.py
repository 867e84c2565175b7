"""The folder in which compiled programs and kernels are kept between processes."""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import jax

from crazysim import jaxcompat
from crazysim.errors import ConfigError
from crazysim.trust import REMEDY, distrust, make_private

VARIABLE = "CRAZYSIM_CACHE"
"""Environment variable with the folder to use, or ``off``."""
LIMIT = 1_000_000_000
"""Size of all files, bytes, above which the oldest are removed when the cache is enabled: some 5,000 programs."""
KEPT = 0.8
"""Share of the limit that is left by a removal, so that not every process has to remove files."""
PATTERNS = ("*-cache", "*-atime", "crazysim/*.so")
"""Names of the files that JAX and the engine write; other files in the folder are never removed."""


def default_cache() -> Path | None:
    """Return the folder that ``enable_cache`` uses by default; None where ``CRAZYSIM_CACHE`` is ``off``."""
    chosen = os.environ.get(VARIABLE, "")
    if chosen.lower() in ("off", "0", "false", "no"):
        return None
    if chosen:
        return Path(chosen).expanduser()
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path.home() / ".cache") / "crazysim" / "jax"


def enable_cache(
    cache_path: str | Path | None = None,
    min_entry_size_bytes: int = -1,
    min_compile_time_secs: float = 0.0,
    enable_xla_caches: bool = False,
) -> Path | None:
    """Keep compiled programs on disk from now on, and return the folder.

    What is in the folder is executed, so it is made for this user alone. Where it holds more than ``LIMIT`` bytes, the
    programs that have not been used for the longest time are removed.

    Args:
        cache_path: Folder; None for that of the environment variable ``CRAZYSIM_CACHE``, or else ``crazysim/jax`` in
            the user's folder of caches. Where the variable is ``off``, None keeps nothing and returns None.
        min_entry_size_bytes: Smallest program to keep; -1 for all.
        min_compile_time_secs: Shortest compilation whose program is kept, s.
        enable_xla_caches: True to let XLA keep files of its own beside JAX's.

    Raises:
        ConfigError: If the folder cannot be made, belongs to another user, or can be written by others.
    """
    path = default_cache() if cache_path is None else Path(cache_path)
    if path is None:
        return None
    try:
        make_private(path)
    except OSError as error:
        raise ConfigError(
            f"expected a folder for compiled programs, got {str(path)!r}: {error}. Use another."
        ) from error
    if reason := distrust(path):
        raise ConfigError(f"expected a folder that only this user can write, got {str(path)!r}: {reason}. {REMEDY}")
    trim(path)
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", min_entry_size_bytes)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", min_compile_time_secs)
    if enable_xla_caches:
        jax.config.update("jax_persistent_cache_enable_xla_caches", "all")
    return path


def enable_for_command() -> None:
    """Enable the cache for a command, unless JAX has one already, and print a line when its folder is made.

    A folder that cannot be used is a line, as the command runs without it.
    """
    path = default_cache()
    if path is None or jaxcompat.cache_folder() is not None:
        return
    is_new = not path.exists()
    try:
        enable_cache(path)
    except ConfigError as error:
        print(f"compiled programs are not kept: {error}", file=sys.stderr)
        return
    if is_new:
        print(
            f"compiled programs are kept in {path}, {LIMIT / 1e9:g} GB at most; {VARIABLE}=off keeps none",
            file=sys.stderr,
        )


PATIENCE = 1.0
"""Time after which work that is not over is announced, s."""

_announced: set[str] = set()


def announce(work: str, seconds: str) -> None:
    """Print a line on stderr before work that takes long, once in a process for each kind of work.

    Args:
        work: Name of the work, such as ``"compiling the gradient"``.
        seconds: Duration on two cores, such as ``"10 to 40 s"``.
    """
    if work in _announced:
        return
    _announced.add(work)
    later = (
        "less once it is in the cache"
        if jaxcompat.cache_folder() is not None
        else ("less in later runs with crazysim.enable_cache()")
    )
    print(f"{work}: {seconds} on two cores, {later}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def announced(work: str, seconds: str) -> Iterator[None]:
    """Announce work that has not ended after ``PATIENCE``, as it does where its programs are in the cache.

    Args:
        work: Name of the work, such as ``"compiling the gradient"``.
        seconds: Duration on two cores, such as ``"10 to 40 s"``.
    """
    timer = threading.Timer(PATIENCE, announce, (work, seconds))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def trim(folder: Path, limit: int = LIMIT) -> None:
    """Remove the least recently used programs of a folder if they take more than a number of bytes.

    Args:
        folder: Folder of the cache.
        limit: Largest size of all programs, bytes.
    """
    found = []
    for pattern in PATTERNS:
        for path in folder.glob(pattern):
            with contextlib.suppress(OSError):  # another process has removed it
                status = path.lstat()
                if stat.S_ISREG(status.st_mode):
                    found.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    size = sum(n for _, n, _ in found)
    if size <= limit:
        return
    for _, n, path in sorted(found):
        with contextlib.suppress(OSError):
            path.unlink()
        size -= n
        if size <= KEPT * limit:
            return
