"""How a step is executed."""

from crazysim.engine.plain import build_reset
from crazysim.engine.rollout import rollout
from crazysim.engine.step import ENGINES, Step, explain

__all__ = ["ENGINES", "Step", "build_reset", "explain", "rollout"]
