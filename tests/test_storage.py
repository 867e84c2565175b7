"""Files are written whole or not at all, and damaged ones are refused with their name."""

import io
import os
import subprocess
import sys
import tracemalloc
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from disks import full_disk

from crazysim.errors import ConfigError, DamagedFileError
from crazysim.storage import (
    check_writable,
    open_replacement,
    process_name,
    read_arrays,
    read_text,
    wrap_read_errors,
    write_figure,
    write_file,
)


def write_to_a_full_disk(path):
    with full_disk(), open_replacement(path) as file:
        file.write(bytes(1000))


def write_and_stop(path):
    with open_replacement(path) as file:
        file.write(b"sec")
        raise KeyboardInterrupt


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.bin"
    with open_replacement(path) as file:
        file.write(b"first")
    with pytest.raises(ConfigError, match=r"file that can be written, got .*a\.bin.*too large"):
        write_to_a_full_disk(path)
    with pytest.raises(KeyboardInterrupt):
        write_and_stop(path)
    assert path.read_bytes() == b"first"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]
    with pytest.raises(ConfigError, match="existing folder"), open_replacement(tmp_path / "b" / "a"):
        pass
    with pytest.raises(ConfigError, match="file that can be written"), open_replacement(tmp_path):
        pass


WRITERS = """
import sys
from crazysim.storage import open_replacement
letter, n = sys.argv[2].encode(), 2**20
for _ in range(50):
    with open_replacement(sys.argv[1]) as file:
        for _ in range(4):
            file.write(n // 4 * letter)
            file.flush()
"""


def test_processes_and_threads_that_write_one_file_do_not_mix_their_contents(tmp_path):
    path = tmp_path / "a.bin"
    with ThreadPoolExecutor() as pool:
        writers = [pool.submit(subprocess.run, [sys.executable, "-c", WRITERS, path, x], check=True) for x in "ab"]
        for writer in writers:
            writer.result()
    assert path.read_bytes() in (2**20 * b"a", 2**20 * b"b")
    with open_replacement(path) as outer, open_replacement(path) as inner:
        outer.write(b"outer")
        inner.write(b"inner")
    assert path.read_bytes() == b"outer"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_left_is_removed_by_the_next_one(tmp_path):
    path = tmp_path / "a[1].bin"
    code = (
        "import os, sys; from crazysim.storage import *; x = open_replacement(sys.argv[1]); x.__enter__(); os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", code, path], check=False)
    others = [tmp_path / "a[1].bin.part", tmp_path / f"a1.bin.{process_name()}-0.part"]
    for other in others:
        other.write_text("mine")
    assert len(list(tmp_path.iterdir())) == 3
    write_file(path, "x")
    assert sorted(tmp_path.iterdir()) == sorted([path, *others])


def pack(save=np.savez, **arrays):
    file = io.BytesIO()
    save(file, **arrays)
    return file.getvalue()


def read(content):
    with wrap_read_errors("a.npz", "some arrays", "Use another copy."):
        return read_arrays(io.BytesIO(content), "a.npz")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_damaged_arrays_are_refused_wherever_the_damage_is(save):
    arrays = {"x": np.arange(8.0), "n": np.array(3), "text": np.array("meta")}
    content = pack(save, **arrays)
    assert read(content).keys() == arrays.keys()
    for length in range(0, len(content), 7):
        with pytest.raises(DamagedFileError, match=r"some arrays, got 'a\.npz', which .* Use another copy\."):
            read(content[:length])
    refused = 0
    for k in range(len(content)):
        try:
            loaded = read(content[:k] + bytes([content[k] ^ 0x10]) + content[k + 1 :])
        except ConfigError as error:
            refused += "a.npz" in str(error)
        else:  # The bit is in a date, for example, or in the size of the table of contents, which then lacks names.
            assert all(np.array_equal(x, arrays[name]) for name, x in loaded.items())
    assert refused > 0.6 * len(content)


def test_objects_are_not_unpickled():
    with pytest.raises(DamagedFileError, match="Object arrays cannot be loaded"):
        read(pack(x=np.array([{}])))


def test_small_files_do_not_take_all_memory():
    """An archive of 256 kB that states 2 GiB is refused before any of it is unpacked."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("x0.npy", "w") as member:
        for _ in range(2**8):
            member.write(bytes(2**20))
    content = file.getvalue()
    forged = content.replace((2**28).to_bytes(4, "little"), (2**31 - 1).to_bytes(4, "little"))
    tracemalloc.start()
    with pytest.raises(ConfigError, match=r"files of at most 1073741824 bytes.*a\.npz: x0"):
        read(forged)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_a_missing_file_is_named(tmp_path):
    path, message = tmp_path / "none", r"expected an existing file with some arrays, got .*none'\. Use another"
    with pytest.raises(ConfigError, match=message) as error, wrap_read_errors(path, "some arrays", "Use another copy."):
        path.read_bytes()
    assert not isinstance(error.value, DamagedFileError)


def test_a_byte_order_mark_is_no_text(tmp_path):
    path = tmp_path / "goals.txt"
    path.write_text("0 0 1\n", encoding="utf-8-sig")
    assert read_text(path, 100) == "0 0 1\n"


def test_writers_of_texts_and_figures_leave_nothing_on_a_full_disk(tmp_path):
    figure = pytest.importorskip("matplotlib.figure").Figure()
    for write in (
        lambda: write_file(tmp_path / "a.txt", "x" * 1000),
        lambda: write_figure(figure, tmp_path / "a.png", 50),
    ):
        with pytest.raises(ConfigError, match="file that can be written"), full_disk():
            write()
        assert not list(tmp_path.iterdir())
    write_file(tmp_path / "a.txt", "é")
    assert (tmp_path / "a.txt").read_bytes() == "é".encode()
    with pytest.raises(ConfigError, match=r"ends with \.png or \.jpg or \.svg or \.pdf, got .*a\.exe"):
        write_figure(figure, tmp_path / "a.exe", 50)


def test_check_writable_changes_no_file(tmp_path):
    check_writable(tmp_path / "a.md")
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.md").write_text("before")
    check_writable(tmp_path / "a.md", (".md",))
    assert (tmp_path / "a.md").read_text() == "before"
    for path, message in ((tmp_path, "got the folder"), (tmp_path / "b" / "a.md", "expected an existing folder")):
        with pytest.raises(ConfigError, match=message):
            check_writable(path)
    with pytest.raises(ConfigError, match=r"ends with \.md, got"):
        check_writable(tmp_path / "a.txt", (".md",))


def test_a_device_or_a_pipe_is_not_replaced(tmp_path):
    """A process that may write to /dev would otherwise replace /dev/null by a file."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match="got the device or pipe"):
        write_file(pipe, "text")
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]
