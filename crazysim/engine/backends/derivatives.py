"""Derivatives of the steps of a kernel for JAX: primitives with rules for derivatives, transposes and vmap.

One primitive computes the tangents after some steps, and is linear in the tangents before them. Its transpose is
another primitive. JAX lowers both to a kernel of the platform, or to the program on lanes if there is no such kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import Run, lanes
from crazysim.engine.backends.derivative_kernels import DerivativeKernels
from crazysim.engine.cache import announce
from crazysim.engine.pytree import replace_leaves

CountedRun = Callable[[list[Any], Array], tuple[list[Any], Array]]
"""A ``Run`` whose number of steps is an array."""


def make_differentiable(run: CountedRun, run_on_lanes: Run, kernels: DerivativeKernels | None = None) -> Run:
    """Return a differentiable function that runs a program.

    Args:
        run_on_lanes: The program on lanes, which JAX can differentiate. Used without ``kernels``, and if the number of
            steps is an array.
        kernels: Kernels of the derivatives; None to differentiate ``run_on_lanes``.
    """

    def run_steps(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        @jax.custom_jvp
        def advance(leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
            return run(leaves, count)

        def jvp_rule(primals: Any, tangents: Any) -> Any:
            (values, count), (leaf_tangents, _) = primals, tangents
            perturbed = [i for i, t in enumerate(leaf_tangents) if not jaxcompat.is_symbolic_zero(t)]
            if kernels is not None and isinstance(n_steps, int) and perturbed:
                array_leaves = tuple([i for i, x in enumerate(values) if x is not None])
                spec = DerivativeSpec(kernels, n_steps, array_leaves, tuple(perturbed), len(values))
                operands = [values[i] for i in array_leaves]
                *written, flagged = advance_p.bind(*operands, run=run, spec=spec)
                in_tangents = [
                    leaf_tangents[i] if kernels.has_world_axis(i) else leaf_tangents[i][None] for i in perturbed
                ]
                out_tangents = tangent_p.bind(*operands, *in_tangents, spec=spec, n_nonlinear=len(operands))
                tangent_by_leaf = dict(zip(kernels.floats, out_tangents, strict=True))
                written_leaves = kernels.program.written_leaves
                written_tangents = [
                    tangent_by_leaf[i] if i in tangent_by_leaf else _float0_zeros(x)
                    for i, x in zip(written_leaves, written, strict=True)
                ]
                return (written, flagged), (written_tangents, _float0_zeros(flagged))

            if kernels is not None:
                announce("compiling a derivative of the steps on lanes", "10 to 40 s")
            step_count = n_steps if isinstance(n_steps, int) else count  # a traced count must be an argument

            def advance_floats(floats: list[Any]) -> Any:
                return run_on_lanes(replace_leaves(values, perturbed, floats), step_count)

            return jax.jvp(advance_floats, ([values[i] for i in perturbed],), ([leaf_tangents[i] for i in perturbed],))

        advance.defjvp(jvp_rule, symbolic_zeros=True)  # to skip the tangents of constant leaves
        return advance(leaves, jnp.asarray(n_steps, jnp.int32))

    return run_steps


def _float0_zeros(x: Any) -> np.ndarray:
    return np.zeros(x.shape, jax.dtypes.float0)


class DerivativeSpec(NamedTuple):
    """Description of a derivative of a program, which the primitives take as a static parameter.

    The operands are the leaves in ``array_leaves``, followed by the tangents of ``perturbed`` or by the cotangents of
    the written floats. Under ``vmap`` arrays of drones or worlds hold ``n_batches`` batches of worlds, one after
    another. Tangents and cotangents of shared leaves always have a leading axis for the batches. (n_batches, ...)
    """

    kernels: DerivativeKernels
    """Kernels of the derivatives."""
    n_steps: int
    """Number of steps."""
    array_leaves: tuple[int, ...]
    """Indices of the leaves that are arrays; the other leaves are None."""
    perturbed: tuple[int, ...]
    """Indices of the leaves whose tangents are operands, or whose cotangents are results."""
    n_leaves: int
    """Number of all leaves."""
    n_batches: int = 1
    """Number of batches."""

    def values(self, args: Sequence[Any]) -> list[Any]:
        """Return all leaves, taken from the operands; None for a leaf that is not in ``array_leaves``."""
        return replace_leaves([None] * self.n_leaves, self.array_leaves, args[: len(self.array_leaves)])

    def linear_operands(self, args: Sequence[Any]) -> list[Any]:
        return list(args[len(self.array_leaves) :])

    def world_axis_flags(self, leaves: Sequence[int]) -> list[bool]:
        """Return for each leaf whether it has a world axis, as leaves of drones and worlds do."""
        return list(map(self.kernels.has_world_axis, leaves))

    def map_batches(self, fn: Callable[..., list[Array]], args: Sequence[Any], linear_leaves: Sequence[int],
                     result_leaves: Sequence[int]) -> list[Array]:  # fmt: skip
        """Apply a function of the leaves and linear operands of one batch to all batches, and return the results."""
        leaf_axes, linear_axes = self.world_axis_flags(self.array_leaves), self.world_axis_flags(linear_leaves)

        def split_batches(x: Any) -> Any:
            return x.reshape(self.n_batches, -1, *x.shape[1:])

        def run_batch(values: Sequence[Any], operands: Sequence[Any]) -> list[Array]:
            return fn(self.values(values), list(operands))

        if self.n_batches == 1:
            linear_operands = [
                x if has_axis else x[0] for x, has_axis in zip(self.linear_operands(args), linear_axes, strict=True)
            ]
            outs = run_batch(args, linear_operands)
            return [
                x if has_axis else x[None]
                for x, has_axis in zip(outs, self.world_axis_flags(result_leaves), strict=True)
            ]
        values = [split_batches(x) if has_axis else x for x, has_axis in zip(args, leaf_axes, strict=False)]
        linear_operands = [
            split_batches(x) if has_axis else x
            for x, has_axis in zip(self.linear_operands(args), linear_axes, strict=True)
        ]
        outs = jax.vmap(run_batch, ([0 if has_axis else None for has_axis in leaf_axes], 0))(values, linear_operands)
        return [
            x.reshape(-1, *x.shape[2:]) if has_axis else x
            for x, has_axis in zip(outs, self.world_axis_flags(result_leaves), strict=True)
        ]


# Tangents ----------------------------------------------------------------------------------------------------------


def _tangent_shapes(*args: Any, spec: DerivativeSpec, **params: Any) -> list[jax.ShapeDtypeStruct]:
    del params
    program = spec.kernels.program
    n_worlds, _ = lanes.batch_counts(program, spec.values(args))
    return [lanes.leaf_shape(program, i, n_worlds) for i in spec.kernels.floats]


def _compute_tangents_on_lanes(*args: Any, spec: DerivativeSpec, **params: Any) -> list[Array]:
    del params

    def tangents(values: list[Any], leaf_tangents: list[Any]) -> list[Array]:
        fn = partial(_advance_floats, spec, values)
        return jax.jvp(fn, ([values[i] for i in spec.perturbed],), (leaf_tangents,))[1]

    return spec.map_batches(tangents, args, spec.perturbed, spec.kernels.floats)


def _compute_tangents(platform: str, *args: Any, spec: DerivativeSpec, **params: Any) -> list[Array]:
    del params
    kernel = spec.kernels.tangent_kernel(spec.perturbed, platform)
    if kernel is None:
        return _compute_tangents_on_lanes(*args, spec=spec)
    in_tangents = dict(zip(spec.perturbed, spec.linear_operands(args), strict=True))
    return kernel(spec.values(args), in_tangents, spec.n_steps, spec.n_batches, _tangent_shapes(*args, spec=spec))


# Cotangents --------------------------------------------------------------------------------------------------------


def _cotangent_shapes(*args: Any, spec: DerivativeSpec) -> list[jax.ShapeDtypeStruct]:
    leaves = [spec.values(args)[i] for i in spec.perturbed]
    shapes = [x.shape if has_world_axis else (spec.n_batches, *x.shape)
              for x, has_world_axis in zip(leaves, spec.world_axis_flags(spec.perturbed), strict=True)]  # fmt: skip
    return [jax.ShapeDtypeStruct(shape, x.dtype) for shape, x in zip(shapes, leaves, strict=True)]


def _compute_cotangents_on_lanes(*args: Any, spec: DerivativeSpec) -> list[Array]:
    def cotangents(values: list[Any], seeds: list[Any]) -> list[Array]:
        return jax.vjp(partial(_advance_floats, spec, values), [values[i] for i in spec.perturbed])[1](seeds)[0]

    return spec.map_batches(cotangents, args, spec.kernels.floats, spec.perturbed)


def _compute_cotangents(platform: str, *args: Any, spec: DerivativeSpec) -> list[Array]:
    kernel = spec.kernels.cotangent_kernel(spec.perturbed, platform)
    if kernel is None:
        return _compute_cotangents_on_lanes(*args, spec=spec)
    seeds = dict(zip(spec.kernels.floats, spec.linear_operands(args), strict=True))
    cotangents = kernel(spec.values(args), seeds, spec.n_steps, spec.n_batches)
    return [cotangents[i].reshape(x.shape) if i in cotangents else jnp.zeros(x.shape, x.dtype)
            for i, x in zip(spec.perturbed, _cotangent_shapes(*args, spec=spec), strict=True)]  # fmt: skip


def _transpose(operands: Sequence[Any], seeds: Sequence[Any], spec: DerivativeSpec, **params: Any) -> list[Array]:
    del params
    return cotangent_p.bind(*operands, *seeds, spec=spec)


def _advance_floats(spec: DerivativeSpec, values: Sequence[Any], floats: Sequence[Any]) -> list[Array]:
    kernels = spec.kernels
    written, _ = kernels.run_on_lanes(replace_leaves(values, spec.perturbed, floats), spec.n_steps)
    return [x for i, x in zip(kernels.program.written_leaves, written, strict=True) if i in kernels.floats]


def _batching_rule(
    primitive: Any, n: int, args: Sequence[Any], batched: Sequence[bool], spec: DerivativeSpec, **params: Any
) -> Any:
    n_nonlinear = len(spec.array_leaves)
    have_world_axis = [*spec.world_axis_flags(spec.array_leaves), *(True for _ in args[n_nonlinear:])]
    if any(b and not has_axis for b, has_axis in zip(batched, have_world_axis, strict=True)):
        # Shared parameters differ between the batches, so the primitive runs for one batch at a time.
        broadcast_args = [x if b else jnp.broadcast_to(x, (n, *x.shape)) for x, b in zip(args, batched, strict=True)]
        return jax.lax.map(lambda xs: list(primitive.bind(*xs, spec=spec, **params)), broadcast_args)

    def join_batches(x: Any, is_batched: bool) -> Any:
        x = x if is_batched else jnp.broadcast_to(x, (n, *x.shape))
        return x.reshape(-1, *x.shape[2:])

    operands = [
        join_batches(x, b) if has_axis else x for x, b, has_axis in zip(args, batched, have_world_axis, strict=True)
    ]
    outs = primitive.bind(*operands, spec=spec._replace(n_batches=n * spec.n_batches), **params)
    return [x.reshape(n, -1, *x.shape[1:]) for x in outs]


cotangent_p = jaxcompat.primitive_by_platform(
    "crazysim_cotangents",
    _cotangent_shapes,
    {"cpu": partial(_compute_cotangents, "cpu"), "cuda": partial(_compute_cotangents, "gpu")},
    differentiable_fn=_compute_cotangents_on_lanes,
    batching_rule=_batching_rule,
)
"""Primitive that computes the cotangents before some steps from the cotangents of the floats after the steps."""

tangent_p = jaxcompat.primitive_by_platform(
    "crazysim_tangents",
    _tangent_shapes,
    {"cpu": partial(_compute_tangents, "cpu"), "cuda": partial(_compute_tangents, "gpu")},
    differentiable_fn=_compute_tangents_on_lanes,
    transpose_rule=_transpose,
    batching_rule=_batching_rule,
)
"""Primitive that computes the tangents of the floats after some steps from the tangents before the steps."""


# The steps in a derivative -----------------------------------------------------------------------------------------


def _advance(*args: Any, run: CountedRun, spec: DerivativeSpec) -> list[Any]:
    written, flagged = run(spec.values(args), jnp.asarray(spec.n_steps, jnp.int32))
    return [*written, flagged]


def _advance_on_lanes(*args: Any, run: CountedRun, spec: DerivativeSpec) -> list[Any]:
    del run
    written, flagged = spec.kernels.run_on_lanes(spec.values(args), spec.n_steps)
    return [*written, flagged]


def _advance_shapes(*args: Any, **params: Any) -> list[Any]:
    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    return jax.eval_shape(lambda *arrays: _advance(*arrays, **params), *avals)


advance_p = jaxcompat.primitive_by_platform(
    "crazysim_advance",
    _advance_shapes,
    {"": _advance},
    differentiable_fn=_advance_on_lanes,
    batching_rule=jaxcompat.make_vmap_rule(_advance),
)
"""Primitive that runs the steps of a kernel inside a derivative. It is differentiated as the program on lanes."""
