"""Backend with one kernel for all steps, in which the numbers of a drone stay in registers.

A call of a kernel is a JAX primitive, which JAX lowers to the kernel of its platform.
"""

from __future__ import annotations

import functools
import sys
import weakref
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import Run, cuda, kernel, lanes, native
from crazysim.engine.backends.derivative_kernels import DerivativeKernels
from crazysim.engine.backends.derivatives import CountedRun, make_differentiable
from crazysim.engine.backends.native import Launch
from crazysim.engine.backends.platforms import TARGETS, compile_kernel, describe_kernel, launch_p
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir.program import Program
from crazysim.engine.passes.layout import packed_rows
from crazysim.engine.pytree import replace_leaves
from crazysim.engine.sharding import Location
from crazysim.errors import ConfigError


class Kernels:
    """Kernels of a program: for the platform that it is planned for, and for others that JAX compiles it for.

    The other kernels are compiled when they are first needed.
    """

    def __init__(self, program: Program, location: Location):
        self.program = program
        self.inputs, self.outputs = kernel.needed_leaves(program), tuple(program.written_leaves)
        self._launches = {location.platform: self._compile(location)}

    def get_launch(self, platform: str) -> Launch:
        if platform not in self._launches:
            try:
                self._launches[platform] = self._compile(Location(platform))
            except UnsupportedError as error:
                raise ConfigError(
                    f"expected a kernel for the {platform.upper()}, which JAX compiles this step for, got none: "
                    f"{error}. Use engine='lanes', or data on another device."
                ) from error
        return self._launches[platform]

    def _compile(self, location: Location) -> Launch:
        return compile_kernel(kernel.write_kernel(self.program, TARGETS[location.platform]), location)

    def n_lanes(self, n_worlds: int) -> int:
        """Return the number of drones in all worlds."""
        return n_worlds * self.program.n_drones

    def result_shapes(self, n_worlds: int) -> list[jax.ShapeDtypeStruct]:
        """Return the shapes and types of the kernel's outputs: leaves, and flags of drones if there is a check."""
        flags = (
            [jax.ShapeDtypeStruct((n_worlds, self.program.n_drones), np.bool_)] if self.program.check_segment else []
        )
        return [*(lanes.leaf_shape(self.program, i, n_worlds) for i in self.outputs), *flags]


def unavailable_reason(platform: str) -> str | None:
    """Return the reason why kernels cannot run on a platform, or None."""
    if platform == "gpu":
        return (
            None if cuda.nvrtc() else "NVRTC was not found, which comes with pip install 'jax[cuda13]' or 'jax[cuda12]'"
        )
    if platform != "cpu":
        return f"there are no kernels for {platform}"
    if native.compiler():
        return None
    _announce_missing_compiler()
    return native.MISSING_COMPILER


@functools.cache
def _announce_missing_compiler() -> None:
    print(f"simulations run on XLA, up to ten times slower: {native.MISSING_COMPILER}", file=sys.stderr)


class FusedRun:
    """A ``Run`` with its kernels. ``kernels`` is None if unfused stages split the step."""

    def __init__(self, run: Run, kernels: Kernels | None):
        self._run, self.kernels = run, kernels

    def __call__(self, leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        return self._run(leaves, n_steps)


def build(program: Program, location: Location, unpacked_program: Program | None = None) -> FusedRun:
    """Compile a program to kernels, and return the function that runs them.

    Args:
        location: Devices to compile it for.
        unpacked_program: The same program before ``pack_rows``, from which derivatives are computed, since kernels
            cannot differentiate rows; None for a program without rows.

    Raises:
        UnsupportedError: If an operation or type has no source.
        KernelError: If the compiler refuses a kernel or takes too long.
    """
    if not program.fused:
        return FusedRun(_run_parts(program, location), None)
    kernels = Kernels(program, location)
    run = _make_batchable(program, partial(_call_kernel, kernels))
    if unpacked_program is not None:
        return FusedRun(make_differentiable(run, _run_without_rows(program, unpacked_program, location)), kernels)
    run_on_lanes = lanes.build(program, location)
    derivatives = DERIVATIVE_KERNELS[program] = DerivativeKernels(program, location, run_on_lanes)
    return FusedRun(make_differentiable(run, run_on_lanes, derivatives), kernels)


DERIVATIVE_KERNELS: weakref.WeakKeyDictionary[Program, DerivativeKernels] = weakref.WeakKeyDictionary()
"""Derivative kernels of the programs that were built."""


def describe(program: Program, platform: str, devices: Sequence[jax.Device] | None = None) -> list[str]:
    """Return a line for each kernel of a program, as ``describe_kernel`` describes it."""
    sources = [kernel.write_kernel(part, TARGETS[platform]) for part in _parts(program) if part.fused]
    return [f"kernel: {describe_kernel(source, platform, devices)}" for source in sources]


def describe_derivatives(program: Program) -> list[str]:
    """Return a line for each way in which derivatives of a program were computed so far."""
    derivatives = (DERIVATIVE_KERNELS.get(part) for part in _parts(program))
    return [line for x in derivatives if x is not None for line in x.descriptions]


def _make_batchable(program: Program, run: CountedRun) -> CountedRun:
    def batching_rule(size: int, in_batched: Any, leaves: list[Any], count: Array) -> Any:
        leaves_batched, count_batched = in_batched
        have_world_axis = [leaf.scope in ("drone", "world") for leaf in program.leaves]
        out_batched = ([True] * len(program.written_leaves), True)
        if count_batched or any(
            b and not has_axis for b, has_axis in zip(leaves_batched, have_world_axis, strict=True)
        ):
            # Batches run one by one if they cannot be joined, for example because their shared parameters differ.
            broadcast_leaves = [x if b or x is None else jnp.broadcast_to(x, (size, *x.shape))
                    for x, b in zip(leaves, leaves_batched, strict=True)]  # fmt: skip
            counts = count if count_batched else jnp.broadcast_to(count, (size,))
            return jax.lax.map(lambda xs: run(*xs), (broadcast_leaves, counts)), out_batched

        def join_batches(x: Any, is_batched: bool, in_rows: bool) -> Any:
            x = x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1) if in_rows else x.reshape(-1, *x.shape[2:])

        def split_batches(x: Any, in_rows: bool) -> Any:
            if in_rows:
                return jnp.moveaxis(x.reshape(x.shape[0], size, -1), 1, 0)
            return x.reshape(size, -1, *x.shape[1:])

        are_rows = [i in program.rows for i in range(len(leaves))]
        merged_leaves = [
            join_batches(x, b, in_rows) if has_axis and x is not None else x
            for x, b, has_axis, in_rows in zip(leaves, leaves_batched, have_world_axis, are_rows, strict=True)
        ]
        written, flagged = run(merged_leaves, count)
        return (
            [split_batches(x, are_rows[i]) for i, x in zip(program.written_leaves, written, strict=True)],
            split_batches(flagged, False),
        ), out_batched

    return jaxcompat.add_vmap_rule(run, batching_rule)


def _run_without_rows(program: Program, unpacked_program: Program, location: Location) -> Run:
    built_runs: list[Run] = []

    def run(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        built_runs[:] = built_runs or [build(unpacked_program, location)]
        packed, unpacked_leaves = packed_rows(program), list(leaves)
        for rows in packed:
            for i in rows.source_leaves:
                unpacked_leaves[i] = rows.unpack(leaves[rows.leaf], i)
        results, flagged = built_runs[0](unpacked_leaves[: len(unpacked_program.leaves)], n_steps)
        leaves_after = replace_leaves(unpacked_leaves, unpacked_program.written_leaves, results)
        leaves_after = replace_leaves(
            leaves_after, [rows.leaf for rows in packed], [rows.pack(leaves_after) for rows in packed]
        )
        return [leaves_after[i] for i in program.written_leaves], flagged

    return run


def _parts(program: Program) -> Sequence[Program]:
    return [program] if program.fused else program.parts


def _run_parts(program: Program, location: Location) -> Run:
    parts = program.parts
    # Compilers run in parallel. Each part has its own derivative, and JAX chains them.
    with native.compiling_threads() as pool:
        runs = list(pool.map(lambda x: build(x, location) if x.fused else partial(lanes.run_steps, x), parts))
    # A derivative keeps the inputs of its part.
    inputs = [frozenset(kernel.input_leaves(x) if x.fused else range(len(x.leaves))) for x in parts]
    loop = [k for k, part in enumerate(parts) if part.phase_segments("each")] or [len(parts)]
    first, end = loop[0], loop[-1] + 1
    loop_leaves = sorted({i for part in parts[first:end] for i in part.written_leaves})

    def run_range(start: int, end: int, leaves: list[Any], n_steps: int | Array) -> list[Any]:
        for part, run, used in zip(parts[start:end], runs[start:end], inputs[start:end], strict=True):
            results, _ = run([x if i in used else None for i, x in enumerate(leaves)], n_steps)
            leaves = replace_leaves(leaves, part.written_leaves, results)
        return leaves

    def run(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        leaves = run_range(0, first, leaves, 1)
        if len(loop) == 1:  # a kernel loops over steps itself
            leaves = run_range(first, end, leaves, n_steps)
        else:

            def advance(values: list[Any]) -> list[Any]:
                leaves_after = run_range(first, end, replace_leaves(leaves_before, loop_leaves, values), 1)
                return [leaves_after[i] for i in loop_leaves]

            leaves_before, values = leaves, [leaves[i] for i in loop_leaves]
            values = (
                lanes.repeat(advance, values, n_steps)
                if isinstance(n_steps, int)
                else jax.lax.fori_loop(0, n_steps, lambda _, x: advance(x), values)
            )
            leaves = replace_leaves(leaves, loop_leaves, values)
        flagged = lanes.nonfinite_worlds(program, lanes.LeafValues(program, leaves))
        leaves = run_range(end, len(parts), leaves, 1)
        return [leaves[i] for i in program.written_leaves], flagged

    return run


def _call_kernel(kernels: Kernels, leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
    program = kernels.program
    n_worlds, n_drones = lanes.batch_counts(program, leaves)
    inputs = [_as_numbers(leaves[i]) for i in kernels.inputs]
    results = launch_p.bind(count.reshape(1), *inputs, kernels=kernels, n=n_worlds)
    written = [
        jax.random.wrap_key_data(x) if jaxcompat.is_key(program.leaves[i]) else x
        for i, x in zip(kernels.outputs, results[: len(kernels.outputs)], strict=True)
    ]
    if not program.check_segment:
        return written, jnp.zeros((n_worlds, 1), bool)
    return written, results[-1] if n_drones == 1 else jnp.any(results[-1], axis=1, keepdims=True)


def _as_numbers(x: Any) -> Array:
    return jax.random.key_data(x) if jaxcompat.is_key(x) else x
