"""Reductions over the drones of a world, for functions that are written for one drone.

Each drone publishes some of its values. A function of one pair computes the effect of another drone's values on a
drone. It has no axis over pairs: the ``plain`` engine adds this axis, and kernels loop over the drones of a world.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NoReturn

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.engine.jaxcompat import ClosedJaxpr, batched_primitive, constants_to_inputs, jaxpr_as_fun
from crazysim.errors import ConfigError

MEMBER_AXIS = "members"
"""Name of the axis of ``vmap`` over the drones of a world, or over the members of another population."""

Reduction = Literal["sum", "min", "max"]


def safe_min(x: Array, axis: int) -> Array:
    """Return the smallest number along an axis, or NaN if any is NaN; ``jnp.min`` with a safe derivative.

    ``jnp.min`` passes the derivative to the elements that equal the result. If XLA recomputes the elements with other
    rounding, no element equals the result, and the derivative is lost.
    """
    return jnp.squeeze(jnp.take_along_axis(x, jnp.argmin(x, axis=axis, keepdims=True), axis), axis)


def safe_max(x: Array, axis: int) -> Array:
    """Return the largest number along an axis; see ``safe_min``."""
    return jnp.squeeze(jnp.take_along_axis(x, jnp.argmax(x, axis=axis, keepdims=True), axis), axis)


REDUCTIONS: dict[str, Callable[..., Array]] = {"sum": jnp.sum, "min": safe_min, "max": safe_max}
"""Function ``(array, axis) -> array`` of each reduction."""

MAX_PAIRS = 2**20
"""Largest number of pairs of a world computed at once. Larger swarms are computed in batches, to bound memory."""


def reduce_over_others(fn: Callable[[Any, Array], Any], values: Any, reduce: Reduction = "sum") -> Any:
    """Sum a function of pairs over all drones of the world, or take its minimum or maximum, in functions of one drone.

    ``fn`` also runs for the pair of the drone with itself, where ``is_self`` is true. It captures the values of this
    drone. Compute everything that only depends on the other drone in ``values``: they are computed once for each drone,
    and ``fn`` once for each pair.

        gap = reduce_over_others(
            lambda other, is_self: jnp.where(is_self, jnp.inf, rotation.safe_norm(pos - other)), pos, "min"
        )

    Args:
        fn: ``fn(other, is_self)`` returns any tree of arrays for one pair: ``other`` are the ``values`` of the other
            drone; ``is_self`` is true if the other drone is this drone, ().
        values: Values of this drone that are passed to all drones of its world, any tree of small arrays.
        reduce: ``"sum"``, ``"min"`` or ``"max"`` over all drones; for bools ``"max"`` is true where any is true.

    Returns:
        The tree of ``fn``, reduced.
    """
    if reduce not in REDUCTIONS:
        raise ConfigError(f"expected reduce as 'sum', 'min' or 'max', got {reduce!r}")
    leaves, treedef = jax.tree.flatten(jax.tree.map(jnp.asarray, values))
    structure: Any = None

    def pair_fn(*args: Any) -> list[Array]:
        nonlocal structure
        *other_values, is_self = args
        pair_results, structure = jax.tree.flatten(
            jax.tree.map(jnp.asarray, fn(treedef.unflatten(other_values), is_self))
        )
        return pair_results

    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    pair_jaxpr = jax.make_jaxpr(pair_fn)(*avals, jax.ShapeDtypeStruct((), bool))
    if reduce == "sum" and any(x.dtype == bool for x in pair_jaxpr.out_avals):
        raise ConfigError("expected numbers to sum over the other drones, got bools. Use reduce='max' for any of them.")
    reduced = reduce_over_others_p.bind(
        *pair_jaxpr.consts,
        *leaves,
        jaxpr=constants_to_inputs(pair_jaxpr),
        n_captured=len(pair_jaxpr.consts),
        reduce=reduce,
    )
    return structure.unflatten(reduced)


def _refuse_outside(*args: object, **params: object) -> NoReturn:
    raise ConfigError(
        "expected reduce_over_others in a function of one drone that a stage applies to all drones of a world, got a "
        "call outside of one, or in the function of another reduction. Use it in stage('drone') or in the influence of "
        "a plugin."
    )


def _result_types(*args: object, jaxpr: ClosedJaxpr, n_captured: int, reduce: str) -> list[Any]:
    return [x.update(weak_type=False) for x in jaxpr.out_avals]


def _batching_rule(
    axis: Any, args: Sequence[Any], dims: Sequence[Any], jaxpr: ClosedJaxpr, n_captured: int, reduce: str
) -> Any:
    # Over the axis of drones, the reduction is computed. Over any other axis, the primitive is bound again for a
    # batched ``jaxpr``.
    in_axes = [None if d is None else 0 for d in dims]
    rows = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)]
    if axis.name == MEMBER_AXIS:
        results = _reduce_for_all(
            axis.size, rows[:n_captured], in_axes[:n_captured], rows[n_captured:], in_axes[n_captured:], jaxpr, reduce
        )
    else:
        batched_pair_fn = jax.vmap(jaxpr_as_fun(jaxpr), in_axes=(*in_axes, None), axis_size=axis.size)
        pair_jaxpr = jax.make_jaxpr(batched_pair_fn)(*rows, jax.ShapeDtypeStruct((), bool))
        results = reduce_over_others_p.bind(*rows, jaxpr=pair_jaxpr, n_captured=n_captured, reduce=reduce)
    return results, [0] * len(results)


def _reduce_for_all(
    n: int,
    captured: Sequence[Array],
    captured_axes: Sequence[int | None],
    other: Sequence[Array],
    other_axes: Sequence[int | None],
    jaxpr: ClosedJaxpr,
    reduce: str,
) -> list[Array]:
    # ``captured`` and ``other`` are the captured and the published values. Their axes are None for values that all
    # drones share.
    pair_fn, indices = jaxpr_as_fun(jaxpr), jnp.arange(n)
    captured_by_drone = [x for x, axis in zip(captured, captured_axes, strict=True) if axis is not None]

    def reduce_for_one(i: Array, values_of_drone: Sequence[Array]) -> list[Array]:
        remaining_values = iter(values_of_drone)
        captured_values = [
            x if axis is None else next(remaining_values) for x, axis in zip(captured, captured_axes, strict=True)
        ]

        def apply_to_pair(j: Array, values: Sequence[Array]) -> list[Array]:
            return pair_fn(*captured_values, *values, i == j)

        pairs = jax.vmap(apply_to_pair, (0, list(other_axes)))(indices, list(other))
        return [REDUCTIONS[reduce](x, axis=0).astype(x.dtype) for x in pairs]

    if n * n <= MAX_PAIRS:
        return jax.vmap(reduce_for_one)(indices, captured_by_drone)
    reduce_in_batch = jax.checkpoint(lambda xs: reduce_for_one(*xs))
    return jax.lax.map(reduce_in_batch, (indices, captured_by_drone), batch_size=max(1, MAX_PAIRS // n))


reduce_over_others_p = batched_primitive("reduce_over_others", _result_types, _batching_rule, _refuse_outside)
"""The reduction as a primitive: its operands are the values that the function captures, then the published values.
``jaxpr`` maps all of these and ``is_self`` to the results for one pair; ``n_captured`` is the number of captured
values."""
