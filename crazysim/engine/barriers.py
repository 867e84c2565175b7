"""Optimisation barriers for ``plain``: a costly value that several others need is computed once.

XLA's CPU backend fuses a value into everything that uses it and computes it again there, angles and norms too. It also
reads a vector of three or four numbers from rows, which do not fill a vector unit. A barrier prevents the first, and a
layout by component behind it the second. Barriers are placed from the equations of a function, so that a control law
needs none: one after another where it saves most, as long as it saves more than ``WORTH``.

The estimate assumes that everything element-wise is fused. For each element of a value, its work is the arithmetic that
computes it from inputs and barriers. Its evaluations are the elements of it that its users request.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax

from crazysim.engine import jaxcompat
from crazysim.engine.jaxcompat import ClosedJaxpr, Literal
from crazysim.engine.ops import TABLE

WORTH = 8.0
"""Repeated arithmetic for each element of a value from which a barrier pays, in multiply-adds. Of 4, 8, 16, 32 and 64,
4 to 16 gave the fastest steps on one core of a CPU; larger values compile sooner."""

MOVES = frozenset(
    "broadcast_in_dim concatenate convert_element_type copy reshape rev slice split squeeze stack transpose "
    "unstack".split()
)
"""Fused primitives without arithmetic."""

NESTED = {"jit": "jaxpr", "pjit": "jaxpr", "custom_jvp_call": "call_jaxpr"}
"""Fused primitives that call a function, and the parameter that has it."""


def compute_once(
    fn: Callable[..., Any], like: Any, least: int, barrier: Callable[[Any], Any] = jax.lax.optimization_barrier
) -> Callable[..., Any]:
    """Return a function of a tree of arrays with barriers behind the costly values that several others use.

    Args:
        fn: The function.
        like: Its operand, or the shapes and types.
        least: Number of elements from which a value gets a barrier. XLA moves smaller ones out of its loops.
        barrier: Function of an array that has its value and is a barrier.
    """
    treedefs = [jax.tree.structure(like)]

    def flat(*leaves: Any) -> list[Any]:
        out, treedef = jax.tree.flatten(fn(treedefs[0].unflatten(leaves)))
        treedefs[1:] = [treedef]
        return out

    jaxpr = jax.make_jaxpr(flat)(*jax.tree.leaves(like))
    chosen = choose(jaxpr, least)

    def computed_once(tree: Any) -> Any:
        return treedefs[1].unflatten(_evaluate(jaxpr, jax.tree.leaves(tree), chosen, barrier))

    return computed_once


def choose(jaxpr: ClosedJaxpr, least: int) -> set[Any]:
    """Return the variables of a jaxpr that get a barrier, of at least as many elements as ``least``."""
    nodes = [_node(eqn) for eqn in jaxpr.jaxpr.eqns]
    asked = [v for v in jaxpr.jaxpr.outvars if not isinstance(v, Literal)]
    chosen: set[Any] = set()
    while True:
        evaluations = _evaluations(nodes, asked, chosen)
        best, most = None, 0.0
        for v, work in _work(nodes, chosen).items():
            size = v.aval.size
            saved = (evaluations.get(v, 0.0) - size) * work
            if saved > max(most, WORTH * size) and size >= least and v not in chosen:
                best, most = v, saved
        if best is None:
            return chosen
        chosen.add(best)


class _Node(NamedTuple):
    """An equation as the estimate reads it."""

    results: list[Any]
    """Variables that it defines."""
    operands: list[tuple[Any, float]]
    """Variables that it uses, and how many elements of each it needs for one element of its results."""
    fused: bool
    """True where XLA fuses it into what uses its results."""
    cost: float
    """Arithmetic of its own for each element of its results, in multiply-adds."""


def _node(eqn: Any) -> _Node:
    name = eqn.primitive.name
    row = TABLE.get(name)
    size = max(sum(v.aval.size for v in eqn.outvars), 1)
    joins = name in ("concatenate", "stack") or name.startswith("reduce_")
    by_element = name in MOVES or name in NESTED or (row is not None and not row.structured)
    operands = [
        (v, 1.0 if by_element and not joins else v.aval.size / size) for v in eqn.invars if not isinstance(v, Literal)
    ]
    cost = 0.0
    if name in NESTED:
        inner = getattr(eqn.params[NESTED[name]], "jaxpr", eqn.params[NESTED[name]])
        found = _work([_node(x) for x in inner.eqns], set())
        cost = max((found.get(v, 0.0) for v in inner.outvars if not isinstance(v, Literal)), default=0.0)
    elif name.startswith("reduce_"):
        cost = eqn.invars[0].aval.size / size
    elif row is not None and name not in MOVES:
        cost = row.cost
    return _Node(list(eqn.outvars), operands, by_element or joins, cost)


def _work(nodes: Sequence[_Node], chosen: set[Any]) -> dict[Any, float]:
    """Return the arithmetic for each element of every fused value, from inputs, barriers and values not fused."""
    work: dict[Any, float] = {}
    for node in nodes:
        if node.fused:
            amount = node.cost + sum(n * work.get(v, 0.0) for v, n in node.operands if v not in chosen)
            work.update(dict.fromkeys(node.results, amount))
    return work


def _evaluations(nodes: Sequence[_Node], asked: Sequence[Any], chosen: set[Any]) -> dict[Any, float]:
    """Return how many elements of every value are computed in all that uses it."""
    count: dict[Any, float] = {}
    for v in asked:
        count[v] = count.get(v, 0.0) + v.aval.size
    for node in reversed(nodes):
        results = sum(count.get(v, 0.0) if node.fused and v not in chosen else v.aval.size for v in node.results)
        for v, n in node.operands:
            count[v] = count.get(v, 0.0) + results * n
    return count


def _evaluate(jaxpr: ClosedJaxpr, args: Sequence[Any], chosen: set[Any], barrier: Callable[[Any], Any]) -> list[Any]:
    """Return the values of a jaxpr, with a barrier behind the chosen variables."""
    inner = jaxpr.jaxpr
    values: dict[Any, Any] = dict(zip(inner.constvars, jaxpr.consts, strict=True))
    values.update(zip(inner.invars, args, strict=True))

    def read(variables: Sequence[Any]) -> Iterator[Any]:
        return (v.val if isinstance(v, Literal) else values[v] for v in variables)

    for eqn in inner.eqns:
        out = jaxcompat.as_function(eqn)(*read(eqn.invars))
        outs = out if eqn.primitive.multiple_results else [out]
        values.update((v, barrier(x) if v in chosen else x) for v, x in zip(eqn.outvars, outs, strict=True))
    return list(read(inner.outvars))
