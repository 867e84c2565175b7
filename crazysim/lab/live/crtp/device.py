"""A simulated Crazyflie for cflib: it answers packets, and sends logs and console text by itself.

Ports, channels and layouts are as in cflib 0.1.34 and crazyflie-firmware, protocol version 12. A packet is a header
byte with port and channel, then up to 30 bytes of data. Malformed packets are reported and ignored.
"""

from __future__ import annotations

import errno
import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from crazysim.control import Control
from crazysim.errors import ConfigError
from crazysim.lab.live.crtp.setpoints import handle_generic, handle_high_level
from crazysim.lab.live.crtp.tables import (
    LOG_TYPES,
    PARAM_TYPES,
    Reading,
    Table,
    Variable,
    create_log_table,
    pack_number,
    supervisor_bits,
)
from crazysim.lab.live.swarm import Swarm

PROTOCOL_VERSION = 12
"""Version of the protocol."""
MAX_DATA_BYTES = 30
"""Largest number of bytes after the header."""
MAX_LOG_BLOCKS, MAX_LOG_VARIABLES = 16, 128
"""Largest number of log blocks, and of the variables in all of them together (``Log`` of cflib)."""
MAX_LOG_BYTES = 26
"""Largest number of bytes of the values of a log block."""
MEMORY_SIZE = 4096
"""Size of the memory of trajectories, bytes."""
TRAJECTORY_MEMORY, LED_MEMORY, DECK_MEMORY = 0x12, 0x10, 0x19
"""Types of the memories of trajectories, of the LED ring and of decks (``MemoryElement`` of cflib)."""
DECK_MEMORY_CONTENT = bytes([3]) + bytes(8 * 32)
"""Content of the memory of decks: its version, and eight invalid descriptions, since no deck has memory."""
MAX_CONSOLE_PACKETS = 256
"""Largest number of packets of console text that wait for a client; if there are more, the oldest are dropped."""

CONSOLE, PARAM, COMMANDER, MEM, LOGGING, LOCALIZATION, GENERIC, HIGH_LEVEL, SUPERVISOR, PLATFORM, LINK = (
    0, 2, 3, 4, 5, 6, 7, 8, 9, 13, 15,
)  # fmt: skip
"""Ports of CRTP."""

Packet = tuple[int, int, bytes]
"""Port, channel and data."""


@dataclass
class LogBlock:
    """Log variables that are sent together in one packet."""

    variables: list[tuple[int, str]]
    """Number in the table of log variables, and format of ``struct``, of each variable."""
    period: float | None = None
    """Time between two packets, s; None while the block is stopped."""
    next_time: float = 0.0
    """Time of the next packet, s."""


class CrtpDevice:
    """One drone of a swarm, for one client."""

    def __init__(self, swarm: Swarm, drone: int | str, log: dict[str, tuple[str, Reading]] | None = None):
        self.swarm = swarm
        self.drone = swarm.index(drone) if isinstance(drone, str) else drone
        self.name, self.commander = swarm.names[self.drone], swarm.commanders[self.drone]
        self.readings = create_log_table(swarm, self.drone) | (log or {})
        self.log = Table([Variable(name, ctype) for name, (ctype, _) in self.readings.items()], LOG_TYPES)
        self.param_values = swarm.parameters[self.drone]
        definitions = self.param_values.definitions.items()
        self.params = Table([Variable(name, x.ctype, x.read_only) for name, x in definitions], PARAM_TYPES)
        self.memory = bytearray(MEMORY_SIZE)
        self.memories = [
            (TRAJECTORY_MEMORY, self.memory),
            (LED_MEMORY, bytearray(24)),
            (DECK_MEMORY, DECK_MEMORY_CONTENT),
        ]
        self._console: deque[bytes] = deque(maxlen=MAX_CONSOLE_PACKETS)
        self.blocks: dict[int, LogBlock] = {}
        self._handlers: dict[int, Callable[[int, bytes], list[Packet]]] = {
            PARAM: self._handle_param, COMMANDER: self._handle_setpoint, MEM: self._handle_memory,
            LOGGING: self._handle_logging, LOCALIZATION: self._handle_localization, GENERIC: self._handle_generic,
            HIGH_LEVEL: self._handle_high_level, SUPERVISOR: self._handle_supervisor, PLATFORM: self._handle_platform,
            LINK: self._handle_link,
        }  # fmt: skip

    # Packets --------------------------------------------------------------------------------------------------------

    def handle(self, packet: bytes) -> list[bytes]:
        """Return the answers to a packet of any content."""
        if not packet:
            return []
        if packet == b"\xff":  # probe of a scan
            return [b"\xff"]
        port, channel, data = packet[0] >> 4, packet[0] & 3, bytes(packet[1:])
        handler = self._handlers.get(port)
        with self.swarm.lock:
            if handler is None or len(data) > MAX_DATA_BYTES:
                self._report(f"packet to port {port} with {len(data)} bytes")
                return []
            try:
                return [bytes([p << 4 | 0x0C | c]) + d for p, c, d in handler(channel, data)]
            except ConfigError as error:
                self._report(str(error))
            except (struct.error, IndexError, ValueError):
                self._report(f"packet of a wrong form to port {port}, channel {channel}: {data.hex()}")
            return []

    def due_packets(self) -> list[bytes]:
        """Return the packets that are due at the swarm's time: console text and logs."""
        now, packets = self.swarm.time, []
        with self.swarm.lock:
            while self._console:
                packets.append(bytes([CONSOLE << 4 | 0x0C]) + self._console.popleft())
            state = self.commander.estimate(self.swarm.state(self.drone))
            for block_id, block in self.blocks.items():
                if block.period is None or now < block.next_time - 1e-9:
                    if block.period is not None and block.next_time - now > block.period:  # after a reset
                        block.next_time = now
                    continue
                block.next_time = max(block.next_time + block.period, now)
                stamp = struct.pack("<I", round(now * 1000) & 0xFFFFFF)[:3]
                values = b"".join(self._pack_value(k, struct_format, state) for k, struct_format in block.variables)
                packets.append(bytes([LOGGING << 4 | 0x0C | 2, block_id]) + stamp + values)
        return packets

    def _pack_value(self, k: int, struct_format: str, state: object) -> bytes:
        name = self.log.variables[k].name
        try:
            value = float(self.readings[name][1](state, self.commander))  # type: ignore[arg-type]
        except Exception as error:  # raised by a reading that a user has added
            self.swarm.reports.add("refused", self.name, self.swarm.time, f"log variable {name} failed: {error}")
            value = math.nan
        return pack_number(struct_format, value)

    def _report(self, text: str) -> None:
        self.swarm.reports.add("refused", self.name, self.swarm.time, text)
        line = f"{text}\n".encode("ascii", "replace")
        self._console.extend(line[k : k + MAX_DATA_BYTES] for k in range(0, len(line), MAX_DATA_BYTES))

    # Connection -----------------------------------------------------------------------------------------------------

    def _handle_link(self, channel: int, data: bytes) -> list[Packet]:
        if channel == 0:
            return [(LINK, 0, data)]
        return [(LINK, 1, b"Bitcraze Crazyflie".ljust(MAX_DATA_BYTES, b"\0"))] if channel == 1 else []

    def _handle_platform(self, channel: int, data: bytes) -> list[Packet]:
        if channel == 1 and data[0] == 0:
            return [(PLATFORM, 1, bytes([0, PROTOCOL_VERSION]))]
        if channel == 1 and data[0] == 1:
            return [(PLATFORM, 1, b"\x01crazysim\0")]
        if channel == 0 and data[0] == 1:
            self.commander.arm(bool(data[1]))
            return [(PLATFORM, 0, bytes([1, 1, self.commander.armed]))]
        return []

    def _handle_supervisor(self, channel: int, data: bytes) -> list[Packet]:
        command = data[0]
        if channel == 0 and command == 0x0C:
            return [(SUPERVISOR, 0, bytes([0x8C]) + struct.pack("<H", supervisor_bits(self.commander)))]
        if channel == 1 and command == 1:
            self.commander.arm(bool(data[1]))
            return [(SUPERVISOR, 1, bytes([0x81, 1, self.commander.armed]))]
        if channel == 1 and command == 2:
            return [(SUPERVISOR, 1, bytes([0x82, 0, not self.commander.locked]))]
        if channel == 1 and command == 3:
            self.commander.emergency()
        return []

    def _handle_localization(self, channel: int, data: bytes) -> list[Packet]:
        if channel == 1 and data[0] == 3:
            self.commander.emergency()
        return []  # positions from outside are not needed: the simulation has its own

    # Setpoints ------------------------------------------------------------------------------------------------------

    def _handle_setpoint(self, channel: int, data: bytes) -> list[Packet]:
        # crtp_commander_rpyt.c reads pitch and yaw rate with the opposite sign, and yaw with the sign of the world
        # frame.
        roll, pitch, yaw, thrust = struct.unpack("<fffH", data)
        if thrust == 0:
            self.commander.stop()
        elif any(self.param_values[f"flightmode.stabMode{axis}"] == 0 for axis in ("Roll", "Pitch")):
            self.commander.command(Control.body_rate, [*_radians(roll, -pitch, -yaw), self._collective_thrust(thrust)])
        elif self.param_values["flightmode.stabModeYaw"]:
            self.commander.command(Control.attitude, [*_radians(roll, -pitch, yaw), self._collective_thrust(thrust)])
        else:
            self.commander.attitude(*_radians(roll, -pitch, -yaw), self._collective_thrust(thrust))
        return []

    def _collective_thrust(self, thrust: int) -> float:
        airframe = self.swarm.sim.airframes[self.drone]
        return thrust / 65535 * airframe.n_rotors * float(np.max(airframe.value("rotors.thrust_max")))

    def _handle_generic(self, channel: int, data: bytes) -> list[Packet]:
        if channel == 1 and data[0] == 0:
            self.commander.notify_setpoints_stop(struct.unpack("<I", data[1:5])[0] / 1000)
        elif channel == 0 and data[0] == 11:
            roll, pitch, yaw_rate, thrust, is_rate_mode = struct.unpack("<fffHB", data[1:])
            angles = _radians(roll, -pitch, yaw_rate)
            if is_rate_mode:
                self.commander.command(Control.body_rate, [*angles, self._collective_thrust(thrust)])
            else:
                self.commander.attitude(*angles, self._collective_thrust(thrust))
        elif channel == 0:
            handle_generic(self.commander, data)
        return []

    def _handle_high_level(self, channel: int, data: bytes) -> list[Packet]:
        try:
            handle_high_level(self.commander, data, bytes(self.memory))
            code = 0
        except ConfigError as error:
            self._report(str(error))
            code = errno.ENOEXEC
        return [(HIGH_LEVEL, 0, (data[:3]).ljust(3, b"\0") + bytes([code]))]

    # Tables ---------------------------------------------------------------------------------------------------------

    def _answer_table_request(self, port: int, table: Table, data: bytes) -> list[Packet]:
        if data[0] == 3:
            header = struct.pack("<BHI", 3, len(table.variables), table.checksum)
            return [(port, 0, header + (bytes([MAX_LOG_BLOCKS, MAX_LOG_VARIABLES]) if port == LOGGING else b""))]
        (k,) = struct.unpack("<H", data[1:3])
        return [(port, 0, data[:3] + table.describe(k))] if data[0] == 2 and k < len(table.variables) else []

    def _handle_logging(self, channel: int, data: bytes) -> list[Packet]:
        if channel == 0:
            return self._answer_table_request(LOGGING, self.log, data)
        if channel != 1:
            return []
        command, block_id = data[0], data[1] if len(data) > 1 else 0
        if command == 5:
            self.blocks.clear()
            return [(LOGGING, 1, bytes([5, 0, 0]))]
        if command in (6, 7):
            code = self._define_block(command, block_id, data[2:])
        elif block_id not in self.blocks:
            code = errno.ENOENT
        elif command == 2:
            del self.blocks[block_id]
            code = 0
        elif command in (3, 8):
            period_ms = 10 * data[2] if command == 3 else struct.unpack("<H", data[2:4])[0]
            block = self.blocks[block_id]
            code = 0 if period_ms > 0 else errno.ENOEXEC
            if period_ms > 0:
                block.period, block.next_time = period_ms / 1000, self.swarm.time + period_ms / 1000
        elif command == 4:
            self.blocks[block_id].period, code = None, 0
        else:
            code = errno.ENOEXEC
        return [(LOGGING, 1, bytes([command, block_id, code]))]

    def _define_block(self, command: int, block_id: int, data: bytes) -> int:
        if command == 6 and block_id in self.blocks:
            return errno.EEXIST
        if command == 7 and block_id not in self.blocks:
            return errno.ENOENT
        formats = {number: struct_format for number, struct_format in LOG_TYPES.values()}
        new_variables = []
        for kind, k in struct.iter_unpack("<BH", data):
            if k >= len(self.log.variables) or kind & 15 not in formats:
                return errno.ENOENT
            new_variables.append((k, formats[kind & 15]))
        block = self.blocks.get(block_id, LogBlock([]))
        variables = block.variables + new_variables
        if sum(struct.calcsize(struct_format) for _, struct_format in variables) > MAX_LOG_BYTES:
            return errno.E2BIG
        n_others = sum(len(other.variables) for i, other in self.blocks.items() if i != block_id)
        if len(self.blocks | {block_id: block}) > MAX_LOG_BLOCKS or n_others + len(variables) > MAX_LOG_VARIABLES:
            return errno.ENOMEM
        block.variables = variables
        self.blocks[block_id] = block
        return 0

    def _handle_param(self, channel: int, data: bytes) -> list[Packet]:
        if channel == 0:
            return self._answer_table_request(PARAM, self.params, data)
        if channel == 3:
            return self._handle_param_misc(data)
        (k,) = struct.unpack("<H", data[:2])
        if k >= len(self.params.variables):
            return [(PARAM, channel, data[:2] + bytes([errno.ENOENT]))]
        name, struct_format = self.params.variables[k].name, self.params.format(k)
        if channel == 1:
            return [(PARAM, 1, data[:2] + b"\0" + pack_number(struct_format, self.param_values[name]))]
        self._set_parameter(name, struct.unpack(struct_format, data[2:])[0])
        return [(PARAM, 2, data[:2] + pack_number(struct_format, self.param_values[name]))]

    def _handle_param_misc(self, data: bytes) -> list[Packet]:
        command = data[0]
        if command == 0:
            group, name, payload = data[1:].split(b"\0", 2)
            full_name = f"{group.decode()}.{name.decode()}"
            code = errno.ENOENT
            formats = {number: struct_format for number, struct_format in PARAM_TYPES.values()}
            if full_name in self.param_values and payload[0] in formats:
                self._set_parameter(full_name, struct.unpack(formats[payload[0]], payload[1:])[0])
                code = 0
            return [(PARAM, 3, data[: len(data) - len(payload)] + bytes([code]))]
        (k,) = struct.unpack("<H", data[1:3])
        if command == 8 and k < len(self.params.variables):
            value = self.param_values.definitions[self.params.variables[k].name].value
            return [(PARAM, 3, data[:3] + b"\0" + pack_number(self.params.format(k), value))]
        return [(PARAM, 3, data[:3] + bytes([errno.ENOENT]))]

    def _set_parameter(self, name: str, value: float) -> None:
        try:
            self.swarm.set_parameter(self.drone, name, value)
        except ConfigError as error:
            self._report(str(error))

    def _handle_memory(self, channel: int, data: bytes) -> list[Packet]:
        if channel == 0:
            if data[0] == 1:
                return [(MEM, 0, bytes([1, len(self.memories)]))]
            if data[0] == 2 and data[1] < len(self.memories):
                kind, content = self.memories[data[1]]
                return [(MEM, 0, data[:2] + struct.pack("<BI8x", kind, len(content)))]
            return [(MEM, 0, data[:2])]
        memory_id, address = struct.unpack("<BI", data[:5])
        kind, memory = self.memories[memory_id] if memory_id < len(self.memories) else (0, b"")
        content = data[5:]
        length = content[0] if channel == 1 else len(content)
        is_valid = address + length <= len(memory) and length <= 24
        if channel == 1:
            answer = bytes(memory[address : address + length]) if is_valid else b""
            return [(MEM, 1, data[:5] + bytes([0 if is_valid else errno.EIO]) + answer)]
        if channel != 2:
            return []
        if not isinstance(memory, bytearray):
            is_valid = False
        elif is_valid:
            memory[address : address + length] = content
            if kind == LED_MEMORY:
                self.swarm.set_leds(self.drone, np.frombuffer(memory, ">u2"))
        return [(MEM, 2, data[:5] + bytes([0 if is_valid else errno.EIO]))]


def _radians(roll: float, pitch: float, yaw: float) -> tuple[float, float, float]:
    return math.radians(roll), math.radians(pitch), math.radians(yaw)
