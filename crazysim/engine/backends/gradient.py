"""Derivatives of kernels: in reverse mode a kernel of its own, otherwise those of the same program on lanes.

Going back is a primitive, which becomes the kernel of the platform that JAX lowers it for, or lanes where it has none.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import jaxcompat
from crazysim.cache import announce, announced
from crazysim.core.sharding import Location
from crazysim.core.stage import with_leaves
from crazysim.engine.backends import Run, lanes, reverse
from crazysim.engine.backends.native import Launch
from crazysim.engine.backends.platforms import TARGETS, compiled, described
from crazysim.engine.backends.reverse import Reverse
from crazysim.engine.errors import LimitError, UnsupportedError
from crazysim.engine.ir.program import Program
from crazysim.errors import EngineWarning


class Gradients:
    """Derivatives of one program for a fixed number of steps."""

    def __init__(self, program: Program, location: Location, on_lanes: Run):
        """Compile nothing yet.

        Args:
            program: The program.
            location: Devices that it is planned for.
            on_lanes: The program on lanes.
        """
        self.program, self.location, self.on_lanes = program, location, on_lanes
        self.used: dict[str, None] = {}
        """Ways in which gradients were computed so far, for ``explain``."""
        self.floats = tuple(i for i in program.written if program.leaves[i].number.kind == "f")
        """Leaves that are written and have derivatives."""
        self._found: dict[tuple[int, ...], Reverse | None] = {}
        self._launches: dict[tuple[str, Reverse], Launch | None] = {}

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
            return self.pull_on_lanes(values, seeds, changing, n_steps)

        going_back = self._reverse(tuple(changing))
        if going_back is None:
            return of_lanes(values, seeds)

        @jax.custom_jvp
        def by_platform(values: Sequence[Any], seeds: Sequence[Any]) -> list[Array]:
            back = Back(self, going_back, n_steps, present_of(values), tuple(changing), len(values))
            found = back.over_batches(1)([*(values[i] for i in back.present), *seeds])
            return [x if self.is_own(i) else x[0] for i, x in zip(changing, found, strict=True)]

        @by_platform.defjvp
        def _(primals: Any, tangents: Any) -> Any:  # second derivatives
            return jax.jvp(of_lanes, primals, tangents)

        return by_platform(list(values), list(seeds))

    def pull_on_lanes(
        self, values: Sequence[Any], seeds: Sequence[Any], changing: Sequence[int], n_steps: int
    ) -> list[Array]:
        """Return the same, computed by lanes."""

        def after(some: list[Any]) -> list[Array]:
            return self._floats_after(with_leaves(values, changing, some), n_steps)

        return jax.vjp(after, [values[i] for i in changing])[1](list(seeds))[0]

    def is_own(self, leaf: int) -> bool:
        """Return True if each drone or world has numbers of its own of a leaf."""
        return self.program.leaves[leaf].scope in ("drone", "world")

    def launch(self, platform: str, going_back: Reverse) -> Launch | None:
        """Return the kernel of a platform that goes back; None where there is none."""
        key = platform, going_back
        if key not in self._launches:
            location = self.location if platform == self.location.platform else Location(platform)
            try:
                kernel = reverse.write(going_back, TARGETS[platform])
                with announced("compiling a gradient through the steps", "5 to 20 s"):
                    self._launches[key] = compiled(kernel, location)
                self.used[f"one kernel, {described(kernel, platform, location.devices)}"] = None
            except UnsupportedError as error:
                self._launches[key] = None
                self._fall_back(error)
        return self._launches[key]

    def _floats_after(self, leaves: list[Any], n_steps: int) -> list[Array]:
        written, _ = self.on_lanes(leaves, n_steps)
        return [x for i, x in zip(self.program.written, written, strict=True) if i in self.floats]

    def _reverse(self, perturbed: tuple[int, ...]) -> Reverse | None:
        """Return the transposed derivatives with respect to some leaves; None where no kernel can compute them."""
        if perturbed not in self._found:
            try:
                self._found[perturbed] = reverse.reverse(self.program, perturbed)
            except UnsupportedError as error:
                self._found[perturbed] = None
                self._fall_back(error)
        return self._found[perturbed]

    def _fall_back(self, error: UnsupportedError) -> None:
        """Note that lanes compute a gradient, and for what reason."""
        announce("compiling a gradient through the steps on lanes", "10 to 40 s")
        self.used[f"on lanes ({error})"] = None
        if not isinstance(error, LimitError):
            warnings.warn(f"the gradient of the step runs on 'lanes': {error}", EngineWarning, stacklevel=2)


class Back(NamedTuple):
    """Static parameters of ``pull_p``."""

    gradients: Gradients
    """Derivatives of the program."""
    going_back: Reverse
    """Transposed derivatives of the program."""
    n_steps: int
    """Number of steps."""
    present: tuple[int, ...]
    """Leaves that are given."""
    changing: tuple[int, ...]
    """Leaves whose cotangents are computed."""
    n_leaves: int
    """Number of all leaves."""

    def over_batches(self, size: int) -> Callable[[list[Any]], list[Array]]:
        """Return ``pull_p`` as a function of its operands, with a rule for vmap: more batches of worlds.

        Args:
            size: Number of batches: those of what each drone or world has of its own follow each other.
        """
        own = [*map(self.gradients.is_own, self.present), *(True for _ in self.gradients.floats)]

        def call(args: list[Any]) -> list[Array]:
            return pull_p.bind(*args, back=self, size=size)

        def batched(n: int, in_batched: Any, args: list[Any]) -> Any:
            full = [x if b else jnp.broadcast_to(x, (n, *x.shape)) for x, b in zip(args, in_batched[0], strict=True)]
            if any(b and not o for b, o in zip(in_batched[0], own, strict=True)):  # parameters that differ: one by one
                out = jax.lax.map(self.over_batches(size), full)
            else:
                joined = [x.reshape(-1, *x.shape[2:]) if o else y for x, y, o in zip(full, args, own, strict=True)]
                out = [x.reshape(n, -1, *x.shape[1:]) for x in self.over_batches(n * size)(joined)]
            return out, [True for _ in out]

        return jaxcompat.batched_rule(call, batched)

    def on(self, platform: str, args: Sequence[Any], size: int) -> list[Array]:
        """Return the cotangents, computed by the kernel of a platform; by lanes where it has none."""
        launch = self.gradients.launch(platform, self.going_back)
        return self._on_lanes(args, size) if launch is None else self._in_kernel(launch, args, size)

    def _in_kernel(self, launch: Launch, args: Sequence[Any], size: int) -> list[Array]:
        program, going_back = self.gradients.program, self.going_back
        values, seeds = self._values(args), args[len(self.present) :]
        n_worlds, n_drones = lanes.batch(program, values)

        def seed(i: int, x: Array) -> Array:
            x = x.reshape(n_worlds, -1, program.leaves[i].size)
            return x if x.shape[1] == n_drones else jnp.pad(x, ((0, 0), (0, n_drones - 1), (0, 0)))

        inputs = [values[i] for i in reverse.needed(going_back)]
        numbers = [jax.random.key_data(x) if jaxcompat.is_key(x) else x for x in inputs]
        given = [seed(i, x) for i, x in zip(self.gradients.floats, seeds, strict=True)]
        leaves = [program.leaves[i] for i in going_back.perturbed]
        outputs = [jax.ShapeDtypeStruct((n_worlds, n_drones, x.size), x.number) for x in leaves]
        n_lanes, count = n_worlds * n_drones, np.asarray([self.n_steps], np.int32)
        found = dict(zip(going_back.perturbed, launch(n_lanes, count, [*numbers, *given], outputs), strict=True))

        def of_leaf(i: int, like: jax.ShapeDtypeStruct) -> Array:
            x, scope = found.get(i), program.leaves[i].scope
            if x is None:
                return jnp.zeros(like.shape, like.dtype)
            if scope == "world":
                x = jnp.sum(x, axis=1)
            elif scope != "drone":
                x = jnp.sum(x.reshape(size, n_lanes // size, -1), axis=1)
            return x.reshape(like.shape)

        return list(map(of_leaf, self.changing, self.results(args, size)))

    def _on_lanes(self, args: Sequence[Any], size: int) -> list[Array]:
        values, seeds, own = self._values(args), list(args[len(self.present) :]), self.gradients.is_own

        def pull(values: list[Any], seeds: list[Any]) -> list[Array]:
            return self.gradients.pull_on_lanes(values, seeds, self.changing, self.n_steps)

        def split(x: Any) -> Any:
            return x.reshape(size, -1, *x.shape[1:])

        if size == 1:
            found = pull(values, seeds)
            return [x if own(i) else x[None] for i, x in zip(self.changing, found, strict=True)]
        axes = [0 if own(i) and x is not None else None for i, x in enumerate(values)]
        values = [x if axis is None else split(x) for x, axis in zip(values, axes, strict=True)]
        found = jax.vmap(pull, (axes, 0))(values, list(map(split, seeds)))
        return [x.reshape(-1, *x.shape[2:]) if own(i) else x for i, x in zip(self.changing, found, strict=True)]

    def results(self, args: Sequence[Any], size: int) -> list[jax.ShapeDtypeStruct]:
        """Return shapes and types of the cotangents: one for each batch of a leaf that drones share."""
        like = [args[self.present.index(i)] for i in self.changing]
        shapes = [x.shape if self.gradients.is_own(i) else (size, *x.shape)
                  for i, x in zip(self.changing, like, strict=True)]  # fmt: skip
        return [jax.ShapeDtypeStruct(shape, x.dtype) for shape, x in zip(shapes, like, strict=True)]

    def _values(self, args: Sequence[Any]) -> list[Any]:
        return with_leaves([None] * self.n_leaves, self.present, args[: len(self.present)])


def _pulled(platform: str, *args: Any, back: Back, size: int) -> list[Array]:
    return back.on(platform, args, size)


pull_p = jaxcompat.primitive_by_platform(
    "crazysim_gradient",
    lambda *args, back, size: back.results(args, size),
    {"cpu": partial(_pulled, "cpu"), "cuda": partial(_pulled, "gpu")},
)
"""Cotangents before some steps: operands are the leaves of the program, then the cotangents of the floats it writes."""


def present_of(values: Sequence[Any]) -> tuple[int, ...]:
    """Return the leaves that are given."""
    return tuple([i for i, x in enumerate(values) if x is not None])


def tangents(gradients: Gradients, values: Sequence[Any], slopes: Sequence[Any], changing: list[int], n: int) -> list:
    """Return the tangents of what a program writes, floats and others, in a form whose transpose is a kernel.

    Args:
        gradients: Derivatives of the program.
        values: Its leaves; None for one that is written before it is read.
        slopes: Tangents of the leaves that change.
        changing: These leaves.
        n: Number of steps.
    """
    present = present_of(values)
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
    present = present_of(values)
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
