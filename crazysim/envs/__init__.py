"""Environments: tasks for many worlds, as pure functions, and as Gymnasium's vector environments.

Importing this module registers every task with Gymnasium, as ``crazysim/Hover-v0`` and so on.
"""

from typing import TYPE_CHECKING

from crazysim.envs.actions import Actions, actions_of
from crazysim.envs.env import DroneEnv, Env, EnvState, Task
from crazysim.envs.random import uniform
from crazysim.envs.registry import TASKS, make
from crazysim.envs.rollout import rollout
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.core import state_of
from crazysim.envs.vector import DroneVectorEnv, register
from crazysim.envs.wrappers import (
    ActionDelay,
    AutoReset,
    AutoresetMode,
    EpisodeStatistics,
    FrameStack,
    Normalize,
    ObservationNoise,
    Observe,
    Randomize,
)
from crazysim.lazy import lazy

if TYPE_CHECKING:
    from crazysim.envs.brax import BraxEnv
    from crazysim.envs.pettingzoo import make_parallel
    from crazysim.envs.sb3 import DroneVecEnv

register()

__all__ = [
    "TASKS",
    "ActionDelay",
    "Actions",
    "AutoReset",
    "AutoresetMode",
    "BraxEnv",
    "DroneEnv",
    "DroneVecEnv",
    "DroneVectorEnv",
    "Env",
    "EnvState",
    "EpisodeStatistics",
    "FrameStack",
    "Normalize",
    "ObservationNoise",
    "Observe",
    "Randomize",
    "Task",
    "actions_of",
    "flying",
    "make",
    "make_parallel",
    "rollout",
    "state_of",
    "uniform",
]

__getattr__ = lazy(
    __name__,
    {
        "BraxEnv": "crazysim.envs.brax",
        "DroneVecEnv": "crazysim.envs.sb3",
        "make_parallel": "crazysim.envs.pettingzoo",
    },
)
