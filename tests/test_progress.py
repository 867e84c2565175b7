"""Progress bars are shown on terminals only, since they would add thousands of lines to a log file."""

import io
import sys
from pathlib import Path

import pytest

import crazysim
from crazysim.progress import progress_bar


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_a_bar_is_shown_on_terminals_only(stream, monkeypatch):
    pytest.importorskip("tqdm")
    monkeypatch.setattr(sys, "stderr", stream())
    assert list(progress_bar(range(3), "flying")) == [0, 1, 2]
    assert ("flying" in sys.stderr.getvalue()) == (stream is Terminal)


def test_without_tqdm_items_are_returned_or_it_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert progress_bar(range(3), "flying") == range(3)
    assert capsys.readouterr().out == "flying ...\n"
    assert progress_bar() is None
    with pytest.raises(ImportError, match="progress bars need tqdm, which is not installed"):
        progress_bar(required=True)


def test_only_progress_py_imports_tqdm():
    package = Path(crazysim.__file__).parent
    assert [x.name for x in package.rglob("*.py") if "tqdm import" in x.read_text()] == ["progress.py"]
