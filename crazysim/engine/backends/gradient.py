"""Derivatives of kernels: in reverse mode a kernel of its own, otherwise those of the same program on lanes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import jaxcompat
from crazysim.cache import announce, announced
from crazysim.core.sharding import Location
from crazysim.core.stage import with_leaves
from crazysim.engine.backends import Run, lanes, native, reverse
from crazysim.engine.backends.native import Launch
from crazysim.engine.errors import LimitError, UnsupportedError
from crazysim.engine.ir.program import Program
from crazysim.errors import ConfigError, EngineWarning


class Gradients:
    """Derivatives of one program for a fixed number of steps."""

    def __init__(self, program: Program, location: Location, on_lanes: Run, launch: Callable[..., Any]):
        """Compile nothing yet.

        Args:
            program: The program.
            location: Devices that it runs on.
            on_lanes: The program on lanes.
            launch: Calls a kernel: ``launch(count, *inputs, kernels=, n_worlds=)``.
        """
        self.program, self.location, self.on_lanes, self.launch = program, location, on_lanes, launch
        self.used: dict[str, None] = {}
        """Lines for ``explain`` with the way in which gradients were computed so far."""
        self.floats = tuple(i for i in program.written if program.leaves[i].number.kind == "f")
        """Leaves that are written and have derivatives."""
        self._found: dict[tuple[int, ...], ReverseKernels | None] = {}

    def push(self, values: Sequence[Any], slopes: Sequence[Any], changing: Sequence[int], n_steps: int) -> list[Array]:
        """Return the tangents of the floats after some steps, from those of the leaves that change."""
        out, tangents = jax.jvp(
            lambda some: self._floats_after(with_leaves(values, changing, some), n_steps),
            ([values[i] for i in changing],),
            (list(slopes),),
        )
        del out
        return tangents

    def pull(self, values: Sequence[Any], seeds: Sequence[Any], changing: Sequence[int], n_steps: int) -> list[Array]:
        """Return the cotangents of the leaves that change, from those of the floats after some steps."""

        def of_lanes(values: Sequence[Any], seeds: Sequence[Any]) -> list[Array]:
            def after(some: list[Any]) -> list[Array]:
                return self._floats_after(with_leaves(values, changing, some), n_steps)

            return jax.vjp(after, [values[i] for i in changing])[1](list(seeds))[0]

        kernels = self._kernels(tuple(changing))
        if kernels is None:
            return of_lanes(values, seeds)

        @jax.custom_jvp
        def of_kernel(values: Sequence[Any], seeds: Sequence[Any]) -> list[Array]:
            return self._run(kernels, values, seeds, changing, n_steps)

        @of_kernel.defjvp
        def _(primals: Any, tangents: Any) -> Any:  # second derivatives
            return jax.jvp(of_lanes, primals, tangents)

        return of_kernel(list(values), list(seeds))

    def _floats_after(self, leaves: list[Any], n_steps: int) -> list[Array]:
        written, _ = self.on_lanes(leaves, n_steps)
        return [x for i, x in zip(self.program.written, written, strict=True) if i in self.floats]

    def _kernels(self, perturbed: tuple[int, ...]) -> ReverseKernels | None:
        """Return the kernels for cotangents of some leaves; None where lanes compute them."""
        if perturbed not in self._found:
            try:
                with announced("compiling a gradient through the steps", "5 to 20 s"):
                    self._found[perturbed] = ReverseKernels(self.program, perturbed, self.location)
                self.used["gradient: one kernel"] = None
            except UnsupportedError as error:
                announce("compiling a gradient through the steps on lanes", "10 to 40 s")
                self._found[perturbed] = None
                self.used[f"gradient: on lanes ({error})"] = None
                if not isinstance(error, LimitError):
                    warnings.warn(f"the gradient of the step runs on 'lanes': {error}", EngineWarning, stacklevel=2)
        return self._found[perturbed]

    def _run(
        self,
        kernels: ReverseKernels,
        values: Sequence[Any],
        seeds: Sequence[Any],
        changing: Sequence[int],
        n_steps: int,
    ) -> list[Array]:
        program = self.program
        n_drones = program.n_drones
        n_worlds = lanes.batch(program, list(values))[0]
        own = [program.leaves[i].scope in ("drone", "world") for i in kernels.inputs]

        def seed(i: int, x: Array) -> Array:
            x = x.reshape(n_worlds, -1, program.leaves[i].size)
            return x if x.shape[1] == n_drones else jnp.pad(x, ((0, 0), (0, n_drones - 1), (0, 0)))

        def call(inputs: list[Array], seeds: list[Array]) -> list[Array]:
            count = jnp.asarray([n_steps, reverse.interval(kernels.reverse, n_steps)], jnp.int32)
            n = seeds[0].shape[0]
            return list(self.launch(count, *inputs, *seeds, kernels=kernels, n_worlds=n))

        def batched(size: int, in_batched: Any, inputs: list[Array], seeds: list[Array]) -> Any:
            of_inputs, of_seeds = in_batched
            some = [*inputs, *seeds]
            flags = [*of_inputs, *of_seeds]
            split = [*own, *(True for _ in seeds)]
            full = [x if b else jnp.broadcast_to(x, (size, *x.shape)) for x, b in zip(some, flags, strict=True)]
            if any(b and not o for b, o in zip(flags, split, strict=True)):  # parameters that differ: one by one
                out = jax.lax.map(lambda xs: call(xs[: len(inputs)], xs[len(inputs) :]), full)
                return out, [True] * len(out)
            joined = [x.reshape(-1, *x.shape[2:]) if o else y for x, y, o in zip(full, some, split, strict=True)]
            out = call(joined[: len(inputs)], joined[len(inputs) :])
            return [x.reshape(size, -1, *x.shape[1:]) for x in out], [True] * len(out)

        inputs = [jax.random.key_data(values[i]) if jaxcompat.is_key(values[i]) else values[i] for i in kernels.inputs]
        given = [seed(i, x) for i, x in zip(self.floats, seeds, strict=True)]
        found = dict(zip(kernels.perturbed, jaxcompat.batched_rule(call, batched)(inputs, given), strict=True))

        def of_leaf(i: int) -> Array:
            x, scope = found.get(i), program.leaves[i].scope
            if x is None:
                return jnp.zeros_like(values[i])
            if scope != "drone":
                x = jnp.sum(x, axis=1 if scope == "world" else (0, 1))
            return x.reshape(values[i].shape)

        return [of_leaf(i) for i in changing]


class ReverseKernels:
    """Kernel that goes back through the steps of a program, on the host."""

    def __init__(self, program: Program, perturbed: tuple[int, ...], location: Location):
        """Compile the kernel.

        Raises:
            UnsupportedError: If a part of the program has no derivative in a kernel, or it cannot be compiled.
        """
        if location.platform != "cpu" or jax.default_backend() != "cpu":  # JAX may compile it for its own choice
            raise LimitError("gradients have kernels only where JAX has CPUs alone")
        self.program = program
        self.reverse = reverse.reverse(program, perturbed)
        self.inputs, self.perturbed = reverse.needed(self.reverse), self.reverse.perturbed
        self._launch = native.HostLaunch(reverse.write(self.reverse))

    def on(self, platform: str) -> Launch:
        """Return the function that calls the kernel.

        Raises:
            ConfigError: If JAX compiles for another platform.
        """
        if platform != "cpu":
            raise ConfigError(
                f"expected a gradient on the CPU, which this step was planned for, got one on the {platform.upper()}. "
                f"Use engine='lanes', or data on the CPU."
            )
        return self._launch

    def results(self, n_worlds: int) -> list[jax.ShapeDtypeStruct]:
        """Return shapes and types of the cotangents: of each perturbed leaf one for every drone."""
        leaves = [self.program.leaves[i] for i in self.perturbed]
        return [jax.ShapeDtypeStruct((n_worlds, self.program.n_drones, x.size), x.number) for x in leaves]


def tangents(gradients: Gradients, values: Sequence[Any], slopes: Sequence[Any], changing: list[int], n: int) -> list:
    """Return the tangents of what a program writes, floats and others, in a form whose transpose is a kernel.

    Args:
        gradients: Derivatives of the program.
        values: Its leaves; None for one that is written before it is read.
        slopes: Tangents of the leaves that change.
        changing: These leaves.
        n: Number of steps.
    """
    present = tuple([i for i, x in enumerate(values) if x is not None])
    found = tangent_p.bind(
        *(values[i] for i in present), *slopes, n_fixed=len(present), gradients=gradients, n_steps=n,
        present=present, changing=tuple(changing), n_leaves=len(values),
    )  # fmt: skip
    return list(found)


def _results(*args: Any, gradients: Gradients, present: Sequence[int], **params: Any) -> list[Any]:
    del params
    program = gradients.program
    n_worlds = next(
        x.shape[0] for i, x in zip(present, args, strict=False)
        if program.leaves[i].scope == "drone" and not program.leaves[i].rows_of
    )  # fmt: skip
    return [lanes.shape_of(program, i, n_worlds) for i in gradients.floats]


def _values(args: Sequence[Any], present: Sequence[int], n_leaves: int) -> list[Any]:
    return with_leaves([None] * n_leaves, present, args[: len(present)])


def _forward(*args: Any, n_fixed: int, gradients: Gradients, n_steps: int, present: Any, changing: Any, n_leaves: int):
    return gradients.push(_values(args, present, n_leaves), args[n_fixed:], changing, n_steps)


def _backward(
    fixed: Any, seeds: Any, n_fixed: int, gradients: Gradients, n_steps: int, present: Any, changing: Any, n_leaves: int
) -> list[Array]:
    del n_fixed
    return gradients.pull(_values(fixed, present, n_leaves), seeds, changing, n_steps)


tangent_p = jaxcompat.linear_primitive("crazysim_tangents", _results, _forward, _backward)
"""Tangents of a program: operands are its leaves, then the tangents of those that change."""


def advance(gradients: Gradients, run: Any, values: Sequence[Any], n: int) -> tuple[list[Array], Array]:
    """Return what a kernel writes, in a form that can be differentiated inside a derivative of it.

    Args:
        gradients: Derivatives of the program.
        run: Runs the kernel.
        values: Its leaves; None for one that is written before it is read.
        n: Number of steps.
    """
    present = tuple([i for i, x in enumerate(values) if x is not None])
    *written, flagged = advance_p.bind(
        *(values[i] for i in present), gradients=gradients, run=run, n_steps=n, present=present, n_leaves=len(values)
    )
    return written, flagged


def _advanced(*args: Any, gradients: Gradients, run: Any, n_steps: int, present: Any, n_leaves: int) -> list[Any]:
    del gradients
    written, flagged = run(_values(args, present, n_leaves), jnp.asarray(n_steps, jnp.int32))
    return [*written, flagged]


def _on_lanes(*args: Any, gradients: Gradients, run: Any, n_steps: int, present: Any, n_leaves: int) -> list[Any]:
    del run
    written, flagged = gradients.on_lanes(_values(args, present, n_leaves), n_steps)
    return [*written, flagged]


def _shapes(*args: Any, **params: Any) -> list[Any]:
    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    return jax.eval_shape(lambda *some: _advanced(*some, **params), *avals)


advance_p = jaxcompat.linear_primitive("crazysim_advance", _shapes, _advanced, derivative=_on_lanes)
"""Steps of a kernel, whose derivative is that of the program on lanes."""


def float0(x: Any) -> np.ndarray:
    """Return the tangent of an array that has none."""
    return np.zeros(x.shape, jax.dtypes.float0)
