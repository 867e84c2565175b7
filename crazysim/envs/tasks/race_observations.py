"""Observations of the race, with true poses of gates and obstacles that the drone has been near, else nominal poses.

All functions take the data of one world.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.envs.tasks.goals import flight_over, nearest_drones, nearest_entries, pick_entry
from crazysim.envs.tasks.race_rules import OPENING, gate_index, gates_of, obstacles_of, race_of

CORNERS = OPENING / 2 * np.array([[0, 1, 1], [0, 1, -1], [0, -1, -1], [0, -1, 1]])
"""Corners of a gate's opening in the gate's frame, m. (4, 3)"""


def visited_objects(data: SimData, sensor_range: float) -> tuple[Array, Array]:
    """Return masks of the gates and of the obstacles that each drone is or has been near. (n_drones, n) each"""
    record = race_of(data)

    def is_near(pos: Array) -> Array:
        offset = (pos - data.states.pos[..., None, :])[..., :2]
        return jnp.sum(offset * offset, axis=-1) < sensor_range**2

    return record.gates_visited | is_near(gates_of(data)[0]), record.obstacles_visited | is_near(obstacles_of(data))


def observe(data: SimData, sensor_range: float) -> dict[str, Array]:
    """Return the observations of lsy_drone_racing, and more observations that suit small networks. (n_drones, k) each

    The additional observations, in the body frame unless stated and with observed poses of gates and obstacles, are

    - ``rot``: rotation matrix, body to world (9);
    - ``vel_body``: velocity, m/s (3);
    - ``gate_corners``: vectors to the corners of the next two gates, m (24);
    - ``obstacles_near``: vectors to the axes of the nearest two obstacles, horizontal in the world, m (6);
    - ``drones_near``, with several drones: vectors to the nearest two drones that are still in the race, m (6, or 3
      with two drones).
    """
    record, s, n_drones = race_of(data), data.states, data.core.n_drones
    gates_pos, gates_quat, poles = (
        jnp.broadcast_to(x, (n_drones, *x.shape)) for x in (*gates_of(data), obstacles_of(data))
    )
    # Exact poses of what was in range of the sensor, nominal poses of the rest.
    visited_gates, visited_obstacles = visited_objects(data, sensor_range)
    n_gates, n_obstacles = visited_gates.shape[-1], visited_obstacles.shape[-1]
    nominal_pos, nominal_quat = record.nominal_pos, record.nominal_quat
    if nominal_pos is not None and nominal_quat is not None:
        gates_pos = jnp.where(visited_gates[..., None], gates_pos, nominal_pos[:n_gates])
        gates_quat = jnp.where(visited_gates[..., None], gates_quat, nominal_quat)
        poles = jnp.where(visited_obstacles[..., None], poles, nominal_pos[n_gates:])
    matrix = rotation.matrix(s.quat)

    def to_body_frame(vector: Array) -> Array:
        return rotation.matvec(jnp.swapaxes(matrix, -1, -2)[..., None, :, :], vector)

    # Corners of the next two gates, body frame.
    corners = []
    for k in (0, 1):
        index = gate_index(data, k)
        pos, quat = pick_entry(gates_pos, index)[..., None, :], pick_entry(gates_quat, index)[..., None, :]
        own_corners = jnp.asarray(CORNERS, pos.dtype)
        if record.openings is not None:
            size = pick_entry(np.insert(np.array(record.openings.sizes, pos.dtype), 0, 0, axis=-1), index)
            own_corners = own_corners / OPENING * size[..., None, :]
        gate_corners = pos + rotation.rotate(quat, own_corners)
        corners.append(to_body_frame(gate_corners - s.pos[..., None, :]))
    # Horizontal vectors to the nearest poles.
    to_poles = (poles - s.pos[..., None, :]) * np.array([1, 1, 0], s.pos.dtype)
    square_distance = jnp.sum(to_poles * to_poles, axis=-1)
    obs = {
        "pos": s.pos,
        "quat": s.quat,
        "vel": s.vel,
        "ang_vel": s.ang_vel,
        "target_gate": jnp.where(record.success, -1, gate_index(data))[..., None],
        "gates_pos": gates_pos,
        "gates_quat": gates_quat,
        "gates_visited": visited_gates,
        "rot": matrix,
        "vel_body": to_body_frame(s.vel[..., None, :]),
        "gate_corners": jnp.concatenate(corners, axis=-2),
    }
    if n_obstacles:
        obs |= {
            "obstacles_pos": poles,
            "obstacles_visited": visited_obstacles,
            "obstacles_near": to_body_frame(nearest_entries(square_distance, to_poles, min(2, n_obstacles))),
        }
    if n_drones > 1:
        obs["drones_near"] = to_body_frame(nearest_drones(data, 2, ~flight_over(record))[0])
    return {name: x.reshape(n_drones, -1).astype(s.pos.dtype) for name, x in obs.items()}
