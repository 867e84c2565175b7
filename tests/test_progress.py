"""Progress bars, on terminals alone: in the log file of a job each of their lines is one of thousands."""

import io
import sys

import pytest

from crazysim.progress import progress


class Terminal(io.StringIO):
    """Text that counts as a terminal."""

    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_a_bar_is_shown_on_a_terminal_alone(stream, monkeypatch):
    pytest.importorskip("tqdm")
    monkeypatch.setattr(sys, "stderr", stream())
    assert list(progress(range(3), "flying")) == [0, 1, 2]
    assert ("flying" in sys.stderr.getvalue()) == (stream is Terminal)
