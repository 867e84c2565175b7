"""Figures of the pages: each has a command and a place, and the pages show the stored records."""

import importlib
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
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
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "speed.py").write_text("print(1)\n")
    (tmp_path / "page.md").write_text("Before.\n\n<!-- figure speed -->\n\n| old |\n\nAfter.\n")
    for name in ("figures", "tables", "training"):
        (tmp_path / f"{name}.json").write_text("[]\n")
    table = figures.tables.columns(
        Machine=figures.tables.machine_of,
        Case=lambda x: x["case"],
        Rate=lambda x: figures.tables.si_text(x["rate"]),
    )
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    monkeypatch.setattr(figures, "FIGURES", {"speed": figures.Figure(cpu="speed.py --fast")})
    monkeypatch.setattr(figures, "PAGES", ["page.md"])
    monkeypatch.setattr(figures.tables, "TABLES", {"speed": (("speed",), table)})
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


def test_each_figure_has_a_script_records_and_a_table(figures):
    for name, figure in figures.FIGURES.items():
        assert figure.cpu or figure.gpu, name
        for command in filter(None, (figure.cpu, figure.gpu)):
            assert (ROOT / "benchmarks" / command.split()[0]).exists(), name
    assert {record["figure"] for record in figures.load_records()} == set(figures.FIGURES)
    in_tables = {name for names, _ in figures.tables.TABLES.values() for name in names}
    assert set(figures.FIGURES) - in_tables == {"depth-small"}


def test_the_page_shows_or_names_each_table(figures):
    page = (ROOT / "docs/results.md").read_text()
    shown = figures.figure_names(page)
    assert len(shown) == len(set(shown))
    named = {name for table in shown for name in figures.tables.figures_of(table)}
    for name in figures.table_names():
        assert name in {*shown, *named, "readme"} or f"`{name}`" in page, name


def test_pages_show_the_records(figures):
    records = figures.page_records()
    for page in PAGES:
        text = page.read_text()
        assert figures.insert_tables(text, records) == text, (
            f"run benchmarks/figures.py --write --only; {page.name} differs"
        )


def test_a_written_table_keeps_the_rows_of_other_machines(repository):
    commit = repository.current_commit()
    repository.store_records([record(repository, commit), record(repository, commit, "Xeon", 3e9)])
    repository.store_records([record(repository, commit, rate=4e6)])
    repository.write_pages()
    text = (repository.ROOT / "page.md").read_text()
    origin = f"`speed`: 2 cores of EPYC (AVX2), 2 cores of Xeon (AVX2), 2026-11-26, commit {commit}"
    assert text.startswith(f"Before.\n\n{origin} <!-- figure speed -->\n\n| Machine |")
    assert text.endswith(
        "| 2 cores of EPYC (AVX2) | hover | 4 M |\n| 2 cores of Xeon (AVX2) | hover | 3 G |\n\nAfter.\n"
    )


def test_figures_are_measured_and_written_by_one_command(repository, monkeypatch, tmp_path, capsys):
    (repository.ROOT / "benchmarks" / "speed.py").write_text(SCRIPT)
    monkeypatch.setattr(sys, "argv", ["figures.py", "--write", "--commit", "abc"])
    repository.main()
    (row,) = json.loads((repository.RESULTS / "figures.json").read_text())
    assert (row["commit"], row["lines"]) == ("abc", [{"case": "--fast", "rate": 5e3}])
    assert "| --fast | 5 k |" in (repository.ROOT / "page.md").read_text()
    (repository.ROOT / "benchmarks" / "speed.py").write_text("raise SystemExit(3)\n")
    with pytest.raises(SystemExit, match=r"speed: speed\.py --fast failed with status 3"):
        repository.main()
    assert json.loads((repository.RESULTS / "figures.json").read_text()) == [row]
    other = tmp_path / "other.json"
    other.write_text(repository.records_text([row | {"machine": "another", "lines": [{"case": "there", "rate": 7.0}]}]))
    monkeypatch.setattr(sys, "argv", ["figures.py", "--write", "--take", str(other)])
    repository.main()
    assert "| there | 7 |" in (repository.ROOT / "page.md").read_text()
