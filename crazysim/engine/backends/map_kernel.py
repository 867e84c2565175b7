"""The kernel of a function of an index and tables, with a lane for each index."""

from __future__ import annotations

from crazysim.engine.backends.frame import Kernel, make_kernel
from crazysim.engine.backends.kernel import write_results
from crazysim.engine.backends.source import Writer, require_block_source, type_name
from crazysim.engine.ir.blocks import Block


def write_map(block: Block, target: str) -> Kernel:
    """Return the source of a function of an index and tables for ``cuda`` or ``host``; each lane has an index.

    Args:
        block: The function: its inputs are the index and the tables, its outputs single numbers.
        target: ``"cuda"`` or ``"host"``.
    """
    require_block_source(block)
    writer, tables = Writer(), block.inputs[1:]
    inputs, outputs = ([type_name(x.dtype) for x in some] for some in (tables, block.outputs))
    pointers = [f"const {kind}* __restrict__ p{k}" for k, kind in enumerate(inputs)]
    pointers += [f"{kind}* __restrict__ q{k}" for k, kind in enumerate(outputs)]
    values = writer.block(block, ["LANE", *(f"p{k}" for k in range(len(tables)))], 2)
    for k, (kind, x) in enumerate(zip(outputs, values, strict=True)):
        write_results(writer, f"q{k}", kind, 1, [x], 2)
    read, written = tuple(range(len(inputs))), tuple(range(len(outputs)))
    return make_kernel(target, pointers, [], writer.lines, [block], writer.tables, inputs=read, outputs=written)
