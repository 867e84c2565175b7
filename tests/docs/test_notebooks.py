"""The notebooks in docs/notebooks are those of the pages in docs/learn, and CI executes them (.ci/dist)."""

import importlib.util

import pytest
from pages import ROOT

spec = importlib.util.spec_from_file_location("notebooks", ROOT / "docs" / "notebooks.py")
notebooks = importlib.util.module_from_spec(spec)
spec.loader.exec_module(notebooks)


@pytest.mark.parametrize("page", notebooks.PAGES, ids=lambda page: page.stem)
def test_a_notebook_follows_its_page(page):
    notebook = ROOT / "docs" / "notebooks" / f"{page.stem}.ipynb"
    assert notebook.read_text() == notebooks.write(page), "run `python docs/notebooks.py`"
    assert f"(../notebooks/{page.stem}.ipynb)" in page.read_text()


def test_every_notebook_has_a_page():
    stems = {path.stem for path in (ROOT / "docs" / "notebooks").iterdir()}
    assert stems == {page.stem for page in notebooks.PAGES}


def sources(tmp_path, text):
    """Return the cells of a page's notebook as (type, source), without title and setup."""
    (tmp_path / "page.md").write_text(f"# Title\n\n{text}")
    cells = notebooks.make(tmp_path / "page.md")["cells"]
    return [(cell["cell_type"], cell["source"]) for cell in cells[2:]]


def test_commands_become_cells_that_show_what_they_write(tmp_path):
    commands = "crazysim train hover \\\n    --out out/a  # a comment\ncrazysim render out/a --film b.mp4"
    command = "!crazysim train hover \\\n    --out out/a  # a comment\n!crazysim render out/a --film b.mp4"
    shown = 'display(Video("out/a/policy.mp4", embed=True), Image("out/a/curve.png"), Video("b.mp4", embed=True))'
    page = f"Train:\n\n```sh\n{commands}\n```\n"
    assert sources(tmp_path, page) == [("markdown", "Train:"), ("code", f"{command}\n{shown}")]


def test_a_command_with_a_title_stays_text(tmp_path):
    text = '```sh title="on a GPU"\ncrazysim train forest\n```'
    assert sources(tmp_path, text) == [("markdown", text)]


def test_a_block_that_others_import_becomes_a_file_and_outputs_are_left_out(tmp_path):
    imported = '```python title="a.py"\nx = 1\n```\n\n'
    importing = '```python title="b.py"\nfrom a import x\nprint(x)\n```\n\n```text\n1\n```\n'
    assert sources(tmp_path, imported + importing) == [
        ("code", "%%writefile a.py\nx = 1"),
        ("code", "from a import x\nprint(x)"),
    ]
