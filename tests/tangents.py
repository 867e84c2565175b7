"""Slopes of a step in NumPy, by the engine's forward mode: nothing is compiled.

``tests/engine`` compares kernels and gradients with them.
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim.engine.backends import interpret
from crazysim.engine.lowering.tangents import add_tangents


def push_forward(step, data, slopes, n_steps):
    """Return the slopes of the leaves that a step of engine ``"interpret"`` writes, by path.

    ``slopes`` are those of leaves at the start, by path; all others are zero. Leaves that drones share have none, since
    they are packed.
    """
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(data)]
    flat = step.flatten(data)
    tangents = add_tangents(flat.plan.program, [names.index(name) for name in slopes])
    assert not {names.index(name) for name in slopes}.intersection(flat.plan.program.packed)
    n_leaves = len(flat.leaves)  # further leaves hold packed numbers
    start = [
        np.broadcast_to(slopes.get(name, 0.0), tangents.leaves[n_leaves + i].shape) for i, name in enumerate(names)
    ]
    start = [*map(jnp.asarray, start), *[None] * (n_leaves - len(names))]
    end, _ = interpret.run_steps(tangents, [*flat.leaves, *start], n_steps)
    return {names[i - n_leaves]: np.asarray(x) for i, x in zip(tangents.written_leaves, end, strict=True)}
