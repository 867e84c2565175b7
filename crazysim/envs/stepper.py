"""Environment steps one call at a time, with few arrays: each costs more than the arithmetic on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import jaxcompat
from crazysim.cache import keep_programs
from crazysim.core.stage import with_leaves
from crazysim.envs.fused_step import FusedEnvStep, PackedState
from crazysim.envs.state import EnvState, bare
from crazysim.envs.task_check import require_finite_start
from crazysim.envs.wrappers.autoreset import AutoReset
from crazysim.errors import ConfigError

Output = Callable[[EnvState], Any]
"""State after a step, without data and memory, to the tree of arrays that a call returns."""


class EnvStepper:
    """A state and its compiled step: packed in one kernel where that is possible, else leaf by leaf."""

    def __init__(self, env: AutoReset, output: Output):
        """Take the environment, and the function that selects what a step returns."""
        self._env, self._output = env, output
        self._structure: object = None
        self._steps: _PackedSteps | _LeafSteps | None = None

    @property
    def state(self) -> EnvState | None:
        """The state without observations, reward and info; None before there is one."""
        return None if self._steps is None else self._steps.state()

    @state.setter
    def state(self, state: EnvState) -> None:
        with keep_programs():
            self._hold(bare(state).replace(obs={}))

    def _hold(self, state: EnvState) -> None:
        leaves, treedef = jax.tree.flatten(state)
        structure = (treedef, [(x.shape, x.dtype) for x in leaves])
        if self._steps is None:
            require_finite_start(self._env.task, state)
        if self._steps is None or structure != self._structure:
            fused = self._env.fused_step(state, state.action, packed=True)
            packed = fused is not None
            self._steps = _PackedSteps(fused, self._output) if packed else _LeafSteps(self._env, self._output)
            self._structure = structure
        self._steps.hold(state)

    @property
    def compiled(self) -> Any:
        """The compiled step; None before there is one."""
        return None if self._steps is None else self._steps.compiled

    def __call__(self, actions: Array | np.ndarray) -> tuple[Any, Array, Array]:
        """Advance the state by one step, and return the output, ``terminated`` and ``truncated``. (n_worlds,) each

        Args:
            actions: Actions of all drones, for each world in any shape. (n_worlds, ...)

        Raises:
            ConfigError: If there is no state.
        """
        if self._steps is None:
            raise ConfigError("expected a state before the first step, got none. Assign stepper.state.")
        compiled = self._steps.compiled
        with keep_programs(when=compiled is None or not jaxcompat.n_compilations(compiled)):
            return self._steps.step(actions)


class _PackedSteps:
    """Steps of one kernel on a packed state."""

    def __init__(self, fused: FusedEnvStep, output: Output):
        self._rows: list[Array]
        self._rest: PackedState
        self._start: EnvState
        self._ends: tuple[Array, Array]

        def step(rows: list[Array], rest: PackedState, ends: tuple[Array, Array], actions: ArrayLike) -> Any:
            packed, state = fused.step_packed(rest._replace(rows=rows), ends, jnp.asarray(actions))
            return packed.rows, output(state), (state.terminated, state.truncated)

        self.compiled = jax.jit(step, donate_argnums=0)  # no caller has the rows
        self._pack, self._unpack = jax.jit(fused.pack), jax.jit(fused.unpack)

    def hold(self, state: EnvState) -> None:
        packed = self._pack(state)
        self._rows, self._rest = packed.rows, packed._replace(rows=[])
        self._start, self._ends = state, (state.terminated, state.truncated)

    def step(self, actions: ArrayLike) -> tuple[Any, Array, Array]:
        self._rows, output, self._ends = self.compiled(self._rows, self._rest, self._ends, actions)
        terminated, truncated = self._ends
        return output, terminated, truncated

    def state(self) -> EnvState:
        terminated, truncated = self._ends
        state = self._unpack(self._rest._replace(rows=self._rows), self._start)
        return state.replace(terminated=terminated, truncated=truncated)


class _LeafSteps:
    """Steps of a function that returns the leaves it writes: a compiled call copies what it returns unchanged."""

    def __init__(self, env: AutoReset, output: Output):
        self._env, self._output = env, output
        self._leaves: list[Array] = []
        self.compiled: Any = None

    def hold(self, state: EnvState) -> None:
        self._leaves, self._treedef = jax.tree.flatten(state)

    def step(self, actions: ArrayLike) -> tuple[Any, Array, Array]:
        if self.compiled is None:
            self.compiled = self._prepare(actions)
        values = self.compiled(self._leaves, actions)
        n = len(self._written)
        self._leaves = with_leaves(self._leaves, self._written, values[:n])
        state = self.state()
        return self._output_tree.unflatten(values[n:]), state.terminated, state.truncated

    def state(self) -> EnvState:
        return self._treedef.unflatten(self._leaves)

    def _prepare(self, actions: ArrayLike) -> Any:
        """Return the function to compile, after finding out which leaves it writes."""
        treedef = self._treedef

        def flat(leaves: list[Array], actions: ArrayLike) -> list[Array]:
            before = treedef.unflatten(leaves)
            state = self._env.step(before, jnp.asarray(actions).reshape(before.action.shape))
            after, same = jax.tree.flatten(bare(state).replace(obs={}))
            if same != treedef:
                raise ConfigError(f"expected a step to keep the structure of the state, {treedef}, got {same}")
            values, self._output_tree = jax.tree.flatten(self._output(state))
            return [*after, *values]

        jaxpr = jax.make_jaxpr(flat)(self._leaves, actions).jaxpr
        n = len(self._leaves)
        self._written = [i for i in range(n) if jaxpr.outvars[i] is not jaxpr.invars[i]]
        kept = [*self._written, *range(n, len(jaxpr.outvars))]
        return jax.jit(lambda leaves, actions: [flat(leaves, actions)[i] for i in kept])
