"""``crazysim validate``: the page, its exit status, and its messages."""

import dataclasses

import pytest

from crazysim.__main__ import main
from crazysim.lab.validate import Row, closed_forms
from crazysim.lab.validate.page import format_page
from crazysim.lab.validate.pictures import draw_section
from crazysim.lab.validate.rows import measure_sections
from crazysim.lab.validate.sections import sections


def test_quick_rows_hold_and_the_page_has_them(tmp_path, capsys):
    out = tmp_path / "page.md"
    assert main(["validate", "--only", "mujoco", "idsia", "--out", str(out)]) == 0
    text = out.read_text()
    assert "| free body under a wrench, 0.5 s: position |" in text
    assert "Not measured: give `--data FOLDER`." in text
    assert "left out idsia: give `--data FOLDER`" in capsys.readouterr().out


def test_rows_with_a_series_are_drawn_and_shown(tmp_path):
    pil_image = pytest.importorskip("PIL.Image")
    section = next(section for section in sections(tmp_path) if section.name == "filter")
    section = dataclasses.replace(section, data_problem="")
    named = [Row(f"{k}", "", 0.5 * k, "", (0, 1.1), series="position", x=f"flight {k}") for k in range(1, 4)]
    errors = [
        Row("x", "", 0.1 * h, unit, series=s, x=h) for h in (0.1, 0.5) for unit in "mN" for s in ("a", "published")
    ]
    for rows in (named, errors):
        draw_section(section, rows, tmp_path / "pictures" / "one.png")
        image = pil_image.open(tmp_path / "pictures" / "one.png")
        assert image.width > 500
        assert len(image.getcolors()) > 8
    rows = [dataclasses.replace(row, section="filter") for row in named]
    text = format_page([section], rows, "Made.", {"filter": "pictures/one.png"})
    assert "(pictures/one.png)" in text
    assert "| 3 | **1.5** | at most 1.1 |" in text
    assert "2 of 3 figures with a range are within it. Outside: 3." in text


def test_a_log_that_cannot_be_read_is_one_line(tmp_path, capsys):
    (tmp_path / "idsia").mkdir()
    (tmp_path / "idsia" / "melon.npz").write_bytes(b"version https://git-lfs.github.com/spec/v1")
    out = str(tmp_path / "page.md")
    assert main(["validate", "--only", "idsia", "nanobench", "--data", str(tmp_path), "--out", out]) == 1
    lines = capsys.readouterr().out.splitlines()
    (failed,) = (line for line in lines if line.startswith("failed"))
    assert "failed: open loop: expected a log of a flight, got 'melon.npz', which is damaged" in failed
    assert "left out nanobench: FOLDER has no folder nanobench" in lines


def test_a_page_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("crazysim.lab.commands.validate.validate", lambda *_: pytest.fail("minutes of work"))
    for out, message in ((tmp_path, "got the folder"), (tmp_path / "none" / "page.md", "expected an existing folder")):
        assert main(["validate", "--only", "closed", "--out", str(out)]) == 2
        assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    (tmp_path / "pictures").write_text("no folder")
    assert main(["validate", "--only", "closed", "--out", str(tmp_path / "page.md")]) == 2
    assert "expected an existing folder, got" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["pictures"]


@pytest.mark.parametrize("check", [closed_forms.free_fall, closed_forms.precession, closed_forms.dzhanibekov])
def test_closed_forms_hold(check):
    rows = list(check())
    assert rows
    assert not [row for row in rows if row.failed]


def test_a_figure_out_of_its_bound_fails_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(closed_forms, "GRAVITY_MAGNITUDE", 9.80)
    monkeypatch.setattr(closed_forms, "CHECKS", (closed_forms.free_fall,))
    out = tmp_path / "page.md"
    assert main(["validate", "--only", "closed", "--out", str(out)]) == 1
    assert "failed: free fall" in capsys.readouterr().out
    assert "**" in out.read_text()


def test_what_cannot_run_is_a_failed_row_or_a_message(tmp_path, capsys):
    def broken():
        raise RuntimeError("no such thing")

    closed = sections(None)[0]
    (row,) = measure_sections([dataclasses.replace(closed, checks=(broken,))])
    assert row.failed
    assert Row("x", "y", float("nan"), bound=(0, 1)).failed
    missing = dataclasses.replace(closed, packages={"numpy": "numpy", "no_such_package": "such==1"})
    assert missing.problem == "run `pip install such==1`"
    assert "Repeat: `pip install numpy such==1` and `crazysim validate --only closed`." in format_page(
        [missing], [], "", {}
    )
    for policy, message in (("none.tar", "expected a checkpoint of rl-tools"), ("none", "none")):
        assert main(["validate", "--only", "any", "--policy", str(tmp_path / policy)]) == 2
        assert message in capsys.readouterr().err
    assert main(["validate", "--data", str(tmp_path / "none")]) == 2
    assert "expected a folder with logs" in capsys.readouterr().err
