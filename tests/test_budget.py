"""The size of the package: a number of statements for each folder, which rises only with its reason in the commit."""

import ast
from collections import Counter
from pathlib import Path

import crazysim

PACKAGE = Path(crazysim.__file__).parent
SLACK = 40
"""Statements that a folder may fall below its number before the number has to follow."""
BUDGET = {
    "commands": 919,
    "control": 1394,
    "core": 1584,
    "crazysim": 845,
    "drones": 516,
    "dynamics": 367,
    "engine": 6809,
    "envs": 3790,
    "geometry": 948,
    "lab": 17785,
    "media": 1093,
    "plugins": 5083,
    "scene": 3313,
    "sim": 914,
    "train": 2780,
    "trajectories": 497,
}
"""Statements by folder, docstrings aside. A new feature pays with something that it makes unnecessary."""


def count_statements(path):
    statements = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.stmt)]
    return len(statements) - sum(
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for node in statements
    )


def test_every_folder_keeps_its_budget():
    counts = Counter()
    for path in PACKAGE.rglob("*.py"):
        folder, *rest = path.relative_to(PACKAGE).parts
        counts[folder if rest else "crazysim"] += count_statements(path)
    assert counts.keys() == BUDGET.keys()
    above = {name: f"{counts[name]} > {BUDGET[name]}" for name in counts if counts[name] > BUDGET[name]}
    assert not above, "folders above their budget: remove what the change makes unnecessary"
    below = {name: f"{counts[name]} < {BUDGET[name]}" for name in counts if counts[name] < BUDGET[name] - SLACK}
    assert not below, "folders that have become smaller: lower their numbers in BUDGET"
