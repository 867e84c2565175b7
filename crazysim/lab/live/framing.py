"""Framing of a stream of bytes: where each message begins and ends, however the stream is split.

The stream has the messages of AIMotionLab's Skybrush server:

- ``<ID>_CMDSTART_<command>_<argument>_EOF`` and ``CMDSTART_<command>_<argument>_EOF``, whose argument may be a JSON
  object with any characters;
- ``REQ_<ID>`` and ``START``;
- shows, each a zip archive followed by ``SKYC``.

JSON and archives end where their own structure says, so end markers inside them are ignored.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

MAX_TEXT = 200
"""Longest message without JSON, bytes."""
MAX_JSON = 4 * 2**20
"""Longest JSON object, bytes."""
MAX_SHOW = 64 * 2**20
"""Largest show, bytes."""

ZIP_START, ZIP_END = b"PK\x03\x04", b"PK\x05\x06"
"""First bytes of a zip archive, and of the record at its end."""
ZIP_END_SIZE = 22
"""Length of the record at the end of a zip archive without its comment, bytes."""
MESSAGE_STARTS = (b"CMDSTART_", b"REQ_", b"START", ZIP_START)
"""First bytes of the messages that have no ID at their start."""
HEAD_PATTERN = re.compile(rb"(?:(\d{1,4})_)?CMDSTART_(?:(\d{1,4})_)?([a-z]{1,20})_")
"""Start of a command. The ID of the drone may be before or after ``CMDSTART``, or missing."""
TOKEN_PATTERN = re.compile(rb'["\\{}]')
"""Characters of JSON that decide where an object ends."""
SPACE_BYTES = b" \r\n\t\0"
"""Bytes that are ignored between messages."""


class FramingError(ValueError):
    """Bytes that are not a message; the rest of the stream cannot be read."""


@dataclass(frozen=True)
class Message:
    """A command in text."""

    drone: int | None
    """ID of the drone; None if the message does not state it."""
    command: str
    """Name of the command."""
    argument: str
    """Argument; may be empty."""
    payload: bytes | None = None
    """JSON object, or None."""


@dataclass(frozen=True)
class Request:
    """A request for the control of a drone."""

    drone: int
    """ID of the drone."""


@dataclass(frozen=True)
class ShowFile:
    """The contents of a ``.skyc`` file."""

    content: bytes
    """Contents."""


class MessageBuffer:
    """Buffer that splits a stream of bytes into messages.

        buffer = MessageBuffer()
        for message in buffer.feed(received):
            ...

    The bytes may be split anywhere between the calls of ``feed``.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._reset_scan()

    def _reset_scan(self) -> None:
        self._scan_position = self._depth = 0
        self._in_string = False

    @property
    def has_partial_message(self) -> bool:
        """Whether the buffer holds the start of a message."""
        return bool(self._buffer)

    def feed(self, received: bytes) -> Iterator[Message | Request | ShowFile]:
        """Add bytes to the buffer, and yield the messages that they complete.

        Raises:
            FramingError: If bytes that are not a message follow, or a message is too long. The rest of the
                stream cannot be read.
        """
        self._buffer += received
        while (message := self._take_message()) is not None:
            yield message

    def _take_message(self) -> Message | Request | ShowFile | None:
        if not self._scan_position and self._buffer[:1] and self._buffer[0] in SPACE_BYTES:
            del self._buffer[: len(self._buffer) - len(self._buffer.lstrip(SPACE_BYTES))]
        buffer = self._buffer
        if not buffer:
            return None
        if buffer.startswith(ZIP_START):
            return self._read_show()
        if buffer.startswith(b"START"):
            self._discard_bytes(5)
            return Message(None, "show", "")
        if buffer.startswith(b"REQ_"):
            digits = bytes(buffer[4:6])
            if len(digits) == 2 and digits.isdigit():
                self._discard_bytes(6)
                return Request(int(digits))
            if digits and not digits.isdigit():
                raise FramingError(f"expected REQ_ and an ID of two digits, got {_excerpt(buffer)}")
            return None
        head = HEAD_PATTERN.match(buffer)
        if head is not None:
            return self._read_message(head)
        if not self._may_start_message(bytes(buffer[: MAX_TEXT + 1])):
            raise FramingError(f"expected a message such as 07_CMDSTART_land_EOF, got {_excerpt(buffer)}")
        return None

    def _may_start_message(self, front: bytes) -> bool:
        if any(start.startswith(front[: len(start)]) for start in MESSAGE_STARTS) and len(front) <= MAX_TEXT:
            command_text = front[len(b"CMDSTART_") :]
            return not front.startswith(b"CMDSTART_") or bool(
                re.fullmatch(rb"\d{0,4}|(\d{1,4}_)?[a-z]{0,20}", command_text)
            )
        rest = re.sub(rb"^\d{1,4}", b"", front)
        if rest == front or not b"_CMDSTART_".startswith(rest[:10]):
            return False
        return bool(re.fullmatch(rb"\d{0,4}|(\d{1,4}_)?[a-z]{0,20}", rest[10:]))

    def _read_message(self, head: re.Match[bytes]) -> Message | None:
        buffer = self._buffer
        brace = buffer.find(b"{", head.end() - 1, MAX_TEXT)
        end = buffer.find(b"_EOF", head.end() - 1, MAX_TEXT)
        if brace >= 0 and (end < 0 or brace < end):
            return self._read_json_message(head, brace)
        if end < 0:
            if len(buffer) >= MAX_TEXT:
                raise FramingError(f"expected _EOF or JSON within {MAX_TEXT} bytes, got {_excerpt(buffer)}")
            return None
        message = _make_message(head, bytes(buffer[head.end() : end]))
        self._discard_bytes(end + 4)
        return message

    def _read_json_message(self, head: re.Match[bytes], brace: int) -> Message | None:
        buffer = self._buffer
        end = self._find_json_end(brace)
        if end is None:
            if len(buffer) > MAX_JSON:
                raise FramingError(f"expected JSON of at most {MAX_JSON} bytes, got more")
            return None
        following = bytes(buffer[end : end + 16]).lstrip(SPACE_BYTES)
        if not following.startswith(b"_EOF"):
            if len(following) >= 4 or not b"_EOF".startswith(following) or len(buffer) - end >= 16:
                raise FramingError(f"expected _EOF after the JSON, got {_excerpt(buffer[end:])}")
            return None
        message = _make_message(head, bytes(buffer[head.end() : brace]).rstrip(b"_"), bytes(buffer[brace:end]))
        self._discard_bytes(buffer.index(b"_EOF", end) + 4)
        return message

    def _find_json_end(self, brace: int) -> int | None:
        self._scan_position = max(self._scan_position, brace)
        while (token := TOKEN_PATTERN.search(self._buffer, self._scan_position)) is not None:
            kind = token[0]
            if kind == b"\\":
                if token.end() >= len(self._buffer):
                    self._scan_position = token.start()
                    return None
                self._scan_position = token.end() + 1  # skip the escaped character
                continue
            self._scan_position = token.end()
            if kind == b'"':
                self._in_string = not self._in_string
            elif not self._in_string:
                self._depth += 1 if kind == b"{" else -1
                if not self._depth:
                    return self._mark_json_end()
        self._scan_position = len(self._buffer)
        return None

    def _mark_json_end(self) -> int:
        end = self._scan_position
        self._scan_position, self._depth = end - 1, 1
        return end

    def _read_show(self) -> ShowFile | None:
        buffer = self._buffer
        while (zip_end := buffer.find(ZIP_END, self._scan_position)) >= 0:
            if zip_end + ZIP_END_SIZE > len(buffer):
                self._scan_position = zip_end
                break
            comment_length = struct.unpack_from("<H", buffer, zip_end + ZIP_END_SIZE - 2)[0]
            end = zip_end + ZIP_END_SIZE + comment_length
            if buffer[end : end + 4] == b"SKYC":
                content = bytes(buffer[:end])
                self._discard_bytes(end + 4)
                return ShowFile(content)
            if end + 4 > len(buffer):
                self._scan_position = zip_end
                break
            self._scan_position = zip_end + 4
        else:
            self._scan_position = max(len(buffer) - 3, 0)
        if len(buffer) > MAX_SHOW:
            raise FramingError(f"expected a show of at most {MAX_SHOW} bytes, got more")
        return None

    def _discard_bytes(self, n: int) -> None:
        del self._buffer[:n]
        self._reset_scan()


def _make_message(head: re.Match[bytes], argument: bytes, payload: bytes | None = None) -> Message:
    drone = head[1] or head[2]
    return Message(
        None if drone is None else int(drone), head[3].decode(), argument.decode("ascii", "replace"), payload
    )


def _excerpt(buffer: bytes | bytearray) -> str:
    return repr(bytes(buffer[:40]))
