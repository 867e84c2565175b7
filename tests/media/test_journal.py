"""Journals: appended chunks are read back, also after the process was killed, and damage loses only what follows."""

import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from pictures import read_frames
from waiting import wait_for

from crazysim.errors import ConfigError
from crazysim.media import Film, Flight, Recorder, View
from crazysim.media.journal import CHUNK_HEADER, Journal, read_journal
from crazysim.sim import Sim

CHUNKS = [(b"AAAA", b"first"), (b"BBBB", b""), (b"CCCC", bytes(range(256)))]
"""Kind and content of each chunk."""


@pytest.fixture
def journal_path(tmp_path):
    path = tmp_path / "x.journal"
    with Journal(path) as journal:
        for chunk in CHUNKS:
            journal.append(*chunk)
        assert list(read_journal(path)) == CHUNKS  # while it is open
    assert not journal.is_open
    return path


def test_a_journal_that_is_cut_off_keeps_the_chunks_before(journal_path, caplog):
    content = journal_path.read_bytes()
    last_chunk_start = len(content) - CHUNK_HEADER.size - len(CHUNKS[-1][1])
    for length in (last_chunk_start, last_chunk_start + 1, last_chunk_start + CHUNK_HEADER.size, len(content) - 1):
        journal_path.write_bytes(content[:length])
        caplog.clear()
        assert list(read_journal(journal_path)) == CHUNKS[:2]
        assert ("cut off or damaged at byte" in caplog.text) == (length > last_chunk_start)


def test_a_damaged_chunk_ends_the_file(journal_path):
    content = bytearray(journal_path.read_bytes())
    content[content.index(b"first")] ^= 1
    journal_path.write_bytes(content)
    assert list(read_journal(journal_path)) == []
    content[-300:] = b"\xff" * 300  # a header of nonsense with a length of exabytes
    journal_path.write_bytes(content)
    assert list(read_journal(journal_path)) == []


def test_wrong_files_are_errors(journal_path, tmp_path):
    with pytest.raises(ConfigError, match="new file"):
        Journal(journal_path)
    assert list(read_journal(journal_path)) == CHUNKS, "the old journal stays"
    with pytest.raises(ConfigError, match="file that can be created"):
        Journal(tmp_path / "nowhere" / "x")
    other = tmp_path / "other"
    other.write_text("else")
    with pytest.raises(ValueError, match="the first line is not 'crazysim journal 1'"):
        list(read_journal(other))
    Journal(journal_path, replace=True).close()
    assert list(read_journal(journal_path)) == []
    with Journal(tmp_path / "y") as journal, pytest.raises(ConfigError, match="kind of 4 bytes"):
        journal.append(b"TOOLONG", b"")


def test_a_recorder_with_a_path_writes_the_same_flight(tmp_path):
    sim = Sim(n_worlds=2, n_drones=2, control="state")
    sim.scene.add("sphere", "ball", pos=[0, 1, 0.5])
    memory, file = Recorder(sim), Recorder(sim, path=tmp_path / "f.journal")
    command = np.zeros((2, 2, 16))
    command[..., 2], command[..., 12] = [[1, 2], [3, 4]], 1
    sim.state_control(command)
    for _ in range(4):
        for recorder in (memory, file):
            recorder.add()
            recorder.add()  # at the same time
        sim.step(10)
    assert len(memory) == len(file) == 4
    file.close()
    in_memory, read = memory.flight(), Flight.load(tmp_path / "f.journal")
    assert read.pos.shape == (4, 2, 2, 3)
    assert read.body_pos.shape == (4, 2, 1, 3)
    for name in ("time", "pos", "quat", "body_pos", "body_quat", "setpoint", "worlds", "drone_ids", "body_ids"):
        np.testing.assert_array_equal(getattr(read, name), getattr(in_memory, name), err_msg=name)
    assert [shape.kind for shape in read.shapes] == [shape.kind for shape in in_memory.shapes]
    read.save(tmp_path / "saved.journal")
    np.testing.assert_array_equal(Flight.load(tmp_path / "saved.journal").pos, in_memory.pos)


def test_a_recording_without_samples_is_refused(tmp_path):
    sim = Sim()
    Recorder(sim, path=tmp_path / "f.journal").close()
    with pytest.raises(ConfigError, match="at least one sample"):
        Flight.load(tmp_path / "f.journal")


KILLED_PROGRAM = textwrap.dedent("""
    import os, signal, sys
    import numpy as np
    from crazysim.media import Film, View
    film = Film(sys.argv[1], View(width=64, height=48), fps=10)
    for k in range(200):
        film.write(np.full((48, 64, 3), k, np.uint8))
    os.kill(os.getpid(), signal.SIGKILL)
""")


def test_a_film_survives_the_end_of_its_process(tmp_path):
    """A killed simulation loses no frame; a killed encoder loses the last seconds, which it had not encoded yet."""
    film = tmp_path / "film.mp4"
    ended = subprocess.run([sys.executable, "-c", KILLED_PROGRAM, film], check=False)
    assert ended.returncode == -signal.SIGKILL
    (path,) = tmp_path.glob("film.mp4.*.part")  # only a film that is closed gets its name
    wait_for(lambda: path.stat().st_size and len(read_frames(path, 48, 64)) == 200)
    killed = Film(film, View(width=64, height=48), fps=10)
    for k in range(400):
        killed.write(np.full((48, 64, 3), k % 256, np.uint8))
    killed._ffmpeg.kill()
    killed._ffmpeg.communicate()
    (path,) = tmp_path.glob("film.mp4.*.part")  # the earlier one is removed
    assert len(read_frames(path, 48, 64)) > 200
