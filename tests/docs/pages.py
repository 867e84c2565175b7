"""The pages, and a function that runs their blocks."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FIRST_PAGES = [ROOT / "README.md", ROOT / "docs" / "quick_start.md"]
"""Pages for newcomers."""
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

spec = importlib.util.spec_from_file_location("outputs", ROOT / "docs" / "outputs.py")
outputs = importlib.util.module_from_spec(spec)
spec.loader.exec_module(outputs)


def run(page, tolerance=outputs.TOLERANCE):
    """Run the blocks of a page in order and in one namespace, and compare their outputs with those of the page."""
    text = page.read_text()
    for package, line in (("casadi", "import casadi"), ("viser", "from crazysim.media import web")):
        if line in text:
            pytest.importorskip(package)
    namespace = {"__name__": "page"}
    for block in outputs.blocks(text):
        printed = outputs.run_block(block, page, namespace)
        line_number = text[: block.end].count("\n")
        if block.output is not None and not outputs.is_same_output(block.output, printed, block.example, tolerance):
            name = page.relative_to(ROOT)
            pytest.fail(
                f"the block that ends at line {line_number} prints\n{printed}; run `python docs/outputs.py {name}`"
            )
