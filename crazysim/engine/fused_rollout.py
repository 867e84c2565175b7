"""Stages that run once before the steps, the steps, and stages that run once after them, as one kernel."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.stage import Stage, with_leaves
from crazysim.engine import fused, kernel
from crazysim.engine.build import build_program


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
        lay: Callable[[list[int]], list[int]] | None = None,
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
            lay: Picks, from the leaves that are written, those that ``advance`` is given as rows.

        Raises:
            UnsupportedError: If something of it cannot be written out.
        """
        self.program = program = build_program(stages, data, zeros, None, first, last, scratch, lay)
        if program.unfused_stages:
            raise program.unfused_stages[0].error
        self._n_leaves = len(jax.tree.leaves(data))
        self._rows = {i: list(leaf.rows_of) for i, leaf in enumerate(program.leaves) if leaf.rows_of}
        self.read = [i for i in kernel.needed(program) if i < self._n_leaves]
        """Leaves that are read as they are, not as rows and not with the shared numbers."""
        self._n_steps = n_steps
        self._run = fused.build(program, platform)

    def __call__(self, leaves: Sequence[Any]) -> list[Any]:
        """Return the leaves after it all."""
        written, _ = self._run([*leaves, *self.shared(leaves)], self._n_steps)
        return with_leaves(leaves, self.program.written, written)

    def shared(self, leaves: Sequence[Any]) -> list[Array]:
        """Return the shared numbers of some leaves one behind the other, if there are any."""
        packed = self.program.packed
        return [jnp.concatenate([leaves[i].ravel() for i in packed])] if packed else []

    def rows(self, leaves: Sequence[Any]) -> list[Array]:
        """Return leaves as rows of one number of all drones each, an array for each type. (n_rows, n_lanes) each"""
        n_drones = self.program.n_drones

        def row(x: Any) -> Array:
            x = jnp.broadcast_to(x, (x.shape[0], n_drones, *x.shape[2:]))
            return x.reshape(x.shape[0] * n_drones, -1).T

        return [jnp.concatenate([row(leaves[i]) for i in some]) for some in self._rows.values()]

    def unlaid(self, rows: Sequence[Array]) -> dict[int, Array]:
        """Return the leaves that rows are of, by number."""
        program, out = self.program, {}
        for array, some in zip(rows, self._rows.values(), strict=True):
            first = 0
            for i in some:
                like = program.leaves[i]
                size = like.size
                x = array[first : first + size].T.reshape(-1, program.n_drones, *like.shape[2:])
                out[i] = x[:, :1] if like.scope == "world" else x
                first += size
        return out

    def advance(
        self, rows: Sequence[Array], shared: Sequence[Array], read: dict[int, Any]
    ) -> tuple[list[Array], dict[int, Array]]:
        """Return the rows after it all, and the other leaves that are written.

        Args:
            rows: From ``rows``.
            shared: From ``shared``.
            read: What is to be read as it is, by leaf.
        """
        leaves = [read.get(i) for i in range(self._n_leaves)]
        written, _ = self._run([*leaves, *shared, *rows], self._n_steps)
        found = dict(zip(self.program.written, written, strict=True))
        return [found.pop(i) for i in self._rows], found
