"""Execution of a step: one description of the physics, several ways to run it."""

from crazysim.engine.compare import Difference, first_difference
from crazysim.engine.explain import explain
from crazysim.engine.plain import build_reset
from crazysim.engine.plan import ENGINES
from crazysim.engine.rollout import rollout
from crazysim.engine.step import Step
from crazysim.engine.stepper import Stepper

__all__ = ["ENGINES", "Difference", "Step", "Stepper", "build_reset", "explain", "first_difference", "rollout"]
