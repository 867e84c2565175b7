"""Progress bars of commands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def progress(items: Iterable[Any], label: str, unit: str = "frame") -> Iterable[Any]:
    """Return the items with a progress bar, if tqdm is installed and stderr is a terminal.

    Args:
        items: Items.
        label: Text in front of the bar.
        unit: Name of one item.
    """
    try:
        from tqdm import tqdm
    except ImportError:
        print(f"{label} ...")
        return items
    return tqdm(items, desc=label, unit=unit, ncols=80, disable=None)
