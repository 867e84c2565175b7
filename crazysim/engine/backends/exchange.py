"""Exchange of numbers between the lanes of a kernel: drones of one world are in one warp, block or set of vectors.

Functions and macros of the source are defined in ``targets/``. ``read_drone`` reads a number of another drone in a
register, ``read_place`` in memory, and ``EACH_VECTOR`` is a loop over the vectors of a world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir.blocks import Value

ReadFunction = Callable[[str], str]
"""Function from the index of a drone in its world to the expression of its published number."""

PublishedNumbers = Sequence[tuple[str, str]]
"""Pairs of the name of a type in the source and the expression of a number of that type."""

LiveValues = Sequence[tuple[Value, str]]
"""Pairs of a value and the name of its type in the source."""

TYPE_BYTES = {"f64": 8, "f32": 4, "i32": 4, "u32": 4, "b1": 1}
"""Sizes of numbers, bytes."""

WARP_THREADS = 32
"""Threads of a GPU that run together."""

BLOCK_SIZE = 64
"""Threads of a block on a GPU, where worlds fit into a warp."""

MAX_THREADS = 1024
"""Maximum number of threads of a block on a GPU."""

SHARED_MEMORY_BYTES = 48 * 1024
"""Memory that the threads of a block share, bytes."""

MAX_DRONES_IN_VECTOR = 8
"""Maximum number of drones of a world that are lanes of one vector on the host."""


class LineWriter(Protocol):
    """Source that is being written, line by line; ``source.Writer``."""

    names: dict[Value, str]
    """Expression of each value."""

    def write_line(self, text: str, depth: int) -> None: ...

    def new_name(self, prefix: str = ...) -> str: ...

    def forget_intermediate_results(self) -> None:
        """Forget intermediate results, after the loop in which their variables were defined was closed."""
        ...


class Exchange(Protocol):
    """A way in which lanes read each other's numbers."""

    depth: int
    """Number of loops in the source around the code of a lane."""

    def publish(self, writer: LineWriter, values: PublishedNumbers, live: LiveValues, depth: int) -> list[ReadFunction]:
        """Write the code that passes numbers to the other drones of a world, and return functions that read them.

        Args:
            live: Values that are defined here and used later, with their types.
            depth: Indentation of the lines.
        """
        ...

    def define_variable(self, writer: LineWriter, name: str, ctype: str, value: str, depth: int) -> str:
        """Define a number of a lane that changes, and return the expression for it."""
        ...

    def define_constant(self, writer: LineWriter, name: str, ctype: str, value: str, depth: int) -> str:
        """Define a number of a lane that does not change, and return the expression for it in all later code."""
        ...

    def open_loop(self, writer: LineWriter, depth: int) -> None: ...

    def close_loop(self, writer: LineWriter, depth: int) -> None: ...

    @property
    def declarations(self) -> list[str]:
        """Lines before the kernel."""
        ...


class UnsplitLane(Exchange):
    """Base of exchanges in which the code of a lane is not split, so that its variables stay defined."""

    depth = 0

    def define_variable(self, writer: LineWriter, name: str, ctype: str, value: str, depth: int) -> str:
        writer.write_line(f"auto {name} = {value};", depth)
        return name

    def define_constant(self, writer: LineWriter, name: str, ctype: str, value: str, depth: int) -> str:
        writer.write_line(f"const auto {name} = {value};", depth)
        return name

    def open_loop(self, writer: LineWriter, depth: int) -> None:
        pass

    def close_loop(self, writer: LineWriter, depth: int) -> None:
        pass


class Registers(UnsplitLane):
    """Lanes of one warp or vector, which read each other's registers."""

    def publish(self, writer: LineWriter, values: PublishedNumbers, live: LiveValues, depth: int) -> list[ReadFunction]:
        names = []
        for ctype, value in values:
            names.append(writer.new_name())
            writer.write_line(f"const auto {names[-1]} = {ctype}_lanes({value});", depth)
        return [lambda j, x=x: f"read_drone({x}, {j})" for x in names]

    @property
    def declarations(self) -> list[str]:
        return []


class SharedMemory(UnsplitLane):
    """Threads of one block of a GPU, which exchange numbers through the block's memory."""

    def __init__(self, lanes: int):
        if lanes > MAX_THREADS:
            raise UnsupportedError(
                f"the {lanes} drones of a world read each other's numbers; on a GPU at most {MAX_THREADS} can"
            )
        self.lanes = lanes
        self._struct_numbers: dict[str, int] = {}
        """Number of each struct of published numbers, by the source of its fields."""

    def publish(self, writer: LineWriter, values: PublishedNumbers, live: LiveValues, depth: int) -> list[ReadFunction]:
        order = sorted(range(len(values)), key=lambda k: -TYPE_BYTES[values[k][0]])
        fields = "".join(f"{values[k][0]} x{n}; " for n, k in enumerate(order))
        struct = f"Record{self._struct_numbers.setdefault(fields, len(self._struct_numbers))}"
        size = sum(math.ceil(_struct_bytes(fields) / 16) * 16 for fields in self._struct_numbers) * self.lanes
        if size > SHARED_MEMORY_BYTES:
            raise UnsupportedError(
                f"the drones of a block publish {size} bytes for each other, and a block's static shared memory has "
                f"{SHARED_MEMORY_BYTES}"
            )
        array = f"shared_{struct}"
        numbers = ", ".join(values[k][1] for k in order)
        writer.write_line("__syncthreads();", depth)
        writer.write_line(f"if (threadIdx.x < {self.lanes}) {array}[threadIdx.x] = {struct}{{{numbers}}};", depth)
        writer.write_line("__syncthreads();", depth)
        position = {k: n for n, k in enumerate(order)}
        return [lambda j, n=position[k]: f"{array}[world_start + {j}].x{n}" for k in range(len(values))]

    @property
    def declarations(self) -> list[str]:
        lines = []
        for fields, k in self._struct_numbers.items():
            lines.append(f"struct __align__(16) Record{k} {{ {fields}}};")
            lines.append(f"static __shared__ Record{k} shared_Record{k}[{self.lanes}];")
        return lines


class HostMemory(Exchange):
    """Several vectors of the host for a world, which exchange numbers through memory.

    Each part of a step is computed for all vectors before the next part begins. Numbers that later parts use are stored
    in memory.
    """

    depth = 1

    def __init__(self) -> None:
        self._fields: list[str] = []

    def publish(self, writer: LineWriter, values: PublishedNumbers, live: LiveValues, depth: int) -> list[ReadFunction]:
        arrays = []
        for ctype, value in values:
            arrays.append(writer.new_name("g"))
            self.define_constant(writer, arrays[-1], ctype, value, depth)
        for x, ctype in live:
            writer.names[x] = self.define_constant(writer, writer.new_name("m"), ctype, writer.names[x], depth)
        self.close_loop(writer, depth - 1)
        self.open_loop(writer, depth - 1)
        writer.forget_intermediate_results()
        return [lambda j, x=x: f"read_place(w.{x}, {j})" for x in arrays]

    def define_variable(self, writer: LineWriter, name: str, ctype: str, value: str, depth: int) -> str:
        self._fields.append(f"{ctype}v {name}[VECTORS];")
        writer.write_line(f"w.{name}[v] = {ctype}_lanes({value});", depth)
        return f"w.{name}[v]"

    def define_constant(self, writer: LineWriter, name: str, ctype: str, value: str, depth: int) -> str:
        return self.define_variable(writer, name, ctype, value, depth)

    def open_loop(self, writer: LineWriter, depth: int) -> None:
        writer.write_line("EACH_VECTOR {", depth)

    def close_loop(self, writer: LineWriter, depth: int) -> None:
        writer.write_line("}", depth)

    @property
    def declarations(self) -> list[str]:
        return ["struct World {", *(f"  {line}" for line in self._fields), "};"]


def make_exchange(target: str, group_size: int) -> Exchange:
    """Return the way in which the drones of a world read each other's numbers on a target."""
    if target == "cuda":
        return Registers() if group_size <= WARP_THREADS else SharedMemory(lanes_of_block(group_size)[1])
    return Registers() if group_size <= MAX_DRONES_IN_VECTOR else HostMemory()


def lanes_of_block(group_size: int) -> tuple[int, int]:
    """Return the number of threads of a block on a GPU, and how many of them are lanes.

    A world of up to ``WARP_THREADS`` drones stays in one warp. For larger worlds, sizes up to 256 threads are compared,
    larger sizes only if one world needs them. The block gets the size with the smallest share of threads without a
    drone, to the nearest percent. Of sizes with equal shares, it gets the smallest.

    Args:
        group_size: Drones of a world that read each other's numbers.
    """
    if group_size <= WARP_THREADS:
        return BLOCK_SIZE, BLOCK_SIZE // WARP_THREADS * (WARP_THREADS // group_size * group_size)
    min_threads = math.ceil(group_size / WARP_THREADS) * WARP_THREADS
    sizes = range(min_threads, max(min_threads, 256) + 1, WARP_THREADS)
    return max(((n, n // group_size * group_size) for n in sizes), key=lambda x: (round(x[1] / x[0], 2), -x[0]))


def _struct_bytes(fields: str) -> int:
    return sum(TYPE_BYTES.get(word, 0) for word in fields.split())
