"""Messages in a stream that is split anywhere, and bytes that are not messages."""

import json
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazysim.lab.live import framing
from crazysim.lab.live.framing import FramingError, Message, MessageBuffer, Request, ShowFile

TRICKY_VALUE = {"name": '_EOF "quoted\\" {', "odd": '" {', "a_b": {"points": [[0.0, [1, 2, 3], []]]}, "SKYC": "START"}
"""JSON value that contains the delimiters of messages."""
JSON = json.dumps(TRICKY_VALUE).encode()
ARCHIVE = (
    b"PK\x03\x04 data with SKYC and PK\x05\x06 inside" + bytes(30) + b"PK\x05\x06" + bytes(16) + b"\x04\x00" + b"note"
)
STREAM = [
    (b"07_CMDSTART_upload_" + JSON + b"_EOF", Message(7, "upload", "", JSON)),
    (b"07_CMDSTART_takeoff_0.5000_EOF", Message(7, "takeoff", "0.5000")),
    (b"07_CMDSTART_land_EOF\n", Message(7, "land", "")),
    (b"00_CMDSTART_start_absolute_EOF", Message(0, "start", "absolute")),
    (b"00_CMDSTART_show_EOF", Message(0, "show", "")),
    (b"START", Message(None, "show", "")),
    (ARCHIVE + b"SKYC", ShowFile(ARCHIVE)),
    (b"REQ_06", Request(6)),
    (b"CMDSTART_param_stabilizer.controller=1_EOF", Message(None, "param", "stabilizer.controller=1")),
    (b"CMDSTART_param_ctrl_mel.kp_xy=0.4_EOF", Message(None, "param", "ctrl_mel.kp_xy=0.4")),
    (b"CMDSTART_4_traj_relative_" + JSON + b"_EOF", Message(4, "traj", "relative", JSON)),
    (b"CMDSTART_hover_EOF", Message(None, "hover", "")),
]
"""Bytes that the lab's programs send, and the message that they encode."""
BYTES = b"".join(message for message, _ in STREAM)
EXPECTED = [expected for _, expected in STREAM]


@pytest.mark.parametrize(("message", "expected"), STREAM, ids=[repr(m[:24]) for m, _ in STREAM])
def test_every_message_is_decoded(message, expected):
    buffer = MessageBuffer()
    assert list(buffer.feed(message)) == [expected]
    assert not buffer.has_partial_message or message.endswith(b"\n")


def test_messages_together_and_byte_by_byte():
    assert list(MessageBuffer().feed(BYTES)) == EXPECTED
    buffer = MessageBuffer()
    assert [message for k in range(len(BYTES)) for message in buffer.feed(BYTES[k : k + 1])] == EXPECTED


@given(st.lists(st.integers(0, len(BYTES)), max_size=12), st.permutations(range(len(STREAM))))
def test_messages_are_decoded_at_any_split_and_in_any_order(cuts, order):
    stream = b"".join(STREAM[k][0] for k in order)
    buffer, messages, start = MessageBuffer(), [], 0
    for end in [*sorted(cuts), len(stream)]:
        messages += buffer.feed(stream[start:end])
        start = end
    assert messages == [EXPECTED[k] for k in order]


def feed_all(buffer, parts):
    return [message for part in parts for message in buffer.feed(part)]


GARBAGE = {
    "text": b"hello",
    "HTTP": b"GET / HTTP/1.1\r\n",
    "zeros and more": bytes(10) + b"\x01",
    "ID without command": b"07_LAND_EOF",
    "capitals": b"07_CMDSTART_LAND_EOF",
    "long ID": b"12345_CMDSTART_land_EOF",
    "request without number": b"REQ_xy",
    "no end": b"07_CMDSTART_takeoff_" + b"0" * 300,
    "no end of JSON": b'07_CMDSTART_upload_{"a": 1}_ENDE',
    "much after JSON": b'07_CMDSTART_upload_{"a": 1}' + b" " * 20,
}


@pytest.mark.parametrize("garbage", GARBAGE.values(), ids=GARBAGE)
def test_garbage_is_refused(garbage):
    with pytest.raises(FramingError):
        list(MessageBuffer().feed(garbage))
    buffer = MessageBuffer()
    with pytest.raises(FramingError):
        feed_all(buffer, [garbage[k : k + 1] for k in range(len(garbage))])


def test_messages_before_garbage_are_returned():
    buffer = MessageBuffer().feed(b"07_CMDSTART_land_EOFhello")
    assert next(buffer) == Message(7, "land", "")
    with pytest.raises(FramingError):
        next(buffer)


def test_sizes_are_bounded(monkeypatch):
    monkeypatch.setattr(framing, "MAX_JSON", 1000)
    monkeypatch.setattr(framing, "MAX_SHOW", 1000)
    for start in (b"07_CMDSTART_upload_{", b"PK\x03\x04"):
        with pytest.raises(FramingError, match="at most 1000"):
            feed_all(MessageBuffer(), [start, *[b"a" * 50] * 30])


def test_long_messages_in_small_parts():
    """A megabyte of brackets, quotes and false ends."""
    body = b'{"a": "' + b'_EOF\\"PK\x05\x06' * 100_000 + b'"}'
    message, buffer = b"07_CMDSTART_upload_" + body + b"_EOF", MessageBuffer()
    messages = [x for k in range(0, len(message), 1000) for x in buffer.feed(message[k : k + 1000])]
    assert messages == [Message(7, "upload", "", body)]


parts = st.sampled_from(
    [
        b"07_",
        b"CMDSTART_",
        b"upload_",
        b"{",
        b"}",
        b'"',
        b"\\",
        b"_EOF",
        b"SKYC",
        b"START",
        b"REQ_",
        b"0",
        b"\xff",
        b" ",
    ]
    + [b"PK\x03\x04", b"PK\x05\x06", bytes(22)]
)


@given(st.lists(parts, max_size=40), st.integers(0, 10**6))
def test_any_bytes_are_messages_or_refused_however_they_are_split(pieces, seed):
    stream, rng = b"".join(pieces), random.Random(seed)

    def read(choose_size):
        buffer, messages, start = MessageBuffer(), [], 0
        try:
            while start < len(stream):
                n = choose_size()
                for message in buffer.feed(stream[start : start + n]):
                    messages.append(message)
                start += n
        except FramingError:
            messages.append(FramingError)
        return messages

    assert read(lambda: len(stream)) == read(lambda: rng.randint(1, 5))
