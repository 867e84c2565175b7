"""Automatic resets: when a new episode begins, and the step that includes it, as one kernel where that is possible."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.settings import member
from crazysim.engine.errors import LimitError, UnsupportedError
from crazysim.envs.env import Env, select_states
from crazysim.envs.fused_step import FusedEnvStep
from crazysim.envs.state import EnvState, validate_action
from crazysim.envs.wrappers.base import Wrapper
from crazysim.errors import EngineWarning


class AutoresetMode(StrEnum):
    """When a new episode begins; the names are Gymnasium's."""

    next_step = "NextStep"
    """In the step after the last, which ignores its action and gives no reward."""
    same_step = "SameStep"
    """At the end of the last step itself: ``obs`` belongs to the new episode, reward and ``info`` to that step, and the
    last observation is in ``info["final_obs"]``."""
    disabled = "Disabled"
    """When the user calls ``restart``."""


@dataclass(frozen=True)
class ResetPolicy:
    """Rule by which new episodes begin within a step; all functions are of one world."""

    is_over: Callable[[Array, EnvState], Array]
    """``is_over(was_done, ended)``: true where a new episode begins; ``was_done`` is ``done`` before the step. ()"""
    end: Callable[[EnvState], EnvState]
    """``end(state)``: the state after a step, whether a new episode begins or not."""
    begin: Callable[[EnvState, EnvState], EnvState]
    """``begin(ended, new)``: the state where a new episode begins, from those before and after its reset."""


def _with_final_obs(state: EnvState) -> EnvState:
    return state.replace(info=state.info | {"final_obs": state.obs})


def _with_results(ended: EnvState, new: EnvState) -> EnvState:
    return new.replace(**{name: getattr(ended, name) for name in ("reward", "terminated", "truncated", "info")})


POLICIES: dict[AutoresetMode, ResetPolicy | None] = {
    AutoresetMode.disabled: None,
    AutoresetMode.next_step: ResetPolicy(lambda was_done, _: was_done, lambda state: state, lambda _, new: new),
    AutoresetMode.same_step: ResetPolicy(lambda _, ended: ended.done, _with_final_obs, _with_results),
}
"""Reset policy of each mode; None for no automatic resets."""


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
        self._fused: dict[Any, FusedEnvStep | str] = {}

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the start of an episode; see ``Env.reset``."""
        state = self.env.reset(key)
        return state if self.policy is None else self.policy.end(state)

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in some worlds; see ``Env.restart``."""
        return self.env.restart(state, mask)

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later, with new episodes where one is over; see ``Env.step``."""
        fused = self.fused_step(state, action)
        if not isinstance(fused, str):
            return fused(state, validate_action(action, state, self.actions))
        ended = self.env.step(state, action)
        if self.policy is None:
            return ended
        over = self.policy.is_over(state.done, ended)
        ended = self.policy.end(ended)
        return select_states(over, self.policy.begin(ended, self.env.begin(ended)), ended)

    def explain(self, state: EnvState) -> str:
        """Return one line that says whether a step is one kernel, and if not, why."""
        fused = self.fused_step(state, state.action)
        return f"a step is not one kernel: {fused}" if isinstance(fused, str) else "a step is one kernel"

    def fused_step(self, state: EnvState, action: Any, packed: bool = False) -> FusedEnvStep | str:
        """Return the step as one kernel, or the reason why there is none; warn if that is not a documented limit.

        Args:
            state: A state of the structure that is stepped.
            action: An action, or its shape and type.
            packed: True for a step of packed states; see ``FusedEnvStep``.

        Raises:
            UnsupportedError: If the simulation is strict, and the engine cannot lower or compile the step.
        """
        if (why := self.base.unfused) is not None:
            return why
        leaves, treedef = jax.tree.flatten((state, action))
        key = (packed, treedef, tuple([(jnp.shape(x), jnp.result_type(x)) for x in leaves]))
        if key not in self._fused:
            try:
                self._fused[key] = FusedEnvStep(self.env, self.policy, state, action, packed)
            except LimitError as error:
                self._fused[key] = str(error)
            except UnsupportedError as error:
                if self.base.strict:
                    raise
                self._fused[key] = str(error).partition("\n")[0]
                warnings.warn(f"environment steps run unfused: {error}", EngineWarning, stacklevel=2)
        return self._fused[key]
