"""Pages and examples import public names only, from a few modules."""

import ast
import importlib.util
import inspect
from pathlib import Path

import pytest
from pages import PAGES, ROOT, outputs

MODULES = {
    "crazysim",
    "crazysim.control",
    "crazysim.core",
    "crazysim.drones",
    "crazysim.engine",
    "crazysim.envs",
    "crazysim.lab",
    "crazysim.lab.live",
    "crazysim.lab.shows",
    "crazysim.media",
    "crazysim.plugins",
    "crazysim.sim",
    "crazysim.trajectories",
}
STAND_IN = {"crazysim.lab.live.crazyflie_py"}
"""Module with the name of a module of Crazyswarm2, for scripts that import it."""
OPTIONAL_NAMES = {"crazysim.envs": ["DroneVecEnv", "RslRlEnv", "make_parallel"]}
"""Public names that need optional packages, which are not in ``__all__``."""
EXEMPT = (ROOT / "docs" / "coming-from-crazyflow.md",)
"""The page that uses Crazyflow's own paths."""
SOURCES = [page for page in PAGES if page not in EXEMPT] + sorted((ROOT / "docs" / "examples").glob("*.py"))


def imports(source: Path):
    """Yield (module, names) of every import of the project in a page or an example."""
    text = source.read_text()
    blocks = [block.code for block in outputs.blocks(text)] if source.suffix == ".md" else [text]
    for block in blocks:
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "crazysim":
                yield node.module, [alias.name for alias in node.names]
            elif isinstance(node, ast.Import):
                yield from ((a.name, []) for a in node.names if a.name.split(".")[0] == "crazysim")


def test_there_are_few_modules():
    assert len(MODULES) <= 13
    assert {module for source in SOURCES for module, _ in imports(source)} == MODULES | STAND_IN


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: str(source.relative_to(ROOT)))
def test_pages_import_public_names_of_these_modules(source):
    for module, names in imports(source):
        assert module in MODULES | STAND_IN, f"{source.name} imports from {module}"
        for name in names:
            package = importlib.import_module(module)
            names = [*getattr(package, "__all__", [name]), *OPTIONAL_NAMES.get(module, [])]
            if name not in names and not inspect.ismodule(getattr(package, name, None)):
                assert importlib.util.find_spec(f"{module}.{name}"), f"{name} is no public name of {module}"
