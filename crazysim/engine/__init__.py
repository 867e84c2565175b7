"""Execution of a step: one description of the physics, several ways to run it."""

from crazysim.engine.plan import ENGINES
from crazysim.engine.step import Step
from crazysim.engine.tools.explain import explain

__all__ = ["ENGINES", "Step", "explain"]
