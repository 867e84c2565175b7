"""Notebooks of the pages in ``docs/learn``: ``python docs/notebooks.py`` writes them into ``docs/notebooks``.

Python blocks become cells, and a block that others import becomes a file. Shell blocks become cells of ``!`` lines;
those with a title, such as ``title="on a GPU"``, stay text. A cell ends with the films and pictures that it writes.

``python docs/notebooks.py WHEEL`` executes all notebooks with that wheel and short trainings, and writes them with
their outputs into the working folder.
"""

from __future__ import annotations

import base64
import json
import re
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
PAGES = sorted((DOCS / "learn").glob("*.md"))
BLOCK = re.compile(
    r'^```(?P<language>python|sh)(?: title="(?P<title>[^"]*)")?\n(?P<code>.*?)^```\n(?:\n```text.*?^```\n)?',
    re.DOTALL | re.MULTILINE,
)
PICTURE = re.compile(r"!\[([^\]]*)\]\(\.\./pictures/([\w.]+)\)")
RUN = re.compile(r"^crazysim train (?:.*\\\n)*.*\b(out/\w+)", re.MULTILINE)
WRITTEN = re.compile(r"(?<![\w/.])\w+\.(?:mp4|png)\b")
SETUP = """import os

from IPython.display import Image, Video

SOURCE = "crazysim[onnx,train]"  # from PyPI; a wheel is "PATH.whl[onnx,train]"
%pip install --quiet "{SOURCE}"
if "COLAB_RELEASE_TAG" in os.environ:  # what films need
    !apt-get install -qq libegl1 libgl1-mesa-dri >/dev/null"""
SHORTER = {
    r"--iterations \d+": "--iterations 3",
    r"--worlds \d{3,}": "--worlds 64",
    r"^(!crazysim train \S++)(?! --resume)": r"\1 --worlds 64 --iterations 2",
}
"""Patterns of long commands, and what is executed instead to try them; the last options count."""
STRICT = """
import subprocess
get_ipython().system = lambda command: subprocess.run(command, shell=True, check=True)"""
"""Lines that make a command that fails an error; in notebooks it is none."""


def make(page: Path) -> dict[str, Any]:
    text = page.read_text()
    text = re.sub(r"\n.*\(\.\./notebooks/.*\n", "\n", text)  # the link to the notebook itself
    text = re.sub(r"\]\((\w+\.md)", r"](../learn/\1", text)
    title, text = text.split("\n", 1)
    cells = [_markdown(title), _code(SETUP)]
    start = 0
    for block in BLOCK.finditer(text):
        if block["language"] == "sh" and block["title"]:
            continue
        cells += [_markdown(text[start : block.start()]), _code(_source(block, text))]
        start = block.end()
    cells.append(_markdown(text[start:]))
    cells = [cell | {"id": str(i)} for i, cell in enumerate(cell for cell in cells if cell["source"])]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def write(page: Path) -> str:
    """Return the text of the notebook's file."""
    return json.dumps(make(page), indent=1, ensure_ascii=False) + "\n"


def _source(block: re.Match[str], page: str) -> str:
    code = block["code"].strip("\n")
    files = [f"{folder}/{name}" for folder in RUN.findall(code) for name in ("policy.mp4", "curve.png")]
    files += WRITTEN.findall(code)
    if block["language"] == "sh":
        code = re.sub(r"^(?! )", "!", code, flags=re.MULTILINE)
    elif block["title"] and f"from {block['title'].removesuffix('.py')} import" in page:
        return f"%%writefile {block['title']}\n{code}"
    shown = [f'Video("{file}", embed=True)' if file.endswith("mp4") else f'Image("{file}")' for file in files]
    return "\n".join([code, f"display({', '.join(shown)})"] if shown else [code])


def _markdown(text: str) -> dict[str, Any]:
    cell: dict[str, Any] = {"cell_type": "markdown", "metadata": {}}
    names = [name for _, name in PICTURE.findall(text)]
    if names:
        cell["attachments"] = {name: {_mime(name): _encoded(name)} for name in names}
    return cell | {"source": PICTURE.sub(r"![\1](attachment:\2)", text).strip("\n")}


def _mime(name: str) -> str:
    return {"svg": "image/svg+xml", "png": "image/png", "jpg": "image/jpeg"}[name.rpartition(".")[2]]


def _encoded(name: str) -> str:
    return base64.b64encode((DOCS / "pictures" / name).read_bytes()).decode()


def _code(source: str) -> dict[str, Any]:
    return {"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": [], "source": source}


def execute(page: Path, wheel: str) -> None:
    """Execute a page's notebook with a wheel and short trainings, and write it into the working folder."""
    import nbclient
    import nbformat

    notebook = make(page)
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            cell["source"] = cell["source"].replace('"crazysim[', f'"{wheel}[')
            for pattern, replacement in SHORTER.items():
                cell["source"] = re.sub(pattern, replacement, cell["source"], flags=re.MULTILINE)
    notebook["cells"][1]["source"] += STRICT
    notebook = nbformat.from_dict(notebook)
    try:
        nbclient.NotebookClient(notebook, timeout=600).execute()
    finally:
        nbformat.write(notebook, f"{page.stem}.ipynb")


def main() -> None:
    """Write the notebooks, or execute them with the wheel that is named."""
    for page in PAGES:
        if len(sys.argv) > 1:
            execute(page, sys.argv[1])
        else:
            (DOCS / "notebooks" / f"{page.stem}.ipynb").write_text(write(page))
        print(page.stem, flush=True)


if __name__ == "__main__":
    main()
