"""Hooks of MkDocs: pages that are generated, and links from the repository's layout to the site's.

The site holds the pages of ``docs/`` and, generated here, README, CONTRIBUTING, SECURITY and CHANGELOG of the
repository, one page for each example, and the API reference of the public names, grouped as users look for them.
``llms.py`` makes its texts for coding assistants.
"""

from __future__ import annotations

import ast
import os
import re
import sys
from pathlib import Path, PurePosixPath
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))  # hooks are loaded as single files
import llms  # noqa: E402

ROOT_PAGES = {
    "README.md": "index.md",
    "docs/README.md": "contents.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
}
"""Pages of the repository, and their places on the site."""

CONTACTS = ("crazysim.ContactLog", "crazysim.ContactResponse", "crazysim.DroneCollisions")
OWN = (
    "Plugin",
    "Param",
    "param",
    "state",
    "StagePlacement",
    "Population",
    "Members",
    "PyTree",
    "leaf",
    "static",
    "stage",
)
REFERENCE = {
    "Simulation": ("crazysim.Sim", "crazysim.functional", "crazysim", "crazysim.sim", "crazysim.core"),
    "Drones and dynamics": ("crazysim.drones", "crazysim.dynamics"),
    "Control": ("crazysim.control", "crazysim.MPPI"),
    "Trajectories": ("crazysim.Follow", "crazysim.trajectories", "crazysim.trajectories.files"),
    "Effects": ("crazysim.plugins.effects",),
    "Loads, cars, bodies": ("crazysim.plugins.payloads", "crazysim.plugins.vehicles", "crazysim.plugins.bodies"),
    "Scene and contacts": (
        *CONTACTS, "crazysim.plugins.scenery", "crazysim.Terrain", "crazysim.SplatScene", "crazysim.geometry",
    ),
    "Sensors": ("crazysim.plugins.sensors", "crazysim.Radar"),
    "Estimators": ("crazysim.plugins.estimators",),
    "Environments": ("crazysim.envs",),
    "Training": ("crazysim.train",),
    "Pictures and films": ("crazysim.media",),
    "Plugins and stages": (*(f"crazysim.{name}" for name in OWN), "crazysim.reduce_over_others", "crazysim.engine"),
    "Live, shows, identification": (
        "crazysim.lab.live", "crazysim.lab.live.sitl", "crazysim.lab.live.crazyflie_py", "crazysim.lab.shows",
        "crazysim.lab.identify", "crazysim.lab.validate",
    ),
}  # fmt: skip
"""Pages of the reference: packages, of which all public names are listed, and single names.

A name that several packages export is on one page.
"""

PACKAGES = {entry for entries in REFERENCE.values() for entry in entries if entry.rpartition(".")[2].islower()} - {
    f"crazysim.{name}" for name in (*OWN, "reduce_over_others", "functional")
}
"""Entries of the reference that are packages."""

LINK = re.compile(r"\[([^\]]*)\]\((?!https?://|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)")
FENCE = re.compile(r"(^```.*?^```)", re.DOTALL | re.MULTILINE)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Append the generated pages of the API reference to the navigation."""
    for section in config.nav or []:
        if "Reference" in section:
            section["Reference"] = [{title: _reference_path(title)} for title in REFERENCE]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the files of the site."""
    overview = files.get_file_from_path("README.md")
    if overview is not None:
        files.remove(overview)
    for source, target in ROOT_PAGES.items():
        files.append(File.generated(config, target, content=(ROOT / source).read_text()))
    for path in sorted((ROOT / "docs" / "examples").glob("*.py")):
        files.append(File.generated(config, f"examples/{path.stem}.md", content=_example_page(path)))
    for title, content in _reference_pages().items():
        files.append(File.generated(config, _reference_path(title), content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Turn links that follow the repository's layout into links of the site."""
    parts = FENCE.split(markdown)
    parts[::2] = [LINK.sub(lambda match: _site_link(match, page.file.src_uri), part) for part in parts[::2]]
    return "".join(parts)


def on_post_build(config: MkDocsConfig) -> None:
    """Write the texts for coding assistants."""
    description = config.site_description or ""
    Path(config.site_dir, "llms.txt").write_text(llms.page_list(config.site_name, description, ROOT_PAGES))
    Path(config.site_dir, "llms-full.txt").write_text(llms.full_text())


def _site_link(match: re.Match[str], page: str) -> str:
    """Return a Markdown link whose target is relative to the page's place on the site.

    A link to a file of the repository that is not on the site becomes plain text.
    """
    text, link, anchor = match[1], match[2], match[3] or ""
    source = next((source for source, site_path in ROOT_PAGES.items() if site_path == page), f"docs/{page}")
    target = os.path.normpath(PurePosixPath(source).parent / link)
    if target not in ROOT_PAGES and not target.startswith("docs/") and (ROOT / target).exists():
        return text
    site_path = ROOT_PAGES.get(target, target.removeprefix("docs/"))
    if target.startswith("docs/examples/") and target.endswith(".py"):
        site_path = site_path.removesuffix(".py") + ".md"
    return f"[{text}]({os.path.relpath(site_path, PurePosixPath(page).parent)}{anchor})"


def _example_page(path: Path) -> str:
    """Return the page of an example: its docstring, how to run it, and its source."""
    source = path.read_text()
    docstring = ast.get_docstring(ast.parse(source)) or ""
    return (
        f"# {path.stem}\n\n{docstring}\n\n```sh\npython docs/examples/{path.name}\n```\n\n"
        f'## Source {{ data-search-exclude }}\n\n```python title="docs/examples/{path.name}"\n{source}```\n'
    )


def _reference_path(title: str) -> str:
    return f"reference/{re.sub('[^a-z]+', '_', title.lower())}.md"


def _reference_pages() -> dict[str, str]:
    package = griffe.load("crazysim", search_paths=[str(ROOT)], docstring_parser="google", resolve_aliases=True)
    assert isinstance(package, griffe.Module)
    names: dict[str, dict[str, list[str]]] = {title: {} for title in REFERENCE}
    listed: set[str] = set()
    requests = [(title, entry) for title, entries in REFERENCE.items() for entry in entries]
    # Single names first, and the package `crazysim`, which exports names of all others, last.
    for title, entry in sorted(requests, key=lambda request: (request[1] == "crazysim", request[1] in PACKAGES)):
        exported = _member(package, entry).exports if entry in PACKAGES else [entry.rpartition(".")[2]]
        parent = entry if entry in PACKAGES else entry.rpartition(".")[0]
        for path in (_definition(package, f"{parent}.{name}") for name in exported or []):
            if path not in listed:
                listed.add(path)
                names[title].setdefault(parent, []).append(path)
    return {title: _reference_page(title, groups) for title, groups in names.items()}


def _reference_page(title: str, groups: dict[str, list[str]]) -> str:
    """Return a page with the public names of each package to import them from."""
    lines = [f"# {title}\n"]
    for parent, paths in groups.items():
        lines.append(f"## {parent}\n")
        lines += [f"::: {path}\n    options: {{heading_level: 3, show_root_heading: true}}\n" for path in paths]
    return "\n".join(lines)


def _member(package: griffe.Module, path: str) -> Any:
    return package if path == package.path else package[path.removeprefix(f"{package.path}.")]


def _definition(package: griffe.Module, path: str) -> str:
    member = _member(package, path)
    if member.is_module and member.name in member.members:  # a function with the name of its module
        member = member.members[member.name]
    if not isinstance(member, griffe.Alias):
        return member.path
    try:
        return member.final_target.path
    except griffe.AliasResolutionError:  # of another package
        return member.target_path
