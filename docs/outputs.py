"""Printed output of the Python blocks of a page: run them, compare, and write the output into the page.

The blocks of a page run in one namespace, as a reader types them one after the other. A block ``python
title="NAME.py"`` is a file of its own: it is saved under that name in the working directory and runs as ``python
NAME.py`` does, without the names of other blocks.

A block ``text`` that follows a block ``python`` shows what that block prints. ``text title="for example"`` shows what
it printed once: times and other numbers that differ from run to run are not compared. ``python docs/outputs.py PAGE``
runs a page and writes the outputs that are missing or have changed; the tests of ``tests/docs`` compare them.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

BLOCK = re.compile(
    r"^```python(?: title=\"(?P<file>\w+\.py)\")?\n(?P<code>.*?)^```\n"
    r"(?:\n```text(?P<example> title=\"for example\")?\n(?P<output>.*?)^```\n)?",
    re.DOTALL | re.MULTILINE,
)
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
TOKEN = re.compile(rf"(?<![\w.]){NUMBER.pattern}(?!\w)|[A-Za-z_]\w*|\S")


TOLERANCE = 0.02
"""Largest relative difference between a number on a page and the printed one."""
CLOSE_TOLERANCE = 2e-4
"""The same for the pages that are read first, and for the outputs that are written again."""


class Block(NamedTuple):
    """Python block of a page."""

    code: str
    """Source, with as many empty lines in front as precede it on the page, so that tracebacks show the page's lines."""

    file: str | None
    """Name of the file that the block is; None for one that continues those before it."""

    output: str | None
    """Output that the page shows below the block; None where it shows none."""

    example: bool
    """True where the output is an example: other runs print other numbers, or other numbers of lines."""

    end: int
    """Offset in the page of the end of the block, its output included."""


def blocks(text: str) -> Iterator[Block]:
    """Yield the Python blocks of a page in order."""
    for match in BLOCK.finditer(text):
        code = "\n" * text[: match.start("code")].count("\n") + match["code"]
        yield Block(code, match["file"], match["output"], match["example"] is not None, match.end())


def run_block(block: Block, page: Path, namespace: dict[str, Any]) -> str:
    """Execute a block, in a namespace or as a file of its own, and return what it prints.

    Lines are without spaces at their ends.
    """
    with contextlib.redirect_stdout(io.StringIO()) as printed, _as_file(block) as file_namespace:
        code = compile(block.code, str(page), "exec", dont_inherit=True)
        exec(code, namespace if file_namespace is None else file_namespace)
    return "".join(f"{line.rstrip()}\n" for line in printed.getvalue().strip("\n").splitlines())


@contextlib.contextmanager
def _as_file(block: Block) -> Iterator[dict[str, Any] | None]:
    """Save a block that is a file and yield its namespace; at the end, unload modules imported from its folder."""
    if block.file is None:
        yield None
        return
    folder = Path.cwd()
    (folder / block.file).write_text(block.code.lstrip("\n"))
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield {"__name__": "__main__", "__file__": str(folder / block.file)}
    finally:
        sys.path.remove(str(folder))
        for name, module in list(sys.modules.items()):
            if Path(getattr(module, "__file__", None) or "/").parent == folder:
                del sys.modules[name]


def is_same_output(page_text: str, printed: str, example: bool = False, tolerance: float = TOLERANCE) -> bool:
    """Return True if a page shows the output of its block.

    An example has the same words, whatever the numbers. In other outputs ``...`` stands for any text. Spaces and line
    breaks do not count. Integers are equal. Other numbers may differ by ``tolerance`` times the larger one, by
    2 in the last digit that the page shows, or by 2e-5: processors and versions of JAX round differently.
    """
    if example:
        return _words(page_text) == _words(printed)
    parts = [TOKEN.findall(part) for part in page_text.split("...")]
    tokens = TOKEN.findall(printed)
    if len(parts) == 1:
        return _equal(parts[0], tokens, tolerance)
    first_part, *middle, last_part = parts
    start, end = len(first_part), len(tokens) - len(last_part)
    if start > end or not (
        _equal(first_part, tokens[:start], tolerance) and _equal(last_part, tokens[end:], tolerance)
    ):
        return False
    for part in middle:
        places = range(start, end - len(part) + 1)
        position = next((i for i in places if _equal(part, tokens[i : i + len(part)], tolerance)), None)
        if position is None:
            return False
        start = position + len(part)
    return True


def _words(text: str) -> set[str]:
    return {token for token in TOKEN.findall(text) if not NUMBER.fullmatch(token)}


def _equal(page_tokens: list[str], printed: list[str], tolerance: float) -> bool:
    return len(page_tokens) == len(printed) and all(
        _token_equal(x, y, tolerance) for x, y in zip(page_tokens, printed, strict=True)
    )


def _token_equal(page_token: str, printed: str, tolerance: float) -> bool:
    if page_token == printed:
        return True
    if not (NUMBER.fullmatch(page_token) and NUMBER.fullmatch(printed)):
        return False
    if page_token.lstrip("+-").isdigit() and printed.lstrip("+-").isdigit():
        return int(page_token) == int(printed)
    mantissa, _, exponent = page_token.lower().partition("e")
    last_digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    a, b = float(page_token), float(printed)
    return abs(a - b) <= max(tolerance * max(abs(a), abs(b)), 2.1 * last_digit, 2e-5)


def _update(page: Path) -> int:
    """Run a page, write its outputs, and return the number of blocks whose output has changed."""
    text = page.read_text()
    namespace: dict[str, Any] = {"__name__": "page"}
    pieces, start, changed = [], 0, 0
    for block in blocks(text):
        printed = run_block(block, page, namespace)
        piece = text[start : block.end]
        start = block.end
        if printed and not (
            block.output is not None and is_same_output(block.output, printed, block.example, CLOSE_TOLERANCE)
        ):
            if block.output is not None:
                piece = piece[: piece.rindex("\n```text")]
            title = ' title="for example"' if block.example else ""
            piece += f"\n```text{title}\n{printed}```\n"
            changed += 1
        pieces.append(piece)
    if changed:
        page.write_text("".join(pieces) + text[start:])
    return changed


def main() -> int:
    """Run pages and write their outputs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("pages", nargs="+", type=Path)
    for page in [path.resolve() for path in parser.parse_args().pages]:
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            changed = _update(page)
            os.chdir("/")
        print(f"{page.name}: {changed} outputs written", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
