"""From the stages of a step to the program that an engine runs: lowering, then passes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any

from crazysim.core.stage import Stage
from crazysim.engine import passes
from crazysim.engine.layout import as_rows, pack_shared
from crazysim.engine.lower_stages import Zeros, lower_stages
from crazysim.engine.program import Program
from crazysim.engine.tracing import Tracer


def build_program(
    stages: Sequence[Stage],
    data: Any,
    zeros: Zeros | None = None,
    watched: Callable[[Any], list[Any]] | None = None,
    first: Sequence[Stage] = (),
    last: Sequence[Stage] = (),
    scratch: Collection[int] = (),
    rows: Callable[[list[int]], list[int]] | None = None,
    population: str = "drone",
    pack: bool = True,
    tracer: Tracer | None = None,
) -> Program:
    """Return the program of a step, ready for an engine.

    Args:
        stages: Stages of a step, in order.
        data: Data of the simulation, or its shapes and types.
        zeros: Elements of shared leaves that are known to be zero, by leaf: their terms are left out.
        watched: Picks the leaves that are checked for NaN and infinity after the last step.
        first: Stages that run once, before the first step.
        last: Stages that run once, after the last step.
        scratch: Leaves that only carry numbers from one stage to another; what is written there is not kept.
        rows: From the leaves that are written to those that are stored as rows of one number of all drones each.
        population: Population whose members are computed side by side.
        pack: True to read shared numbers from one leaf.
        tracer: Cache of traced stages; None for a new one.
    """
    program = lower_stages(stages, data, zeros, watched, first, last, scratch, population, tracer)
    then: list[passes.Pass] = [passes.fuse, passes.join_ticks, passes.hoist, *([pack_shared] if pack else [])]
    if rows is not None:
        stored = functools.partial(as_rows, select=rows)
        then.append(functools.update_wrapper(stored, as_rows))
    return passes.apply(program, then)
