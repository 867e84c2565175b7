"""Stages that run once before the steps, the steps, and stages that run once after them, as one kernel."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.sharding import Location
from crazysim.core.stage import Stage, with_leaves
from crazysim.engine.backends import fused, kernel
from crazysim.engine.lowering.relative import on_data, viewed
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.optimise import optimise


class FusedCall:
    """``rollout(leaves) -> leaves``, pure, as ``Step`` is, for data of one structure and a fixed number of steps.

    A leaf that is written before it is read is not read: its value may be anything.
    """

    def __init__(
        self,
        first: Sequence[Stage],
        stages: Sequence[Stage],
        last: Sequence[Stage],
        data: Any,
        n_steps: int,
        platform: str,
        scratch: Collection[int] = (),
        rows: Callable[[list[int]], list[int]] | None = None,
    ):
        """Lower the stages.

        Args:
            first: Stages that run once, before the steps.
            stages: Stages of a step.
            last: Stages that run once, after the steps.
            data: Data of the structure, or its shapes and types.
            n_steps: Number of steps.
            platform: Platform it runs on, ``"cpu"`` or ``"gpu"``.
            scratch: Leaves that only pass values from one stage to another.
            rows: Selects, from the leaves that are written, those that ``run_packed`` takes as rows.

        Raises:
            UnsupportedError: If a stage cannot be lowered.
        """
        lowered = lower_stages(stages, data, (), None, first, last, scratch)
        self.program = program = optimise(lowered, rows)
        if program.unfused_stages:
            raise program.unfused_stages[0].error
        self._n_leaves = len(jax.tree.leaves(data))
        self._rows = {i: list(leaf.rows_of) for i, leaf in enumerate(program.leaves) if leaf.rows_of}
        self.read = [i for i in kernel.needed(program) if i < self._n_leaves]
        """Leaves that are read as arrays of their own, neither as rows nor with the shared numbers."""
        self._n_steps = n_steps
        self._run = on_data(program, fused.build(program, Location(platform)))

    def __call__(self, leaves: Sequence[Any]) -> list[Any]:
        """Return the leaves after all stages."""
        written, _ = self._run([*leaves, *self.shared(leaves)], self._n_steps)
        return with_leaves(leaves, self.program.written, written)

    def shared(self, leaves: Sequence[Any]) -> list[Array]:
        """Return the shared numbers of the leaves as one array, if there are any."""
        packed = self.program.packed
        return [jnp.concatenate([leaves[i].ravel() for i in packed])] if packed else []

    def pack(self, leaves: Sequence[Any]) -> list[Array]:
        """Return leaves as rows, each one number of all drones; one array for each type. (n_rows, n_lanes) each"""
        n_drones = self.program.n_drones
        leaves = viewed(self.program.views, leaves)

        def row(x: Any) -> Array:
            x = jnp.broadcast_to(x, (x.shape[0], n_drones, *x.shape[2:]))
            return x.reshape(x.shape[0] * n_drones, -1).T

        return [jnp.concatenate([row(leaves[i]) for i in some]) for some in self._rows.values()]

    def unpack(self, rows: Sequence[Array]) -> dict[int, Array]:
        """Return packed leaves, by number."""
        program, out = self.program, {}
        for array, some in zip(rows, self._rows.values(), strict=True):
            first = 0
            for i in some:
                like = program.leaves[i]
                size = like.size
                x = array[first : first + size].T.reshape(-1, program.n_drones, *like.shape[2:])
                x = x[:, :1] if like.scope == "world" else x
                out[i] = x.reshape(x.shape[0], *x.shape[2:]) if i in program.views else x
                first += size
        return out

    def run_packed(
        self, rows: Sequence[Array], shared: Sequence[Array], read: dict[int, Any]
    ) -> tuple[list[Array], dict[int, Array]]:
        """Return the rows after all stages, and the other leaves that are written.

        Args:
            rows: From ``pack``.
            shared: From ``shared``.
            read: Leaves that are read as arrays of their own.
        """
        leaves = [read.get(i) for i in range(self._n_leaves)]
        written, _ = self._run([*leaves, *shared, *rows], self._n_steps)
        found = dict(zip(self.program.written, written, strict=True))
        return [found.pop(i) for i in self._rows], found
