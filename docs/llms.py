"""Texts of the site for coding assistants: ``llms.txt``, the list of pages, and ``llms-full.txt``, their text."""

from __future__ import annotations

import os
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONTENTS = ROOT / "docs" / "README.md"
LINK = re.compile(r"\[([^\]]*)\]\(([^)]+\.md)\)")


def page_list(name: str, description: str, places: dict[str, str]) -> str:
    """Return ``llms.txt``: the list of pages in ``docs/README.md``, with links to the pages of the site.

    Args:
        name: Name of the site.
        description: Description of the site, one line.
        places: Pages of the site by their files, for files outside of ``docs/``.
    """

    def link(match: re.Match[str]) -> str:
        target = places.get(os.path.normpath(f"docs/{match[2]}"), match[2])
        return f"[{match[1]}]({target.removesuffix('.md')}.html)"

    pages = CONTENTS.read_text().partition("\n## ")
    return f"# {name}\n\n> {description} [All pages as one text](llms-full.txt).\n{pages[1]}{LINK.sub(link, pages[2])}"


def full_text() -> str:
    """Return ``llms-full.txt``: the pages in ``docs/README.md`` in their order, and then the examples."""
    pages = [(CONTENTS.parent / target).resolve() for _, target in LINK.findall(CONTENTS.read_text())]
    sources = [*pages, *sorted((ROOT / "docs" / "examples").glob("*.py"))]
    return "\n\n".join(f"<!-- {source.relative_to(ROOT)} -->\n\n{source.read_text()}" for source in sources)
