"""Journals: files to which chunks are appended one by one, and which stay readable after a crash.

A file consists of the line ``crazysim journal 1`` and chunks. A chunk consists of its kind (4 bytes), the length of the
content (8 bytes, little endian), the CRC-32 of kind and content (4 bytes, little endian), and the content. Each chunk
is passed to the operating system in one write, so appended chunks are not lost if the process ends, even by SIGKILL. If
a chunk is cut off, by a full disk or a loss of power, readers warn and stop before it.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from crazysim.errors import ConfigError, require
from crazysim.storage import Closeable, open_file

log = logging.getLogger(__name__)

MAGIC = b"crazysim journal 1\n"
"""First line of a journal."""
CHUNK_HEADER = struct.Struct("<4sQI")
"""Head of a chunk: kind, length of the content, checksum."""


class Journal(Closeable):
    """File to which chunks are appended."""

    path: Path
    """Path of the file."""

    def __init__(self, path: str | Path, replace: bool = False):
        self.path = Path(path)
        existing_file_flag = os.O_TRUNC if replace else os.O_EXCL
        try:
            self._file = os.open(
                self.path, os.O_WRONLY | os.O_CREAT | existing_file_flag | getattr(os, "O_BINARY", 0), 0o644
            )
        except FileExistsError:
            raise ConfigError(f"expected a new file, got {str(path)!r}, which exists. Use another name.") from None
        except OSError as error:
            raise ConfigError(f"expected a file that can be created, got {str(path)!r}: {error}") from error
        self._write(MAGIC)

    @property
    def is_open(self) -> bool:
        return self._file >= 0

    def append(self, kind: bytes, content: bytes) -> None:
        """Append a chunk.

        Args:
            kind: Kind of the chunk, 4 bytes.

        Raises:
            OSError: If the chunk cannot be written, for example because the disk is full.
        """
        self._write(pack_chunk(kind, content))

    def close(self) -> None:
        if self.is_open:
            os.close(self._file)
            self._file = -1

    def _write(self, content: bytes) -> None:
        remaining_bytes = memoryview(content)
        while remaining_bytes:
            remaining_bytes = remaining_bytes[os.write(self._file, remaining_bytes) :]


def pack_chunk(kind: bytes, content: bytes) -> bytes:
    """Return a chunk as it stands in a file."""
    require(len(kind) == 4, f"expected a kind of 4 bytes, got {kind!r}")
    return CHUNK_HEADER.pack(kind, len(content), zlib.crc32(content, zlib.crc32(kind))) + content


def read_journal(path: str | Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield kind and content of the chunks of a file, which may still be growing.

    The iteration ends with a warning at the first chunk that is cut off or damaged.

    Raises:
        ValueError: If the file is not a journal.
        OSError: If the file cannot be read.
    """
    with open_file(path) as file:
        require(file.read(len(MAGIC)) == MAGIC, f"the first line is not {MAGIC.decode().strip()!r}", ValueError)
        size = os.fstat(file.fileno()).st_size
        while (start := file.tell()) < size:
            head = file.read(CHUNK_HEADER.size)
            kind, length, checksum = CHUNK_HEADER.unpack(head) if len(head) == CHUNK_HEADER.size else (b"", size, 0)
            content = file.read(length) if length <= size - file.tell() else b""
            if len(content) < length or zlib.crc32(content, zlib.crc32(kind)) != checksum:
                log.warning("%s is cut off or damaged at byte %d of %d; the part before it was read", path, start, size)
                return
            yield kind, content
