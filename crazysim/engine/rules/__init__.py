"""What each primitive of JAX means for single numbers; importing this fills the table of rules (``lower``)."""

from crazysim.engine.rules import control_flow, elementwise, indexing, linalg, movement, random, reductions

__all__ = ["control_flow", "elementwise", "indexing", "linalg", "movement", "random", "reductions"]
