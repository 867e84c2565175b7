"""Rules for primitives that only move elements: they are run once, on the elements themselves or on their indices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from crazysim.engine.jaxcompat import JaxprEqn, bind
from crazysim.engine.lowering.jaxprs import ElementArray, Lowering, as_elements, constants, rule

MOVING_PRIMITIVES = (
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "rev", "slice", "split", "unstack",
    "concatenate", "stack", "pad", "tile",
)  # fmt: skip


@rule(*MOVING_PRIMITIVES)
def _move(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return move_by_indices(eqn, args) if eqn.primitive.multiple_results else [move_elements(eqn, args)]


def move_elements(eqn: JaxprEqn, args: list[ElementArray]) -> ElementArray:
    p, x = eqn.params, args[0]
    match eqn.primitive.name:
        case "reshape" if p.get("dimensions") is None:
            return x.reshape(eqn.outvars[0].aval.shape)
        case "squeeze" | "expand_dims":
            return x.reshape(eqn.outvars[0].aval.shape)
        case "transpose":
            return x.transpose(p["permutation"])
        case "slice":
            strides = p["strides"] or (1,) * x.ndim
            return x[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]
        case "broadcast_in_dim":
            shape = [1] * len(p["shape"])
            for size, axis in zip(x.shape, p["broadcast_dimensions"], strict=True):
                shape[axis] = size
            return np.broadcast_to(x.reshape(shape), p["shape"])
        case "concatenate":
            return np.concatenate(args, axis=p["dimension"])
        case "stack":
            return np.stack(args, axis=p["axis"])
    return move_by_indices(eqn, args)[0]


def move_by_indices(eqn: JaxprEqn, args: list[ElementArray], known_operands: Sequence[Any] = ()) -> list[ElementArray]:
    """Return the results of a primitive that only moves elements, by running it on their indices.

    Args:
        args: The arrays whose elements are moved.
        known_operands: Values of further operands, such as indices, which are not moved.
    """
    indices, elements = [], []
    for x in args:
        indices.append(np.arange(len(elements), len(elements) + x.size, dtype=np.int32).reshape(x.shape))
        elements.extend(x.reshape(-1))
    positions = _source_indices(eqn, [*indices, *known_operands])
    return [as_elements([elements[i] for i in p.reshape(-1)], p.shape) for p in positions]


def _source_indices(eqn: JaxprEqn, args: list[Any]) -> list[np.ndarray]:
    p, x = eqn.params, args[0]
    match eqn.primitive.name:
        case "split":
            return np.split(x, np.cumsum(p["sizes"])[:-1], p["axis"])
        case "unstack":
            return list(np.moveaxis(x, p["axis"], 0))
        case "rev":
            return [np.flip(x, p["dimensions"])]
        case "pad":
            return [_pad(x, args[1], p["padding_config"])]
        case "gather":
            return evaluate(eqn, args, fill_value=0)  # the fill value is not used: indices are in bounds, or clipped
    return evaluate(eqn, args)


def _pad(x: np.ndarray, value: np.ndarray, config: Sequence[tuple[int, int, int]]) -> np.ndarray:
    for axis, (low, high, interior) in enumerate(config):
        n = x.shape[axis]
        length = max(low + n + max(n - 1, 0) * interior + high, 0)
        positions = low + np.arange(n) * (interior + 1)
        is_kept = (positions >= 0) & (positions < length)
        padded = np.full((length, *np.delete(x.shape, axis)), value)
        padded[positions[is_kept]] = np.moveaxis(x, axis, 0)[is_kept]
        x = np.moveaxis(padded, 0, axis)
    return x


def evaluate(eqn: JaxprEqn, args: Sequence[Any], **params: Any) -> list[np.ndarray]:
    """Return the results of an operation on known numbers."""
    with jax.ensure_compile_time_eval(), jax.default_device(jax.local_devices(backend="cpu")[0]):
        return [np.asarray(x) for x in bind(eqn, *(jax.numpy.asarray(x) for x in args), **params)]


@rule("iota", "iota_2x32_shape")
def _iota(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    outs = evaluate(eqn, [])
    return [constants(x, x.dtype) for x in outs]
