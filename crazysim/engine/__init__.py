"""How a step is executed."""

from crazysim.engine.explain import explain
from crazysim.engine.plain import build_reset
from crazysim.engine.plan import ENGINES
from crazysim.engine.rollout import rollout
from crazysim.engine.step import Step
from crazysim.engine.stepper import Stepper

__all__ = ["ENGINES", "Step", "Stepper", "build_reset", "explain", "rollout"]
