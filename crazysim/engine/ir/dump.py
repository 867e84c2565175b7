"""Jaxprs, programs and sources written to files, to inspect the engine: ``CRAZYSIM_DUMP=folder``."""

from __future__ import annotations

import itertools
import os
import re
from pathlib import Path

from crazysim.storage import write_file

DUMP_VARIABLE = "CRAZYSIM_DUMP"
"""Environment variable that names the folder. If it is not set, nothing is written."""

_file_numbers = itertools.count()


def is_enabled() -> bool:
    """Whether a folder is set. Callers check it first, because to make the texts takes time."""
    return bool(os.environ.get(DUMP_VARIABLE))


def write(name: str, text: str) -> None:
    """Write a text into the folder, in a file whose name begins with the process ID and a running number.

    Args:
        name: Name of the text, such as ``"attitude_controller.jaxpr"``; characters other than letters, digits, points
            and hyphens become underscores.
        text: Text to write.
    """
    folder = Path(os.environ[DUMP_VARIABLE])
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / f"{os.getpid()}-{next(_file_numbers):03d}-{re.sub(r'[^A-Za-z0-9._-]+', '_', name)}", text)
