"""Files of compiled kernels, safe to share between processes and machines.

A file is named by its key, which holds everything that the code depends on, and by the hash of its contents. A file
that was cut short or damaged does not match its name and is not used. Two processes may write the same kernel at the
same time: each file appears complete, by renaming.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from crazysim import jaxcompat

LENGTH = 24
"""Hexadecimal digits of a hash in a name: 96 bits."""


def digest(*parts: str | bytes) -> str:
    """Return the hash of some texts; the order and the boundaries between them count."""
    state = hashlib.sha256()
    for part in parts:
        raw = part.encode() if isinstance(part, str) else part
        state.update(len(raw).to_bytes(8, "little") + raw)
    return state.hexdigest()[:LENGTH]


def folder() -> Path:
    """Return the folder of compiled kernels: beside JAX's compilation cache, or of this process alone."""
    cache = jaxcompat.cache_folder()
    if cache is not None:
        shared = Path(cache) / "crazysim"
        with contextlib.suppress(OSError):
            shared.mkdir(parents=True, exist_ok=True)
        if os.access(shared, os.W_OK | os.R_OK):
            return shared
    return temporary()


@functools.cache
def temporary() -> Path:
    """Return a folder that is removed when this process ends."""
    folder = tempfile.TemporaryDirectory(prefix="crazysim-")
    atexit.register(folder.cleanup)
    return Path(folder.name)


def find(place: Path, key: str) -> Iterator[Path]:
    """Yield the intact files of a key; damaged ones are removed."""
    for path in sorted(place.glob(f"{key}-*.so")):
        try:
            intact = path.stem == f"{key}-{digest(path.read_bytes())}"
        except OSError:
            continue
        if intact:
            yield path
        else:
            with contextlib.suppress(OSError):
                path.unlink()


def store(place: Path, key: str, made: Path) -> Path:
    """Move a file that was made in the same folder to the name of its key and contents, and return it."""
    path = place / f"{key}-{digest(made.read_bytes())}.so"
    made.replace(path)
    return path
