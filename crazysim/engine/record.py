"""Records that an engine steps: what it is told of them besides the scopes of their leaves."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.engine.pytree import PyTree, check_axes
from crazysim.errors import ConfigError, short_repr

MAX_STEPS = 2**31 - 1
"""Largest number of steps since a reset, the largest int32: 24.9 days at 1000 Hz."""


class Roles(NamedTuple):
    """Leaves of a record with a role in a step, as indices of ``jax.tree.leaves``."""

    population: str
    """Population whose members the engine computes in lanes."""
    clock: int
    """Steps since the last reset of the world, int32. (n_worlds, 1)"""
    nonfinite: int
    """Flag of worlds that are not valid. (n_worlds, 1)"""
    watched: Mapping[int, bool]
    """Leaves in which NaN flags a world, each with True if infinity does so, too."""
    parameters: Collection[int] = ()
    """Leaves in which zeros remove terms while all members share them, besides leaves that are declared sparse."""
    cleared: int | None = None
    """Flag that is False after a step. ()"""


class Record(PyTree):
    """Interface of records that an engine steps: any leaves with declared scopes, and leaves with a role."""

    def roles(self) -> Roles:
        """Return the leaves with a role; leaves may be arrays, or their shapes and types."""
        raise ConfigError(
            f"expected the roles of leaves of {type(self).__name__}, got none. Define roles(self), as in 'The engine'."
        )

    def check(self) -> None:
        """Raise an error for values that no step accepts. It is called once for each structure."""
        require_arrays(self)
        check_axes(self, len(jax.tree.leaves(self)[self.roles().clock]))

    def without_sizes(self) -> Self:
        """Return the record with equal static fields for any number of worlds and members.

        Stages with ``trace_once`` are traced once for all records that are then alike.
        """
        return self


def require_arrays(data: Record) -> None:
    """Check that every leaf is an array."""
    for path, x in jax.tree_util.tree_leaves_with_path(data):
        if not hasattr(x, "dtype"):
            raise ConfigError(
                f"expected an array as data{jax.tree_util.keystr(path)}, got {short_repr(x)}. Use jnp.full_like of the "
                f"array that it replaces."
            )


def nonfinite_worlds(data: Record) -> Array:
    """Return True for worlds that are flagged, hold NaN or infinity in watched leaves, or exceed ``MAX_STEPS``.

    The step counter overflows to a negative number after ``MAX_STEPS``, and one call takes too few steps for it to
    become positive again. The data may be of all worlds or of one world.

    Returns:
        (n_worlds, 1), or () in one world
    """
    leaves, roles = jax.tree.leaves(data), data.roles()
    steps = leaves[roles.clock]
    n_axes = max(steps.ndim - 1, 0)
    floats = [
        (leaves[i], must_be_finite)
        for i, must_be_finite in roles.watched.items()
        if jnp.issubdtype(leaves[i].dtype, jnp.floating)
    ]
    is_valid = [
        jnp.all(jnp.isfinite(x) if must_be_finite else ~jnp.isnan(x), axis=tuple(range(n_axes, x.ndim)))
        for x, must_be_finite in floats
    ]
    return leaves[roles.nonfinite] | ~jnp.all(jnp.stack(is_valid), axis=0).reshape(steps.shape) | (steps < 0)
