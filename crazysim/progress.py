"""The progress bar of rollouts, films, trainings and commands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from crazysim.errors import not_installed


def progress_bar(
    items: Iterable[Any] | None = None, label: str = "", unit: str = "frame", required: bool = False, **settings: Any
) -> Any:
    """Return a progress bar of tqdm, shown where stderr is a terminal; iterating over it returns the items.

    Args:
        items: Items; None for a bar that advances when its method ``update`` is called.
        label: Text in front of the bar.
        unit: Name of one item.
        required: Whether to raise an error where tqdm is not installed; else the label is printed and the items are
            returned.
        **settings: Settings of tqdm, such as ``total``.

    Raises:
        ImportError: If tqdm is required and not installed.
    """
    try:
        from tqdm import tqdm
    except ImportError as error:
        if required:
            raise ImportError(not_installed("progress bars need", "tqdm", "demo")) from error
        if label:
            print(f"{label} ...")
        return items
    options: dict[str, Any] = {"ncols": 80} | settings
    return tqdm(items, label, unit=unit, disable=None, **options)
