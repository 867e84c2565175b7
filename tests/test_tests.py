"""Every test can fail: it asserts something itself, or calls a function that does.

The sources are parsed, not imported.
"""

import ast
from collections import defaultdict
from pathlib import Path

SOURCES = sorted(Path(__file__).parent.rglob("*.py"))
CHECKS = {"assert", "raises", "warns", "fail", "check_grads", "check_env", "parallel_seed_test", "parallel_api_test"}
"""Statements and functions of libraries that fail, besides those whose names begin with "assert"."""


def names_in(function):
    """Yield "assert" for what a function asserts, and what it calls, except for methods, whose class is unknown."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            yield "assert"
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name.startswith("assert") or any(
                k.arg == "check" and ast.unparse(k.value) == "True" for k in node.keywords
            ):
                yield "assert"
            elif isinstance(node.func, ast.Name) or name in CHECKS:
                yield name


def find_tests_without_checks(sources):
    """Return the paths and names of tests that cannot fail except by an error."""
    functions, tests = defaultdict(list), []
    for path, text in sources.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                names = set(names_in(node))
                if node.name.startswith("test_"):
                    tests.append((path, node.name, names))
                else:
                    functions[node.name].append(names)
    checks, n_checks = set(CHECKS), 0
    while n_checks < len(checks):
        n_checks = len(checks)
        checks |= {name for name, uses in functions.items() if any(names & checks for names in uses)}
    return [f"{path}: {name}" for path, name, names in tests if not names & checks]


def test_every_test_can_fail():
    assert not find_tests_without_checks({path.name: path.read_text() for path in SOURCES})


def test_a_test_that_cannot_fail_is_found():
    source = """
def helper(x): assert x
def caller(x): helper(x)
def test_calls(): print(3)
def test_adds(sim): sim.helper(3)
def test_asserts(): assert 3
def test_raises():
    with pytest.raises(ValueError): print(3)
def test_compares(): np.testing.assert_allclose(1, 1)
def test_calls_a_caller(): caller(1)
"""
    assert find_tests_without_checks({"a.py": source}) == ["a.py: test_calls", "a.py: test_adds"]
