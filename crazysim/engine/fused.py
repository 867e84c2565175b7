"""Fused: one kernel for all steps, in which a drone's numbers stay in registers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from crazysim.core.stage import with_leaves
from crazysim.engine import cuda, kernel, lanes, native
from crazysim.engine.lower import is_key
from crazysim.engine.program import Program

Run = Callable[[list[Any], Array], tuple[list[Any], Array]]
"""Leaves and a number of steps to the written leaves and which worlds are flagged as not finite."""


def missing(platform: str) -> str | None:
    """Return what keeps kernels from running on a platform, or None."""
    if platform == "gpu":
        return (
            None if cuda.nvrtc() else "NVRTC was not found, which comes with pip install 'jax[cuda13]' or 'jax[cuda12]'"
        )
    if platform != "cpu":
        return f"there are no kernels for {platform}"
    return None if native.compiler() else "no C++ compiler was found (g++, clang++, or the variable CXX)"


def build(program: Program, platform: str) -> Callable[[list[Any], int | Array], tuple[list[Any], Array]]:
    """Return what ``lanes.steps`` is, in kernels: leaves and a number of steps to written leaves and flags.

    Raises:
        UnsupportedError: If the program has something that there is no source for.
    """
    target = "cuda" if platform == "gpu" else "host"
    run = _one_kernel(program, target) if program.fused else _split(program, target)
    batched = _over_batches(program, run)

    def steps(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        """Run the kernel; its derivative is that of the same program on lanes."""

        @jax.custom_jvp
        def advance(leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
            return batched(leaves, count)

        def slope(primals: Any, tangents: Any) -> Any:
            (values, _), (slopes, _) = primals, tangents
            changing = [i for i, t in enumerate(slopes) if t is not None and not isinstance(t, SymbolicZero)]

            def of(some: list[Any]) -> Any:
                return lanes.steps(program, with_leaves(values, changing, some), n_steps)

            return jax.jvp(of, ([values[i] for i in changing],), ([slopes[i] for i in changing],))

        advance.defjvp(slope, symbolic_zeros=True)  # what does not change has no derivative to be computed
        return advance(leaves, jnp.asarray(n_steps, jnp.int32))

    return steps


def describe(program: Program, platform: str) -> str:
    """Return what a kernel takes, in a line."""
    if platform != "gpu":
        return f"kernel: compiled by {native.compiler()}"
    source = cuda.fitted(kernel.write(program, "cuda"))
    used = cuda.resources(source)
    return f"kernel: {kernel.BLOCK} threads a block, {used.registers} registers, {used.spilled} bytes spilled"


def _over_batches(program: Program, run: Run) -> Run:
    """Return a kernel call that vmap understands: more of the same worlds are more worlds."""

    @jax.custom_batching.custom_vmap
    def call(leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
        return run(leaves, count)

    @call.def_vmap
    def _(size: int, in_batched: Any, leaves: list[Any], count: Array) -> Any:
        batched, count_batched = in_batched
        own = [leaf.scope in ("drone", "world") for leaf in program.leaves]
        out_batched = ([True] * len(program.written), True)
        if count_batched or not program.fused or any(b and not o for b, o in zip(batched, own, strict=True)):
            # What the worlds of a batch share is not the same in all batches: one after the other.
            whole = [x if b or x is None else jnp.broadcast_to(x, (size, *x.shape))
                     for x, b in zip(leaves, batched, strict=True)]  # fmt: skip
            counts = count if count_batched else jnp.broadcast_to(count, (size,))
            return jax.lax.map(lambda xs: run(*xs), (whole, counts)), out_batched

        def join(x: Any, b: bool, lies: bool) -> Any:
            x = x if b else jnp.broadcast_to(x, (size, *x.shape))
            return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1) if lies else x.reshape(-1, *x.shape[2:])

        def part(x: Any, lies: bool) -> Any:
            return jnp.moveaxis(x.reshape(x.shape[0], size, -1), 1, 0) if lies else x.reshape(size, -1, *x.shape[1:])

        lying = [i in program.rows for i in range(len(leaves))]
        joined = [
            join(x, b, lies) if o and x is not None else x
            for x, b, o, lies in zip(leaves, batched, own, lying, strict=True)
        ]
        written, flagged = run(joined, count)
        return (
            [part(x, lying[i]) for i, x in zip(program.written, written, strict=True)],
            part(flagged, False),
        ), out_batched

    return call


def _one_kernel(program: Program, target: str) -> Run:
    source = kernel.write(program, target)
    return lambda leaves, count: _call(program, source, leaves, count, target)


def _split(program: Program, target: str) -> Run:
    """Return the same for a step that some stage takes apart: a kernel for what is between such stages."""
    parts = list(program.parts())
    kernels = [kernel.write(p, target) if p.fused else None for p in parts]
    written = program.written

    def turn(leaves: list[Any]) -> list[Any]:
        for part, source in zip(parts, kernels, strict=True):
            if source is not None:
                out, _ = _call(part, source, leaves, jnp.asarray(1, jnp.int32), target)
            else:
                out, _ = lanes.steps(part, leaves, 1)
            leaves = with_leaves(leaves, part.written, out)
        return leaves

    def run(leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
        def body(_: Any, values: list[Any]) -> list[Any]:
            after = turn(with_leaves(leaves, written, values))
            return [after[i] for i in written]

        out = jax.lax.fori_loop(0, count, body, [leaves[i] for i in written])
        return out, lanes.nonfinite(program, lanes.Lanes(program, with_leaves(leaves, written, out)))

    return run


def _call(
    program: Program, source: kernel.Kernel, leaves: list[Any], count: Array, target: str
) -> tuple[list[Any], Array]:
    n_worlds, n_drones = lanes.batch(program, leaves)
    n_lanes = n_worlds * n_drones
    inputs = [_bare(leaves[i]) for i in source.inputs]
    like = {i: program.leaves[i] for i in source.outputs}
    shapes = {i: (program.rows[i], n_lanes) if i in program.rows else (n_worlds, *x.shape[1:]) for i, x in like.items()}
    outputs = [jax.ShapeDtypeStruct(shapes[i], x.dtype) for i, x in like.items()]
    call = cuda.call if target == "cuda" else native.call
    if program.check is None:
        return call(source, n_lanes, count.reshape(1), inputs, outputs), jnp.zeros((n_worlds, 1), bool)
    flags = jax.ShapeDtypeStruct((n_worlds, n_drones), np.bool_)
    *written, flagged = call(source, n_lanes, count.reshape(1), inputs, [*outputs, flags])
    return written, flagged if n_drones == 1 else jnp.any(flagged, axis=1, keepdims=True)


def _bare(x: Any) -> Array:
    """Return an array of plain numbers: a key as its words."""
    return jax.random.key_data(x) if is_key(x) else x
