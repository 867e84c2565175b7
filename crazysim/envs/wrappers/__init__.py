"""Wrappers: environments around environments. Most wrappers are written for one world."""

from crazysim.envs.reset_policy import AutoresetMode, ResetPolicy
from crazysim.envs.wrappers.action import ActionDelay
from crazysim.envs.wrappers.base import AutoReset, Wrapper
from crazysim.envs.wrappers.images import CameraImages
from crazysim.envs.wrappers.observation import FrameStack, Normalize, ObservationNoise, Observe, PrivilegedObservation
from crazysim.envs.wrappers.randomize import RandomizeWith
from crazysim.envs.wrappers.rewards import EpisodeStatistics, RewardTerms

__all__ = [
    "ActionDelay",
    "AutoReset",
    "AutoresetMode",
    "CameraImages",
    "EpisodeStatistics",
    "FrameStack",
    "Normalize",
    "ObservationNoise",
    "Observe",
    "PrivilegedObservation",
    "RandomizeWith",
    "ResetPolicy",
    "RewardTerms",
    "Wrapper",
]
