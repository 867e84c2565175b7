"""Meaning of each JAX primitive on scalars; importing this package fills ``RULES`` of ``lowering.jaxprs``."""

from crazysim.engine.lowering.rules import (
    control_flow,
    elementwise,
    indexing,
    linalg,
    movement,
    pair_reductions,
    random,
    reductions,
)

__all__ = ["control_flow", "elementwise", "indexing", "linalg", "movement", "pair_reductions", "random", "reductions"]
