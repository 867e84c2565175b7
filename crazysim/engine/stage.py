"""Stages with a declared scope, such as one drone or one world, and transformations of functions to all worlds.

Leaves have scopes too, which ``leaf`` in ``crazysim.engine.pytree`` defines. A function is
``batched`` if it also accepts leading axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.arguments import check_arguments
from crazysim.eager import explain_traced_values
from crazysim.engine.pair_reductions import MEMBER_AXIS
from crazysim.engine.pytree import (
    PyTree,
    has_members,
    leaf_indices,
    n_batch_axes,
    n_world_axes,
    replace_leaves,
    scopes,
    select_worlds,
)
from crazysim.engine.record import Record
from crazysim.errors import ConfigError, expect

T = TypeVar("T")

StageScope = str
"""``"drone"``, ``"world"``, ``"batch"`` for all worlds, or the name of a population."""

Phase = Literal["before", "each", "after"]
"""Time within a call of the step function at which a stage runs: once before the first physics step, at each physics
step, or once after the last."""

PHASES: tuple[Phase, ...] = ("before", "each", "after")

RESERVED_SCOPES = ("batch", "shared", "opaque", "parameter", "member")
"""Names of scopes that ``stage`` does not accept, and that no population may have as its name."""


class Stage:
    """A function from a record such as ``SimData`` to one alike, with the scope that the function is written for.

    When the stage is called with the data of a simulation, it applies the function to every drone, to every member of a
    population, or to every world. With the scope ``"batch"``, it applies the function to the data of all worlds at
    once.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        scope: StageScope,
        when: Callable[..., Array | None] | None = None,
        batched: bool = False,
        name: str | None = None,
        trace_once: bool = False,
        unfused_reason: str = "it is not declared for one drone or one world",
        phase: Phase = "each",
        ground: Callable[..., Array | float] | None = None,
    ):
        # ``batched`` declares that ``fn`` and ``when`` also accept any leading axes. ``trace_once`` declares that their
        # operations are the same in all simulations and do not depend on ``n_worlds`` and ``n_drones``, so that an
        # engine traces them only once in a process. ``unfused_reason`` is the reason for the scope ``"batch"``, for
        # messages. ``ground`` is a function from the same data to the height of the ground at which the stage stops
        # drones, m.
        self.fn, self.when, self.batched, self.trace_once = fn, when, batched, trace_once
        self.unfused_reason, self.ground = unfused_reason, ground
        self.scope: StageScope = scope
        self.phase: Phase = phase
        self.__name__ = name or getattr(fn, "__name__", type(fn).__name__)
        self.__doc__ = fn.__doc__

    def __call__(self, data: Record) -> Any:
        if self.batched or self.scope == "batch":
            return self.apply_unmapped(data)
        return vmap_worlds(world_function(self, Axes(data)), 2)(data)

    def apply_unmapped(self, data: Record) -> Any:
        """Return the data after the stage, from one call of its function that is not mapped over worlds or members.

        Args:
            data: Data as the function takes it: of one unit of the scope, or with any leading axes if ``batched``.
        """
        with explain_traced_values(f"stage {self.__name__!r}"):
            data_after = self.fn(data)
        mask = None if self.when is None else self.when(data)
        if mask is None:
            return data_after

        def select(new: Array, old: Array) -> Array:
            return new if new is old else jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - mask.ndim)), new, old)

        return jax.tree.map(select, data_after, data)

    def apply_in_worlds(self, data: Record, mask: Array | None) -> Any:
        """Return the data after the stage, with changes only in some worlds.

        Args:
            mask: True in the worlds to change; None for all. (n_worlds,)
        """
        data_after = self(data)
        return (
            data_after
            if mask is None
            else jax.tree.map(lambda x, y: x if x is y else select_worlds(mask, x, y), data_after, data)
        )

    def __repr__(self) -> str:
        return f"<stage {self.__name__} of one {_unit(self.scope)}>"


@check_arguments
def stage(
    scope: StageScope, when: Callable[..., Array | None] | None = None, phase: Phase = "each"
) -> Callable[[Callable[..., Any]], Stage]:
    """Declare the scope of a stage, so that an engine can fuse the stage with its neighbours.

    A stage without a declared scope receives the full batch.

    A stage with ``@stage("drone")`` receives the data of one drone. Leaves of drones and worlds have no batch axes:
    ``pos`` is (3,), and ``steps`` is (). Leaves of other populations are (n_members, ...). The stage may write leaves
    of its drone, and can read leaves of other drones with ``reduce_over_others``.

    A stage with ``@stage("cars")`` receives the data of one member of the population ``cars``, in the same way. Leaves
    of drones are (n_drones, ...). The stage may write leaves of its member.

    A stage with ``@stage("world")`` receives the data of one world. Leaves of drones are (n_drones, ...), leaves of
    other populations (n_members, ...), and leaves of worlds have no batch axes. The stage may write all of these.

    Args:
        scope: ``"drone"``, ``"world"`` or the name of a population.
        when: Function from the same data to a bool, (): True if the stage acts at this step. None for a stage that
            always acts. An engine may skip the stage at steps at which the condition is True nowhere.
        phase: Time within a call of the step function: ``"before"`` the first physics step, at ``"each"`` physics step,
            or ``"after"`` the last.
    """
    if not isinstance(scope, str) or not scope or scope in RESERVED_SCOPES:
        raise ConfigError(
            f"expected scope 'drone', 'world' or the name of a population, got {scope!r}. A stage of the full batch is "
            f"left undeclared."
        )
    expect(phase in PHASES, f"a phase of {', '.join(map(repr, PHASES))}", phase)
    return lambda fn: Stage(fn, scope, when, phase=phase)


def is_tick(data: Any, freq: int) -> Array | None:
    """Return True in worlds in which a stage with a rate, Hz, acts at this step; None if it acts at every step.

    Returns:
        (n_worlds, 1), or () for data of one world
    """
    period = data.core.freq // freq
    return None if period == 1 else data.core.steps % period == 0


def is_first_step(data: Any) -> Array:
    """Return True in the first step of an episode. (n_worlds, 1), or () for data of one world

    An engine may evaluate stages with this condition at the beginning of a step pipeline only once per call of the step
    function, before its first physics step.
    """
    return data.core.steps == 0


def as_stages(pipeline: Mapping[str, Callable[..., Any]]) -> list[Stage]:
    """Return the functions of a pipeline as stages with the names in the pipeline.

    A function without a declared scope receives the full batch. The integration holds drones on the ground at which a
    stage of this pipeline stops them.
    """
    expect(isinstance(pipeline, Mapping), "stages as a dict by name", pipeline, "Use {'swing': swing}, say.")
    ground = next((fn.ground for fn in pipeline.values() if isinstance(fn, Stage) and fn.ground is not None), None)
    return [
        Stage(
            fn.fn.on_ground(ground) if hasattr(fn.fn, "on_ground") else fn.fn,
            fn.scope,
            fn.when,
            fn.batched,
            name,
            fn.trace_once,
            fn.unfused_reason,
            fn.phase,
        )
        if isinstance(fn, Stage)
        else Stage(fn, "batch", name=name)
        for name, fn in pipeline.items()
    ]


class Axes:
    """Names, indices and scopes of all leaves of a simulation's data. The scopes give the batch axes."""

    def __init__(self, data: Record):
        paths, self.treedef = jax.tree_util.tree_flatten_with_path(data)
        self.names = [jax.tree_util.keystr(path).lstrip(".") for path, _ in paths]
        self.leaf_indices = leaf_indices(data)
        """Record with the index of every leaf in place of the leaf."""
        self.scopes: list[str] = jax.tree.leaves(scopes(data))

    def written_leaves(self, before: list[Array], after: Record, stage: Stage) -> list[int]:
        """Return the indices of the leaves that a stage wrote, and check that it may write them.

        Args:
            after: Data after the stage. A leaf that is the same object as before has not been written.
        """
        name = stage.__name__
        expect(
            isinstance(after, Record),
            f"stage {name!r} to return the data that it got, with other values",
            after,
            "End its function with return data, or return data.replace(...).",
        )
        new_leaves, treedef = jax.tree.flatten(after)
        if treedef != self.treedef:
            raise ConfigError(
                f"stage {name!r} changed the structure of SimData (a field became None, or a plugin was added or "
                f"removed); make such changes before the step, with sim.data = sim.data.replace(...)"
            )
        written_indices = [i for i, (x, y) in enumerate(zip(before, new_leaves, strict=True)) if x is not y]
        writable_scopes = self.writable_scopes(stage)
        for i in written_indices:
            x, y = before[i], new_leaves[i]
            if jnp.shape(x) != jnp.shape(y) or jnp.result_type(x) != jnp.result_type(y):
                raise ConfigError(
                    f"stage {name!r} turned {self.names[i]} of shape {jnp.shape(x)} and type {jnp.result_type(x)} into "
                    f"shape {jnp.shape(y)} and type {jnp.result_type(y)}; a step must keep both"
                )
            if writable_scopes is not None and self.scopes[i] not in writable_scopes:
                raise ConfigError(
                    f"stage {name!r} is declared for one {_unit(stage.scope)} and writes {self.names[i]}, which is "
                    f"{self.scopes[i]}; it may write leaves of scope {' or '.join(writable_scopes)}. Give every "
                    f"{_unit(stage.scope)} a leaf of its own first, or leave the stage undeclared."
                )
        return written_indices

    def writable_scopes(self, stage: Stage) -> list[str] | None:
        """Return the scopes of the leaves that a stage may write; None if it may write all leaves."""
        if stage.scope == "batch":
            return None
        populations = list(dict.fromkeys(scope for scope in self.scopes if has_members(scope)))
        if stage.scope == "world":
            return [*populations, "world"]
        if stage.scope not in (*populations, "drone"):
            raise ConfigError(
                f"stage {stage.__name__!r} is declared for one {_unit(stage.scope)}, and there is no population of "
                f"that name. Use one of {', '.join(map(repr, populations))} or 'world', or add the population first."
            )
        return [stage.scope]

    def unbatched_shapes(self, leaves: list[Array], scope: StageScope) -> list[jax.ShapeDtypeStruct]:
        """Return the shape and type of each leaf as a stage with a scope receives it."""
        return [self.unbatched_shape(i, x, scope) for i, x in enumerate(leaves)]

    def unbatched_shape(self, i: int, x: Array, scope: StageScope) -> jax.ShapeDtypeStruct:
        """Return the shape and type of leaf ``i`` as a stage with a scope receives it."""
        leaf_scope, n_leading = self.scopes[i], 0
        if scope != "batch" and leaf_scope != "batch":
            n_leading = n_batch_axes(leaf_scope) if leaf_scope == scope else n_world_axes(leaf_scope)
        return jax.ShapeDtypeStruct(jnp.shape(x)[n_leading:], x.dtype)


def _unit(scope: StageScope) -> str:
    return scope if scope in ("drone", "world") else f"member of {scope!r}"


def vmap_worlds(fn: Callable[..., Any], min_batch_axes: int = 1) -> Callable[..., Any]:
    """Transform a function of one world to a function of all worlds.

    Leaves of records have the batch axes that they declare. The function receives leaves of drones as (n_drones, ...),
    leaves of other populations as (n_members, ...), and leaves of worlds and of the scope ``batch`` without batch axes.
    All other leaves are passed unchanged, and must be returned unchanged. The first axis of an array outside of a
    record is over worlds.

    Args:
        fn: The function of one world: takes any number of trees of arrays, and returns a tree of arrays.
        min_batch_axes: Leaves with fewer batch axes are passed unchanged. With 2, as for stages, this includes batched
            leaves, which have one batch axis.
    """

    def apply_to_worlds(*args: Any) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        leaf_scopes = _leaf_scopes(args)
        # Leaves of worlds, (n_worlds, 1, ...), lose their second axis.
        inputs = [x[:, 0] if scope == "world" else x for scope, x in zip(leaf_scopes, leaves, strict=True)]
        is_split = [n_batch_axes(scope) >= min_batch_axes for scope in leaf_scopes]
        result_structure: dict[str, Any] = {}

        def apply_to_world(values: list[Any]) -> list[Any]:
            with explain_traced_values(f"{getattr(fn, '__qualname__', fn)!r}"):
                result = fn(*treedef.unflatten(values))
            paths, result_structure["treedef"] = jax.tree_util.tree_flatten_with_path(result)
            result_structure["scopes"] = result_scopes = _leaf_scopes(result)
            # Unchanged leaves are found by identity, since ``fn`` may return trees of another structure. If two shared
            # leaves are the same array, either may be found.
            indices = {id(x): i for i, x in enumerate(values)}
            input_indices = [indices.get(id(x)) for _, x in paths]
            for k, i in enumerate(input_indices):
                if i is not None and not is_split[i] and n_batch_axes(result_scopes[k]) >= min_batch_axes:
                    input_indices[k] = None  # a shared leaf, returned in a field that has a value for every world
                elif i is not None and n_batch_axes(result_scopes[k]) < min_batch_axes:
                    # A leaf (scope "batch") of another library's record appears as opaque without its axis over worlds.
                    result_scopes[k] = leaf_scopes[i]
            result_structure["input_indices"] = input_indices
            for (path, _), scope, i in zip(paths, result_scopes, input_indices, strict=True):
                if n_batch_axes(scope) < min_batch_axes and i is None:
                    name = jax.tree_util.keystr(path).lstrip(".")
                    raise ConfigError(
                        f"{getattr(fn, '__name__', fn)!r} is written for one world and changes {name}, which all "
                        f"worlds share. Give every drone or world a leaf of its own first."
                    )
            return [x for (_, x), i in zip(paths, input_indices, strict=True) if i is None]

        changed_leaves = iter(jax.vmap(apply_to_world, ([0 if split else None for split in is_split],))(inputs))
        outputs = []
        for scope, i in zip(result_structure["scopes"], result_structure["input_indices"], strict=True):
            if i is not None and leaf_scopes[i] == scope:
                outputs.append(leaves[i])
            else:
                x = next(changed_leaves) if i is None else inputs[i]
                outputs.append(x[:, None] if scope == "world" else x)
        return result_structure["treedef"].unflatten(outputs)

    return apply_to_worlds


def vmap_drones(fn: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Transform a function of the data of one drone to a function of the data of one world.

    Args:
        fn: Function that returns any tree of arrays. In the result each array has a first axis over drones.
    """

    def apply_to_drones(data: Any) -> Any:
        leaves, treedef = jax.tree.flatten(data)
        axes = [0 if scope == "drone" else None for scope in jax.tree.leaves(scopes(data))]
        return jax.vmap(lambda values: fn(treedef.unflatten(values)), (axes,), axis_name=MEMBER_AXIS)(leaves)

    return apply_to_drones


def _leaf_scopes(tree: object) -> list[str]:
    def is_record(x: object) -> bool:
        return isinstance(x, PyTree)

    return jax.tree.leaves(jax.tree.map(lambda x: scopes(x) if is_record(x) else "batch", tree, is_leaf=is_record))


def world_function(stage: Stage, axes: Axes) -> Callable[[Any], Any]:
    """Return a stage as a function from the data of one world to the data after it, for all drones or members."""

    def apply_in_world(world: Any) -> Any:
        leaves = jax.tree.leaves(world)
        written: list[int] = []

        def apply_to_values(values: list[Array]) -> list[Array]:
            data_after = stage.apply_unmapped(axes.treedef.unflatten(values))
            written[:] = axes.written_leaves(values, data_after, stage)
            new_leaves = jax.tree.leaves(data_after)
            return [new_leaves[i] for i in written]

        in_axes = [0 if s == stage.scope else None for s in axes.scopes]
        outputs = (
            apply_to_values(leaves)
            if stage.scope == "world"
            else jax.vmap(apply_to_values, (in_axes,), axis_name=MEMBER_AXIS)(leaves)
        )
        return axes.treedef.unflatten(replace_leaves(leaves, written, outputs))

    return apply_in_world
