"""Damaged and hostile logs: each is read or refused with a ConfigError, without warnings, hangs or much memory."""

import io
import os
import random
import re
import signal
import struct
import tracemalloc
import warnings
from zlib import crc32

import numpy as np
import pytest
from log_files import COLUMNS, N, T, create_mocap, drift, swing, write_bag, write_blackbox, write_crazyflie, write_ulog

from crazysim.errors import ConfigError
from crazysim.lab.identify import Columns, read_log

N_MUTATIONS = 10 if os.environ.get("CRAZYSIM_HYPOTHESIS") != "explore" else 500
"""Number of mutated files of each kind."""
MAX_MEMORY = 64 * 2**20
"""Largest amount of memory that reading a file of some 200 kB may take, bytes."""
HANG_TIMEOUT = 60
"""Processor time after which a reader counts as hanging, s: a valid file takes a tenth of a second."""
INTEGERS = [0, 1, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1]
CELLS = ["", "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-1", "x", '"', "1" * 400, "\x00", "1,2", "é"]
"""Integers and table cells that mutations write into files."""


class HangError(BaseException):
    """Error raised by the alarm; it is no ``Exception``, which readers would turn into their own errors."""


def create_table():
    columns = create_mocap() | {
        "vx": np.ones(N),
        "vy": drift(T)[1],
        "vz": T,
        "wx": swing(T)[1],
        "wy": 0 * T,
        "wz": 0 * T,
    }
    return columns | {f"rpm{k}": 1000.0 + 10 * np.sin(7 * T + k) for k in range(1, 5)}


def write_csv(path):
    columns = create_table()
    rows = [",".join(f"{x:.6g}" for x in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")


def bag_writer(storage):
    def write(path):
        if storage == "bag":
            return write_bag(path, storage=storage, seconds=1.0)
        folder = write_bag(path.parent / f"{path.name}-folder", storage=storage, seconds=1.0)
        (made,) = folder.glob(f"*{path.suffix}")
        path.write_bytes(made.read_bytes())
        return path

    return write


LOG_KINDS = {
    "sd": ("log00", write_crazyflie, COLUMNS, None),
    "ulog": ("a.ulg", write_ulog, None, None),
    "csv": ("a.csv", write_csv, None, None),
    "angles": ("b.csv", write_csv, Columns(rpy=("qx", "qy", "qz")), None),
    "npz": ("a.npz", lambda path: np.savez(path, **create_table()), None, None),
    "deflated": ("b.npz", lambda path: np.savez_compressed(path, **create_table()), None, None),
    "blackbox": ("c.csv", write_blackbox, None, create_mocap(offset=1234.56)),
    "ros1": ("a.bag", bag_writer("bag"), None, None),
    "mcap": ("a.mcap", bag_writer("mcap"), None, None),
    "db3": ("a.db3", bag_writer("sqlite3"), None, None),
}
"""Name of the file, function that writes it, its columns and its motion capture, by kind of log."""


def draw_offset(rng, n):
    margin = min(n, 1500)
    return rng.choice([rng.randrange(n), rng.randrange(n), rng.randrange(margin), n - 1 - rng.randrange(margin)])


def damage_bytes(rng, data):
    """Return the bytes with one random change: a flipped bit, a new number, or replaced, missing or repeated bytes."""
    offset, length = draw_offset(rng, len(data)), rng.choice([1, 2, 4, 8, 100, 3000])
    change = rng.randrange(8)
    if change == 0:
        return data[:offset] + bytes([data[offset] ^ 1 << rng.randrange(8)]) + data[offset + 1 :]
    if change == 1:
        return data[:offset] + rng.randbytes(length) + data[offset + length :]
    if change in (2, 3):
        layout = rng.choice(["<B", "<H", "<I", "<Q", ">I", "<d", "<f"])
        size = struct.calcsize(layout)
        value = rng.choice([np.nan, np.inf, 1e30, -1.0]) if layout[1] in "df" else rng.choice(INTEGERS) % 256**size
        return data[:offset] + struct.pack(layout, value) + data[offset + size :]
    if change == 4:
        return data[:offset]
    if change == 5:
        return data[:offset] + data[offset + length :]
    if change == 6:
        return data[:offset] + data[offset : offset + length] + data[offset:]
    other = draw_offset(rng, len(data))
    return data[:offset] + data[other : other + length] + data[offset + length :]


def damage_table(rng, text):
    lines = text.splitlines()
    k = rng.choice([0, rng.randrange(len(lines))])
    cells = lines[k].split(",")
    j = rng.randrange(len(cells))
    change = rng.randrange(5)
    if change == 0:
        cells[j] = rng.choice(CELLS)
    elif change == 1:
        value, step = rng.choice(CELLS), rng.choice([1, 2, 50])  # in many rows
        for i in range(1, len(lines), step):
            row = lines[i].split(",")
            row[min(j, len(row) - 1)] = value
            lines[i] = ",".join(row)
        return "\n".join(lines)
    elif change == 2:
        del cells[j]
    elif change == 3:
        cells[j] = rng.choice(cells)
    else:
        other = rng.randrange(len(lines))
        lines[k], lines[other] = lines[other], lines[k]
        return "\n".join(lines)
    lines[k] = ",".join(cells)
    return "\n".join(lines)


def damage_archive(rng):
    columns, file = create_table(), io.BytesIO()
    key = rng.choice(list(columns))
    x = columns[key]
    columns[key] = rng.choice([
        x[: rng.randrange(N)], x[None], x * 1e300, x * np.nan, x.astype("U8"), x.astype("c16"), x.astype("f2"), x > 6,
        np.array(3.0), x[::-1], x * 0, np.full(N, np.inf), x.astype("M8[s]"), np.zeros((N, 0)), x.astype(">f8"),
    ])  # fmt: skip
    np.savez(file, **columns)
    return file.getvalue()


def mutate_file(rng, kind, k, data):
    """Return the file of a kind after one to three mutations; its number ``k`` selects the kind of mutation."""
    if kind == "npz" and k % 2:
        return damage_archive(rng)
    for _ in range(rng.randint(1, 3)):
        if LOG_KINDS[kind][0].endswith(".csv") and k % 4:
            data = damage_table(rng, data.decode()).encode()
        else:
            data = damage_bytes(rng, data) or b"\0"
    return data


@pytest.fixture(scope="module")
def valid_files(tmp_path_factory):
    pytest.importorskip("rosbags")
    folder, valid_files = tmp_path_factory.mktemp("seeds"), {}
    for kind, (name, write, columns, motion) in LOG_KINDS.items():
        write(folder / name)
        # The columns of "angles" are wrong for this file: they read a quaternion as angles.
        read_log(folder / name, columns if kind != "angles" else None, motion)
        valid_files[kind] = (folder / name).read_bytes()
    return valid_files


def read_refusal_message(path, columns, motion):
    """Return the message with which a log is refused, None if it is read; fail for anything else."""

    def raise_hang_error(*_):
        raise HangError

    previous_handler = signal.signal(signal.SIGVTALRM, raise_hang_error)
    signal.setitimer(signal.ITIMER_VIRTUAL, HANG_TIMEOUT)
    tracemalloc.reset_peak()
    start, _ = tracemalloc.get_traced_memory()
    message = None
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            read_log(path, columns, motion)
    except ConfigError as error:
        message = str(error)
        assert path.stem in message
        assert len(message) < 3000
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, previous_handler)
    assert not warned, str(warned[0])
    assert tracemalloc.get_traced_memory()[1] - start < MAX_MEMORY
    return message


@pytest.fixture
def trace_allocations():
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.long("reads mutated files with their allocations trace_allocations")
@pytest.mark.parametrize("kind", LOG_KINDS)
def test_a_mutated_log_is_read_or_refused(kind, valid_files, tmp_path, capfd, trace_allocations):
    name, _, columns, motion = LOG_KINDS[kind]
    seed = int(os.environ.get("CRAZYSIM_FUZZ_SEED", "0"))
    outcomes = {True: 0, False: 0}
    for k in range(N_MUTATIONS):
        rng = random.Random(f"{kind} {seed} {k}")
        path = tmp_path / f"{k}-{name}"
        path.write_bytes(mutate_file(rng, kind, k, valid_files[kind]))
        try:
            outcomes[read_refusal_message(path, columns, motion) is None] += 1
        except BaseException as error:
            error.add_note(f"of the mutation {k} of {kind} with CRAZYSIM_FUZZ_SEED={seed}")
            raise
        path.unlink()
    assert outcomes[False], "some mutations must be bad enough"
    assert capfd.readouterr() == ("", "")


def pack_archive(data=b"", method=0, flags=0):
    """Return an archive with one member ``t.npy``, whose headers state a method and flags (PKWARE's APPNOTE.TXT)."""
    sizes = struct.pack("<III", crc32(data), len(data), len(data))
    local = b"PK\3\4" + struct.pack("<HHHHH", 20, flags, method, 0, 0) + sizes + struct.pack("<HH", 5, 0) + b"t.npy"
    central = b"PK\1\2" + struct.pack("<HHHHHH", 20, 20, flags, method, 0, 0) + sizes + struct.pack("<H", 5)
    central += bytes(16) + b"t.npy"
    end = b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local) + len(data), 0)
    return local + data + central + end


def make_npy(header):
    """Return an ``.npy`` file of eight bytes of data with a header."""
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header.encode() + bytes(8)


HOSTILE_LOGS = {
    "foreign compression": ("a.npz", pack_archive(method=99), "compression method is not supported"),
    "encryption": ("a.npz", pack_archive(flags=1), "is encrypted"),
    "40 TB": (
        "a.npz",
        pack_archive(make_npy("{'descr': '<f8', 'fortran_order': False, 'shape': (5000000000000,), }\n")),
        r"an array of the 8 bytes that follow its header, got a header of shape \(5000000000000,\) in .*a\.npz: t\.npy",
    ),
    "negative": (
        "a.npz",
        pack_archive(make_npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }\n")),
        r"got a header of shape \(-1,\)",
    ),
    "columns": ("a.csv", b"t," * 200_000 + b"x\n" + b"1," * 200_000 + b"1\n", "at most 10000 columns, got 200001"),
    "empty variable": ("log00", b"\xbc" + struct.pack("<HH", 2, 1) + b"\1\0a\0\1\0\0" + bytes(20), "such as 'gyro.x"),
    "mcap": ("a.mcap", b"\x89MCAP0\r\n\1" + struct.pack("<Q", 2**40) + bytes(50), "1099511627776 bytes, got 50"),
    "self": (
        "a.ulg",
        b"ULog\1\x12\x35\1" + bytes(8)
        + b"".join(
            struct.pack("<HB", len(x), k) + x
            for k, x in (
                (ord("F"), b"vehicle_attitude:vehicle_attitude[60000] q;"),
                (ord("A"), b"\0\0\0vehicle_attitude"),
                (ord("D"), bytes(20)),
            )
        ),
        "over 8 within each other",
    ),
}  # fmt: skip
"""Name of the file, its content, and a part of the message that refuses it."""


@pytest.mark.parametrize("case", HOSTILE_LOGS)
def test_a_crafted_log_is_refused_with_its_name_and_a_remedy(case, tmp_path, capfd, trace_allocations):
    if case == "mcap":
        pytest.importorskip("rosbags")
    name, data, expected = HOSTILE_LOGS[case]
    (tmp_path / name).write_bytes(data)
    message = read_refusal_message(tmp_path / name, None, None)
    assert re.search(expected, message), message
    assert message.endswith(".")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["log00", "a.ulg", "a.csv", "a.npz"])
def test_a_log_without_an_end_is_refused_before_it_is_read(name, tmp_path, trace_allocations):
    with (tmp_path / name).open("wb") as file:
        file.truncate(2**40)  # takes no room on the disk
    assert "expected a log of at most 2147483648 bytes, got 1099511627776" in read_refusal_message(
        tmp_path / name, None, None
    )
