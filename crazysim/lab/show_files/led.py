"""Skybrush's light programs: byte code that drones run to control their LEDs.

Commands and arguments are as in libskybrush (``src/lights/commands.h``, ``commands.cpp``), and their effects as in its
``executor.cpp``; pyledctrl compiles the same code. Durations and times are LEB128 varints in units of 20 ms.
"""

from __future__ import annotations

import base64
import binascii

import numpy as np

from crazysim.errors import ConfigError, require
from crazysim.lab.show_files.lights import Lights

TIME_UNIT = 0.02
"""Unit of times and durations, s."""
MAX_BYTES = 2**20
"""Longest program, bytes."""
MAX_REPEATED_COMMANDS = 200_000
"""Largest number of commands that the loops and jumps of a program may repeat."""
MAX_LOOPS = 4
"""Deepest nesting of loops, libskybrush's ``CONFIG_MAX_LOOP_DEPTH``."""
MAX_VARINT = 2**28 - 1
"""Largest duration or address, as in pyledctrl's compiler."""

END, NOP, SLEEP, WAIT_UNTIL = 0x00, 0x01, 0x02, 0x03
SET_COLOR, SET_GRAY, SET_BLACK, SET_WHITE = 0x04, 0x05, 0x06, 0x07
FADE_TO_COLOR, FADE_TO_GRAY, FADE_TO_BLACK, FADE_TO_WHITE = 0x08, 0x09, 0x0A, 0x0B
LOOP_BEGIN, LOOP_END, RESET_CLOCK = 0x0C, 0x0D, 0x0E
SET_COLOR_FROM_CHANNELS, FADE_TO_COLOR_FROM_CHANNELS = 0x10, 0x11
JUMP, TRIGGERED_JUMP, SET_PYRO, SET_PYRO_ALL = 0x12, 0x13, 0x14, 0x15
"""Byte codes of the commands."""

BLACK, WHITE = (0, 0, 0), (255, 255, 255)
"""Colours, red, green and blue, 0 to 255."""


def decode_lights(
    program: bytes | str,
    until: float = 3600.0,
    location: str = "a light program",
    max_repeated: int = MAX_REPEATED_COMMANDS,
) -> Lights:
    """Decode the lights of a light program.

    A simulated drone has no remote control and no pyrotechnics. Colours from channels of a remote control are therefore
    black, as in libskybrush without channels. Triggers never fire, and pyro commands do nothing.

    Args:
        program: Byte code, or its base64 form as in ``lights.json``.
        until: Time at which the program is stopped, s; endless loops end there.
        location: File and location in it, for messages.
        max_repeated: Largest number of commands that loops and jumps may repeat.
    """
    if isinstance(program, str):
        try:
            program = base64.b64decode(program, validate=True)
        except (binascii.Error, ValueError) as error:
            raise ConfigError(f"expected base64 in {location}, got {str(error)[:60]}") from error
    require(len(program) <= MAX_BYTES, f"expected at most {MAX_BYTES} bytes in {location}, got {len(program)}")
    machine = _Machine(program, location)
    machine.run(round(until / TIME_UNIT), len(program) + max_repeated)
    return machine.lights()


class _Machine:
    """State of a running program."""

    def __init__(self, code: bytes, location: str):
        self.code, self.location, self.address = code, location, 0
        self.now = self.origin = 0  # time, and time of the last RESET_CLOCK, in units of TIME_UNIT
        self.color = BLACK
        self.loops: list[tuple[int, int]] = []  # address of the body, iterations left; 0 for endless
        self.pieces: list[tuple[int, tuple, tuple]] = [(0, BLACK, BLACK)]  # start, colours at the start and at the end

    def raise_error(self, expected: str, got: str) -> None:
        raise ConfigError(f"expected {expected}, got {got} in {self.location}, byte {self.address}")

    def read_byte(self) -> int:
        if self.address >= len(self.code):
            self.raise_error("an argument", "the end of the program")
        self.address += 1
        return self.code[self.address - 1]

    def read_varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.read_byte()
            value |= (byte & 0x7F) << shift
            shift += 7
            if value > MAX_VARINT or shift > 35:
                self.raise_error(f"a number of at most {MAX_VARINT}", "a larger one")
            if byte < 0x80:
                return value

    def run(self, end: int, max_commands: int) -> None:
        for _ in range(max_commands):
            if self.address >= len(self.code) or self.now > end or not self.run_command(self.read_byte()):
                return
        self.raise_error(f"a program that runs at most {max_commands} commands in {end * TIME_UNIT:g} s", "more")

    def run_command(self, code: int) -> bool:
        # False at the end of the program.
        if code == END:
            return False
        if code in (NOP, SET_PYRO, SET_PYRO_ALL):
            self.address += code != NOP
        elif code == SLEEP:
            self.now += self.read_varint()
        elif code == WAIT_UNTIL:
            self.now = max(self.now, self.origin + self.read_varint())
        elif code == RESET_CLOCK:
            self.origin = self.now
        elif SET_COLOR <= code <= FADE_TO_WHITE or code in (SET_COLOR_FROM_CHANNELS, FADE_TO_COLOR_FROM_CHANNELS):
            self.set_color(code)
        elif code == LOOP_BEGIN:
            if len(self.loops) == MAX_LOOPS:
                self.raise_error(f"loops nested at most {MAX_LOOPS} deep", "a further one")
            iterations = self.read_byte()
            self.loops.append((self.address, iterations))
        elif code == LOOP_END:
            self.end_loop()
        elif code == JUMP:
            self.jump(self.read_varint())
        elif code == TRIGGERED_JUMP:
            if self.read_byte() & 0x30:  # an address follows if the jump reacts to a rising or falling edge
                self.read_varint()
        else:
            self.address -= 1
            self.raise_error("a command of Skybrush's light programs, 0x00 to 0x15", f"0x{code:02x}")
        return True

    def set_color(self, code: int) -> None:
        is_fade = FADE_TO_COLOR <= code <= FADE_TO_WHITE or code == FADE_TO_COLOR_FROM_CHANNELS
        if code in (SET_COLOR, FADE_TO_COLOR):
            color = (self.read_byte(), self.read_byte(), self.read_byte())
        elif code in (SET_GRAY, FADE_TO_GRAY):
            color = (self.read_byte(),) * 3
        elif code in (SET_WHITE, FADE_TO_WHITE):
            color = WHITE
        else:
            if code in (SET_COLOR_FROM_CHANNELS, FADE_TO_COLOR_FROM_CHANNELS):
                _ = self.read_byte(), self.read_byte(), self.read_byte()
            color = BLACK
        duration = self.read_varint()
        if is_fade and duration:
            self.pieces.append((self.now, self.color, color))
            self.now += duration
            self.pieces.append((self.now, color, color))
        else:
            if self.pieces[-1][1:] != (color, color):  # loops of one colour need one piece
                self.pieces.append((self.now, color, color))
            self.now += duration
        self.color = color

    def end_loop(self) -> None:
        if not self.loops:
            self.raise_error("the start of a loop in front of its end", "none")
        start, iterations_left = self.loops.pop()
        if iterations_left != 1:
            self.loops.append((start, max(iterations_left - 1, 0)))
            self.address = start

    def jump(self, address: int) -> None:
        if address >= len(self.code):
            self.raise_error(f"a jump to one of {len(self.code)} bytes", f"one to byte {address}")
        self.address = address
        self.loops.clear()

    def lights(self) -> Lights:
        # Of pieces that begin at the same time, only the last is used.
        piece_colors = {start: (a, b) for start, a, b in self.pieces}
        starts, colors = list(piece_colors), np.array(list(piece_colors.values()), float) / 255
        return Lights.of_pieces(TIME_UNIT * np.array(starts), colors[:, 0], colors[:, 1])


def encode_lights(lights: Lights) -> bytes:
    """Encode one drone's lights as a light program, with colours of 8 bits and times in steps of 20 ms.

    Args:
        lights: Lights of one drone.
    """
    times, starts, ends = (np.asarray(x, float) for x in (lights.times, lights.starts, lights.ends))
    require(times.ndim == 1, f"expected the lights of one drone, got shape {times.shape}. Encode one drone at a time.")
    unit_times = np.maximum(np.round((times - min(times[0], 0.0)) / TIME_UNIT), 0).astype(int)
    start_colors, end_colors = np.round(255 * starts).astype(int), np.round(255 * ends).astype(int)
    code = bytearray()
    color = None
    if unit_times[0] > 0:
        code += _encode_color(SET_COLOR, start_colors[0], unit_times[0])
    for k, start in enumerate(unit_times):
        duration = unit_times[k + 1] - start if k + 1 < len(unit_times) else 0
        if k + 1 < len(unit_times) and not duration:
            continue  # padding, or a piece shorter than a unit of time
        is_fade = duration and not np.array_equal(start_colors[k], end_colors[k])
        if is_fade:
            if color is None or not np.array_equal(color, start_colors[k]):
                code += _encode_color(SET_COLOR, start_colors[k], 0)
            code += _encode_color(FADE_TO_COLOR, end_colors[k], duration)
            color = end_colors[k]
        else:
            code += _encode_color(SET_COLOR, start_colors[k], duration)
            color = start_colors[k]
    code.append(END)
    return bytes(code)


def _encode_color(code: int, color: np.ndarray, duration: int) -> bytes:
    red, green, blue = (int(x) for x in color)
    if (red, green, blue) == BLACK:
        head = [code + 2]
    elif (red, green, blue) == WHITE:
        head = [code + 3]
    elif red == green == blue:
        head = [code + 1, red]
    else:
        head = [code, red, green, blue]
    return bytes(head) + _encode_varint(int(duration))


def _encode_varint(value: int) -> bytes:
    require(
        value <= MAX_VARINT,
        f"expected durations of at most {MAX_VARINT * TIME_UNIT:g} s, got {value * TIME_UNIT:g} s. "
        "Split longer pieces.",
    )
    code = bytearray()
    while value >= 0x80:
        code.append(value & 0x7F | 0x80)
        value >>= 7
    code.append(value)
    return bytes(code)
