"""Contact slots of a synced scene: the rows of MJX's contact arrays. Only this module reads these private arrays."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
from jax import Array

from crazysim.eager import jit_eager_calls
from crazysim.errors import UnknownNameError
from crazysim.scene import mjx


def contact_flags(mjx_data: mjx.Data) -> Array:
    """Return True for every contact slot whose two geoms touch. (n_worlds, n_slots)"""
    return mjx_data._impl.contact.dist < 0


def body_contact_flags(mjx_data: mjx.Data, mj_model: mujoco.MjModel, body: str) -> Array:
    """Return True for every contact slot in which a geom of a body touches another geom. (n_worlds, n_slots)"""
    belongs_to_body = mj_model.geom_bodyid == body_id(mj_model, body)
    contact = mjx_data._impl.contact
    return _slot_flags(contact.dist, contact.geom1, contact.geom2, belongs_to_body)


@jit_eager_calls()
def _slot_flags(dist: Array, geom1: Array, geom2: Array, belongs_to_body: Array) -> Array:
    belongs_to_body = jnp.asarray(belongs_to_body)
    return (dist < 0) & ((geom1 >= 0) & belongs_to_body[geom1] | (geom2 >= 0) & belongs_to_body[geom2])


def body_id(mj_model: mujoco.MjModel, body: str) -> int:
    """Return the id of a body."""
    index = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, body) if isinstance(body, str) else -1
    if index < 0:
        names = [name for name in (mj_model.body(i).name for i in range(mj_model.nbody)) if not name.startswith("_")]
        listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise UnknownNameError(f"expected a body of the scene, {listed}, got {body!r}")
    return index
