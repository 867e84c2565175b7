"""The site's navigation holds every page, and links lead to files and headings that exist."""

import importlib.util
import re

import pytest
from pages import GENERATED, ROOT, navigation_pages

spec = importlib.util.spec_from_file_location("llms", ROOT / "docs" / "llms.py")
llms = importlib.util.module_from_spec(spec)
spec.loader.exec_module(llms)
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *(ROOT / "docs").rglob("*.md")]
LINK = re.compile(r"\]\((?!https?://)([^)#\s]*)(?:#([^)\s]+))?\)")
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def read_prose(page):
    return FENCE.sub("", page.read_text())


def heading_anchors(page):
    """Return the anchors of a page's headings as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", read_prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def test_every_page_is_in_the_navigation():
    examples = {f"examples/{path.stem}.md" for path in (ROOT / "docs/examples").glob("*.py")}
    written = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")} - {"README.md"}
    assert sorted(navigation_pages()) == sorted(written | examples | set(GENERATED))


def test_the_list_of_pages_follows_the_navigation():
    listed = [target for target, _ in LINK.findall((ROOT / "docs/README.md").read_text())]
    pages = [page for page in navigation_pages() if not page.startswith("examples/") or page == "examples/README.md"]
    assert listed == [f"../{GENERATED[page]}" if page in GENERATED else page for page in pages]


def test_guides_are_short():
    lengths = {page.name: page.read_text().count("\n") for page in (ROOT / "docs/guides").glob("*.md")}
    assert not {name: length for name, length in lengths.items() if length > 150}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for target, anchor in LINK.findall(read_prose(page)):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in heading_anchors(file), f"{target}#{anchor}"


def test_no_page_has_marks_of_a_merge():
    assert not [page for page in PAGES if re.search(r"^(<{7}|>{7}) ", page.read_text(), re.MULTILINE)]


def test_there_are_links_and_anchors_to_check():
    links = [link for page in PAGES for link in LINK.findall(read_prose(page))]
    assert len(links) > 50
    assert sum(bool(anchor) for _, anchor in links) > 5


def test_coding_assistants_find_every_page_and_example():
    """``llms.txt`` links to pages of the site, and ``llms-full.txt`` holds their text."""
    listed = llms.page_list("crazysim", "A drone simulator.", {source: page for page, source in GENERATED.items()})
    pages = [page for page in navigation_pages() if not page.startswith("examples/") or page == "examples/README.md"]
    assert [target for target, _ in LINK.findall(listed)] == ["llms-full.txt", *[f"{page[:-3]}.html" for page in pages]]
    text = llms.full_text()
    for source in (*(ROOT / "docs/guides").glob("*.md"), *(ROOT / "docs/examples").glob("*.py")):
        assert source.read_text() in text
