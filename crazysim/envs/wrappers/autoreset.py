"""Automatic resets: when a new episode begins, and the step that includes it, as one kernel where that is possible."""

from __future__ import annotations

from collections.abc import Hashable
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.settings import member
from crazysim.core.sharding import beside
from crazysim.engine.errors import LimitError, UnsupportedError
from crazysim.envs.env import Env, select_states
from crazysim.envs.fused_step import Action, FusedEnvStep
from crazysim.envs.reset_policy import POLICIES, AutoresetMode
from crazysim.envs.state import EnvState, validate_action
from crazysim.envs.wrappers.base import Wrapper
from crazysim.errors import EngineWarning, warn


class AutoReset(Wrapper):
    """Begin a new episode where one is over; the outermost of all wrappers."""

    auto_resets: ClassVar[bool] = True

    def __init__(self, env: Env, mode: AutoresetMode | str = AutoresetMode.same_step):
        """Take the environment and the mode.

        Raises:
            ConfigError: If there is no such mode.
        """
        super().__init__(env)
        self.mode = member(AutoresetMode, "mode", mode)
        self.policy = POLICIES[self.mode]
        self._fused: dict[Hashable, tuple[FusedEnvStep | None, str]] = {}

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the start of an episode; see ``Env.reset``."""
        state = self.env.reset(key)
        return state if self.policy is None else self.policy.end(state)

    def restart(self, state: EnvState, mask: Array | None) -> EnvState:
        """Return the state with new episodes in some worlds; see ``Env.restart``."""
        return self.env.restart(state, mask)

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later, with new episodes where one is over; see ``Env.step``."""
        with beside(state.data.core.steps):
            fused = self.fused_step(state, action)
            if fused is not None:
                return fused(state, validate_action(action, state, self.actions))
            ended = self.env.step(state, action)
            if self.policy is None:
                return ended
            over = self.policy.is_over(state.done, ended)
            ended = self.policy.end(ended)
            return select_states(over, self.policy.begin(ended, self.env.begin(ended)), ended)

    def _kind_of_step(self) -> str:
        """Return whether a step is one kernel, and if not, why."""
        state = jax.eval_shape(self.reset, jax.random.key(0))
        fused, reason = self._fused_or_reason(state, state.action, packed=False)
        return f"not one kernel: {reason}" if fused is None else "one kernel"

    def fused_step(self, state: EnvState, action: Action, packed: bool = False) -> FusedEnvStep | None:
        """Return the step as one kernel, or None; warn if the reason, which ``explain`` gives, is no documented limit.

        Args:
            state: A state of the structure that is stepped.
            action: An action, or its shape and type.
            packed: True for a step of packed states; see ``FusedEnvStep``.

        Raises:
            UnsupportedError: If the simulation is strict, and the engine cannot lower or compile the step.
        """
        return self._fused_or_reason(state, action, packed)[0]

    def _fused_or_reason(self, state: EnvState, action: Action, packed: bool) -> tuple[FusedEnvStep | None, str]:
        """Return the step as one kernel, or None and the reason why there is none."""
        if (why := self.base.unfused) is not None:
            return None, why
        leaves, treedef = jax.tree.flatten((state, action))
        key = (packed, treedef, tuple([(jnp.shape(x), jnp.result_type(x)) for x in leaves]))
        if key not in self._fused:
            try:
                self._fused[key] = FusedEnvStep(self.env, self.policy, state, action, packed), ""
            except LimitError as error:
                self._fused[key] = None, str(error)
            except UnsupportedError as error:
                if self.base.strict:
                    raise
                self._fused[key] = None, str(error).partition("\n")[0]
                warn(f"environment steps run unfused: {error}", EngineWarning)
        return self._fused[key]
