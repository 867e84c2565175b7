"""Steps of an environment one call at a time, with as few arrays as can be: each costs more than what is done to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.stage import with_leaves
from crazysim.envs.env import EnvState
from crazysim.envs.fused_step import Laid, WholeStep
from crazysim.envs.rollout import bare
from crazysim.envs.wrappers import AutoReset
from crazysim.errors import ConfigError

Tell = Callable[[EnvState], Any]
"""What of a state after a step is handed out: a tree of arrays. Of its data and memory nothing is there."""


class Advance:
    """A state, and its compiled step: as rows in one kernel where that can be, else leaf by leaf."""

    def __init__(self, env: AutoReset, tell: Tell):
        """Take the environment, and what is handed out after a step."""
        self._env, self._tell = env, tell
        self._structure: Any = None
        self._steps: _Rows | _Leaves | None = None

    @property
    def state(self) -> EnvState | None:
        """The state, bare of observations, reward and info; None before there is one."""
        return None if self._steps is None else self._steps.state()

    @state.setter
    def state(self, state: EnvState) -> None:
        state = bare(state).replace(obs={})
        leaves, treedef = jax.tree.flatten(state)
        structure = (treedef, [(x.shape, x.dtype) for x in leaves])
        if self._steps is None or structure != self._structure:
            whole = self._env.whole(state, state.action, laid=True)
            self._steps = _Leaves(self._env, self._tell) if isinstance(whole, str) else _Rows(whole, self._tell)
            self._structure = structure
        self._steps.hold(state)

    @property
    def compiled(self) -> Any:
        """The compiled step; None before there is one."""
        return None if self._steps is None else self._steps.compiled

    def __call__(self, actions: Array | np.ndarray) -> tuple[Any, Array, Array]:
        """Return what is handed out after a step, and where an episode is over and where its time is. (n_worlds,)

        Args:
            actions: What all drones do, for each world in any shape. (n_worlds, ...)

        Raises:
            ConfigError: If there is no state.
        """
        if self._steps is None:
            raise ConfigError("there is no state to step on from")
        return self._steps.step(actions)


class _Rows:
    """Steps of one kernel."""

    def __init__(self, whole: WholeStep, tell: Tell):
        self._whole = whole
        self._rows: list[Array]
        self._laid: Laid
        self._start: EnvState
        self._ends: tuple[Array, Array]

        def advance(rows: list[Array], laid: Laid, ends: tuple[Array, Array], actions: Any) -> Any:
            laid, told = whole.advance(laid._replace(rows=rows), ends, jnp.asarray(actions))
            return laid.rows, tell(told), (told.terminated, told.truncated)

        self.compiled = jax.jit(advance, donate_argnums=0)  # nobody else has the rows
        self._lay, self._unlay = jax.jit(whole.lay), jax.jit(whole.unlay)

    def hold(self, state: EnvState) -> None:
        laid = self._lay(state)
        self._rows, self._laid = laid.rows, laid._replace(rows=[])
        self._start, self._ends = state, (state.terminated, state.truncated)

    def step(self, actions: Any) -> tuple[Any, Array, Array]:
        self._rows, told, self._ends = self.compiled(self._rows, self._laid, self._ends, actions)
        terminated, truncated = self._ends
        return told, terminated, truncated

    def state(self) -> EnvState:
        terminated, truncated = self._ends
        state = self._unlay(self._laid._replace(rows=self._rows), self._start)
        return state.replace(terminated=terminated, truncated=truncated)


class _Leaves:
    """Steps of a function of the state that return what of it they write, and copy nothing.

    What a compiled call returns as it came is copied.
    """

    def __init__(self, env: AutoReset, tell: Tell):
        self._env, self._tell = env, tell
        self._leaves: list[Any] = []
        self.compiled: Any = None

    def hold(self, state: EnvState) -> None:
        self._leaves, self._treedef = jax.tree.flatten(state)

    def step(self, actions: Any) -> tuple[Any, Array, Array]:
        if self.compiled is None:
            self.compiled = self._prepare(actions)
        values = self.compiled(self._leaves, actions)
        n = len(self._written)
        self._leaves = with_leaves(self._leaves, self._written, values[:n])
        state = self.state()
        return self._told.unflatten(values[n:]), state.terminated, state.truncated

    def state(self) -> EnvState:
        return self._treedef.unflatten(self._leaves)

    def _prepare(self, actions: Any) -> Any:
        """Find out what is written, and return what is to be compiled."""
        treedef = self._treedef

        def flat(leaves: list[Any], actions: Any) -> list[Any]:
            before = treedef.unflatten(leaves)
            state = self._env.step(before, jnp.asarray(actions).reshape(before.action.shape))
            after, same = jax.tree.flatten(bare(state).replace(obs={}))
            if same != treedef:
                raise ConfigError(f"a step changed the structure of the state: {treedef} became {same}")
            values, self._told = jax.tree.flatten(self._tell(state))
            return [*after, *values]

        jaxpr = jax.make_jaxpr(flat)(self._leaves, actions).jaxpr
        n = len(self._leaves)
        self._written = [i for i in range(n) if jaxpr.outvars[i] is not jaxpr.invars[i]]
        kept = [*self._written, *range(n, len(jaxpr.outvars))]
        return jax.jit(lambda leaves, actions: [flat(leaves, actions)[i] for i in kept])
