"""Samples of a simulation at equal intervals, in one compiled call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from crazysim.core.data import SimData
from crazysim.core.stage import with_leaves
from crazysim.engine import fused
from crazysim.engine.rollout import Keep
from crazysim.engine.step import Step

Sampler = Callable[[SimData], tuple[SimData, Any]]
"""Data to the data after all samples, and the samples with time in front. (n_samples, ...)"""


def compile_sampler(step: Step, data: SimData, keep: Keep, n_samples: int, n_steps: int) -> Sampler:
    """Return a compiled function that steps, and takes a sample after every ``n_steps`` steps.

    Where one kernel runs the step, that kernel also writes the samples: the numbers of a drone stay in registers from
    the first step to the last. Otherwise a loop calls the step. The function has no derivatives; ``rollout`` has.

    Args:
        step: From ``sim.build_step_fn()``, or ``sim.step_fn``.
        data: The simulation, for its structure and for the elements of its shared parameters that are zero.
        keep: ``keep(data)`` returns what to sample, any tree of arrays. A kernel can sample fields of the data that
            every drone or world has and a step changes.
        n_samples: Number of samples.
        n_steps: Steps from one sample to the next.

    Raises:
        UnsupportedError: If an operation or type has no source.
        KernelError: If the compiler refuses the kernel or takes too long.
    """
    take = _by_kernel(step, data, keep, n_samples, n_steps) or _by_loop(step, data, keep, n_samples, n_steps)
    return jax.jit(take).lower(data).compile()


def _by_loop(step: Step, data: SimData, keep: Keep, n_samples: int, n_steps: int) -> Sampler:
    zeros = step.zeros(data)

    def sample(data: SimData, _: None) -> tuple[SimData, Any]:
        data = step(data, n_steps, zeros)
        return data, keep(data)

    return lambda data: jax.lax.scan(sample, data, length=n_samples)


def _by_kernel(step: Step, data: SimData, keep: Keep, n_samples: int, n_steps: int) -> Sampler | None:
    """Return a sampler that is one kernel; None where there is none for this step or these samples."""
    plan, zeros = step.plan(data), step.zeros(data)
    if plan.engine != "fused" or len(plan.programs) != 1 or plan.location.mesh is not None:
        return None
    program, location = plan.programs[0], plan.location
    if program.views or not program.fused:
        return None
    numbers = {id(x): i for i, x in enumerate(jax.tree.leaves(data))}
    kept, tree = jax.tree.flatten(keep(data))
    places = [numbers.get(id(x), -1) for x in kept]
    sampled = sorted(set(places))
    if not set(program.written).issuperset(sampled):
        return None
    run = fused.build_sampler(program, location.platform, sampled, location.devices)

    def take(data: SimData) -> tuple[SimData, Any]:
        flat = step.flatten(data, zeros)
        packed = [] if flat.packed is None else [len(program.leaves) - 1]
        values = with_leaves([None] * len(program.leaves), [*plan.read, *packed], flat.inputs())
        written, flagged, samples = run(values, n_steps, n_samples)
        leaves = with_leaves(flat.leaves, plan.written, [*written, flagged])
        leaves[plan.synced] = jnp.asarray(False)
        of = dict(zip(sampled, samples, strict=True))
        return flat.treedef.unflatten(leaves), tree.unflatten([of[i] for i in places])

    return take
