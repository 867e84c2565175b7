"""Archives of JSON files that refer to each other, with bounds on the unpacked size."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from crazysim.errors import require, short_repr
from crazysim.lab.trajectory_files import checks
from crazysim.storage import ZipReader, wrap_read_errors, write_file

MAX_MEMBERS = 20_100
"""Largest number of files in an archive: four for each of 5,000 drones, Skybrush's limit, and 100 for the show."""
MAX_MEMBER_BYTES = 16 * 2**20
"""Largest file of an archive that is unpacked, bytes."""
MAX_TOTAL_BYTES = 512 * 2**20
"""Largest number of bytes that may be unpacked from an archive."""
MIN_TOTAL_BYTES, MAX_RATIO = 64 * 2**20, 100
"""Number of bytes that may be unpacked from any archive; larger archives may be unpacked to this multiple of their
size."""
MAX_CHAIN = 8
"""Longest chain of references."""
REMEDY = "Export it again, or use another copy."
"""Remedy for a damaged archive."""


class Archive:
    """A zip archive of JSON files."""

    def __init__(self, content: bytes, location: str):
        self.location = location
        self._parsed: dict[str, Any] = {}
        limit = min(MAX_TOTAL_BYTES, max(MIN_TOTAL_BYTES, MAX_RATIO * len(content)))
        with wrap_read_errors(location, "a zip archive", REMEDY):
            self._zip = ZipReader(io.BytesIO(content), location, MAX_MEMBERS, MAX_MEMBER_BYTES, limit)

    def json(self, name: str) -> Any:
        """Return the contents of a JSON file of the archive.

        Raises:
            ConfigError: If the JSON file is missing, too large, or not JSON.
            DamagedFileError: If the JSON file cannot be unpacked.
        """
        if name in self._parsed:
            return self._parsed[name]
        location = f"{self.location}: {name}"
        require(name in self._zip.names, f"expected a file {name!r} in {self.location}, got an archive without it")
        with wrap_read_errors(location, "a file that can be unpacked", REMEDY):
            self._parsed[name] = checks.parse_json(self._zip.read(name), location)
        return self._parsed[name]

    def resolve(self, value: Any, location: str) -> tuple[Any, str]:
        """Return a value and its location, or the contents and location of the file that the value refers to.

        A reference is ``{"$ref": "./name#"}``.

        Raises:
            ConfigError: If the file is missing, or references form a cycle or a chain that is too long.
        """
        for _ in range(MAX_CHAIN):
            if not isinstance(value, dict) or "$ref" not in value:
                return value, location
            reference = checks.require_text(value["$ref"], f"{location}, $ref", 1000)
            name, _, fragment = reference.partition("#")
            if fragment.strip("/"):
                checks.raise_error("a reference to a whole file, such as ./cues.json#", short_repr(reference), location)
            name = str(PurePosixPath(name))
            value, location = self.json(name), f"{self.location}: {name}"
        return checks.raise_error(f"a chain of at most {MAX_CHAIN} references", "a longer one", location)


def write_archive(path: str | Path, files: Mapping[str, str]) -> None:
    """Write a compressed zip archive of text files; the same contents give the same bytes.

    Raises:
        ConfigError: If the folder does not exist.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    write_file(path, buffer.getvalue())
