"""Stages with a declared scope, one drone or one world, and functions of one world applied to all worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.others import MEMBER_AXIS
from crazysim.errors import ConfigError
from crazysim.pytree import (
    PyTree,
    has_members,
    leaf_indices,
    n_batch_axes,
    n_world_axes,
    replace_leaves,
    scopes,
    select_worlds,
)

T = TypeVar("T")

StageScope = str
"""``"drone"``, ``"world"``, ``"batch"`` for all worlds, or the name of a population."""

Phase = Literal["before", "each", "after"]
"""When in a call a stage runs: once before the first step, at each step, or once after the last."""

PHASES: tuple[Phase, ...] = ("before", "each", "after")

RESERVED_SCOPES = ("batch", "batched", "shared", "opaque", "parameter", "member")
"""Names of other scopes, which neither a stage is declared for nor a population is named."""


class Stage:
    """A function ``SimData -> SimData`` with the scope that it is written for.

    Called with the data of a simulation, it applies its function to every drone, or to every world.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        scope: StageScope,
        when: Callable[..., Array | None] | None = None,
        batched: bool = False,
        name: str | None = None,
        fixed: bool = False,
        why: str = "it is not declared for one drone or one world",
        phase: Phase = "each",
    ):
        """Declare a stage; see ``stage``.

        ``batched`` declares that the functions also take any leading axes. ``fixed`` declares that they always do the
        same, for any numbers of worlds and drones, so that an engine traces them once in a process. ``why`` is the
        reason of the scope ``"batch"``.
        """
        self.fn, self.when, self.batched, self.fixed, self.why = fn, when, batched, fixed, why
        self.scope: StageScope = scope
        self.phase: Phase = phase
        self.__name__ = name or getattr(fn, "__name__", type(fn).__name__)
        self.__doc__ = fn.__doc__

    def __call__(self, data: SimData) -> SimData:
        """Return the data after the stage, in every world and for every drone."""
        if self.batched or self.scope == "batch":
            return self.apply_to_one(data)
        return _apply_in_all_worlds(self, data)

    def apply_to_one(self, data: SimData) -> SimData:
        """Return the data of one drone or world after the stage."""
        after = self.fn(data)
        mask = None if self.when is None else self.when(data)
        if mask is None:
            return after

        def select(new: Array, old: Array) -> Array:
            return new if new is old else jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - mask.ndim)), new, old)

        return jax.tree.map(select, after, data)

    def apply_in_worlds(self, data: SimData, mask: Array | None) -> SimData:
        """Return the data after the stage in the worlds of a mask, (n_worlds,), or in all for None."""
        after = self(data)
        return (
            after
            if mask is None
            else jax.tree.map(lambda x, y: x if x is y else select_worlds(mask, x, y), after, data)
        )

    def __repr__(self) -> str:
        return f"<stage {self.__name__} of one {self.scope}>"


def stage(
    scope: StageScope, when: Callable[..., Array | None] | None = None, phase: Phase = "each"
) -> Callable[[Callable[..., Any]], Stage]:
    """Declare the scope of a stage, so that an engine can fuse it with its neighbours.

    A stage without a declared scope receives the full batch.

    ``@stage("drone")``: the data of one drone. Leaves of drones and worlds come without batch axes: ``pos`` is (3,),
    ``steps`` (). Leaves of other populations come as (n_members, ...). The stage writes leaves of its drone, and reads
    leaves of other drones by ``reduce_over_others``.

    ``@stage("cars")``: the data of one member of the population of that name, likewise. Leaves of drones come as
    (n_drones, ...). The stage writes leaves of the population.

    ``@stage("world")``: the data of one world. Leaves of drones come as (n_drones, ...), leaves of other populations as
    (n_members, ...), leaves of worlds without batch axes. The stage writes leaves of any of these.

    Args:
        scope: ``"drone"``, ``"world"`` or the name of a population.
        when: ``when(data)``: true if the stage acts at this step, (); None for always. An engine skips a stage at
            steps where it acts nowhere.
        phase: When in a call of the step it runs: ``"before"`` the first of its physics steps, at ``"each"`` of them,
            or ``"after"`` the last.
    """
    if not isinstance(scope, str) or not scope or scope in RESERVED_SCOPES:
        raise ConfigError(
            f"expected scope 'drone', 'world' or the name of a population, got {scope!r}. A stage of the full batch is "
            f"left undeclared."
        )
    if phase not in PHASES:
        raise ConfigError(f"expected a phase of {', '.join(map(repr, PHASES))}, got {phase!r}.")
    return lambda fn: Stage(fn, scope, when, phase=phase)


def tick(data: SimData, freq: int) -> Array | None:
    """Return where a controller of a rate acts at this step, or None if it does always. (n_worlds, 1), or () for one"""
    period = data.core.freq // freq
    return None if period == 1 else data.core.steps % period == 0


def is_first_step(data: SimData) -> Array:
    """Return True in the first step of an episode. (n_worlds, 1), or () for one

    Leading stages of a step with this condition run before the first step of a call.
    """
    return data.core.steps == 0


def as_stages(pipeline: Mapping[str, Callable[..., Any]]) -> list[Stage]:
    """Return the functions of a pipeline as stages under the pipeline's names; undeclared ones get the full batch."""
    return [
        Stage(fn.fn, fn.scope, fn.when, fn.batched, name, fn.fixed, fn.why, fn.phase)
        if isinstance(fn, Stage)
        else Stage(fn, "batch", name=name)
        for name, fn in pipeline.items()
    ]


class Axes:
    """Names and batch axes of all leaves of a simulation's data."""

    def __init__(self, data: SimData):
        paths, self.treedef = jax.tree_util.tree_flatten_with_path(data)
        self.names = [jax.tree_util.keystr(path).lstrip(".") for path, _ in paths]
        self.numbers = leaf_indices(data)
        """Number of every leaf, by its path."""
        self.scopes: list[str] = jax.tree.leaves(scopes(data))

    def written(self, before: list[Array], after: SimData, stage: Stage) -> list[int]:
        """Return the numbers of the leaves that a stage wrote, and check that it may."""
        name = stage.__name__
        new, treedef = jax.tree.flatten(after)
        if treedef != self.treedef:
            raise ConfigError(
                f"stage {name!r} changed the structure of SimData (a field became None, or a plugin came or went); "
                f"put everything in place before the step, with sim.data = sim.data.replace(...)"
            )
        written = [i for i, (x, y) in enumerate(zip(before, new, strict=True)) if x is not y]
        writable_scopes = self.writable(stage)
        for i in written:
            x, y = before[i], new[i]
            if jnp.shape(x) != jnp.shape(y) or jnp.result_type(x) != jnp.result_type(y):
                raise ConfigError(
                    f"stage {name!r} turned {self.names[i]} of shape {jnp.shape(x)} and type {jnp.result_type(x)} into "
                    f"shape {jnp.shape(y)} and type {jnp.result_type(y)}; a step must keep both"
                )
            if writable_scopes is not None and self.scopes[i] not in writable_scopes:
                raise ConfigError(
                    f"stage {name!r} is declared for one {stage.scope} and writes {self.names[i]}, which is "
                    f"{self.scopes[i]}; it may write leaves of scope {' or '.join(writable_scopes)}. Give every "
                    f"{stage.scope} a leaf of its own first, or leave the stage undeclared."
                )
        return written

    def writable(self, stage: Stage) -> list[str] | None:
        """Return the scopes of the leaves that a stage may write; None for all."""
        if stage.scope == "batch":
            return None
        populations = list(dict.fromkeys(scope for scope in self.scopes if has_members(scope)))
        if stage.scope == "world":
            return [*populations, "world"]
        if stage.scope not in (*populations, "drone"):
            others = ", ".join(repr(name) for name in populations if name != "drone")
            raise ConfigError(
                f"stage {stage.__name__!r} is declared for one {stage.scope!r}, and there is no population of that "
                f"name; there {'are ' + others if others else 'is none'}. Add it with sim.add first, or declare the "
                f"stage for 'drone' or 'world'."
            )
        return [stage.scope]

    def shapes_of_one(self, leaves: list[Array], scope: StageScope) -> list[jax.ShapeDtypeStruct]:
        """Return the shape and type of each leaf as a stage receives it, for one drone or world."""
        return [self.shape_of_one(i, x, scope) for i, x in enumerate(leaves)]

    def shape_of_one(self, i: int, x: Array, scope: StageScope) -> jax.ShapeDtypeStruct:
        """Return the same for the leaf with number ``i``."""
        leaf_scope, n_leading = self.scopes[i], 0
        if scope != "batch" and leaf_scope != "batched":
            n_leading = n_batch_axes(leaf_scope) if leaf_scope == scope else n_world_axes(leaf_scope)
        return jax.ShapeDtypeStruct(jnp.shape(x)[n_leading:], x.dtype)


def vmap_worlds(fn: Callable[..., Any], least: int = 1) -> Callable[..., Any]:
    """Return a function of one world as a function of all worlds.

    In records the batch axes are the declared ones: the function receives leaves of drones as (n_drones, ...), leaves
    of other populations as (n_members, ...), and leaves of worlds and batched leaves without batch axes. It receives
    all other leaves as they are, and must return them unchanged. An array outside of a record has worlds as its first
    axis.

    Args:
        fn: The function of one world: from any trees of arrays to one.
        least: Number of batch axes from which a leaf is divided among worlds: 2 excludes batched leaves.
    """

    def of_all(*args: Any) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        kinds = _kinds(args)
        rows = [x[:, 0] if kind == "world" else x for kind, x in zip(kinds, leaves, strict=True)]
        split = [n_batch_axes(kind) >= least for kind in kinds]
        returned: dict[str, Any] = {}

        def in_one_world(values: list[Any]) -> list[Any]:
            result = fn(*treedef.unflatten(values))
            paths, returned["treedef"] = jax.tree_util.tree_flatten_with_path(result)
            returned["kinds"] = after = _kinds(result)
            # By identity, since ``fn`` may return other trees. Only shared leaves can be the very same array, and then
            # each stands for the others.
            numbers = {id(x): i for i, x in enumerate(values)}
            unchanged = [numbers.get(id(x)) for _, x in paths]
            for k, number in enumerate(unchanged):
                if number is not None and not split[number] and n_batch_axes(after[k]) >= least:
                    unchanged[k] = None  # shared, and now an array of every world
                elif number is not None and n_batch_axes(after[k]) < least:
                    after[k] = kinds[number]  # without its axis of worlds the scope of a foreign record is not known
            returned["unchanged"] = unchanged
            for (path, _), kind, number in zip(paths, after, unchanged, strict=True):
                if n_batch_axes(kind) < least and number is None:
                    name = jax.tree_util.keystr(path).lstrip(".")
                    raise ConfigError(
                        f"{getattr(fn, '__name__', fn)!r} is written for one world and changes {name}, which all "
                        f"worlds share. Give every drone or world a leaf of its own first."
                    )
            return [x for (_, x), number in zip(paths, unchanged, strict=True) if number is None]

        changed = iter(jax.vmap(in_one_world, ([0 if divided else None for divided in split],))(rows))
        out = []
        for kind, number in zip(returned["kinds"], returned["unchanged"], strict=True):
            if number is not None and kinds[number] == kind:
                out.append(leaves[number])
            else:
                x = next(changed) if number is None else rows[number]
                out.append(x[:, None] if kind == "world" else x)
        return returned["treedef"].unflatten(out)

    return of_all


def vmap_drones(fn: Callable[[SimData], Any]) -> Callable[[SimData], Any]:
    """Return a function of the data of one drone as a function of the data of one world.

    Args:
        fn: From the data of one drone to any tree of arrays; each gets a first axis over drones.
    """

    def of_world(data: SimData) -> Any:
        leaves, treedef = jax.tree.flatten(data)
        axes = [0 if scope == "drone" else None for scope in jax.tree.leaves(scopes(data))]
        return jax.vmap(lambda values: fn(treedef.unflatten(values)), (axes,), axis_name=MEMBER_AXIS)(leaves)

    return of_world


def _kinds(tree: object) -> list[str]:
    """Return the scope of every leaf: as its record declares it, and ``batched`` outside of records."""

    def is_record(x: object) -> bool:
        return isinstance(x, PyTree)

    return jax.tree.leaves(jax.tree.map(lambda x: scopes(x) if is_record(x) else "batched", tree, is_leaf=is_record))


def _apply_in_all_worlds(stage: Stage, data: SimData) -> SimData:
    """Return the data after a stage in every world, and there for every drone or member if it is declared for one."""
    return vmap_worlds(world_function(stage, Axes(data)), 2)(data)


def world_function(stage: Stage, axes: Axes) -> Callable[[SimData], SimData]:
    """Return a stage as a function of the data of one world, with a condition that selects its results."""

    def of_one_world(world: SimData) -> SimData:
        leaves = jax.tree.leaves(world)
        written: list[int] = []

        def apply(values: list[Array]) -> list[Array]:
            after = stage.apply_to_one(axes.treedef.unflatten(values))
            written[:] = axes.written(values, after, stage)
            new = jax.tree.leaves(after)
            return [new[i] for i in written]

        in_axes = [0 if s == stage.scope else None for s in axes.scopes]
        out = apply(leaves) if stage.scope == "world" else jax.vmap(apply, (in_axes,), axis_name=MEMBER_AXIS)(leaves)
        return axes.treedef.unflatten(replace_leaves(leaves, written, out))

    return of_one_world
