"""The pages, and a function that runs their blocks."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FIRST_PAGES = [ROOT / "README.md", ROOT / "docs" / "learn" / "quick_start.md"]
"""Pages for newcomers."""
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GENERATED = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "security.md": "SECURITY.md",
    "changelog.md": "CHANGELOG.md",
}
"""Pages of the site that come from outside docs/, by their place on the site."""

spec = importlib.util.spec_from_file_location("outputs", ROOT / "docs" / "outputs.py")
outputs = importlib.util.module_from_spec(spec)
spec.loader.exec_module(outputs)


def navigation_pages():
    """Return the pages of the navigation in order, without generated ones."""
    text = (ROOT / "mkdocs.yml").read_text()
    section = re.search(r"^nav:\n((?: .*\n)+)", text, re.MULTILINE)[1]
    return [page for page in re.findall(r"(\S+\.md)$", section, re.MULTILINE) if page != "contents.md"]


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
