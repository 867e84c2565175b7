"""Docstrings and messages of the package follow the rules of CONTRIBUTING.md ("Style"), as far as they can be checked.

The sources are parsed, not imported.
"""

import ast
import itertools
import re
from pathlib import Path

import pytest
from raised import raised

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "crazysim").rglob("*.py"))

QUESTION_WORDS = ("What", "How", "Where", "Which", "Who", "Why")
"""Never the first word of a docstring, or of the description of an argument or a result."""

REMEDY = re.compile(
    r"\b(expected|must|needs?|needed|use|pass|install|call|set|choose|add|remove|give|see|try|make|reduce|raise|increase"
    r"|define|declare|move|write|omit|replace|update|delete|known|available|one of|at least|at most|run|allowed|only"
    r"|did you mean|there are|it has|takes?|check|name|nearest|start|describe|repeat|first|are \{\}|reads)\b|>=|<=",
    re.IGNORECASE,
)
"""Words of which a message to the user contains at least one: those of a requirement, an alternative or a remedy."""
USER_ERRORS = {"ConfigError", "UnknownNameError", "ValueError", "TypeError", "RenderError", "ImportError"}

FIELD_LINE = re.compile(r"^\s*\*{0,2}\w+( \([^)]*\))?: (\w+)", re.MULTILINE)


def docstrings(tree):
    """Yield line, kind and text of the docstrings of modules, classes, functions and attributes."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            text = ast.get_docstring(node)
            if text:
                yield node.body[0].lineno, type(node).__name__, text
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        for before, after in itertools.pairwise(body):
            is_text = isinstance(after, ast.Expr) and isinstance(getattr(after.value, "value", None), str)
            if is_text and isinstance(before, (ast.Assign, ast.AnnAssign)):
                annotation = getattr(before, "annotation", None)
                kind = "flag" if isinstance(annotation, ast.Name) and annotation.id == "bool" else "field"
                yield after.lineno, kind, after.value.value.strip()


def descriptions(text):
    """Yield the first word of every description in the sections of a docstring."""
    for section in re.findall(r"^\s*(?:Args|Attributes|Raises):\n((?:\s+.*\n?)+)", text, re.MULTILINE):
        yield from (match[2] for match in FIELD_LINE.finditer(section))
    yield from re.findall(r"^\s*(?:Returns|Yields):\n\s+(\w+)", text, re.MULTILINE)


def literal(node):
    """Return the literal parts of a message; None if it is not a literal, or a function contributes to it."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        calls = (part.value for part in node.values if isinstance(getattr(part, "value", None), ast.Call))
        if any(isinstance(call.func, ast.Name) and call.func.id.startswith("_") for call in calls):
            return None
        return "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return None


def violations(source):
    """Return every violation of a source as (line, complaint)."""
    tree = ast.parse(source)
    result = []
    for line, kind, text in docstrings(tree):
        if text.split()[0] in QUESTION_WORDS:
            result.append((line, f"a {kind} docstring begins with {text.split()[0]!r}"))
        if kind == "flag" and not text.startswith(("Whether ", "True ")):
            result.append((line, f"the docstring of a flag begins with {text.split()[0]!r}, not with 'Whether'"))
        result += [
            (line, f"a description begins with {word!r}") for word in descriptions(text) if word in QUESTION_WORDS
        ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            result.append((node.lineno, "assert: raise an error that names the remedy"))
        if error := raised(node):
            name, message = error[0], literal(ast.parse(error[1], mode="eval").body)
            if name in USER_ERRORS and message is not None and not REMEDY.search(message):
                result.append((node.lineno, f"message without a remedy: {message!r}"))
    return sorted(result)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_prose_of_the_package(path):
    result = violations(path.read_text())
    assert not result, "\n".join(f"{path.relative_to(ROOT)}:{line}: {complaint}" for line, complaint in result)


BAD = '''
class Record:
    done: bool
    """If it is over."""
    obs: int
    """What a policy is told."""

def f(x):
    """Return y.

    Args:
        x: How far it is.
    """
    assert x
    raise ValueError(f"{x!r} is bad")
'''


def test_the_check_finds_each_kind_of_violation():
    complaints = [complaint for _, complaint in violations(BAD)]
    for expected in (
        "a field docstring begins with 'What'",
        "a flag begins with 'If', not with 'Whether'",
        "a description begins with 'How'",
        "assert:",
        "message without a remedy",
    ):
        assert any(expected in complaint for complaint in complaints), expected
    good = BAD[: BAD.index("obs")].replace("If", "Whether")
    assert not violations(good)
    assert not violations(good.replace("Whether it", "True where it"))
    assert not violations('"""Module."""\n\n\ndef f(x):\n    """Return x."""\n    return x\n')
