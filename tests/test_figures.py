"""Figures of the pages: each has a command and a place, and outdated figures are found."""

import importlib
import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MEASURED = '''
from math import sin

def thrust(speed: float) -> float:
    """Return the thrust."""
    if speed < 0:
        raise ValueError(f"expected a speed, got {speed}")
    squared = speed * speed
    return 2.0 * squared + sin(squared)
'''
SCRIPT = f"""
import json, sys
sys.path.insert(0, {str(ROOT / "benchmarks")!r})
from measure import describe_machine
print("something else")
print(json.dumps(dict(describe_machine("cpu"), case=sys.argv[1], rate=5e3)))
"""


@pytest.fixture
def figures(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("figures")


@pytest.fixture
def repository(figures, monkeypatch, tmp_path):
    """Return the script for another repository, with one figure, one source and no record."""
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "speed.py").write_text("print(1)\n")
    (tmp_path / "thrust.py").write_text(MEASURED)
    (tmp_path / "page.md").write_text("Before.\n\n<!-- figure speed -->\n\n<!-- end of speed -->\n\nAfter.\n")
    (tmp_path / "README.md").write_text("Nothing.\n")
    (tmp_path / "figures.json").write_text("[]\n")
    table = figures.tables.columns(Case=lambda x: x["case"], Rate=lambda x: figures.tables.si_text(x["rate"]))
    figure = figures.Figure("page.md", ("thrust.py",), cpu="speed.py --fast", table=table)
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "RECORDS_FILE", tmp_path / "figures.json")
    monkeypatch.setattr(figures, "FIGURES", {"speed": figure})
    figures.run_git("init", "-q")
    commit_all(figures)
    return figures


def commit_all(figures):
    figures.run_git("add", "-A")
    figures.run_git("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false", "commit", "-qm", "x")
    return figures.current_commit()


def record(figures, commit, processor="EPYC", rate=2e9):
    about = {"device": "cpu", "processor": processor, "cores": 2, "vectors": "AVX2", "jax": "0.10.1",
             "python": "3.11.7", "date": "2026-11-26"}  # fmt: skip
    return figures.make_record("speed", "speed.py --fast", commit, [{"case": "hover", "rate": rate} | about])


def test_each_figure_has_a_script_and_a_place_on_its_page(figures):
    for name, figure in figures.FIGURES.items():
        assert figure.cpu or figure.gpu or figure.commits, name
        for path in figure.tracked_paths():
            assert (ROOT / path.removeprefix(":(exclude)")).exists(), f"{name}: {path} does not exist"
    places = [(name, str(page.relative_to(ROOT))) for page in PAGES for name in figures.figure_names(page.read_text())]
    expected = [(name, figure.page) for name, figure in figures.FIGURES.items() if figure.table]
    assert sorted(places) == sorted([*expected, ("readme", "README.md")])


def test_pages_show_the_records(figures):
    records = figures.load_records()
    for page in PAGES:
        text = page.read_text()
        assert figures.insert_tables(text, records) == text, (
            f"run benchmarks/figures.py --write --only; {page.name} differs"
        )


def test_a_record_is_stale_once_the_code_that_it_measures_has_changed(repository):
    assert repository.stale_records() == ["speed: no record"]
    commit = repository.current_commit()
    repository.store_records([record(repository, commit)])
    assert repository.stale_records() == []
    source = repository.ROOT / "thrust.py"
    text = MEASURED.replace("squared", "square").replace("Return the", "Give back the").replace(": float)", ")")
    source.write_text("# A comment.\n" + text.replace("expected a speed", "expected m/s"))
    commit_all(repository)
    assert repository.stale_records() == []
    source.write_text(
        MEASURED.replace("thrust(", "lift(").replace("import sin", "import sin as sine").replace("sin(", "sine(")
    )
    assert "thrust.py changed after" in repository.stale_records()[0]
    source.write_text(MEASURED.replace("thrust(", "lift("))
    assert repository.stale_records() == []
    source.write_text(MEASURED.replace("sin", "cos"))
    assert "thrust.py changed after" in repository.stale_records()[0]
    source.write_text(MEASURED.replace("return 2.0 * squared", "return 2.0 * speed"))
    assert "thrust.py changed after" in repository.stale_records()[0]
    source.write_text(MEASURED.replace("2.0", "3.0"))
    (result,) = repository.stale_records()
    assert result == f"speed, 2 cores of EPYC (AVX2): thrust.py changed after {commit}"
    repository.store_records([record(repository, commit_all(repository))])
    assert repository.stale_records() == []
    (repository.ROOT / "benchmarks" / "speed.py").write_text("print(2)\n")
    assert "benchmarks/speed.py changed after" in repository.stale_records()[0]
    repository.store_records([record(repository, "0123abc")])
    assert "0123abc" in repository.stale_records()[0]


VARIABLES = """
def move(start, change):
    def add(x):
        return [start + x for x in change]

    end = add(1) + [x for x in change]
    return start, end
"""


@pytest.mark.parametrize(
    ("renamings", "is_same"),
    [
        ({"start": "end", "end": "start"}, True),  # all uses of two variables
        ({"def add(x)": "def add(y)", "start + x for": "start + y for"}, False),  # a variable that the list binds
        ({"add": "sum_of", "end": "last", "change": "all_changes"}, True),  # of a function within, and in its closure
        ({"return start, end": "return end, start"}, False),
        ({"+ [x for x in": "+ [y for y in"}, True),
        ({"[start + x for": "[end + x for"}, False),
    ],
)
def test_local_variables_are_renamed_one_to_one(repository, renamings, is_same):
    source = repository.ROOT / "thrust.py"
    source.write_text(VARIABLES)
    repository.store_records([record(repository, commit_all(repository))])
    text = re.sub("|".join(map(re.escape, renamings)), lambda match: renamings[match[0]], VARIABLES)
    assert text != VARIABLES
    source.write_text(text)
    assert (repository.stale_records() == []) == is_same


def test_a_written_table_keeps_the_rows_of_other_machines(repository):
    commit = repository.current_commit()
    repository.store_records([record(repository, commit), record(repository, commit, "Xeon", 3e9)])
    repository.store_records([record(repository, commit, rate=4e6)])
    repository.write_pages()
    text = (repository.ROOT / "page.md").read_text()
    assert text.startswith(
        "Before.\n\n<!-- figure speed -->\n\n2 cores of EPYC (AVX2) (jax 0.10.1, Python 3.11.7, 2026-11-26"
    )
    assert text.endswith("| hover | 3 G |\n\n<!-- end of speed -->\n\nAfter.\n")
    assert "| Case | Rate |\n| --- | --- |\n| hover | 4 M |" in text


def test_figures_are_measured_and_written_by_one_command(repository, monkeypatch, tmp_path, capsys):
    (repository.ROOT / "benchmarks" / "speed.py").write_text(SCRIPT)
    monkeypatch.setattr(sys, "argv", ["figures.py", "--write", "--commit", "abc"])
    repository.main()
    (row,) = json.loads((repository.ROOT / "figures.json").read_text())
    assert (row["commit"], row["lines"]) == ("abc", [{"case": "--fast", "rate": 5e3}])
    assert "| --fast | 5 k |" in (repository.ROOT / "page.md").read_text()
    (repository.ROOT / "benchmarks" / "speed.py").write_text("raise SystemExit(3)\n")
    with pytest.raises(SystemExit, match=r"speed: speed\.py --fast failed with status 3"):
        repository.main()
    assert json.loads((repository.ROOT / "figures.json").read_text()) == [row]
    other = tmp_path / "other.json"
    other.write_text(repository.records_text([row | {"machine": "another", "lines": [{"case": "there", "rate": 7.0}]}]))
    monkeypatch.setattr(sys, "argv", ["figures.py", "--write", "--take", str(other)])
    repository.main()
    assert "| there | 7 |" in (repository.ROOT / "page.md").read_text()
    monkeypatch.setattr(sys, "argv", ["figures.py", "--stale"])
    with pytest.raises(SystemExit, match="speed, "):
        repository.main()
