"""Programs made of single blocks, to run in an engine."""

import jax.numpy as jnp
import numpy as np

from crazysim.engine.ir.program import Leaf, Program, Segment


def make_program(block, inputs, n_lanes):
    """Return a program of one block, and its leaves: one for each input, shared if it is a scalar, and each output."""
    leaves, arrays = [], []
    for k, x in enumerate(map(np.asarray, inputs)):
        scope, shape = ("drone", (n_lanes, 1)) if x.ndim else ("shared", (1,))
        leaves.append(Leaf(f"in {k}", scope, shape, x.dtype))
        arrays.append(jnp.asarray(x).reshape(shape))
    for k, x in enumerate(block.outputs):
        leaves.append(Leaf(f"out {k}", "drone", (n_lanes, 1), x.dtype))
        arrays.append(jnp.zeros((n_lanes, 1), x.dtype))
    reads = tuple((k, 0) for k in range(len(inputs)))
    writes = tuple((len(inputs) + k, 0) for k in range(len(block.outputs)))
    return Program(tuple(leaves), 1, (Segment("drone", ("all",), "each", block, reads, writes),)), arrays
