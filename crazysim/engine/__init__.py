"""Execution of a step: one description of the physics, several ways to run it."""

from crazysim.engine.compare import Difference, first_difference
from crazysim.engine.plain import build_reset
from crazysim.engine.rollout import rollout
from crazysim.engine.step import ENGINES, Step, explain

__all__ = ["ENGINES", "Difference", "Step", "build_reset", "explain", "first_difference", "rollout"]
