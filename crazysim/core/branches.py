"""Branches and look-ups in tables, for functions of one element that engines compute for many elements in parallel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from crazysim.engine.jaxcompat import simple_primitive

Carry = TypeVar("Carry")


def any_lane(condition: Array) -> Array:
    """Whether a condition holds for this element or for another element that is computed together with it.

    Which elements are computed together depends on the engine, so the return value may decide what is computed, but
    must not change results. For example, if all elements of a vector take the same path through a loop, the loop reads
    its tables once for all elements.

    Args:
        condition: The condition. ()
    """
    return any_lane_p.bind(condition)[0]


def _batching_rule(args: Sequence[Array], dims: Sequence[int]) -> tuple[list[Array], list[None]]:
    return any_lane_p.bind(jnp.any(args[0], axis=dims[0])), [None]


any_lane_p = simple_primitive("any_lane", lambda condition: [condition], _batching_rule)
"""``any_lane`` as a primitive of one operand."""


def compute_where(condition: Array, fn: Callable[[Carry], Carry], value: Carry) -> Carry:
    """Return ``fn(value)`` where a condition holds and the value elsewhere; ``fn`` is skipped if it holds nowhere.

    Kernels compile this function to a branch; ``lax.cond`` in a function of one element would compute both cases. The
    function has no reverse-mode derivative.

    Args:
        condition: The condition. ()
        value: Argument of ``fn``, any tree of arrays.
    """
    carry = condition, value
    return lax.while_loop(lambda c: c[0], lambda c: (jnp.zeros_like(c[0]), fn(c[1])), carry)[1]


def select_where(condition: Array, fn: Callable[[Carry], Carry], value: Carry) -> Carry:
    """Return the same as ``compute_where``, with derivatives of all modes; ``fn`` is always computed."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), fn(value), value)


def table_row(table: Array, index: Array) -> Array:
    """Return a row of a table at a computed index, which must be in range. (k,)

    Args:
        table: The table. (n, k)
        index: Index of the row, int32. ()
    """
    return lax.dynamic_slice(table, (index, jnp.int32(0)), (1, table.shape[1]), allow_negative_indices=False)[0]


def table_rows(table: Array, index: Array) -> list[Any]:
    """Return the elements of a row of a table as a list of k scalars. () each"""
    row = table_row(table, index)
    return [row[k] for k in range(table.shape[1])]
