"""Fused: one kernel for all steps, in which a drone's numbers stay in registers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine import cuda, kernel, lanes, native
from crazysim.engine.program import Program, is_key


def build(program: Program, platform: str) -> Callable[[list[Any], int | Array], tuple[list[Any], Array]]:
    """Return what ``lanes.steps`` is, in one kernel: leaves and a number of steps to written leaves and flags.

    Raises:
        NoRuleError: If the program has something that there is no source for.
    """
    source = kernel.write(program, "cuda" if platform == "gpu" else "host")

    def steps(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        """Run the kernel; its derivative is that of the same program on lanes."""

        @jax.custom_jvp
        def run(leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
            return _call(program, source, leaves, count, platform)

        @run.defjvp
        def _(primals: Any, tangents: Any) -> Any:
            (values, _), (slopes, _) = primals, tangents
            return jax.jvp(lambda x: lanes.steps(program, x, n_steps), (values,), (slopes,))

        return run(leaves, jnp.asarray(n_steps, jnp.int32))

    return steps


def _call(
    program: Program, source: kernel.Kernel, leaves: list[Any], count: Array, platform: str
) -> tuple[list[Any], Array]:
    drone = next(i for i, scope in enumerate(program.axes.scopes) if scope == "drone")
    n_worlds, n_drones = leaves[drone].shape[:2]
    n_lanes = n_worlds * n_drones
    inputs = [_bare(leaves[i]) for i in source.inputs]
    outputs = [jax.ShapeDtypeStruct(leaves[i].shape, leaves[i].dtype) for i in source.outputs]
    flags = jax.ShapeDtypeStruct((n_worlds, n_drones), np.bool_)
    call = cuda.call if platform == "gpu" else native.call
    *written, finite = call(source, n_lanes, count.reshape(1), inputs, [*outputs, flags])
    return written, jnp.all(finite, axis=1, keepdims=True)


def _bare(x: Any) -> Array:
    """Return an array of plain numbers: a key as its words."""
    return jax.random.key_data(x) if is_key(x) else x
