"""Poses of all bodies, geoms and sites of a scene whose bodies are fixed to the world or to mocap bodies."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.scene import mjx

N_DUMMY_JOINTS = 1
"""Number of joints that ``build_spec`` adds, with a body without geoms, because MJX requires a joint."""


def update_kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Return MJX data with the world poses of bodies, inertial frames, geoms and sites.

    It equals ``mjx.kinematics`` for a scene that defines no joints, with three differences. It takes a quarter of the
    time to trace and compile. Children of a mocap body follow its pose in each world; MJX 3.17 places them by the pose
    in the model. ``xanchor`` and ``xaxis`` of the dummy joint are left as they are.

    Args:
        data: MJX data of every world. (n_worlds, ...)
    """
    batch_shape = data.mocap_pos.shape[:1]
    pos = jnp.broadcast_to(model.body_pos, batch_shape + model.body_pos.shape)
    quat = jnp.broadcast_to(_to_xyzw(model.body_quat), batch_shape + model.body_quat.shape)
    mocap = np.flatnonzero(model.body_mocapid >= 0)
    if len(mocap):
        ids = model.body_mocapid[mocap]
        mocap_quat = _to_xyzw(data.mocap_quat[:, ids])
        pos = pos.at[:, mocap].set(data.mocap_pos[:, ids])
        quat = quat.at[:, mocap].set(mocap_quat / jnp.linalg.norm(mocap_quat, axis=-1, keepdims=True))
    for bodies in _generations(np.asarray(model.body_parentid)):
        parents = model.body_parentid[bodies]
        pos = pos.at[:, bodies].set(rotation.rotate(quat[:, parents], pos[:, bodies], pos[:, parents]))
        quat = quat.at[:, bodies].set(rotation.multiply(quat[:, parents], quat[:, bodies]))

    rot = rotation.matrix(quat)
    body_of_row = np.concatenate([np.arange(model.nbody), model.geom_bodyid, model.site_bodyid])
    offsets = jnp.concatenate([model.body_ipos, model.geom_pos, model.site_pos])
    local_quats = _to_xyzw(jnp.concatenate([model.body_iquat, model.geom_quat, model.site_quat]))
    ends = np.cumsum([model.nbody, model.ngeom])
    positions = jnp.split(rotation.matvec(rot[:, body_of_row], offsets, pos[:, body_of_row]), ends, axis=1)
    frames = jnp.split(rotation.matrix(rotation.multiply(quat[:, body_of_row], local_quats)), ends, axis=1)
    data = data.replace(xpos=pos, xquat=jnp.roll(quat, 1, axis=-1), xmat=rot, xipos=positions[0], ximat=frames[0])
    return data.replace(geom_xpos=positions[1], geom_xmat=frames[1], site_xpos=positions[2], site_xmat=frames[2])


def _to_xyzw(quat: Array) -> Array:
    return jnp.roll(quat, -1, axis=-1)


def _generations(parents: NDArray) -> list[NDArray]:
    depth = np.zeros(len(parents), int)
    for body in range(1, len(parents)):  # a parent comes before its children
        depth[body] = depth[parents[body]] + 1
    return [np.flatnonzero(depth == k) for k in range(2, depth.max() + 1)]
