"""Derivatives of the steps of a kernel for JAX: primitives with rules for derivatives, transposes and vmap.

One primitive computes the tangents after some steps, and is linear in the tangents before them. Its transpose is
another primitive. JAX lowers each to a kernel of the platform, or to the program on lanes if there is no such kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import jaxcompat
from crazysim.cache import announce
from crazysim.engine.backends import Run, lanes
from crazysim.engine.backends.derivative_kernels import DerivativeKernels
from crazysim.pytree import replace_leaves

CountedRun = Callable[[list[Any], Array], tuple[list[Any], Array]]
"""A ``Run`` whose number of steps is an array."""


def make_differentiable(run: CountedRun, run_on_lanes: Run, kernels: DerivativeKernels | None = None) -> Run:
    """Return a differentiable function that runs a program.

    Args:
        run: Function that runs the program.
        run_on_lanes: The program on lanes, which JAX can differentiate. Used without ``kernels``, and if the number of
            steps is an array.
        kernels: Kernels of the derivatives; None to differentiate ``run_on_lanes``.
    """

    def steps(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        @jax.custom_jvp
        def advance(leaves: list[Any], count: Array) -> tuple[list[Any], Array]:
            return run(leaves, count)

        def derivative(primals: Any, tangents: Any) -> Any:
            (values, count), (leaf_tangents, _) = primals, tangents
            perturbed = [i for i, t in enumerate(leaf_tangents) if not jaxcompat.is_symbolic_zero(t)]
            if kernels is not None and isinstance(n_steps, int) and perturbed:
                array_leaves = tuple([i for i, x in enumerate(values) if x is not None])
                case = Case(kernels, n_steps, array_leaves, tuple(perturbed), len(values))
                operands = [values[i] for i in array_leaves]
                *written, flagged = advance_p.bind(*operands, run=run, case=case)
                in_tangents = [leaf_tangents[i] if kernels.is_own(i) else leaf_tangents[i][None] for i in perturbed]
                out_tangents = tangent_p.bind(*operands, *in_tangents, case=case, n_nonlinear=len(operands))
                tangent_by_leaf = dict(zip(kernels.floats, out_tangents, strict=True))
                written_leaves = kernels.program.written_leaves
                written_tangents = [
                    tangent_by_leaf[i] if i in tangent_by_leaf else _float0_zeros(x)
                    for i, x in zip(written_leaves, written, strict=True)
                ]
                return (written, flagged), (written_tangents, _float0_zeros(flagged))

            if kernels is not None:
                announce("compiling a derivative of the steps on lanes", "10 to 40 s")
            count_or_array = n_steps if isinstance(n_steps, int) else count  # a traced one may not be closed over

            def advance_floats(floats: list[Any]) -> Any:
                return run_on_lanes(replace_leaves(values, perturbed, floats), count_or_array)

            return jax.jvp(advance_floats, ([values[i] for i in perturbed],), ([leaf_tangents[i] for i in perturbed],))

        advance.defjvp(derivative, symbolic_zeros=True)  # to skip the tangents of constant leaves
        return advance(leaves, jnp.asarray(n_steps, jnp.int32))

    return steps


def _float0_zeros(x: Any) -> np.ndarray:
    """Return the tangent of an array whose type is not floating-point."""
    return np.zeros(x.shape, jax.dtypes.float0)


class Case(NamedTuple):
    """Derivative of a program: static parameters of the primitives.

    The operands are the leaves in ``array_leaves``, then the tangents of ``perturbed``, or the cotangents of the floats
    that are written. Under ``vmap`` arrays of drones or worlds hold ``size`` batches of worlds, one after another;
    tangents and cotangents of shared leaves have a leading axis for the batches. (size, ...)
    """

    kernels: DerivativeKernels
    """Kernels of the derivatives."""
    n_steps: int
    """Number of steps."""
    array_leaves: tuple[int, ...]
    """Leaves that are arrays; the others are None."""
    perturbed: tuple[int, ...]
    """Leaves whose tangents are operands, or whose cotangents are results."""
    n_leaves: int
    """Number of all leaves."""
    n_batches: int = 1
    """Number of batches."""

    def values(self, args: Sequence[Any]) -> list[Any]:
        """Return all leaves, taken from the operands; None for a leaf that is not in ``array_leaves``."""
        return replace_leaves([None] * self.n_leaves, self.array_leaves, args[: len(self.array_leaves)])

    def linear_operands(self, args: Sequence[Any]) -> list[Any]:
        """Return the operands in which the derivative is linear."""
        return list(args[len(self.array_leaves) :])

    def is_own(self, leaves: Sequence[int]) -> list[bool]:
        """Return True for leaves with numbers of their own for each drone or world."""
        return list(map(self.kernels.is_own, leaves))

    def map_batches(self, fn: Callable[..., list[Array]], args: Sequence[Any], linear_leaves: Sequence[int],
                     result_leaves: Sequence[int]) -> list[Array]:  # fmt: skip
        """Apply a function of the leaves and linear operands of one batch to all batches, and return the results."""
        leaves_batched, linear_batched = self.is_own(self.array_leaves), self.is_own(linear_leaves)

        def split_batches(x: Any) -> Any:
            return x.reshape(self.n_batches, -1, *x.shape[1:])

        def run_batch(values: Sequence[Any], operands: Sequence[Any]) -> list[Array]:
            return fn(self.values(values), list(operands))

        if self.n_batches == 1:
            linear_operands = [
                x if o else x[0] for x, o in zip(self.linear_operands(args), linear_batched, strict=True)
            ]
            outs = run_batch(args, linear_operands)
            return [x if o else x[None] for x, o in zip(outs, self.is_own(result_leaves), strict=True)]
        values = [split_batches(x) if o else x for x, o in zip(args, leaves_batched, strict=False)]
        linear_operands = [
            split_batches(x) if o else x for x, o in zip(self.linear_operands(args), linear_batched, strict=True)
        ]
        outs = jax.vmap(run_batch, ([0 if o else None for o in leaves_batched], 0))(values, linear_operands)
        return [x.reshape(-1, *x.shape[2:]) if o else x for x, o in zip(outs, self.is_own(result_leaves), strict=True)]


# Tangents ----------------------------------------------------------------------------------------------------------


def _tangent_shapes(*args: Any, case: Case, **params: Any) -> list[jax.ShapeDtypeStruct]:
    del params
    program = case.kernels.program
    n_worlds, _ = lanes.batch_counts(program, case.values(args))
    return [lanes.leaf_shape(program, i, n_worlds) for i in case.kernels.floats]


def _tangents_on_lanes(*args: Any, case: Case, **params: Any) -> list[Array]:
    del params

    def tangents(values: list[Any], leaf_tangents: list[Any]) -> list[Array]:
        fn = partial(_advance_floats, case, values)
        return jax.jvp(fn, ([values[i] for i in case.perturbed],), (leaf_tangents,))[1]

    return case.map_batches(tangents, args, case.perturbed, case.kernels.floats)


def _tangents(platform: str, *args: Any, case: Case, **params: Any) -> list[Array]:
    del params
    kernel = case.kernels.tangent_kernel(case.perturbed, platform)
    if kernel is None:
        return _tangents_on_lanes(*args, case=case)
    in_tangents = dict(zip(case.perturbed, case.linear_operands(args), strict=True))
    return kernel(case.values(args), in_tangents, case.n_steps, case.n_batches, _tangent_shapes(*args, case=case))


# Cotangents --------------------------------------------------------------------------------------------------------


def _cotangent_shapes(*args: Any, case: Case) -> list[jax.ShapeDtypeStruct]:
    leaves = [case.values(args)[i] for i in case.perturbed]
    shapes = [x.shape if is_own else (case.n_batches, *x.shape)
              for x, is_own in zip(leaves, case.is_own(case.perturbed), strict=True)]  # fmt: skip
    return [jax.ShapeDtypeStruct(shape, x.dtype) for shape, x in zip(shapes, leaves, strict=True)]


def _cotangents_on_lanes(*args: Any, case: Case) -> list[Array]:
    def cotangents(values: list[Any], seeds: list[Any]) -> list[Array]:
        return jax.vjp(partial(_advance_floats, case, values), [values[i] for i in case.perturbed])[1](seeds)[0]

    return case.map_batches(cotangents, args, case.kernels.floats, case.perturbed)


def _cotangents(platform: str, *args: Any, case: Case) -> list[Array]:
    kernel = case.kernels.cotangent_kernel(case.perturbed, platform)
    if kernel is None:
        return _cotangents_on_lanes(*args, case=case)
    seeds = dict(zip(case.kernels.floats, case.linear_operands(args), strict=True))
    cotangents = kernel(case.values(args), seeds, case.n_steps, case.n_batches)
    return [cotangents[i].reshape(x.shape) if i in cotangents else jnp.zeros(x.shape, x.dtype)
            for i, x in zip(case.perturbed, _cotangent_shapes(*args, case=case), strict=True)]  # fmt: skip


def _transpose(operands: Sequence[Any], seeds: Sequence[Any], case: Case, **params: Any) -> list[Array]:
    del params
    kernels = case.kernels
    if not kernels.program.fused:  # unfused stages may have effects, such as printing, which a primitive cannot have
        kernels.cotangent_kernel(case.perturbed, kernels.location.platform)  # returns None, and records the reason
        return _cotangents_on_lanes(*operands, *seeds, case=case)
    return cotangent_p.bind(*operands, *seeds, case=case)


def _advance_floats(case: Case, values: Sequence[Any], floats: Sequence[Any]) -> list[Array]:
    kernels = case.kernels
    written, _ = kernels.run_on_lanes(replace_leaves(values, case.perturbed, floats), case.n_steps)
    return [x for i, x in zip(kernels.program.written_leaves, written, strict=True) if i in kernels.floats]


def _batching_rule(
    primitive: Any, n: int, args: Sequence[Any], batched: Sequence[bool], case: Case, **params: Any
) -> Any:
    """Return the results of a primitive for ``n`` batches: one call for more worlds, if parameters do not differ."""
    n_nonlinear = len(case.array_leaves)
    is_own = [*case.is_own(case.array_leaves), *(True for _ in args[n_nonlinear:])]
    if any(b and not o for b, o in zip(batched, is_own, strict=True)):  # parameters differ: one batch at a time
        broadcast_args = [x if b else jnp.broadcast_to(x, (n, *x.shape)) for x, b in zip(args, batched, strict=True)]
        return jax.lax.map(lambda xs: list(primitive.bind(*xs, case=case, **params)), broadcast_args)

    def join_batches(x: Any, b: bool) -> Any:
        x = x if b else jnp.broadcast_to(x, (n, *x.shape))
        return x.reshape(-1, *x.shape[2:])

    operands = [join_batches(x, b) if o else x for x, b, o in zip(args, batched, is_own, strict=True)]
    outs = primitive.bind(*operands, case=case._replace(n_batches=n * case.n_batches), **params)
    return [x.reshape(n, -1, *x.shape[1:]) for x in outs]


cotangent_p = jaxcompat.primitive_by_platform(
    "crazysim_cotangents",
    _cotangent_shapes,
    {"cpu": partial(_cotangents, "cpu"), "cuda": partial(_cotangents, "gpu")},
    differentiable_fn=_cotangents_on_lanes,
    batching_rule=_batching_rule,
)
"""Cotangents before some steps, from the cotangents of the floats after them."""

tangent_p = jaxcompat.primitive_by_platform(
    "crazysim_tangents",
    _tangent_shapes,
    {"cpu": partial(_tangents, "cpu"), "cuda": partial(_tangents, "gpu")},
    differentiable_fn=_tangents_on_lanes,
    transpose_rule=_transpose,
    batching_rule=_batching_rule,
)
"""Tangents of the floats after some steps, from the tangents before them."""


# The steps in a derivative -----------------------------------------------------------------------------------------


def _advance(*args: Any, run: CountedRun, case: Case) -> list[Any]:
    written, flagged = run(case.values(args), jnp.asarray(case.n_steps, jnp.int32))
    return [*written, flagged]


def _advance_on_lanes(*args: Any, run: CountedRun, case: Case) -> list[Any]:
    del run
    written, flagged = case.kernels.run_on_lanes(case.values(args), case.n_steps)
    return [*written, flagged]


def _shapes(*args: Any, **params: Any) -> list[Any]:
    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    return jax.eval_shape(lambda *arrays: _advance(*arrays, **params), *avals)


advance_p = jaxcompat.primitive_by_platform(
    "crazysim_advance",
    _shapes,
    {"": _advance},
    differentiable_fn=_advance_on_lanes,
    batching_rule=jaxcompat.make_vmap_rule(_advance),
)
"""Steps of a kernel inside a derivative; higher derivatives are derivatives of the program on lanes."""
