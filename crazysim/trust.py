"""Folders of compiled code: made for this user alone, and refused where another user could put code into them."""

from __future__ import annotations

import os
import stat
from pathlib import Path

REMEDY = "Remove it, since what it holds may not be yours, or use another."
"""End of the message for a folder that is refused."""

SYSTEM = (0, 65534)
"""Users that may own the folders above: root, and the one that stands for root in containers that do not map it."""


def make_private(folder: Path) -> None:
    """Make a folder that only this user can enter, with the folders above it as usual; it may exist.

    Raises:
        OSError: If it cannot be made.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)


def distrust(path: Path) -> str:
    """Return the reason why another user could have written a file or folder, for a message; empty if none could.

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
        if status.st_uid not in (os.geteuid(), *SYSTEM):
            return f"the user {status.st_uid} can replace it, who owns {parent}"
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"other users can replace it, as they can write to {parent}"
    return ""
