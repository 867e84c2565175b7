"""Environments: tasks for many worlds, as pure functions, and as Gymnasium's vector environments.

Importing this module registers every task with Gymnasium, as ``crazysim/Hover-v0`` and so on.
"""

from crazysim.envs.actions import Actions, actions_of
from crazysim.envs.env import DroneEnv, Env, EnvState, Task
from crazysim.envs.registry import TASKS, make
from crazysim.envs.rollout import rollout
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

register()

__all__ = [
    "TASKS",
    "ActionDelay",
    "Actions",
    "AutoReset",
    "AutoresetMode",
    "DroneEnv",
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
    "make",
    "rollout",
]
