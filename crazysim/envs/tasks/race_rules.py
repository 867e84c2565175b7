"""Rules of the race: gates and obstacles of a course, progress of each drone, and rewards of progress.

All functions take the data of one world or, without the axis of drones, of one drone.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.envs import terms
from crazysim.envs.task import TASK_RECORD_NAME
from crazysim.envs.tasks.goals import pick_entry
from crazysim.envs.tracks import OPENING

POLE_HEIGHT = 1.7
"""Length of an obstacle, m; if its upper end is lower than this length, its lower part is below the floor."""
BYPASS_DISTANCE = 0.45
"""Distance from the middle of a gate at which the way around the frame passes it, m."""
FUNNEL_RADIUS = 0.15
"""Radius, in the gate's plane, of a funnel in front of the gate, m. The radius grows by 1 m per metre of distance from
the plane. Positions in the funnel have a straight way to the gate."""

PENALTY_COST = 10.0
"""Reward that a penalty of 1 s costs: that of 5 m of progress."""


def race_of(data: SimData) -> Any:
    """Return the states of the race; see ``Race``."""
    return data.plugins[TASK_RECORD_NAME]


def gates_of(data: SimData) -> tuple[Array, Array]:
    """Return positions, m (..., n_gates, 3), and attitudes, xyzw (..., n_gates, 4), of the gates."""
    rows = race_of(data).gates.rows
    gate_rows = slice(rows[0], rows[-1] + 1)
    return data.objects.pos[..., gate_rows, :], data.objects.quat[..., gate_rows, :]  # type: ignore[union-attr]


def obstacles_of(data: SimData) -> Array:
    """Return the upper ends of the obstacles, m. (..., n_obstacles, 3)"""
    if race_of(data).obstacles is None:
        return jnp.zeros((*data.states.pos.shape[:-2], 0, 3), data.states.pos.dtype)
    rows = race_of(data).obstacles.rows
    pos = data.objects.pos[..., rows[0] : rows[-1] + 1, :]  # type: ignore[union-attr]
    return pos + np.array([0.0, 0.0, POLE_HEIGHT], pos.dtype)


def next_gate(data: SimData, ahead: int = 0) -> tuple[Array, Array]:
    """Return position, m (..., 3), and attitude, xyzw (..., 4), of the gate of ``gate_index``."""
    pos, quat = gates_of(data)
    index = gate_index(data, ahead)
    return pick_entry(pos, index), pick_entry(quat, index)


def gate_index(data: SimData, ahead: int = 0) -> Array:
    """Return the index of the gate that is some gates after each drone's next gate, or of the last gate. (...)"""
    record, n = race_of(data), len(race_of(data).gates)
    index = jnp.minimum(record.passed + ahead, record.n_laps * n - 1)
    return index if record.n_laps == 1 else index % n


def passes_gate(data: SimData, ahead: int = 0) -> Array:
    """Whether the last physics step led forwards through the opening of the gate of ``gate_index``. (...)"""
    record = race_of(data)
    pos, quat = next_gate(data, ahead)
    pos_before, pos_now = (rotation.rotate_inverse(quat, x - pos) for x in (record.last_pos, data.states.pos))
    if record.openings is not None:
        return record.openings.crosses(gate_index(data, ahead), pos_before, pos_now)[0] & ~record.success
    crossed = (pos_before[..., 0] < 0) & (pos_now[..., 0] >= 0)
    fraction = pos_before[..., :1] / jnp.where(crossed[..., None], pos_before[..., :1] - pos_now[..., :1], 1)
    crossing = pos_before + fraction * (pos_now - pos_before)
    return crossed & jnp.all(jnp.abs(crossing[..., 1:]) < OPENING / 2, axis=-1) & ~record.success


def next_gate_distance(data: SimData) -> Array:
    """Return the distance to the middle of the next gate, m; zero where all gates are passed. (n_drones,)"""
    pos, _ = next_gate(data)
    return jnp.where(race_of(data).success, 0, rotation.safe_norm(data.states.pos - pos)[..., 0])


def remaining_way(data: SimData) -> Array:
    """Return the length of the way through the middles of all gates that are not passed, m. (n_drones,)"""
    record = race_of(data)
    pos, quat = gates_of(data)
    n, openings = pos.shape[-2], record.openings
    sizes = None
    if openings is not None:
        size = np.max(openings.sizes, axis=-1, keepdims=True)
        sizes = np.where(np.array(openings.radii) > 0, 0, size).astype(pos.dtype)
    next_size = None if sizes is None else pick_entry(sizes, gate_index(data))
    next_pos, next_quat = next_gate(data)
    way_to_next = way_to_gate(rotation.rotate_inverse(next_quat, data.states.pos - next_pos), next_size)
    # The leg to each gate, and how often it is flown after the next gate.
    first = 1 if record.n_laps == 1 else 0
    before = pos[..., :-1, :] if first else jnp.roll(pos, 1, axis=-2)
    offsets = rotation.rotate_inverse(quat[..., first:, :], before - pos[..., first:, :])
    legs = way_to_gate(offsets, None if sizes is None else sizes[first:])
    index = np.arange(first, n, dtype=np.int32)
    if first:
        is_ahead = index > record.passed[..., None]
        rest = jnp.sum(jnp.where(is_ahead, legs, 0), axis=-1)
    else:
        flights = record.n_laps - 1 - (record.passed[..., None] - index) // n
        rest = jnp.sum(flights * legs, axis=-1)
    return jnp.where(record.success, 0, way_to_next + rest)


def way_to_gate(pos: Array, size: Array | np.ndarray | None = None) -> Array:
    """Return the length of the way to a gate's middle that avoids the frame, m. (...)

    In front of the gate it is longer than the straight line for positions outside of the funnel (``FUNNEL_RADIUS``).
    Behind the gate it leads around the frame.

    Args:
        pos: Position in the gate's frame, m. (..., 3)
        size: Larger side of the opening, m, by which the distances are scaled, or 0 for a waypoint without a frame;
            None for 0.45 m. (..., 1)
    """
    scale: Any = 1.0 if size is None else size / OPENING
    bypass = BYPASS_DISTANCE * np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1]], pos.dtype)
    if size is not None:
        bypass = scale[..., None] * bypass
        scale = scale[..., 0]
    bypass_distance = rotation.safe_norm(pos[..., None, :] - bypass)[..., 0]
    axis_distance = rotation.safe_norm(pos[..., 1:])[..., 0]
    distance = rotation.safe_norm(pos)[..., 0]
    detour = jnp.maximum(axis_distance - (scale * FUNNEL_RADIUS - pos[..., 0]), 0)
    way_around = scale * (2 * BYPASS_DISTANCE - FUNNEL_RADIUS) + jnp.min(bypass_distance, axis=-1)
    way = jnp.where(pos[..., 0] > 0, way_around, distance + detour)
    return way if size is None else jnp.where(scale > 0, way, distance)


def dense(data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
    """Return rewards of progress and of gates, and costs of turning, changing actions, penalties and being disabled."""
    record = race_of(data)
    reward_terms = {
        "progress": 2.0 * (record.remaining_way_before - remaining_way(data)),
        "gates": 2.0 * (record.passed - record.passed_before),
        "spin": -0.001 * terms.spin(data),
        "action_rate": -0.01 * terms.action_rate(action, last_action),
        "disabled": -2.0 * record.failure,
    }
    if record.penalty_sum is not None:
        reward_terms["penalty"] = PENALTY_COST * (record.penalty_before - record.penalty_sum)
    return terms.only_where(~record.flight_over_before, reward_terms)


def sparse(data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
    """Return a reward of 1 for each gate passed in the step, and of -1 when the drone is disabled."""
    del action, last_action
    record, dtype = race_of(data), data.states.pos.dtype
    gates, disabled = (record.passed - record.passed_before).astype(dtype), record.failure.astype(dtype)
    return terms.only_where(~record.flight_over_before, {"gates": gates, "disabled": -disabled})
