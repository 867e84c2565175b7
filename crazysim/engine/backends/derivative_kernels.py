"""Kernels of the derivatives of a program: tangents in a forward pass with the steps, cotangents in a backward pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import Run, kernel, lanes, reverse
from crazysim.engine.backends.frame import Kernel
from crazysim.engine.backends.native import Launch
from crazysim.engine.backends.platforms import TARGETS, compile_kernel, describe_kernel
from crazysim.engine.backends.reverse import ReverseProgram
from crazysim.engine.cache import announce, announce_if_slow
from crazysim.engine.errors import LimitError, UnsupportedError
from crazysim.engine.ir.program import Program
from crazysim.engine.lowering.tangents import add_tangents
from crazysim.engine.sharding import Location
from crazysim.errors import EngineWarning, warn

Leaves = dict[int, Any]
"""Arrays by the index of their leaf."""


class DerivativeKernels:
    """Kernels of the derivatives of one program, each compiled when it is first used."""

    def __init__(self, program: Program, location: Location, run_on_lanes: Run):
        self.program, self.location, self.run_on_lanes = program, location, run_on_lanes
        self.descriptions: dict[str, None] = {}
        """Descriptions of how derivatives were computed so far, for ``explain``, as keys in order."""
        self.floats = tuple(i for i in program.written_leaves if program.leaves[i].number_type.kind == "f")
        """Indices of the written leaves that have derivatives."""
        self._programs: dict[Any, Any] = {}
        self._launches: dict[Any, Launch | None] = {}

    def has_world_axis(self, leaf: int) -> bool:
        """Return True for a leaf of drones or worlds, whose first axis is the axis of worlds."""
        return self.program.leaves[leaf].scope in ("drone", "world")

    def tangent_kernel(self, perturbed: tuple[int, ...], platform: str) -> Callable[..., list[Array]] | None:
        """Return the kernel that computes the steps and the tangents of some leaves; None if there is no such kernel.

        It takes all leaves, tangents by leaf, the number of steps, the number of batches (see
        ``DerivativeSpec``), and the shapes and types of the tangents after the steps. It returns these tangents.
        """
        compiled = self._compile("jvp", add_tangents, kernel.write_kernel, perturbed, platform)
        return None if compiled is None else partial(_launch_tangents, self, *compiled)

    def cotangent_kernel(self, perturbed: tuple[int, ...], platform: str) -> Callable[..., Leaves] | None:
        """Return the kernel that computes the cotangents of some leaves; None if there is no such kernel.

        It takes all leaves, cotangents of the written floats by leaf, the number of steps, and the number of batches.
        It returns cotangents by leaf. The cotangent of a leaf that all drones share has one row for each batch.
        """
        compiled = self._compile("gradient", reverse.reverse_program, reverse.write_kernel, perturbed, platform)
        return None if compiled is None else partial(_launch_cotangents, self, *compiled)

    def _compile(
        self,
        kind: str,
        transform: Callable[[Program, Sequence[int]], Any],
        write: Callable[[Any, str], Kernel],
        perturbed: tuple[int, ...],
        platform: str,
    ) -> tuple[Any, Launch] | None:
        key, launch_key = (kind, perturbed), (kind, perturbed, platform)
        try:
            if key not in self._programs:
                self._programs[key] = None
                self._programs[key] = transform(self.program, perturbed)
            transformed_program = self._programs[key]
            if transformed_program is not None and launch_key not in self._launches:
                self._launches[launch_key] = None
                source = write(transformed_program, TARGETS[platform])
                location = self.location if platform == self.location.platform else Location(platform)
                with announce_if_slow("compiling a derivative of the steps", "2 to 10 s"):
                    self._launches[launch_key] = compile_kernel(source, location)
                self.descriptions[f"{kind}: one kernel, {describe_kernel(source, platform, location.devices)}"] = None
        except UnsupportedError as error:
            announce("compiling a derivative of the steps on lanes", "10 to 40 s, with contacts many minutes")
            self.descriptions[f"{kind}: on lanes ({error})"] = None
            if not isinstance(error, LimitError):
                warn(f"the {kind} of the step runs on 'lanes': {error}", EngineWarning)
        launch = self._launches.get(launch_key)
        return None if launch is None else (self._programs[key], launch)


def _kernel_inputs(values: Sequence[Any], leaves: Sequence[int]) -> list[Array]:
    arrays = [values[i] for i in leaves]
    return [jax.random.key_data(x) if jaxcompat.is_key(x) else x for x in arrays]


def _launch_tangents(
    kernels: DerivativeKernels,
    program: Program,
    launch: Launch,
    values: Sequence[Any],
    tangents: Leaves,
    n_steps: int,
    n_batches: int,
    result_shapes: Sequence[jax.ShapeDtypeStruct],
) -> list[Array]:
    n_leaves = len(kernels.program.leaves)
    n_worlds, n_drones = lanes.batch_counts(kernels.program, list(values))

    def broadcast_tangent(i: int, x: Array) -> Array:
        if kernels.has_world_axis(i):
            return x
        return jnp.broadcast_to(x[:, None, None], (n_batches, n_worlds // n_batches, 1, *x.shape[1:])).reshape(
            n_worlds, 1, *x.shape[1:]
        )

    leaves = [*values, *(broadcast_tangent(i, tangents[i]) if i in tangents else None for i in range(n_leaves))]
    inputs = _kernel_inputs(leaves, kernel.needed_leaves(program))
    outputs = [lanes.leaf_shape(program, i, n_worlds) for i in program.written_leaves]
    results = launch(n_worlds * n_drones, np.asarray([n_steps], np.int32), inputs, outputs)
    result_by_leaf = dict(zip(program.written_leaves, results, strict=True))
    return [result_by_leaf[n_leaves + i] if n_leaves + i in result_by_leaf else jnp.zeros(x.shape, x.dtype)
            for i, x in zip(kernels.floats, result_shapes, strict=True)]  # fmt: skip


def _launch_cotangents(
    kernels: DerivativeKernels,
    cotangent_program: ReverseProgram,
    launch: Launch,
    values: Sequence[Any],
    cotangents: Leaves,
    n_steps: int,
    n_batches: int,
) -> Leaves:
    program = kernels.program
    n_worlds, n_drones = lanes.batch_counts(program, list(values))

    def pad_seed(i: int) -> Array:
        x = cotangents[i].reshape(n_worlds, -1, program.leaves[i].size)
        return x if x.shape[1] == n_drones else jnp.pad(x, ((0, 0), (0, n_drones - 1), (0, 0)))

    inputs = [*_kernel_inputs(values, reverse.needed_leaves(cotangent_program)), *map(pad_seed, kernels.floats)]
    leaves = [program.leaves[i] for i in cotangent_program.perturbed]
    outputs = [jax.ShapeDtypeStruct((n_worlds, n_drones, x.size), x.number_type) for x in leaves]
    lane_cotangents = launch(n_worlds * n_drones, np.asarray([n_steps], np.int32), inputs, outputs)

    def sum_cotangent(i: int, x: Array) -> Array:
        if program.leaves[i].scope == "world":
            return jnp.sum(x, axis=1)
        return (
            x
            if kernels.has_world_axis(i)
            else jnp.sum(x.reshape(n_batches, n_worlds * n_drones // n_batches, -1), axis=1)
        )

    return {i: sum_cotangent(i, x) for i, x in zip(cotangent_program.perturbed, lane_cotangents, strict=True)}
