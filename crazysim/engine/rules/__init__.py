"""Rules that lower the primitives of JAX to scalar operations; importing the package registers them (``lower``)."""

from crazysim.engine.rules import control_flow, elementwise, indexing, linalg, movement, random, reductions

__all__ = ["control_flow", "elementwise", "indexing", "linalg", "movement", "random", "reductions"]
