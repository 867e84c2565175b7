"""Lower bounds of the requirements in pyproject.toml. ``python tests/lower_bounds.py EXTRAS`` prints them for pip."""

import re
import sys
import tomllib
from pathlib import Path

UNBOUNDED_EXTRAS = {"gpu", "mocap", "test", "docs", "check", "dev"}
"""Extras for developers, which take the newest packages, and those of which nothing can be tried without hardware."""


def lower_bounds(extras=()):
    """Return the requirements of crazysim and of some extras with their smallest versions; None for those without."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in extras)]
    bounds = {}
    for requirement in (x for group in groups for x in group):
        name, bound = re.match(r"([\w-]+)(?:>=([\w.]+))?", requirement).groups()
        bounds[name] = bound
    return bounds


if __name__ == "__main__":
    for name, bound in lower_bounds(sys.argv[1].split(",")).items():
        print(f"{name}=={bound}")
