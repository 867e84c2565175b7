"""The one base class of every record, and how a record declares the axes of its leaves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.errors import ConfigError

Scope = Literal["drone", "world", "rows", "shared", "opaque", "parameter"]

T = TypeVar("T")


def leaf(scope: Scope, core_ndim: int = 0, core: tuple[int, ...] | None = None) -> Any:
    """Declare an array field, or a dict of such arrays.

    Args:
        scope: Which batch axes the array carries. ``drone``: (n_worlds, n_drones, *core). ``world``:
            (n_worlds, 1, *core). ``rows``: (n_worlds, ...), with any further axes. ``shared``: core.
            ``parameter``: shared or drone, told apart by its number of dimensions. ``opaque``: untouched by
            resets and by sharding.
        core_ndim: Number of dimensions of the core shape.
        core: The core shape, where it can be no other. It keeps one mass for each of three worlds from passing
            for one along each of three axes.
    """
    return dataclasses.field(metadata={"scope": scope, "core_ndim": core_ndim, "core": core})


def static(**kwargs: Any) -> Any:
    """Declare a field that is part of the record's type: hashable, no array, a new value recompiles."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, static, dataclasses.field))
class PyTree:
    """A frozen record of arrays that JAX can look into.

    Subclasses list annotated fields; an array field says with ``leaf`` which batch axes it carries, a
    ``static`` field belongs to the type, any other field holds a record of its own.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Make every subclass a frozen dataclass that is registered with JAX."""
        super().__init_subclass__(**kwargs)
        dataclasses.dataclass(frozen=True, eq=False)(cls)
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        jax.tree_util.register_dataclass(
            cls,
            data_fields=[f.name for f in fields if not f.metadata.get("static")],
            meta_fields=[f.name for f in fields if f.metadata.get("static")],
        )

    def replace(self, **changes: Any) -> Self:
        """Return a copy with the named fields exchanged."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


def scopes(tree: Any) -> Any:
    """Return the same tree with the scope of every leaf in its place.

    A parameter comes out as ``shared`` or ``drone``. What is declared nowhere is ``opaque``.
    """
    return _map_declared(lambda x, metadata, _: _scope(x, metadata), tree, {}, "")


def check_axes(tree: Any, n_worlds: int, n_drones: int) -> None:
    """Check that every leaf has the axes of its scope: a parameter of one drone must not pass for one of a world.

    Raises:
        ConfigError: If a leaf has others, with its name and the shapes it may have.
    """
    batches = {"drone": (n_worlds, n_drones), "world": (n_worlds, 1), "shared": ()}

    def check(x: Any, metadata: Any, name: str) -> None:
        scope = _scope(x, metadata)
        if scope == "opaque":
            return
        shape, batch, core_ndim, core = jnp.shape(x), batches[scope], metadata["core_ndim"], metadata["core"]
        has_axes = shape[: len(batch)] == batch and len(shape) == len(batch) + core_ndim
        if not has_axes or core not in (None, shape[len(batch) :]):
            is_parameter = metadata["scope"] == "parameter"
            batch = batches["drone"] if is_parameter else batch
            or_shared = f", or {core_ndim} if all drones share it" if is_parameter else ""
            ending = "" if core is None else f" and end with {core}"
            raise ConfigError(
                f"{name} has shape {shape}; needed are {len(batch) + core_ndim} dimensions that begin with {batch}"
                f"{ending}, for {n_worlds} worlds of {n_drones} drones{or_shared}. For one value per world, repeat it "
                f"for every drone with jnp.broadcast_to."
            )

    _map_declared(check, tree, {}, "data")


def _map_declared(fn: Callable[[Any, Any, str], Any], node: Any, metadata: Any, name: str) -> Any:
    """Return the tree with ``fn(leaf, metadata of its field, its name)`` in place of every leaf."""
    if isinstance(node, PyTree):
        changes = {
            f.name: _map_declared(fn, getattr(node, f.name), f.metadata, f"{name}.{f.name}")
            for f in dataclasses.fields(node)  # type: ignore[arg-type]
            if not f.metadata.get("static")
        }
        return node.replace(**changes)
    if isinstance(node, dict):
        return {k: _map_declared(fn, v, metadata, f"{name}[{k!r}]") for k, v in node.items()}
    return jax.tree.map(
        lambda x: _map_declared(fn, x, metadata, name) if isinstance(x, PyTree) else fn(x, metadata, name),
        node,
        is_leaf=lambda x: isinstance(x, PyTree),
    )


def _scope(x: Any, metadata: Any) -> str:
    scope = metadata.get("scope", "opaque")
    if scope != "parameter":
        return scope
    return "shared" if jnp.ndim(x) == metadata["core_ndim"] else "drone"


def map_batched(fn: Callable[..., Any], tree: T, *others: T) -> T:
    """Apply ``fn`` to the leaves that belong to a world (scope drone or world), and keep the rest."""
    return jax.tree.map(
        lambda scope, x, *rest: fn(x, *rest) if scope in ("drone", "world") else x,
        scopes(tree),
        tree,
        *others,
    )


def select_worlds(mask: Array | None, new: Array, old: Array) -> Array:
    """Return ``new`` where ``mask`` says so, ``old`` elsewhere; the mask (n_worlds,), (n_worlds, 1) or of one world ().

    Both are broadcast to the larger of their shapes; without a mask ``new`` is taken everywhere.
    """
    shape = jnp.broadcast_shapes(jnp.shape(new), jnp.shape(old))
    if mask is None:
        return jnp.broadcast_to(new, shape)
    mask = mask.reshape(mask.shape + (1,) * (len(shape) - mask.ndim))
    return jnp.where(mask, new, old)


def floating() -> Any:
    """Return the type of numbers that JAX computes with as it is set now: float32, or float64."""
    return np.float64 if jax.config.jax_enable_x64 else np.float32  # type: ignore[attr-defined]


def as_parameter(value: Any) -> Any:
    """Return a number or array as a shared parameter: of floating type, and never a bare scalar.

    It is an array of the host, which takes no compilation; a simulation puts it on its device with all else.
    """
    return np.atleast_1d(np.asarray(value, floating()))
