"""Light programs: every command against its effect in libskybrush, and back."""

import base64

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazysim.errors import ConfigError
from crazysim.lab.show_files import Lights, decode_lights, encode_lights, led

RED, GREEN, WHITE, BLACK = (1, 0, 0), (0, 1, 0), (1, 1, 1), (0, 0, 0)


LONG_LIGHTS = Lights.of_pieces(np.arange(64.0), np.zeros((64, 3)))
"""Lights with as many pieces as any test needs; lights stacked with it are all evaluated by one compiled function."""


def colors(program, *times, **options):
    """Return the colours of a light program at times, s."""
    lights = Lights.stack([decode_lights(bytes(program), **options), LONG_LIGHTS])
    return np.round(lights.colors(np.resize(times, 10))[: len(times), 0], 4)


CASES = {  # program, times, colours
    "set colour for 3 s": ([4, 255, 0, 0, 0x96, 0x01, 7, 0, 0], [0, 2.99, 3.0], [RED, RED, WHITE]),
    "set grey": ([5, 51, 50, 0], [0, 99], [(0.2,) * 3] * 2),
    "set black and white": ([7, 50, 6, 50, 7, 0, 0], [0.5, 1.5, 2.0], [WHITE, BLACK, WHITE]),
    "fade to colour": ([8, 255, 0, 0, 50, 0], [0, 0.5, 1.0, 5.0], [BLACK, (0.5, 0, 0), RED, RED]),
    "fade to grey": ([9, 102, 50, 0], [0.5, 2.0], [(0.2,) * 3, (0.4,) * 3]),
    "fades to white and black": ([11, 50, 10, 100, 0], [0.5, 1.0, 2.0, 3.0], [(0.5,) * 3, WHITE, (0.5,) * 3, BLACK]),
    "fade in no time": ([8, 255, 0, 0, 0, 2, 50, 0], [0.0], [RED]),
    "fade after a jump of colour": ([7, 0, 8, 255, 0, 0, 50, 0], [0.0, 0.5, 1.0], [WHITE, (1, 0.5, 0.5), RED]),
    "sleep": ([7, 50, 2, 50, 6, 0, 0], [1.5, 2.0], [WHITE, BLACK]),
    "wait until": ([7, 0, 3, 100, 6, 0, 3, 50, 7, 0, 0], [1.99, 2.0], [WHITE, WHITE]),
    "wait until with a later clock": ([7, 50, 14, 3, 50, 6, 0, 0], [1.99, 2.0], [WHITE, BLACK]),
    "loop of two": ([12, 2, 7, 50, 6, 50, 13, 4, 255, 0, 0, 0, 0], [0, 1, 2, 3, 4], [WHITE, BLACK, WHITE, BLACK, RED]),
    "loop in a loop": (
        [12, 2, 12, 2, 7, 25, 6, 25, 13, 4, 0, 255, 0, 50, 13, 0],
        [0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 3.5, 5.0],
        [WHITE, BLACK, WHITE, BLACK, GREEN, WHITE, BLACK, GREEN],
    ),
    "endless loop": ([12, 0, 7, 50, 6, 50, 13, 0], [0, 1, 8, 9], [WHITE, BLACK, WHITE, BLACK]),
    "jump": ([7, 50, 6, 50, 18, 0], [0, 1, 8, 9], [WHITE, BLACK, WHITE, BLACK]),
    "jump over a command": ([18, 4, 7, 50, 4, 255, 0, 0, 50, 0], [0], [RED]),
    "colours from channels": ([7, 50, 16, 0, 1, 2, 50, 0], [0, 1], [WHITE, BLACK]),
    "fade to colours from channels": ([7, 0, 17, 0, 1, 2, 50, 0], [0, 0.5, 1], [WHITE, (0.5,) * 3, BLACK]),
    "triggers without and with an address": ([19, 0x0F, 19, 0x30, 0, 7, 50, 0], [0], [WHITE]),
    "pyro and nop": ([20, 0x81, 21, 0, 1, 7, 0, 0], [0], [WHITE]),
    "no end": ([7, 0], [0, 9], [WHITE, WHITE]),
    "nothing": ([], [0, 9], [BLACK, BLACK]),
}


@pytest.mark.parametrize(("program", "times", "expected"), CASES.values(), ids=CASES)
def test_light_commands_give_their_colours(program, times, expected):
    np.testing.assert_allclose(colors(program, *times, until=10.0), expected, atol=1e-4)


def test_all_commands_of_the_table_are_covered():
    covered = {code for program, *_ in CASES.values() for code in program}
    assert set(range(0x16)) - {0x0F} <= covered


PUBLIC = "DAMHBQYFDQwACAAA/zIKMgj/AAAyCjIIAP8AMgoyCP//ADIKMggA//8yCjII/wD/MgoyCzIKMg0A"
"""color_cycle.json of pyledctrl's tests: three white flashes, then fades to blue, red, green, ... and back to black."""


def test_a_public_light_program_gives_its_colours():
    lights = Lights.stack([decode_lights(PUBLIC, 20.0)])
    result = lights.colors([0.05, 0.15, 0.25, 0.6, 1.1, 1.6, 3.1, 3.6, 13.6, 14.6])[:, 0]
    blue, red = (0, 0, 1), (1, 0, 0)
    expected = [WHITE, BLACK, WHITE, BLACK, (0, 0, 0.5), blue, (0.5, 0, 0), red, WHITE, BLACK]
    np.testing.assert_allclose(result, expected, atol=1e-4)


WRONG_PROGRAMS = [
    ([7, 1, 0x16], "0x16"),
    ([0x0F], "0x0f"),
    ([4, 1, 2], "argument"),
    ([2, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x00], "at most 268435455"),
    ([2, 0xFF, 0xFF, 0xFF, 0xFF, 0x0F], "at most 268435455"),
    ([13], "start of a loop"),
    ([12, 2] * 5, "at most 4 deep"),
    ([12, 0, 13], "at most"),
    ([18, 0], "at most"),
    ([12, 255] * 4 + [1] + [13] * 4, "at most"),
    ([18, 100], "byte 100"),
]
"""Bytes of programs that are refused, and words of the error."""


def test_programs_are_bytes_or_base64():
    assert np.array_equal(decode_lights(base64.b64encode(bytes([7, 0])).decode()).starts[-1], WHITE)


@given(st.binary(max_size=60))
def test_any_program_is_decoded_or_refused(program):
    try:
        lights = decode_lights(program, 60.0, max_repeated=2000)
    except ConfigError:
        return
    assert np.all(np.diff(lights.times) >= 0)
    assert np.all((lights.starts >= 0) & (lights.ends <= 1))


pieces = st.lists(
    st.tuples(
        st.integers(1, 400), st.tuples(*[st.integers(0, 255)] * 3), st.tuples(*[st.integers(0, 255)] * 3), st.booleans()
    ),
    min_size=1,
    max_size=8,
)


@given(pieces)
def test_lights_survive_the_code(pieces):
    times = 0.02 * np.cumsum([0] + [length for length, *_ in pieces])
    begins = np.array([first for _, first, _, _ in pieces] + [pieces[-1][2]]) / 255
    ends = np.array([last if fades else first for _, first, last, fades in pieces] + [pieces[-1][2]]) / 255
    lights = Lights.of_pieces(times, begins, ends)
    decoded = decode_lights(encode_lights(lights), until=1e4)
    sampled = Lights.stack([decoded, lights, LONG_LIGHTS]).colors(np.linspace(0.0, times[-1] + 1.0, 500))
    np.testing.assert_allclose(sampled[:, 0], sampled[:, 1], atol=1e-4)


def test_encoded_lights_use_the_shortest_commands():
    white = Lights.of_pieces([0.0, 1.0, 2.0, 3.0], [(1, 1, 1), (0, 0, 0), (0.2,) * 3, (1, 0, 0)])
    assert list(encode_lights(white)) == [
        led.SET_WHITE,
        50,
        led.SET_BLACK,
        50,
        led.SET_GRAY,
        51,
        50,
        4,
        255,
        0,
        0,
        0,
        0,
    ]


@pytest.mark.parametrize("make, remedy", [
    (lambda: Lights.of_pieces([0.0], [[255, 0, 0]]), "0 to 1"),
    (lambda: Lights.of_pieces([1.0, 0.0], np.zeros((2, 3))), "ascending"),
    (lambda: Lights.of_pieces([0.0], np.zeros((2, 3))), "shapes"),
    (lambda: encode_lights(Lights.stack([Lights.constant()])), "one drone"),
    (lambda: Lights.stack([]), "at least one drone"),
    (lambda: decode_lights("?"), "base64"),
    (lambda: decode_lights(bytes(2**20 + 1)), "at most 1048576 bytes"),
    *[(lambda x=program: decode_lights(bytes(x)), words) for program, words in WRONG_PROGRAMS],
])  # fmt: skip
def test_wrong_lights_and_programs_are_refused(make, remedy):
    with pytest.raises(ConfigError, match=remedy):
        make()
