"""``crazysim validate``: the page, its exit status, and its messages."""

import dataclasses

import pytest

from crazysim.__main__ import main
from crazysim.commands.validate import sections
from crazysim.validate import closed_forms
from crazysim.validate.rows import Row, measure


def test_quick_rows_hold_and_the_page_has_them(tmp_path):
    out = tmp_path / "page.md"
    assert main(["validate", "--only", "mujoco", "idsia", "--out", str(out)]) == 0
    text = out.read_text()
    assert "| free body under a wrench, 0.5 s: pos |" in text
    assert "Not measured: give `--data FOLDER`." in text


@pytest.mark.parametrize("check", [closed_forms.free_fall, closed_forms.precession, closed_forms.dzhanibekov])
def test_closed_forms_hold(check):
    rows = list(check())
    assert rows
    assert not [row for row in rows if row.failed]


def test_a_figure_out_of_its_bound_fails_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(closed_forms, "GRAVITY", 9.80)
    monkeypatch.setattr(closed_forms, "CHECKS", (closed_forms.free_fall,))
    out = tmp_path / "page.md"
    assert main(["validate", "--only", "closed", "--out", str(out)]) == 1
    assert "failed: free fall" in capsys.readouterr().out
    assert "**" in out.read_text()


def test_what_cannot_run_is_a_failed_row_or_a_message(tmp_path, capsys):
    def broken():
        raise RuntimeError("no such thing")

    closed = sections(None)[0]
    (row,) = measure([dataclasses.replace(closed, checks=(broken,))])["closed"]
    assert row.failed
    assert Row("x", "y", float("nan"), bound=(0, 1)).failed
    missing = dataclasses.replace(closed, package="no_such_package", install="such")
    assert "pip install such" in missing.missing
    assert main(["validate", "--data", str(tmp_path / "none")]) == 2
    assert "expected a folder with logs" in capsys.readouterr().err
