"""Starts of episodes with drones that are already flying."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.envs.actions import hover_rotor_states


def flying(
    data: SimData, pos: ArrayLike, quat: Array | None = None, vel: ArrayLike = 0.0, ang_vel: ArrayLike = 0.0
) -> SimData:
    """Return the data with drones in the air and rotors at hover speed.

    Args:
        data: Data of one world, or of all worlds.
        pos: Positions, world frame, m. (..., n_drones, 3)
        quat: Attitudes, xyzw; None for level. (..., n_drones, 4)
        vel: Velocities, world frame, m/s; broadcasts to the shape of the positions.
        ang_vel: Angular velocities, body frame, rad/s; broadcasts to the shape of the positions.
    """
    states, controls = data.states, data.controls
    level_quat = jnp.array([0.0, 0.0, 0.0, 1.0], states.quat.dtype)
    ang_vel = jnp.broadcast_to(ang_vel, states.ang_vel.shape)
    states = states.replace(
        pos=jnp.broadcast_to(pos, states.pos.shape),
        quat=jnp.broadcast_to(level_quat if quat is None else quat, states.quat.shape),
        vel=jnp.broadcast_to(vel, states.vel.shape),
        ang_vel=ang_vel,
        rotor_vel=jnp.broadcast_to(hover_rotor_states(data.params), states.rotor_vel.shape),
    )
    # Without this, the derivative terms of the controllers would react to a jump from zero at their first tick.
    for command_level in ("attitude", "body_rate"):
        ctrl = getattr(controls, command_level)
        if ctrl is not None and ctrl.prev_ang_vel is not None:
            memory = ctrl.controller.memory.replace(prev_ang_vel=ang_vel)
            controller = ctrl.controller.replace(memory=memory)
            controls = controls.replace(**{command_level: ctrl.replace(controller=controller)})
    return data.replace(states=states, controls=controls)


def random_attitude(x: Array) -> Array:
    """Return attitudes distributed uniformly over all rotations, xyzw (Shoemake 1992). (..., 4)

    Args:
        x: Random numbers in [0, 1). (..., 3)
    """
    a, b, c = x[..., 0], 2 * jnp.pi * x[..., 1], 2 * jnp.pi * x[..., 2]
    r1, r2 = jnp.sqrt(1 - a), jnp.sqrt(a)
    return jnp.stack([r1 * jnp.sin(b), r1 * jnp.cos(b), r2 * jnp.sin(c), r2 * jnp.cos(c)], axis=-1)
