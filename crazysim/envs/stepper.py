"""Environment steps in separate calls that pass few arrays, because passing an array takes longer than computing it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import NamedSharding, PartitionSpec
from numpy.typing import ArrayLike

from crazysim.engine import jaxcompat
from crazysim.engine.cache import keep_programs
from crazysim.engine.pytree import replace_leaves
from crazysim.engine.sharding import WORLD_AXIS
from crazysim.engine.step import FlatData
from crazysim.envs.env import Env
from crazysim.envs.state import ENV_RECORD_NAME, RESULT_FIELDS, EnvState
from crazysim.envs.task_check import require_finite_start
from crazysim.errors import require

Output = Callable[[EnvState], Any]
"""``output(state)``: the tree of arrays that a call returns, from the state after a step."""


class EnvStepper:
    """An environment state that is stored flattened and advanced in place.

    Its compiled step returns the result of ``output``, ``terminated`` and ``truncated``.
    """

    def __init__(self, env: Env, output: Output):
        self._env, self._output = env, output
        self._flatten = jax.jit(env.flatten)
        self._unflatten = jax.jit(lambda flat, terminated, truncated: EnvState(flat.data()).replace(
            terminated=terminated, truncated=truncated
        ))  # fmt: skip
        self._flat: FlatData | None = None
        self._ends: tuple[Array, Array]
        """``terminated`` and ``truncated`` of the state. (n_worlds,) each"""
        self._carried_indices: list[int] = []
        """Indices of the leaves of ``_flat`` that the compiled step changes."""
        self._fixed_indices: list[int] = []
        """Indices of the leaves of ``_flat`` that the compiled step only reads."""
        self.compiled: Any = None
        """The compiled step; None before a state is assigned."""

    @property
    def state(self) -> EnvState | None:
        """The state; None before the first assignment.

        ``terminated`` and ``truncated`` have the values of the last step. The other results of steps
        (``RESULT_FIELDS``) may still have the values of the assigned state, because steps do not store them.
        """
        return None if self._flat is None else self._unflatten(self._flat, *self._ends)

    @state.setter
    def state(self, state: EnvState) -> None:
        old_flat = self._flat
        if old_flat is None:
            require_finite_start(self._env.task, state)
        with keep_programs():
            flat = self._flat = self._flatten(state)
        self._ends = state.terminated, state.truncated
        if old_flat is None or old_flat.plan is not flat.plan:
            self._compile(flat)

    def __call__(self, actions: Array | np.ndarray) -> tuple[Any, Array, Array]:
        flat = self._flat
        require(flat is not None, "expected a state before the first step, got none. Assign stepper.state.")
        if self._env.sim.mesh is not None:  # the actions may be on one device
            actions = jax.device_put(actions, NamedSharding(self._env.sim.mesh, PartitionSpec(WORLD_AXIS)))
        carry, fixed_leaves = (
            [flat.leaves[i] for i in indices] for indices in (self._carried_indices, self._fixed_indices)
        )
        with keep_programs(enabled=not jaxcompat.n_compilations(self.compiled)):
            carry, output, self._ends = self.compiled(carry, fixed_leaves, self._ends, actions)
        self._flat = flat.replace(self._carried_indices, carry)
        return output, *self._ends

    def _compile(self, flat: FlatData) -> None:
        plan, env = flat.plan, self._env
        record, n = plan.leaf_indices.plugins[ENV_RECORD_NAME], len(flat.leaves)
        end_indices = [record.terminated, record.truncated]
        result_indices = set(jax.tree.leaves([getattr(record, name) for name in RESULT_FIELDS]))
        self._carried_indices = carried_indices = [
            i for i in plan.written_leaves if i not in result_indices - set(plan.inputs) and i not in end_indices
        ]
        fixed_results = result_indices - set(plan.written_leaves)  # entries of info that only a reset sets
        self._fixed_indices = fixed_indices = sorted(
            {*plan.inputs, *fixed_results} - {*carried_indices, *end_indices, record.next_action}
        )
        template = flat.leaves[record.next_action]

        def step(carry: list[Array], fixed_leaves: list[Array], ends: tuple[Array, Array], actions: ArrayLike) -> Any:
            leaves = replace_leaves(replace_leaves([None] * n, fixed_indices, fixed_leaves), carried_indices, carry)
            leaves = replace_leaves(leaves, end_indices, [x[:, None] for x in ends])
            new_flat = env.advance(FlatData(leaves, plan), jnp.asarray(actions, template.dtype).reshape(template.shape))
            state = EnvState(new_flat.data())
            return (
                [new_flat.leaves[i] for i in carried_indices],
                self._output(state),
                (state.terminated, state.truncated),
            )

        self.compiled = jaxcompat.jit_donating(step)  # callers never get the carried arrays
