"""Fused: one kernel for all steps, in which a drone's numbers stay in registers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import jaxcompat
from crazysim.core.stage import with_leaves
from crazysim.engine import cuda, kernel, lanes, native, passes
from crazysim.engine.native import Launch
from crazysim.engine.program import Program

Run = Callable[[list[Any], Array], tuple[list[Any], Array]]
"""Leaves and a number of steps to the written leaves and the worlds that are flagged as not finite."""

Compiled = tuple[kernel.Kernel, Launch]
"""A kernel and the function that calls it."""


def missing(platform: str) -> str | None:
    """Return the reason why kernels cannot run on a platform, or None."""
    if platform == "gpu":
        return (
            None if cuda.nvrtc() else "NVRTC was not found, which comes with pip install 'jax[cuda13]' or 'jax[cuda12]'"
        )
    if platform != "cpu":
        return f"there are no kernels for {platform}"
    return None if native.compiler() else "no C++ compiler was found (g++, clang++, or the variable CXX)"


def build(
    program: Program, platform: str, devices: Sequence[jax.Device] | None = None
) -> Callable[[list[Any], int | Array], tuple[list[Any], Array]]:
    """Compile a program to kernels, and return the function that runs them, as ``lanes.steps`` does.

    Args:
        program: The program.
        platform: ``"cpu"`` or ``"gpu"``.
        devices: GPUs that will run it; None for those of this machine.

    Raises:
        UnsupportedError: If an operation or type has no source.
        KernelError: If the compiler refuses a kernel or takes too long.
    """

    def compiled(part: Program) -> Compiled:
        return _compiled(kernel.write(part, "cuda" if platform == "gpu" else "host"), platform, devices)

    run = _one_kernel(program, compiled(program)) if program.fused else _split(program, compiled)
    on_lanes = program if platform == "gpu" else passes.separate(program)
    return differentiable(on_lanes, _over_batches(program, run))


def build_sampler(
    program: Program, platform: str, samples: Sequence[int], devices: Sequence[jax.Device] | None = None
) -> Callable[[list[Any], int, int], tuple[list[Any], Array, list[Any]]]:
    """Compile a program to a kernel that takes samples, and return the function that runs it, without derivatives.

    The function takes leaves, the number of steps between samples, and the number of samples. It returns the written
    leaves, the worlds that are flagged as not finite, and the samples, with time in front.

    Args:
        program: The program, which one kernel can run.
        platform: ``"cpu"`` or ``"gpu"``.
        samples: Leaves to sample, of drones or worlds, which the program writes.
        devices: As for ``build``.

    Raises:
        UnsupportedError: If an operation or type has no source.
        KernelError: If the compiler refuses the kernel or takes too long.
    """
    compiled = _compiled(kernel.write(program, "cuda" if platform == "gpu" else "host", samples), platform, devices)

    def run(leaves: list[Any], n_steps: int, n_samples: int) -> tuple[list[Any], Array, list[Any]]:
        return _launch(program, compiled, leaves, jnp.asarray([n_steps, n_samples], jnp.int32), n_samples)

    return run


def _compiled(source: kernel.Kernel, platform: str, devices: Sequence[jax.Device] | None) -> Compiled:
    return source, cuda.compiled(source, devices) if platform == "gpu" else native.compiled(source)


def differentiable(program: Program, run: Run) -> Callable[[list[Any], int | Array], tuple[list[Any], Array]]:
    """Return a function that runs a program, with the derivative of the same program on lanes."""

    def steps(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        @jax.custom_jvp
        def forward(leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
            return run(leaves, count)

        def derivative(primals: Any, tangents: Any) -> Any:
            (values, _), (slopes, _) = primals, tangents
            changing = [i for i, t in enumerate(slopes) if not jaxcompat.is_symbolic_zero(t)]

            def of(some: list[Any]) -> Any:
                return lanes.steps(program, with_leaves(values, changing, some), n_steps)

            return jax.jvp(of, ([values[i] for i in changing],), ([slopes[i] for i in changing],))

        forward.defjvp(derivative, symbolic_zeros=True)  # constant leaves have no derivative to be computed
        return forward(leaves, jnp.asarray(n_steps, jnp.int32))

    return steps


def describe(program: Program, platform: str, devices: Sequence[jax.Device] | None = None) -> str:
    """Return the compiler of a kernel, or on a GPU the registers that it takes, in one line."""
    if platform != "gpu":
        return f"kernel: compiled by {native.compiler()}"
    source, device = kernel.write(program, "cuda"), cuda.weakest(devices)
    if device is None:
        return f"kernel: compiled for {cuda.DEFAULT_ARCHITECTURE}; this machine has no GPU"
    used = cuda.resources(cuda.fitted(source, device), device)
    return f"kernel: {source.threads} threads a block, {used.registers} registers, {used.spilled} bytes spilled"


def _over_batches(program: Program, run: Run) -> Run:
    """Return a kernel call with a rule for vmap: a batch of the same worlds is more worlds."""

    def batched(size: int, in_batched: Any, leaves: list[Any], count: Array) -> Any:
        of_leaves, of_count = in_batched
        own = [leaf.scope in ("drone", "world") for leaf in program.leaves]
        out_batched = ([True] * len(program.written), True)
        if of_count or not program.fused or any(b and not o for b, o in zip(of_leaves, own, strict=True)):
            # Shared parameters that differ between batches: one batch after the other.
            full = [x if b or x is None else jnp.broadcast_to(x, (size, *x.shape))
                    for x, b in zip(leaves, of_leaves, strict=True)]  # fmt: skip
            counts = count if of_count else jnp.broadcast_to(count, (size,))
            return jax.lax.map(lambda xs: run(*xs), (full, counts)), out_batched

        def join(x: Any, b: bool, in_rows: bool) -> Any:
            x = x if b else jnp.broadcast_to(x, (size, *x.shape))
            return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1) if in_rows else x.reshape(-1, *x.shape[2:])

        def part(x: Any, in_rows: bool) -> Any:
            if in_rows:
                return jnp.moveaxis(x.reshape(x.shape[0], size, -1), 1, 0)
            return x.reshape(size, -1, *x.shape[1:])

        rows = [i in program.rows for i in range(len(leaves))]
        joined = [
            join(x, b, in_rows) if o and x is not None else x
            for x, b, o, in_rows in zip(leaves, of_leaves, own, rows, strict=True)
        ]
        written, flagged = run(joined, count)
        return (
            [part(x, rows[i]) for i, x in zip(program.written, written, strict=True)],
            part(flagged, False),
        ), out_batched

    return jaxcompat.batched_rule(run, batched)


def _one_kernel(program: Program, compiled: Compiled) -> Run:
    return lambda leaves, count: _call(program, compiled, leaves, count)


def _split(program: Program, compile_part: Callable[[Program], Compiled]) -> Run:
    """Return the same for a step that unfused stages split: a kernel for the stages between them."""
    parts = list(program.parts())
    with ThreadPoolExecutor() as pool:
        kernels = list(pool.map(lambda part: compile_part(part) if part.fused else None, parts))
    written = program.written

    def turn(leaves: list[Any]) -> list[Any]:
        for part, compiled in zip(parts, kernels, strict=True):
            if compiled is not None:
                out, _ = _call(part, compiled, leaves, jnp.asarray(1, jnp.int32))
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


def _call(program: Program, compiled: Compiled, leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
    written, flagged, _ = _launch(program, compiled, leaves, count.reshape(1))
    return written, flagged


def _launch(
    program: Program, compiled: Compiled, leaves: list[Any], counts: Array, n_samples: int = 0
) -> tuple[list[Any], Array, list[Any]]:
    """Return what a kernel writes: leaves, the worlds that are flagged, and samples."""
    source, launch = compiled
    n_worlds, n_drones = lanes.batch(program, leaves)

    def shape(i: int, *before: int) -> jax.ShapeDtypeStruct:
        x = lanes.shape_of(program, i, n_worlds)
        return jax.ShapeDtypeStruct((*before, *x.shape), x.dtype)

    def as_keys(i: int, x: Array) -> Array:
        return jax.random.wrap_key_data(x) if jaxcompat.is_key(program.leaves[i]) else x

    flags = [] if program.check is None else [jax.ShapeDtypeStruct((n_worlds, n_drones), np.bool_)]
    samples = [shape(i, n_samples) for i in source.samples]
    inputs = [_as_numbers(leaves[i]) for i in source.inputs]
    out = launch(n_worlds * n_drones, counts, inputs, [*(shape(i) for i in source.outputs), *flags, *samples])
    n = len(source.outputs)
    written = [as_keys(i, x) for i, x in zip(source.outputs, out[:n], strict=True)]
    kept = [as_keys(i, x) for i, x in zip(source.samples, out[n + len(flags) :], strict=True)]
    if not flags:
        return written, jnp.zeros((n_worlds, 1), bool), kept
    return written, out[n] if n_drones == 1 else jnp.any(out[n], axis=1, keepdims=True), kept


def _as_numbers(x: Any) -> Array:
    """Return an array of numbers; random keys as their 32-bit integers."""
    return jax.random.key_data(x) if jaxcompat.is_key(x) else x
