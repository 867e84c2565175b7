"""The policy for any quadrotor as a controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.control.levels import Control
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import AirframeParams
from crazysim.engine.pytree import PyTree, leaf
from crazysim.lab.export.rl_tools import (
    MAX_DIFFERENCE,
    MAX_VELOCITY,
    N_ACTIONS,
    N_MEMORY,
    RAPTOR_RATE,
    RAPTOR_ROTORS,
    RAPTOR_YAW_TORQUE_SIGNS,
    evaluate_step,
    shipped_weights,
)

LEAST_THRUST = 1e-6
"""Least thrust over the largest, at which the speed still has a derivative."""


def state_from_goal(pos: Array, quat: Array, vel: Array, goal: Array, goal_vel: Array, yaw: Array) -> dict[str, Array]:
    """Position, attitude and velocity in the frame of a goal, limited as PX4 does, by the names of the task ``any``.

    Args:
        pos: Position, world frame, m. (..., 3)
        quat: Attitude, body to world, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        goal: Position of the goal, world frame, m. (..., 3)
        goal_vel: Velocity of the goal, world frame, m/s. (..., 3)
        yaw: Yaw of the goal, rad. (..., 1)
    """
    frame = rotation.from_rpy(jnp.concatenate([0 * yaw, 0 * yaw, yaw], axis=-1))
    difference, relative_vel = (rotation.rotate_inverse(frame, x) for x in (pos - goal, vel - goal_vel))
    matrix = rotation.matrix(rotation.multiply(rotation.conjugate(frame), quat))
    return {
        "pos_from_goal": rotation.clip(difference, -MAX_DIFFERENCE, MAX_DIFFERENCE),
        "attitude_from_goal": matrix.reshape(*matrix.shape[:-2], 9),
        "vel_from_goal": rotation.clip(relative_vel, -MAX_VELOCITY, MAX_VELOCITY),
    }


class AnyAirframeMemory(PyTree):
    """What the policy remembers of a drone."""

    network: Array = leaf("drone", 1, (N_MEMORY,))
    """Memory of the network. (n_worlds, n_drones, 16)"""
    action: Array = leaf("drone", 1, (N_ACTIONS,))
    """Last action. (n_worlds, n_drones, 4)"""


def rotor_shares(airframe: Airframe) -> np.ndarray:
    """Shares of the thrust of each rotor in that of the policy's four. (n_rotors, 4)

    The rotors exert the wrench of four at the corners of the frame: four rotors at corners have one of them each,
    others the least squares of the thrusts.
    """
    corners, pos = np.array(RAPTOR_ROTORS), np.asarray(airframe.value("rotors.position"))[:, :2]
    arms = np.sqrt(np.mean(np.square(pos), axis=0))
    signs = [airframe.value("rotors.yaw_torque_sign"), np.array(RAPTOR_YAW_TORQUE_SIGNS)]
    wrenches = [np.vstack([np.ones(len(x)), *x.T, sign]) for x, sign in zip((pos, corners * arms), signs, strict=True)]
    return np.linalg.pinv(wrenches[0]) @ wrenches[1] * (len(pos) / 4)


class AnyAirframeParams(AirframeParams):
    """What the policy is told of an airframe; it finds out everything else in flight."""

    shares: Array = leaf("parameter", 2, airframe=rotor_shares)
    """See ``rotor_shares``. (n_rotors, 4)"""
    max_rotor_vel: Array = leaf("parameter", 1, (1,), airframe=lambda airframe: np.max(airframe.rotor_vel_limits[1]))
    """Largest rotor speed, rpm. (1,)"""


class AnyAirframe(Controller, params=AnyAirframeParams, memory=AnyAirframeMemory):
    """A trained policy that flies multirotors it has not seen, from 20 g to 8 kg, with delayed commands.

    It knows the places and the largest speed of the rotors, and no mass, inertia, thrust or lag: choose it for
    airframes whose numbers are unknown or change, and to try in simulation what ``crazysim export any`` writes for
    flight controllers. It was trained with four rotors at the corners; others exert the wrench of these. Position
    errors beyond 0.5 m and velocity errors beyond 1 m/s along an axis are limited, so that a fast setpoint runs away
    from it.
    """

    name = "any"
    levels = (Control.state,)
    output = Control.rotor_vel
    follows_feedforward: ClassVar[bool] = False
    freq: int = RAPTOR_RATE
    weights: Mapping[str, np.ndarray] = field(default_factory=shipped_weights, repr=False)
    """Weights of another policy of RAPTOR's shape, from ``crazysim.train.export.read_rl_tools`` or
    ``raptor_weights``."""

    def update(
        self, data: DroneData, command: Setpoint, memory: AnyAirframeMemory, params: AnyAirframeParams
    ) -> tuple[Array, AnyAirframeMemory]:
        s = data.states
        parts = state_from_goal(s.pos, s.quat, s.vel, command.pos, command.vel, command.yaw)
        observation = jnp.concatenate([*parts.values(), s.ang_vel, memory.action])
        outputs, network = evaluate_step(self.weights, observation[None], memory.network[None])
        action = rotation.clip(outputs[0], -1.0, 1.0)
        # Thrust is about proportional to the square of the speed; the policy corrects for the rest.
        thrusts = rotation.clip(params.shares @ jnp.square((action + 1) / 2), LEAST_THRUST, 1.0)
        return params.max_rotor_vel * jnp.sqrt(thrusts), AnyAirframeMemory(network[0], action)
