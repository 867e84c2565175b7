"""What hand-written policies of these tasks share."""

import jax.numpy as jnp


def fly_to(way, vel, lean=0.5, gain=0.7, damping=0.45):
    """Return the action, at the command level attitude, that leans along a vector to a point and brakes.

    Args:
        way: Vector to the point, m. (..., 3)
        vel: Velocity relative to the point, m/s. (..., 3)
        lean: Largest action.
        gain: Action per distance, 1/m.
        damping: Action per velocity, s/m.
    """
    x, y, z = jnp.moveaxis(jnp.clip(gain * way - damping * vel, -lean, lean), -1, 0)
    return jnp.stack([-y, x, 0 * x, z], axis=-1)
