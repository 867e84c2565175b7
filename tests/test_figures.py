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
    (tmp_path / "page.md").write_text("Before.\n\n<!-- figure speed -->\n\n<!-- end of speed -->\n\nAfter.\n")
    (tmp_path / "README.md").write_text("Nothing.\n")
    (tmp_path / "figures.json").write_text("[]\n")
    table = figures.tables.columns(Case=lambda x: x["case"], Rate=lambda x: figures.tables.si_text(x["rate"]))
    figure = figures.Figure(cpu="speed.py --fast", table=table)
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "RECORDS_FILE", tmp_path / "figures.json")
    monkeypatch.setattr(figures, "FIGURES", {"speed": figure})
    monkeypatch.setattr(figures, "PAGES", ["page.md"])
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


def test_each_figure_has_a_script_records_and_a_place(figures):
    for name, figure in figures.FIGURES.items():
        assert figure.cpu or figure.gpu, name
        for command in filter(None, (figure.cpu, figure.gpu)):
            assert (ROOT / "benchmarks" / command.split()[0]).exists(), name
    assert {record["figure"] for record in figures.load_records()} == set(figures.FIGURES)
    places = [name for page in PAGES for name in figures.figure_names(page.read_text())]
    assert sorted(places) == sorted(["readme", *(name for name, figure in figures.FIGURES.items() if figure.table)])


def test_pages_show_the_records(figures):
    records = figures.load_records()
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
    assert text.startswith(
        "Before.\n\n<!-- figure speed -->\n\n2 cores of EPYC (AVX2) (jax 0.10.1, Python 3.11.7, 2026-11-26"
    )
    assert text.endswith("| CPU | hover | 3 G |\n\n<!-- end of speed -->\n\nAfter.\n")
    assert "| Machine | Case | Rate |\n| --- | --- | --- |\n| CPU | hover | 4 M |" in text


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
