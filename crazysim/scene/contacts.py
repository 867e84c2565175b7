"""Contact slots of a synced scene. The only module that reads MJX's private contact record."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.errors import UnknownNameError
from crazysim.scene import mjx


def contact_flags(mjx_data: mjx.Data) -> Array:
    """Return True for every contact slot whose two geoms touch. (n_worlds, n_slots)"""
    return mjx_data._impl.contact.dist < 0


def body_contact_flags(mjx_data: mjx.Data, mj_model: mujoco.MjModel, body: str) -> Array:
    """Return True for every contact slot whose two geoms touch and one of which is part of a body. (n_worlds, n_slots)

    Raises:
        UnknownNameError: If the scene has no such body.
    """
    geoms = jnp.asarray(np.flatnonzero(mj_model.geom_bodyid == body_id(mj_model, body)))
    contact = mjx_data._impl.contact
    geom = jnp.stack([contact.geom1, contact.geom2], axis=-1)
    return (contact.dist < 0) & jnp.any(geom[..., None] == geoms, axis=(-1, -2))


def body_id(mj_model: mujoco.MjModel, body: str) -> int:
    """Return the id of a body.

    Raises:
        UnknownNameError: If the scene has no such body.
    """
    found = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, body) if isinstance(body, str) else -1
    if found < 0:
        names = [name for name in (mj_model.body(i).name for i in range(mj_model.nbody)) if not name.startswith("_")]
        listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise UnknownNameError(f"expected a body of the scene, {listed}, got {body!r}")
    return found
