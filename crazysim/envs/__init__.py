"""Environments: tasks in many worlds, as pure functions, and as environments of Gymnasium.

Importing this module registers every task with Gymnasium, as ``crazysim/Hover-v0`` and so on.
"""

from typing import TYPE_CHECKING

from crazysim.envs import terms
from crazysim.envs.actions import Actions, actions_of
from crazysim.envs.env import DroneEnv, Env
from crazysim.envs.random import draw, uniform
from crazysim.envs.registry import TASKS, make, register
from crazysim.envs.rollout import rollout
from crazysim.envs.single import DroneSingleEnv
from crazysim.envs.spawn import flying
from crazysim.envs.state import EnvState, flatten
from crazysim.envs.task import Task
from crazysim.envs.tasks.course import HoopTask, VisitTask
from crazysim.envs.tasks.goals import ProgressTask, state_of
from crazysim.envs.vector import DroneVectorEnv
from crazysim.envs.wrappers import (
    ActionDelay,
    AutoReset,
    AutoresetMode,
    CameraImages,
    EpisodeStatistics,
    FrameStack,
    Normalize,
    ObservationNoise,
    Observe,
    PrivilegedObservation,
    RandomizeWith,
    RewardTerms,
    Wrapper,
)
from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.envs.brax import BraxEnv
    from crazysim.envs.pettingzoo import make_parallel as make_parallel
    from crazysim.envs.race_clock import RaceClock, time_flight
    from crazysim.envs.rsl_rl import RslRlEnv as RslRlEnv
    from crazysim.envs.sb3 import DroneVecEnv as DroneVecEnv
    from crazysim.envs.track_files import load_track, track_names
    from crazysim.envs.tracks import Track, gates_of_track

# Without names that need optional packages, with which ``from crazysim.envs import *`` would fail.
__all__ = [
    "TASKS",
    "ActionDelay",
    "Actions",
    "AutoReset",
    "AutoresetMode",
    "BraxEnv",
    "CameraImages",
    "DroneEnv",
    "DroneSingleEnv",
    "DroneVectorEnv",
    "Env",
    "EnvState",
    "EpisodeStatistics",
    "FrameStack",
    "HoopTask",
    "Normalize",
    "ObservationNoise",
    "Observe",
    "PrivilegedObservation",
    "ProgressTask",
    "RaceClock",
    "RandomizeWith",
    "RewardTerms",
    "Task",
    "Track",
    "VisitTask",
    "Wrapper",
    "actions_of",
    "draw",
    "flatten",
    "flying",
    "gates_of_track",
    "load_track",
    "make",
    "register",
    "rollout",
    "state_of",
    "terms",
    "time_flight",
    "track_names",
    "uniform",
]

__getattr__ = lazy_getattr(__name__)
