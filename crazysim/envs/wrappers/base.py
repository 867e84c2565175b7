"""Base class of wrappers, and the wrapper for automatic resets."""

from __future__ import annotations

from typing import Any

from crazysim.arguments import check_arguments
from crazysim.core.settings import enum_member
from crazysim.envs.env import DroneEnv, Env
from crazysim.envs.hooks import Hooks
from crazysim.envs.reset_policy import POLICIES, AutoresetMode, ResetPolicy
from crazysim.errors import ConfigError, require


class Wrapper(Hooks, Env):
    """An environment around another environment. Subclasses override hooks, which the phases of a step call."""

    @check_arguments
    def __init__(self, env: Env):
        require(isinstance(env, Env), f"expected an environment, got {env!r}")
        require(
            env.reset_policy is None,
            "expected an environment without AutoReset, got one with it. AutoReset is the outermost wrapper, and "
            "adapters to other libraries add it themselves.",
        )
        self.env = env
        name, used_names = self.name or type(self).__name__, {wrapper.name for wrapper in env.wrappers}
        numbered_names = [f"{name} {k}" for k in range(2, len(used_names) + 2)]
        self.name = next(x for x in (name, *numbered_names) if x not in used_names)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        overridden = {"reset", "restart", "step"} & set(vars(cls))
        if overridden:
            raise ConfigError(
                f"expected hooks for one world, got {cls.__name__}.{sorted(overridden)[0]}. Override before_step, "
                f"after_step or after_reset: docs/guides/tasks.md"
            )

    @property
    def base(self) -> DroneEnv:
        return self.env.base

    @property
    def wrappers(self) -> tuple[Hooks, ...]:
        return (*self.env.wrappers, self)


class AutoReset(Wrapper):
    """Begin a new episode within a step where an episode is over. It must be the outermost wrapper."""

    def __init__(self, env: Env, mode: AutoresetMode | str = AutoresetMode.same_step):
        super().__init__(env)
        self.mode = enum_member(AutoresetMode, "mode", mode)

    @property
    def reset_policy(self) -> ResetPolicy | None:
        return POLICIES[self.mode]
