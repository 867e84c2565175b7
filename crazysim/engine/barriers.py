"""Optimisation barriers for ``plain``: a costly value that several others need is computed once.

XLA's CPU backend fuses a value into everything that uses it and computes it again there, angles and norms too. It also
reads a vector of three or four numbers from rows, which do not fill a vector unit. A barrier prevents the first, and a
layout by component behind it the second. Barriers are placed from the equations of a function, so that a control law
needs none: one after another where it saves most, as long as it saves more than ``WORTH``.

The estimate assumes that everything element-wise is fused. For each element of a value, its work is the arithmetic that
computes it from inputs and barriers. Its evaluations are the elements of it that its users request.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
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
    estimate = _Estimate([_node(eqn) for eqn in jaxpr.jaxpr.eqns], jaxpr.jaxpr.outvars, least)
    while (best := estimate.best()) is not None:
        estimate.add_barrier(best)
    return estimate.chosen


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
            work.update(dict.fromkeys(node.results, _own_work(node, work, chosen)))
    return work


def _own_work(node: _Node, work: dict[Any, float], chosen: set[Any]) -> float:
    return node.cost + sum(n * work.get(v, 0.0) for v, n in node.operands if v not in chosen)


class _Queue:
    """Numbers in ascending order, each once."""

    def __init__(self, numbers: Iterable[int]):
        self._heap: list[int] = []
        self._waiting: set[int] = set()
        self.extend(numbers)

    def __len__(self) -> int:
        return len(self._heap)

    def extend(self, numbers: Iterable[int]) -> None:
        for k in numbers:
            if k not in self._waiting:
                self._waiting.add(k)
                heapq.heappush(self._heap, k)

    def pop(self) -> int:
        k = heapq.heappop(self._heap)
        self._waiting.discard(k)
        return k


class _Estimate:
    """Work and evaluations of every fused value. A barrier updates those that it changes, and no others."""

    def __init__(self, nodes: Sequence[_Node], outputs: Sequence[Any], least: int):
        self.nodes, self.least = nodes, least
        self.chosen: set[Any] = set()
        self.work = _work(nodes, self.chosen)
        self.order = {v: k for k, v in enumerate(self.work)}
        self.size = {v: v.aval.size for node in nodes for v in node.results}
        self.producer = {v: k for k, node in enumerate(nodes) for v in node.results}
        self.users: dict[Any, list[tuple[int, float]]] = {}
        self.outputs: dict[Any, float] = {}
        """Elements of a value that are outputs, as often as it is one."""
        for k, node in enumerate(nodes):
            for v, n in node.operands:
                self.users.setdefault(v, []).append((k, n))
        for v in outputs:
            if not isinstance(v, Literal):
                self.outputs[v] = self.outputs.get(v, 0.0) + v.aval.size
        self.count: dict[Any, float] = {}
        """Evaluations: how many elements of a value are computed in all that uses it."""
        self.requested = [0.0] * len(nodes)
        """Elements that are computed of all results of a node."""
        self.candidates: list[tuple[float, int, Any]] = []
        for k in reversed(range(len(nodes))):
            self._count_results(k)
        for v in self.work:
            self._propose(v)

    def best(self) -> Any:
        """Return the value whose barrier saves most, the first of several; None if none saves enough."""
        while self.candidates:
            saved, _, v = heapq.heappop(self.candidates)
            if v not in self.chosen and -saved == self._saved(v):
                return v
        return None

    def add_barrier(self, barrier: Any) -> None:
        """Put a barrier behind a value: what follows no longer computes it, and it is computed once."""
        self.chosen.add(barrier)
        changed: set[Any] = set()
        later = _Queue(k for k, _ in self.users.get(barrier, ()))
        while later:  # ascending, so that all operands are known
            node = self.nodes[later.pop()]
            amount = _own_work(node, self.work, self.chosen) if node.fused and node.results else None
            if amount is None or amount == self.work[node.results[0]]:
                continue
            for v in node.results:
                self.work[v] = amount
                changed.add(v)
                if v not in self.chosen:
                    later.extend(user for user, _ in self.users.get(v, ()))
        earlier = _Queue([-self.producer[barrier]])
        while earlier:  # descending, so that all users are known
            k = -earlier.pop()
            before = self.requested[k]
            self._count_results(k)
            changed.update(self.nodes[k].results)
            if self.requested[k] != before:
                earlier.extend(-self.producer[v] for v, _ in self.nodes[k].operands if v in self.producer)
        for v in changed:
            self._propose(v)

    def _count_results(self, k: int) -> None:
        """Count the evaluations of the results of a node, whose users are counted."""
        node, requested = self.nodes[k], 0.0
        for v in node.results:
            count = self.outputs.get(v, 0.0)
            for user, n in reversed(self.users.get(v, ())):
                count += self.requested[user] * n
            self.count[v] = count
            requested += count if node.fused and v not in self.chosen else self.size[v]
        self.requested[k] = requested

    def _saved(self, v: Any) -> float:
        return (self.count[v] - self.size[v]) * self.work[v]

    def _propose(self, v: Any) -> None:
        """Add a value to the candidates if a barrier behind it saves enough."""
        size = self.size[v]
        if size >= self.least and v in self.work and (saved := self._saved(v)) > WORTH * size:
            heapq.heappush(self.candidates, (-saved, self.order[v], v))


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
