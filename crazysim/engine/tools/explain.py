"""A description of how a step is executed."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp

from crazysim.engine.backends import fused
from crazysim.engine.ir.program import UnfusedStage
from crazysim.engine.record import Record
from crazysim.engine.step import Step


def explain(step: Step, data: Record, measure: bool = False) -> str:
    """Explain a step in a few lines: its engine, the stages that are fused, and why other stages are not.

    Args:
        data: Data to step, or its shapes and types.
        measure: Whether to measure the cost of stages that are not fused, which compiles the step once more without
            them and takes 256 steps.
    """
    plan = step.plan(data)
    lines = [f"engine: {plan.engine}" + (f" ({plan.engine_reason})" if plan.engine_reason else "")]
    if plan.program is None:
        return "\n".join([*lines, f"stages: {', '.join(s.__name__ for s in step.stages)}"])
    for program in plan.programs:
        for segment in program.segments:
            if isinstance(segment, UnfusedStage):
                lines.append(f"splits the step: {segment.explanation}")
            else:
                names, is_per_member = ", ".join(segment.stages), segment.scope == "drone"
                owner = (
                    f"member of {program.population!r}"
                    if is_per_member and program.population != "drone"
                    else segment.scope
                )
                lines.append(f"fused, for one {owner}: {names} ({segment.n_operations} operations)")
    unfused_names = [stage.name for program in plan.programs for stage in program.unfused_stages]
    if unfused_names and measure:
        lines.append(_measure_split_cost(step, data, unfused_names))
    if plan.engine == "fused":
        location = plan.location.platform, plan.location.devices
        lines += dict.fromkeys(line for program in plan.programs for line in fused.describe(program, *location))
        call_text = "sim.step calls it without XLA" if plan.host_call is not None else "sim.step is one compiled call"
        lines[-1] += f"; {call_text}, and reads make only the fields that are read"
        lines += dict.fromkeys(line for program in step.programs for line in fused.describe_derivatives(program))
    return "\n".join(lines)


def _measure_split_cost(step: Step, data: Record, unfused_names: list[str]) -> str:
    def measure_seconds(step: Step, n: int = 64) -> float:
        jax.block_until_ready(step(data, jnp.int32(n)))  # compiles
        start_time = time.perf_counter()
        jax.block_until_ready(step(data, jnp.int32(n)))
        return (time.perf_counter() - start_time) / n

    split_seconds, unsplit_seconds = measure_seconds(step), measure_seconds(step.without_stages(unfused_names))
    return (
        f"cost of the split, measured: a step takes {1e6 * split_seconds:.0f} us, and {1e6 * unsplit_seconds:.0f} us "
        f"without {', '.join(unfused_names)}"
    )
