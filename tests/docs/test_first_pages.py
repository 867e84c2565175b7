"""README and quick start: every Python block runs, in the order of the page, and prints its output."""

import pytest
from pages import FIRST_PAGES, outputs, run


@pytest.mark.long("runs every block of a page as a reader would")
@pytest.mark.parametrize("page", FIRST_PAGES, ids=lambda page: page.name)
def test_page_runs(page, tmp_path, monkeypatch, opengl):
    monkeypatch.chdir(tmp_path)
    run(page, outputs.CLOSE_TOLERANCE)
