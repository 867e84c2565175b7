"""The base class of records, and the declarations of the axes of their leaves."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar, dataclass_transform, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.errors import ConfigError, expect, require

Scope = Literal["drone", "member", "world", "batch", "shared", "opaque", "parameter"]
"""Scope of a leaf as a field declares it; see ``leaf``."""

WITHOUT_MEMBERS = ("world", "batch", "shared", "opaque")
"""Results of ``scopes`` for leaves without an axis over members; other results are ``drone`` or a population's name."""
CORE_NDIM_KEY = "core_ndim"
"""Key, in the metadata of a field, of the number of dimensions without batch axes; Crazyflow uses the same key."""

T = TypeVar("T")


def leaf(
    scope: Scope,
    core_ndim: int | None = 0,
    core: tuple[int, ...] | None = None,
    *,
    sparse: bool = False,
    scratch: bool = False,
    airframe: Any = None,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Declare an array field, or a dict of such arrays.

    Args:
        scope: Batch axes of the array. ``drone``: (n_worlds, n_drones, *core). ``member``, in a record of a population
            (``Members``): (n_worlds, n_members, *core). ``world``: (n_worlds, 1, *core), which broadcasts over drones.
            ``batch``: (n_worlds, ...), with any further axes; stages receive it whole. ``shared``: core.
            ``parameter``: either core, or core with the axes of ``drone`` (in a population, of ``member``); the number
            of dimensions decides. ``opaque``: undeclared; masked resets and sharding do not change it.
        core_ndim: Number of dimensions of the core shape; None for any.
        core: The core shape, if it is fixed. It prevents, for example, masses of three worlds from being taken
            for masses along three axes.
        sparse: Whether zeros of the parameter remove terms of the equations, as for an offset along one axis. While the
            parameter is shared, a step is compiled without these terms. It is compiled again after a zero changes.
        scratch: Whether the array only carries numbers from one stage of a step to another. Its values are not kept
            after the step.
        airframe: Dotted path or function of the airframe that gives the value, in ``AirframeParams``.
    """
    expect(scope in get_args(Scope), f"a scope, one of {', '.join(get_args(Scope))}", scope)
    metadata = {"scope": scope, CORE_NDIM_KEY: core_ndim, "core": core, "sparse": sparse, "scratch": scratch}
    return dataclasses.field(default=default, metadata=metadata | {"airframe": airframe})


def static(**kwargs: Any) -> Any:
    """Declare a field that is part of the record's type: a hashable value, not an array. A new value recompiles."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, static, dataclasses.field))
class PyTree:
    """Base class of records: frozen dataclasses that are JAX pytrees.

    Subclasses list annotated fields. An array field declares its batch axes with ``leaf``, a ``static`` field is part
    of the type, and any other field holds a record.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        dataclasses.dataclass(frozen=True, eq=False)(cls)
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        jax.tree_util.register_dataclass(
            cls,
            data_fields=[f.name for f in fields if not f.metadata.get("static")],
            meta_fields=[f.name for f in fields if f.metadata.get("static")],
        )
        for f in fields:  # a class attribute would hide a leaf of a lazy record, which is made when it is first read
            if CORE_NDIM_KEY in f.metadata and f.name in vars(cls):
                delattr(cls, f.name)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with the given fields replaced."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    if not TYPE_CHECKING:  # a type checker would take any name for a field

        def __getattr__(self, name: str) -> Any:
            fields = self.__dict__
            template = fields.get(_TEMPLATE)
            if template is None or name not in template.__dict__:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
            return fields.setdefault(name, _lazy_child(template.__dict__[name], fields[_READ_LEAF]))

        def __getstate__(self) -> dict[str, Any]:
            return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


_TEMPLATE, _READ_LEAF = "_template", "_read_leaf"
"""Attributes of a record from ``lazy_record``."""


def lazy_record(template: T, read_leaf: Callable[[Any], Any]) -> T:
    """Return a record with the leaves ``read_leaf(x)`` of the leaves ``x`` of a template, each made at its first use.

    Leaves of fields with a default are made at once. The record behaves like any other: JAX, ``replace`` and ``copy``
    read all fields. To list its fields, use ``dataclasses.fields``: ``vars`` returns only fields that have been read.

    Args:
        template: A record of the same structure.
        read_leaf: Function from a leaf of the template to a leaf of the record. Two threads that read a field at the
            same time may both call it.
    """
    record, values = object.__new__(type(template)), template.__dict__
    fields = record.__dict__
    fields[_TEMPLATE], fields[_READ_LEAF] = template, read_leaf
    for name, is_static in _initial_fields(type(template)):
        fields[name] = values[name] if is_static else _lazy_child(values[name], read_leaf)
    return record


def _lazy_child(x: Any, read_leaf: Callable[[Any], Any]) -> Any:
    if isinstance(x, PyTree):
        return lazy_record(x, read_leaf)
    if isinstance(x, dict):
        return {k: _lazy_child(v, read_leaf) for k, v in x.items()}
    if x is None or isinstance(x, int):  # a fast path for the most common cases
        return x if x is None else read_leaf(x)
    return jax.tree.map(read_leaf, x)


@functools.cache
def _initial_fields(cls: Any) -> list[tuple[str, bool]]:
    # The default of a field is an attribute of the class, so reading such a field would never call ``__getattr__``.
    fields = [(field.name, bool(field.metadata.get("static"))) for field in dataclasses.fields(cls)]
    return [(name, is_static) for name, is_static in fields if is_static or hasattr(cls, name)]


class Members(PyTree):
    """Base class of records of a population: all objects of one kind in a world, such as cars.

    ``scopes`` returns the name of the population for its leaves of scope ``member``, also in nested records.
    """

    population: str = static()
    """Name of the population."""
    n_members: int = static()
    """Number of members in each world."""
    member_id: Array = leaf("member")
    """Index of the member in its world. Its random numbers depend on it. (n_worlds, n_members)"""


def has_members(scope: str) -> bool:
    """Return True for the scope of leaves with axes (n_worlds, n_members): ``drone``, or the name of a population."""
    return scope not in WITHOUT_MEMBERS


def n_batch_axes(scope: str) -> int:
    """Return the number of batch axes of a leaf, by its scope as ``scopes`` returns it."""
    return {"batch": 1, "shared": 0, "opaque": 0}.get(scope, 2)


def n_world_axes(scope: str) -> int:
    """Return the number of batch axes that a leaf loses where a function receives the data of one world.

    It is 1 for leaves of members, which keep the axis over members, and 2 for leaves of worlds, (n_worlds, 1, ...).
    """
    return 1 if has_members(scope) else n_batch_axes(scope)


def scopes(tree: Any) -> Any:
    """Return a tree of the same structure that holds the scope of every leaf.

    A leaf of members has the name of their population as its scope, a parameter has ``shared``, ``drone`` or the name
    of a population, and a leaf without a declaration is ``opaque``. Fields of dataclasses of other libraries can
    declare ``CORE_NDIM_KEY`` in their metadata. A leaf with more dimensions than that has the scope ``batch``:
    its first axis is over worlds, and stages receive it whole.
    """
    return _map_leaves(lambda x, metadata, _, members: _scope(x, metadata, members), tree, {}, "", None)


def leaf_indices(tree: Any) -> Any:
    """Return a tree of the same structure that holds the index of every leaf in ``jax.tree.leaves``.

    Code that handles flattened trees finds a leaf by its path, as in ``leaf_indices(data).core.nonfinite``. It cannot
    find it by identity, since leaves may share one array.
    """
    treedef = jax.tree.structure(tree)
    return treedef.unflatten(range(treedef.num_leaves))


def replace_leaves(leaves: Sequence[T], indices: Sequence[int], values: Sequence[T]) -> list[T]:
    new_leaves = list(leaves)
    for i, value in zip(indices, values, strict=True):
        new_leaves[i] = value
    return new_leaves


def leaf_flags(tree: Any, flag: Literal["sparse", "scratch"]) -> Any:
    """Return a tree of the same structure, True for leaves that are declared with a flag of ``leaf``."""
    return _map_leaves(lambda _, metadata, *__: bool(metadata.get(flag)), tree, {}, "", None)


def watched_flags(tree: Any) -> Any:
    """Return a tree of the same structure, True for leaves of drones, members and worlds except parameters and scratch.

    Such leaves of plugins must be finite; see ``crazysim.core.data.SimData.roles``.
    """
    declared = ("drone", "member", "world")
    return _map_leaves(
        lambda _, metadata, *__: metadata.get("scope") in declared and not metadata.get("scratch"), tree, {}, "", None
    )


def check_axes(tree: Any, n_worlds: int, n_drones: int | None = None) -> None:
    """Check that every leaf has the axes of its scope; ``n_drones`` is None for a tree without drones."""
    batches = {"world": (n_worlds, 1), "shared": ()}

    def check_leaf(x: Any, metadata: Any, name: str, members: Members | None) -> None:
        scope = _scope(x, metadata, members)
        if scope == "opaque":
            return
        if scope == "batch":
            require(
                jnp.shape(x)[0] == n_worlds,
                f"expected {name} to have a first axis over {n_worlds} worlds, got shape {jnp.shape(x)}. Without "
                f"batch axes it would have {metadata[CORE_NDIM_KEY]} dimensions, as its field declares.",
            )
            return
        require(
            scope != "drone" or n_drones is not None,
            f"expected {name} in a record of a population, got a leaf of drones, which these data lack. Declare it "
            f'with leaf("member") in a subclass of Members.',
        )
        # Batch axes of drones, or of members of a population.
        n, kind, kinds = n_drones, "drone", "drones"
        if members is not None and scope != "drone":
            n, kind, kinds = members.n_members, "member", members.population
        member_shape = (n_worlds, n)
        shape, batch = jnp.shape(x), batches.get(scope, member_shape)
        core_ndim, core = metadata[CORE_NDIM_KEY], metadata["core"]
        n_axes = len(shape) if core_ndim is None else len(batch) + core_ndim
        has_axes = shape[: len(batch)] == batch and len(shape) == n_axes
        if not has_axes or core not in (None, shape[len(batch) :]):
            is_parameter = metadata["scope"] == "parameter"
            batch = member_shape if is_parameter else batch
            shared_text = f", or {core_ndim} if all {kinds} share it" if is_parameter else ""
            ending = "" if core is None else f" and end with {core}"
            n_axes = len(batch) + (core_ndim or 0)
            raise ConfigError(
                f"{name} has shape {shape}; expected {n_axes} dimensions that begin with {batch}{ending}, for "
                f"{n_worlds} worlds{'' if n is None else f' of {n} {kinds}'}{shared_text}. For one value per world, "
                f"repeat it for every {kind} with jnp.broadcast_to."
            )

    _map_leaves(check_leaf, tree, {}, "data", None)


def _map_leaves(
    fn: Callable[[Any, Any, str, Members | None], Any], node: Any, metadata: Any, name: str, members: Members | None
) -> Any:
    # The function receives the metadata of the leaf's field, its name for messages, and the record of its population.
    if isinstance(node, PyTree):
        members = node if isinstance(node, Members) else members
        changes = {
            f.name: _map_leaves(fn, getattr(node, f.name), f.metadata, f"{name}.{f.name}", members)
            for f in dataclasses.fields(node)  # type: ignore[arg-type]
            if not f.metadata.get("static")
        }
        return node.replace(**changes)
    if isinstance(node, dict):
        return {k: _map_leaves(fn, v, metadata, f"{name}[{k!r}]", members) for k, v in node.items()}
    if _is_foreign_record(node):
        return _map_foreign(fn, node, name, members)
    return jax.tree.map(
        lambda x: _map_leaves(fn, x, metadata, name, members) if _is_record(x) else fn(x, metadata, name, members),
        node,
        is_leaf=_is_record,
    )


def _map_foreign(
    fn: Callable[[Any, Any, str, Members | None], Any], record: Any, name: str, members: Members | None
) -> Any:
    children, treedef = jax.tree_util.tree_flatten_with_path(record, is_leaf=lambda x: x is not record)
    metadata = {field.name: field.metadata for field in dataclasses.fields(record)}
    leaves = []
    for path, child in children:
        key = getattr(path[0], "name", "")  # absent where the record is registered without names
        child_name, field_metadata = f"{name}{jax.tree_util.keystr(path)}", metadata.get(key, {})
        if CORE_NDIM_KEY in field_metadata and _is_record(child):
            raise ConfigError(
                f"expected an array in {child_name}, whose metadata have {CORE_NDIM_KEY!r}, got a "
                f"{type(child).__name__}. Give the metadata to the fields of that record."
            )
        leaves.append(_map_leaves(fn, child, field_metadata, child_name, members))
    return treedef.unflatten(leaves)


def _is_record(node: Any) -> bool:
    return isinstance(node, PyTree) or _is_foreign_record(node)


def _is_foreign_record(node: Any) -> bool:
    is_instance = dataclasses.is_dataclass(node) and not isinstance(node, (type, PyTree))
    return is_instance and not jax.tree_util.all_leaves([node])


def _scope(x: Any, metadata: Any, members: Members | None) -> str:
    if "scope" not in metadata:
        core_ndim = metadata.get(CORE_NDIM_KEY)
        return "opaque" if core_ndim is None or jnp.ndim(x) <= core_ndim else "batch"
    scope = metadata["scope"]
    if scope == "member":
        return scope if members is None else members.population
    if scope != "parameter":
        return scope
    if jnp.ndim(x) == metadata[CORE_NDIM_KEY]:
        return "shared"
    return "drone" if members is None else members.population


def map_batched(fn: Callable[..., Any], tree: T, *others: T) -> T:
    """Apply ``fn`` to the leaves that have an axis over worlds; other leaves are unchanged."""
    return jax.tree.map(
        lambda scope, x, *rest: fn(x, *rest) if n_batch_axes(scope) else x,
        scopes(tree),
        tree,
        *others,
    )


def select_worlds(mask: Array | None, new: Array, old: Array) -> Array:
    """Take ``new`` in the worlds of a mask and ``old`` elsewhere, both broadcast to a common shape.

    Args:
        mask: True in worlds with new values; None for all worlds. (n_worlds,), (n_worlds, 1), or () for one world
        new: New values. (n_worlds, ...)
        old: Old values. (n_worlds, ...)
    """
    shape = jnp.broadcast_shapes(jnp.shape(new), jnp.shape(old))
    if mask is None:
        return jnp.broadcast_to(new, shape)
    mask = mask.reshape(mask.shape + (1,) * (len(shape) - mask.ndim))
    return jnp.where(mask, new, old)


def float_dtype() -> Any:
    """Return the floating dtype of JAX in its current configuration: float32 or float64."""
    return np.float64 if jax.config.jax_enable_x64 else np.float32  # type: ignore[attr-defined]


def as_parameter(value: Any) -> Any:
    """Return a number or array as a shared parameter: of floating dtype, and never zero-dimensional.

    It is a NumPy array, which needs no compilation; the simulation moves it to its device with the other data.
    """
    return np.atleast_1d(np.asarray(value, float_dtype()))


def device_array(value: Any, dtype: Any = None) -> jax.Array:
    """Return host data as an array on the default device, of floating dtype by default.

    It compiles no program; ``jnp.asarray`` compiles one for each shape.
    """
    return jax.device_put(np.array(value, dtype or float_dtype()))


def host_array(value: Any, *shape: int, dtype: Any = None) -> Any:
    """Return a value broadcast to a shape as a NumPy array, of floating dtype by default; it needs no compilation."""
    return np.array(np.broadcast_to(value, shape), dtype or float_dtype())
