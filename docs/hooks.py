"""Hooks of MkDocs: pages that are generated, and links from the repository's layout to the site's.

The site holds the pages of ``docs/`` and, generated here, README, CONTRIBUTING, SECURITY and CHANGELOG of the
repository, one page for each example, and one page of API reference for each public module. ``llms.py`` makes its texts
for coding assistants.
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

LINK = re.compile(r"\[([^\]]*)\]\((?!https?://|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)")
FENCE = re.compile(r"(^```.*?^```)", re.DOTALL | re.MULTILINE)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Append the generated pages of the API reference to the navigation."""
    for section in config.nav or []:
        if "API reference" in section:
            section["API reference"] = _reference_nav()
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
    for module in _public_modules():
        files.append(File.generated(config, _reference_path(module), content=_reference_page(module)))
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


_modules: list[griffe.Module] = []


def _public_modules() -> list[griffe.Module]:
    """Return every public module of the package."""
    if not _modules:
        package = griffe.load("crazysim", search_paths=[str(ROOT)], docstring_parser="google", resolve_aliases=True)
        assert isinstance(package, griffe.Module)
        _collect(package, _modules)
    return _modules


def _collect(module: griffe.Module, modules: list[griffe.Module]) -> None:
    if module.name.startswith("_"):
        return
    modules.append(module)
    for name in sorted(module.modules):
        if not module.modules[name].is_alias:
            _collect(module.modules[name], modules)


def _reference_path(module: griffe.Module) -> str:
    name = f"{module.path.replace('.', '/')}/index.md" if module.is_package or module.is_subpackage else None
    return f"reference/{name or module.path.replace('.', '/') + '.md'}"


def _reference_page(module: griffe.Module) -> str:
    """Return the page of a module: its docstring, the names that it exports from elsewhere, and its own members."""
    members = [name for name, member in module.members.items() if not (name.startswith("_") or _elsewhere(member))]
    options = f"    options: {{show_root_heading: false, members: {members or 'false'}}}"
    lines = [f"# {module.path}\n", f"::: {module.path}\n{options}\n"]
    exported = [name for name in map(str, module.exports or []) if name in module.members and module[name].is_alias]
    if exported:
        lines += ["## Public names\n", "| Name | Definition |", "| --- | --- |"]
        for name in exported:
            path = _definition(module, name)
            lines.append(f'| `{name}` | <autoref identifier="{path}" optional><code>{path}</code></autoref> |')
        lines.append("")
    inner = [m for m in module.modules.values() if m in _public_modules()]
    if inner:
        lines += ["## Modules\n", "| Module | Contents |", "| --- | --- |"]
        for m in sorted(inner, key=lambda m: m.path):
            summary = m.docstring.value.split("\n\n")[0].replace("\n", " ") if m.docstring else ""
            link = os.path.relpath(_reference_path(m), PurePosixPath(_reference_path(module)).parent)
            lines.append(f"| [`{m.name}`]({link}) | {summary} |")
        lines.append("")
    return "\n".join(lines)


def _elsewhere(member: griffe.Object | griffe.Alias) -> bool:
    """Return True for a member whose documentation has a page of its own."""
    return member.is_alias or member.is_module


def _definition(module: griffe.Module, name: str) -> str:
    """Return the path of the definition of a name that a module imports."""
    alias = module.members[name]
    assert isinstance(alias, griffe.Alias)
    try:
        return alias.final_target.path
    except griffe.AliasResolutionError:  # of another package
        return alias.target_path


def _reference_nav() -> list[dict[str, Any]]:
    """Return the navigation of the API reference: the root, then one section for each package."""
    root, *modules = _public_modules()
    sections: dict[str, list[Any]] = {}
    for module in modules:
        package = module if module.is_package or module.is_subpackage else module.parent
        assert package is not None
        path = _reference_path(module)
        sections.setdefault(package.path, []).append(path if package is module else {module.name: path})
    nav: list[dict[str, Any]] = [{root.path: [_reference_path(root), *sections.pop(root.path)]}]
    return nav + [{name.removeprefix(f"{root.path}."): pages} for name, pages in sections.items()]
