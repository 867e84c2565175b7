"""Base class of wrappers."""

from __future__ import annotations

from typing import Any

from jax import Array

from crazysim.core.data import SimData
from crazysim.envs.env import DroneEnv, Env
from crazysim.envs.state import EnvState
from crazysim.errors import ConfigError


class Wrapper(Env):
    """An environment around another one. Subclasses add to its phases by overriding hooks, written for one world.

    | Hook | When it is called |
    | --- | --- |
    | ``prepare(data)`` | once in ``reset``, with the data of all worlds |
    | ``after_spawn(data)`` | at the start of an episode, after the task has placed drones and goals |
    | ``after_reset(state)`` | at the start of an episode, after it was observed |
    | ``before_step(state, action)`` | before the physics; the outermost wrapper is called first |
    | ``after_step(state)`` | after observations and reward; the innermost wrapper is called first |

    A hook receives the state without the axis of worlds: (n_drones, k). What a wrapper remembers is in
    ``state.memory[self.name]``; see ``remember`` and ``recall``.
    """

    name: str = ""
    """Key of its memory in ``state.memory``; the name of the class if empty."""
    batched: bool = False
    """True for a wrapper that needs all worlds at once: its hooks then receive them with their axis, and steps are not
    fused. Leaves of its memory without that axis are declared ``leaf("shared")``."""

    def __init__(self, env: Env):
        """Take the environment to wrap.

        Raises:
            ConfigError: If that resets automatically; the wrapper would not be called when an episode starts.
        """
        if not isinstance(env, Env):
            raise ConfigError(f"expected an environment, got {env!r}")
        if env.auto_resets:
            raise ConfigError(
                f"expected an environment without AutoReset, which is the outermost wrapper, got one with it. Put "
                f"{type(self).__name__} inside."
            )
        self.env = env
        self.name = self.name or type(self).__name__

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Refuse wrappers of version 0.1, which stepped the environment inside.

        Raises:
            ConfigError: If the class overrides reset, restart or step without being an automatic reset.
        """
        super().__init_subclass__(**kwargs)
        own = {"reset", "restart", "step"} & set(vars(cls))
        if own and not cls.auto_resets:
            raise ConfigError(
                f"expected hooks for one world, got {cls.__name__}.{sorted(own)[0]}. Override before_step, after_step "
                f"or after_reset: docs/guides/tasks.md"
            )

    @property
    def base(self) -> DroneEnv:
        """The environment inside all wrappers."""
        return self.env.base

    @property
    def wrappers(self) -> tuple[Wrapper, ...]:
        """Wrappers around it, the innermost first, this one last."""
        return (*self.env.wrappers, self)

    def prepare(self, data: SimData) -> SimData:
        """Return the data of all worlds before their first episode."""
        return data

    def after_spawn(self, data: SimData) -> SimData:
        """Return the data at the start of an episode, after the task has placed drones and goals."""
        return data

    def after_reset(self, state: EnvState) -> EnvState:
        """Return the state at the start of an episode, with what the wrapper observes and remembers."""
        return state

    def before_step(self, state: EnvState, action: Array) -> tuple[EnvState, Array]:
        """Return state and action as they are passed on inwards. (n_drones, k)"""
        return state, action

    def after_step(self, state: EnvState) -> EnvState:
        """Return the state after the step."""
        return state

    def recall(self, state: EnvState) -> Any:
        """Return the memory of this wrapper."""
        return state.memory[self.name]

    def remember(self, state: EnvState, memory: Any, **changes: Any) -> EnvState:
        """Return the state with another memory of this wrapper, and other changes."""
        return state.replace(memory=state.memory | {self.name: memory}, **changes)
