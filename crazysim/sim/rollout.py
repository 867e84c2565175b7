"""Rollouts: policy, commands and physics of many control steps in one compiled call."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from crazysim.arguments import check_array, require_memory, tree_bytes
from crazysim.core import functional as F
from crazysim.core.data import SimData
from crazysim.core.settings import positive_integer
from crazysim.engine.host_call import HostLeaves
from crazysim.engine.pytree import leaf_indices
from crazysim.engine.step import FlatData, Step, scan
from crazysim.errors import require
from crazysim.progress import progress_bar

Policy = Callable[[Any, SimData], Any]
"""Function from parameters and data to a command for every drone, (n_worlds, n_drones, k)."""
KeepFunction = Callable[[SimData], Any]
"""Function from data to any tree of arrays to record."""


def get_states(data: SimData) -> Any:
    """Return the states, which a rollout records by default."""
    return data.states


def stage_flat(flat: FlatData, reference: SimData, command: Any, feedforward: Any = None) -> FlatData:
    """Return flat data with a checked command, as ``crazysim.core.functional.stage_command`` does.

    Args:
        reference: Data of the simulation, or its shapes and devices.
        command: Command, which must not be changed afterwards. (n_worlds, n_drones, k)
        feedforward: Feedforward of a setpoint; None for the default of ``stage_command``.
    """
    leaf_indices, is_on_host = flat.plan.leaf_indices, isinstance(flat.leaves, HostLeaves)
    indices, values = F.staged_leaves(leaf_indices), F.staged_fields(leaf_indices, command, feedforward)
    return flat.replace(indices, [x if is_on_host else F.put_command(reference, x) for x in values.values()])


def rollout(
    step: Step,
    data: SimData,
    policy: Policy,
    params: Any,
    n_control_steps: int,
    n_substeps: int,
    keep: KeepFunction = get_states,
    every: int = 1,
    wait: bool = False,
) -> tuple[SimData, Any]:
    """Fly some control steps; return the data after them, and the arrays that were recorded after these steps.

    A control step evaluates the policy, stages its command, and takes ``n_substeps`` physics steps. The function is
    pure and can be used inside jit, vmap and grad. Leaves that no step writes, mainly parameters, are constants of the
    loop.

    Args:
        step: From ``sim.build_step_fn()``.
        data: The simulation at the start.
        policy: ``policy(params, data) -> command``, for all worlds at once.
        params: Parameters of the policy.
        n_control_steps: Number of control steps; a multiple of ``every``.
        n_substeps: Physics steps of a control step.
        keep: ``keep(data)`` returns the arrays to record after a control step.
        every: Number of control steps from one recording to the next.
        wait: Whether to step to the next multiple of ``n_substeps`` first, if it is equally far in all worlds.

    Returns:
        The data, and the recorded arrays with a leading time axis. (n_control_steps // every, ...)
    """
    n_control_steps = positive_integer("n_control_steps", n_control_steps)
    n_substeps, every = positive_integer("n_substeps", n_substeps), positive_integer("every", every)
    require(
        n_control_steps % every == 0,
        f"every={every} does not divide n_control_steps={n_control_steps}; choose a multiple of it",
    )
    require_memory_of_records(step, n_control_steps // every, jax.eval_shape(keep, data))
    staged = F.staged_leaves(leaf_indices(data))
    flat = step.flatten(data, n_substeps, frozenset(staged) if step.platform == "gpu" else None)
    if wait and n_substeps > 1:
        n_waits = -data.core.steps % n_substeps
        n_waits = jnp.where(jnp.all(n_waits == n_waits[0]), n_waits[0, 0], 0)
        flat = jax.lax.cond(n_waits > 0, lambda flat: step.advance(flat, n_waits), lambda flat: flat, flat)

    def control_step(flat: FlatData, *_: Any) -> tuple[FlatData, Any, Any]:
        command = F.check_command(data, data.controls.mode, policy(params, flat.data()))
        return step.advance(stage_flat(flat, data, command), n_substeps), (), None

    def advance_and_record(flat: FlatData, *_: Any) -> tuple[FlatData, Any, Any]:
        flat, _, _ = scan(control_step, flat, length=every, also_changed=staged)
        return flat, (), keep(flat.data())

    flat, _, recordings = scan(advance_and_record, flat, length=n_control_steps // every, also_changed=staged)
    return flat.data(), recordings


def require_memory_of_records(step: Step, n_records: int, record: Any) -> None:
    """Check that a number of records, given one or its shapes, fits into the memory of a step's devices."""
    devices = step.location.devices or jax.devices(step.platform)[:1]
    n_bytes, remedy = n_records * tree_bytes(record), "Keep less, or use several rollouts."
    require_memory("the records of all steps", n_bytes, remedy, devices[0], len(devices))


STATIC_ARGUMENTS = ("step", "policy", "n_control_steps", "n_substeps", "keep", "every", "wait")


@functools.partial(jax.jit, static_argnames=STATIC_ARGUMENTS)
@functools.wraps(rollout)
def compiled_rollout(step: Step, *args: Any, **settings: Any) -> tuple[SimData, Any]:
    """Return the results of ``rollout`` in one compiled call, which does not donate the buffers of its arguments."""
    return rollout(step, *args, **settings)


def run_rollout(
    step: Step,
    data: SimData,
    policy: Policy,
    params: Any,
    n_control_steps: int,
    progress: bool = False,
    every: int = 1,
    **settings: Any,
) -> tuple[SimData, Any]:
    """Return the results of ``rollout``, compiled; with ``progress``, run it in pieces and show a progress bar.

    The caller's buffers are not donated. ``settings`` are the other arguments of ``rollout``.
    """
    for leaf in jax.tree.leaves(params):
        check_array("every leaf of params", leaf)
    step = step.with_zeros_of(data)
    if not progress:
        return compiled_rollout(step, data, policy, params, n_control_steps, every=every, **settings)
    steps_per_piece = max(n_control_steps // every // 100, 1) * every
    n_pieces, remainder = divmod(n_control_steps, steps_per_piece)
    recordings_by_piece = []
    with progress_bar(unit="control steps", required=True, total=n_control_steps) as bar:
        for n in [steps_per_piece] * n_pieces + [remainder] * (remainder > 0):
            data, recordings = compiled_rollout(step, data, policy, params, n, every=every, **settings)
            jax.block_until_ready(recordings)
            recordings_by_piece.append(recordings)
            bar.update(n)
    return data, jax.tree.map(lambda *parts: jnp.concatenate(parts), *recordings_by_piece)
