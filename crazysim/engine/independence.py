"""Whether a function of all worlds does to each what it does to the others, so that it can be written for one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import Block, Element, Operation, Value, prune
from crazysim.engine.lower import Lowering, scalars
from crazysim.engine.lower import inputs as input_elements


def require_apart(fn: Callable[[list[Any]], list[Any]], two: Sequence[Any], sources: Sequence[str], what: str) -> None:
    """Check on two worlds that neither sees the other, and that both are treated alike.

    Args:
        fn: From arrays to arrays that have an axis of worlds in front.
        two: Shapes and types of what it is given, for two worlds.
        sources: What each of it is: of ``"worlds"``, which are its first axis, ``"shared"``, or something that no
            result may depend on, and that the message is to name.
        what: What the function is, for the message.

    Raises:
        UnsupportedError: If one world's result depends on the other's numbers or on its place, or cannot be read.
    """
    lowering = Lowering()
    labels: dict[Value, tuple[Any, frozenset[Any]]] = {}
    inputs = []
    for i, (aval, source) in enumerate(zip(two, sources, strict=True)):
        elements = input_elements(lowering.builder, aval)
        for world, part in enumerate(elements) if source == "worlds" else [(source, elements)]:
            for k, x in enumerate(scalars(part)):
                labels[x] = (("input", i, k), frozenset() if world == "shared" else frozenset([world]))
        inputs.append(elements)
    outputs = lowering.lower(jax.make_jaxpr(fn)(list(two)), inputs)
    block = prune(lowering.finish(outputs))
    forms = _Forms(labels)
    forms.block(block)
    for out in outputs:
        if out.shape[:1] != (2,):
            raise UnsupportedError(f"{what} returns an array of shape {out.shape} for two worlds")
        first, second = ([forms.of(x) for x in scalars(part)] for part in out)
        for (a, worlds_a), (b, worlds_b) in zip(first, second, strict=True):
            seen = (worlds_a | worlds_b) - {0, 1}
            if seen:
                raise UnsupportedError(f"{what} looks at {', '.join(sorted(seen))}")
            if worlds_a - {0} or worlds_b - {1}:
                raise UnsupportedError(f"{what} looks from one world into another")
            if a != b:
                raise UnsupportedError(f"{what} does not do the same in every world")


Known = tuple[Any, frozenset[Any]]
"""What a value computes, whatever world's numbers it computes with, and whose numbers those are."""


class _Forms:
    """Finds out of every value what it computes, and from whose numbers."""

    def __init__(self, labels: dict[Value, Known]):
        self.known: dict[Value, Known] = dict(labels)
        self.numbers: dict[Any, int] = {}

    def of(self, x: Element) -> Known:
        return self.known[x] if isinstance(x, Value) else ((x.dtype.name, x.tobytes()), frozenset())

    def block(self, block: Block) -> list[Known]:
        """Go through a block whose inputs are known, and return what its outputs are."""
        for op in block.operations:
            if op.name != "barrier":
                self.known.update(zip(op.results, self._results(op, [self.of(x) for x in op.args]), strict=True))
        return [self.of(x) for x in block.outputs]

    def _results(self, op: Operation, args: list[Known]) -> list[Known]:
        match op.name:
            case "custom_jvp":
                (body,) = op.blocks
                self.known.update(zip(body.inputs, args, strict=True))
                return self.block(body)
            case "loop" | "while":
                return self._repeated(op, args)
        return [self._joined((op.name, x.dtype.name, op.params, k), args) for k, x in enumerate(op.results)]

    def _joined(self, what: Any, args: list[Known]) -> Known:
        form = (what, *(f for f, _ in args))
        return self.numbers.setdefault(form, len(self.numbers)), frozenset().union(*(w for _, w in args))

    def _repeated(self, op: Operation, carry: list[Known]) -> list[Known]:
        """Tell what is carried apart by what it begins as and what becomes of it, until no turn tells more apart."""
        *test, body = op.blocks
        n_before: Any = None
        while (len({f for f, _ in carry}), sum(len(w) for _, w in carry)) != n_before:
            n_before = (len({f for f, _ in carry}), sum(len(w) for _, w in carry))
            self.known.update(zip(body.inputs, carry, strict=True))
            after = self.block(body)
            for block in test:
                self.known.update(zip(block.inputs, carry, strict=True))
                after = [self._joined("while", [x, *self.block(block)]) for x in after]
            carry = [self._joined((op.name, op.params), [x, y]) for x, y in zip(carry, after, strict=True)]
        return carry
