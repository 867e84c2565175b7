"""Wrapper for automatic resets."""

from __future__ import annotations

from crazysim.core.settings import enum_member
from crazysim.envs.env import Env
from crazysim.envs.reset_policy import POLICIES, AutoresetMode, ResetPolicy
from crazysim.envs.wrappers.base import Wrapper


class AutoReset(Wrapper):
    """Begin a new episode within a step where an episode is over. It must be the outermost wrapper."""

    def __init__(self, env: Env, mode: AutoresetMode | str = AutoresetMode.same_step):
        super().__init__(env)
        self.mode = enum_member(AutoresetMode, "mode", mode)

    @property
    def reset_policy(self) -> ResetPolicy | None:
        return POLICIES[self.mode]
