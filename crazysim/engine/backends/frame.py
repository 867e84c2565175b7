"""The frame of a kernel: the types and functions of a target, and the loop over lanes around the code of a lane."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from importlib import resources

from crazysim.engine.backends.exchange import BLOCK_SIZE, lanes_of_block
from crazysim.engine.ir.blocks import Block

MIN_BLOCKS_PLACEHOLDER = "1 /* blocks at least */"
"""Text in a kernel for a GPU that ``Kernel.with_blocks`` replaces by a number of blocks."""

BLOCK_THREADS_DEFINITION = "#define BLOCK_THREADS {}\n"
"""Text in a kernel for a GPU that ``Kernel.with_threads`` replaces."""


@dataclasses.dataclass(frozen=True)
class Kernel:
    """Source of a kernel, with its inputs and outputs."""

    text: str
    """The source."""
    inputs: tuple[int, ...]
    """Indices of the leaves that it reads."""
    outputs: tuple[int, ...]
    """Indices of the leaves that it writes. If worlds are checked, another output follows, with a bool per drone: True
    where its world is flagged as not finite."""
    in_place: tuple[int, ...] = ()
    """Indices of the leaves with rows that it updates in place: input and output of such a leaf are the same memory."""
    threads: int = BLOCK_SIZE
    """Threads of a block on a GPU."""
    lanes: int = BLOCK_SIZE
    """Threads of a block that are lanes. If drones read each other's numbers, these lanes make up whole worlds."""
    group_size: int = 1
    """Drones of a world that read each other's numbers."""
    state_bytes: int = 0
    """Memory in which a lane stores the state before a step, bytes; 0 for a kernel without backward pass. A kernel with
    backward pass takes two counts: the number of all steps, and the number of steps of an interval."""

    def aliases(self) -> dict[int, int]:
        """Return the index of the result that shares memory with an operand, by the operand's index.

        Two scalar operands precede the leaves.
        """
        return {2 + self.inputs.index(i): self.outputs.index(i) for i in self.in_place}

    def with_blocks(self, n: int) -> Kernel:
        """Return the kernel limited to so few registers that a multiprocessor of a GPU runs ``n`` blocks at once."""
        return dataclasses.replace(self, text=self.text.replace(MIN_BLOCKS_PLACEHOLDER, f"{n}"))

    def with_threads(self, n: int) -> Kernel:
        """Return the kernel with blocks of ``n`` threads on a GPU, a multiple of its present number."""
        text = self.text.replace(BLOCK_THREADS_DEFINITION.format(self.threads), BLOCK_THREADS_DEFINITION.format(n))
        return dataclasses.replace(self, text=text, threads=n, lanes=self.lanes * n // self.threads)


def steps_per_interval(n_steps: int, state_bytes: int, memory_bytes: int) -> int:
    """Return the number of steps in an interval of the backward pass: all if the state before each step fits in memory.

    Otherwise it is the square root of the number of steps, rounded up. This choice needs the least memory, because the
    state before each interval is stored too.

    Args:
        state_bytes: Memory of the state before a step, bytes.
        memory_bytes: Available memory, bytes.
    """
    return max(n_steps, 1) if n_steps * state_bytes <= memory_bytes else math.isqrt(n_steps - 1) + 1


def _preamble(target: str) -> str:
    files = resources.files("crazysim.engine.backends").joinpath("targets")
    text = files.joinpath(f"{target}.h").read_text()
    return text.replace('#include "scalar.h"\n', files.joinpath("scalar.h").read_text())


def _epilogue(target: str) -> str:
    if target == "cuda":
        return ""
    return resources.files("crazysim.engine.backends").joinpath("targets", "host_call.h").read_text()


def make_kernel(
    target: str,
    pointers: Sequence[str],
    shared_lines: Sequence[str],
    lane_lines: Sequence[str],
    blocks: Sequence[Block],
    declarations: Sequence[str],
    *,
    inputs: tuple[int, ...],
    outputs: tuple[int, ...],
    in_place: tuple[int, ...] = (),
    group_size: int = 1,
    in_memory: bool = False,
    n_stored: int | None = None,
) -> Kernel:
    """Return the kernel with the given code.

    Args:
        target: ``"cuda"`` or ``"host"``.
        pointers: Declarations of inputs and outputs.
        shared_lines: Lines that compute the numbers that all lanes share.
        lane_lines: Lines that compute the numbers of a lane.
        blocks: Blocks of a step, whose operations are counted.
        declarations: Lines before the kernel.
        inputs: Indices of the leaves that it reads.
        outputs: Indices of the leaves that it writes.
        in_place: Indices of the leaves that it updates in place.
        group_size: Drones of a world that read each other's numbers.
        in_memory: Whether the numbers of a world are in memory, which is possible only on the host.
        n_stored: Numbers that a lane stores for each step; None for a kernel without backward pass.
    """
    threads, lanes = lanes_of_block(group_size)
    shared, body = "\n".join(shared_lines), "\n".join(lane_lines)
    if target == "cuda":
        function = _cuda_function(pointers, shared, body, n_stored is not None)
    else:
        function = _host_function(pointers, shared, body, in_memory, n_stored is not None)
    max_number_bytes = 8 if any("f64*" in pointer for pointer in pointers) else 4
    defines = (
        f"#define MAX_NUMBER_BYTES {max_number_bytes}\n#define GROUP {group_size}\n"
        + BLOCK_THREADS_DEFINITION.format(threads)
    )
    defines += f"#define OPERATIONS {sum(map(_n_operations, blocks))}\n"
    prefix = "".join(f"{line}\n" for line in declarations)
    if n_stored is not None:
        prefix = f"#define N_STORED {n_stored}\n{_preamble(target + '_stored')}{prefix}"
    text = defines + _preamble(target) + prefix + function + _epilogue(target)
    return Kernel(text, inputs, outputs, in_place, threads, lanes, group_size, (n_stored or 0) * max_number_bytes)


def _n_operations(block: Block) -> int:
    inner = [dict(op.params).get("n_members", 1) * sum(map(_n_operations, op.blocks)) for op in block.operations]
    return len(block.operations) + sum(inner)


def _cuda_function(pointers: Sequence[str], shared: str, body: str, stores_states: bool) -> str:
    # In a kernel with backward pass, a thread may process several lanes one after the other, to bound the memory.
    scalars = ["const int* __restrict__ sizes", "const int* __restrict__ count"]
    arguments = ", ".join([*scalars, *pointers, *(["StoredNumber* __restrict__ stored"] if stores_states else [])])
    interval, loop = "", "const int first = blockIdx.x * BLOCK_LANES;"
    if stores_states:
        loop = "for (int first = blockIdx.x * BLOCK_LANES; first < n_lanes; first += gridDim.x * BLOCK_LANES)"
        interval = ", interval = count[1]"
    return f"""
extern "C" __global__ void __launch_bounds__(BLOCK_THREADS, {MIN_BLOCKS_PLACEHOLDER}) advance({arguments}) {{
  const int n_lanes = sizes[0], n_steps = count[0]{interval};
  const int opaque_zero = n_steps >> 31;
  const int thread = threadIdx.x % THREADS, lane_of_block = threadIdx.x / THREADS * LANES + thread;
{shared}
  {loop} {{
  const int unclamped_lane = first + lane_of_block;
  const bool is_active = thread < LANES && unclamped_lane < n_lanes;
  const int lane = unclamped_lane < n_lanes ? unclamped_lane : n_lanes - 1;
  const int own_drone = lane % GROUP;
  const int world_start = is_active ? lane_of_block / GROUP * GROUP : 0;
{body}
  }}
}}
"""


def _host_function(pointers: Sequence[str], shared: str, body: str, in_memory: bool, stores_states: bool) -> str:
    n_in = sum(p.startswith("const") for p in pointers)
    buffers = [f"in[{k}]" if k < n_in else f"out[{k - n_in}]" for k in range(len(pointers))]
    definitions = []
    for pointer, buffer in zip(pointers, buffers, strict=True):
        ctype, name = pointer.split("* __restrict__ ")
        definitions.append(f"  {ctype}* __restrict__ const {name} = ({ctype}*){buffer};")
    pointer_definitions, memory, free_line = "\n".join(definitions), "", ""
    if stores_states:  # the number of steps, which XLA passes before the inputs, is followed by the interval
        memory = """
  const int interval = ((int*)in[-1])[1];
  char* const stored = static_cast<char*>(ALLOCATE(STORED_BYTES));
  if (stored == nullptr) return false;"""
        free_line = "\n  free(stored);"
    if in_memory:
        memory = """
  World* const memory = static_cast<World*>(ALLOCATE(sizeof(World)));
  if (memory == nullptr) return false;
  World& w = *memory;"""
        free_line = "\n  free(memory);"
    return f"""
static bool advance_range(int64_t from, int64_t to, int64_t n_lanes, int n_steps, void** in, void** out) {{
{pointer_definitions}{memory}
{shared}
  {"EACH_WORLD" if in_memory else "EACH_SINGLE_VECTOR"} {{
{body}
  }}{free_line}
  return true;
}}
"""
