"""Stages that run once before the steps, the steps, and stages that run once after them, as one kernel."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import jax.numpy as jnp

from crazysim.engine import fused
from crazysim.engine.lower import NoRuleError
from crazysim.engine.program import Program
from crazysim.sim.stage import Stage, with_leaves


class Whole:
    """``whole(leaves) -> leaves``, pure, as ``Step`` is, for data of one structure and a number of steps that is known.

    What it writes before it reads is not read: there may be anything in its place.
    """

    def __init__(
        self,
        first: Sequence[Stage],
        stages: Sequence[Stage],
        last: Sequence[Stage],
        data: Any,
        zeros: dict[int, frozenset[int]],
        n_steps: int,
        platform: str,
        scratch: Collection[int] = (),
    ):
        """Read the stages.

        Args:
            first: Stages that run once, before the steps.
            stages: Stages of a step.
            last: Stages that run once, after the steps.
            data: Data of the structure, or its shapes and types.
            zeros: Elements of shared leaves that are known to be zero, by leaf.
            n_steps: How many steps.
            platform: Where it runs, ``"cpu"`` or ``"gpu"``.
            scratch: Leaves that are only there for one stage to tell another.

        Raises:
            NoRuleError: If something of it cannot be written out.
        """
        self.program = program = Program(stages, data, zeros, None, first, last, scratch)
        split = [s for s in program.segments if s.scope == "batch"]
        if split:
            raise NoRuleError(f"{split[0].stages[0].__name__!r} is not fused: {split[0].why}")
        program.pack()
        self.n_steps = n_steps
        self._run = fused.build(program, platform)

    def __call__(self, leaves: Sequence[Any]) -> list[Any]:
        """Return the leaves after it all."""
        packed = [jnp.concatenate([leaves[i].ravel() for i in self.program.packed])] if self.program.packed else []
        written, _ = self._run([*leaves, *packed], self.n_steps)
        return with_leaves(leaves, self.program.written, written)
