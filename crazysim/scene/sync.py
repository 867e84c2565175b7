"""Copy the drones' poses into the scene: for every world at once with MJX, or for one world to be drawn."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.core.data import SimData
from crazysim.scene import mjx

COM_CAMERAS = (mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM)
"""Cameras that follow a centre of mass, which nothing else needs."""


@jax.jit
def sync_sim2mjx(data: SimData, mjx_data: mjx.Data, mjx_model: mjx.Model) -> tuple[SimData, mjx.Data]:
    """Return the data with its flag set, and the scene as the data has it.

    Writes the poses of drones and of objects with handles, and computes the transforms of all bodies, the cameras and
    lights, and the contacts. Other mocap bodies stay where ``mjx_data`` has them.

    Args:
        data: The simulation. Quaternions are xyzw here and wxyz in MuJoCo.
        mjx_data: The scene of every world.
        mjx_model: The model, shared by all worlds.
    """
    for ids, pos, quat in _poses(data):
        mjx_data = mjx_data.replace(
            mocap_pos=mjx_data.mocap_pos.at[:, ids].set(pos),
            mocap_quat=mjx_data.mocap_quat.at[:, ids].set(jnp.roll(quat, 1, axis=-1)),
        )

    def of_world(world: mjx.Data) -> mjx.Data:
        world = mjx.kinematics(_carry_children(mjx_model, world), world)
        if np.isin(mjx_model.cam_mode, COM_CAMERAS).any():
            world = mjx.com_pos(mjx_model, world)
        world = mjx.camlight(mjx_model, world)
        return mjx.collision(mjx_model, world)

    mjx_data = jax.vmap(of_world)(mjx_data)
    return data.replace(core=data.core.replace(mjx_synced=jnp.asarray(True))), mjx_data


def _poses(data: SimData) -> list[tuple[Any, Any, Any]]:
    """Return mocap ids, positions and attitudes of what the simulation owns: drones, and objects with handles."""
    owned = [(data.core.drone_mocap_ids, data.states.pos, data.states.quat)]
    if data.objects is not None:
        owned.append((data.objects.mocap_ids, data.objects.pos[:, 0], data.objects.quat[:, 0]))
    return owned


def _carry_children(mjx_model: mjx.Model, world: mjx.Data) -> mjx.Model:
    """Return a model whose mocap bodies stand where this world has them, if some carry bodies of their own.

    MJX 3.17 places mocap bodies after it has gone down the tree, and leaves their children where the model has them.
    """
    mocap = np.flatnonzero(mjx_model.body_mocapid >= 0)
    if not np.isin(mjx_model.body_parentid, mocap).any():
        return mjx_model
    norm = jnp.linalg.norm(world.mocap_quat, axis=-1, keepdims=True)
    return mjx_model.replace(
        body_pos=mjx_model.body_pos.at[mocap].set(world.mocap_pos),
        body_quat=mjx_model.body_quat.at[mocap].set(world.mocap_quat / norm),
    )


def poses_of(
    data: SimData, mjx_data: mjx.Data | None, worlds: NDArray, mj_model: mujoco.MjModel
) -> tuple[Array, Array, Array]:
    """Return where everything of some worlds is, for who computes the rest himself.

    Args:
        data: The simulation.
        mjx_data: The scene of every world, if there is one yet: it knows where the user moved other bodies.
        worlds: Which worlds. (n,)
        mj_model: The model.

    Returns:
        Positions of mocap bodies, m (n, n_mocap, 3), attitudes, wxyz (n, n_mocap, 4), positions of joints (n, n_qpos).
    """
    if mjx_data is not None:
        mocap_pos, mocap_quat, qpos = mjx_data.mocap_pos[worlds], mjx_data.mocap_quat[worlds], mjx_data.qpos[worlds]
    else:
        rest, n = mujoco.MjData(mj_model), len(worlds)
        mocap_pos, mocap_quat, qpos = (
            jnp.asarray(np.broadcast_to(x, (n, *x.shape)), jnp.float32)
            for x in (rest.mocap_pos, rest.mocap_quat, mj_model.qpos0)
        )
    for ids, pos, quat in _poses(data):
        mocap_pos = mocap_pos.at[:, ids].set(pos[worlds])
        mocap_quat = mocap_quat.at[:, ids].set(jnp.roll(quat[worlds], 1, axis=-1))
    return mocap_pos, mocap_quat, qpos


def sync_one_world(
    data: SimData, mjx_data: mjx.Data | None, world: int, mj_model: mujoco.MjModel, mj_data: mujoco.MjData
) -> None:
    """Write one world into ``mj_data``, ready to be drawn; nothing is allocated or computed for the others.

    Args:
        data: The simulation.
        mjx_data: The scene of every world, if there is one yet: it knows where the user moved other bodies.
        world: Which world.
        mj_model: The model.
        mj_data: Where it is written to.
    """
    if mjx_data is not None:
        mj_data.mocap_pos[:] = mjx_data.mocap_pos[world]
        mj_data.mocap_quat[:] = mjx_data.mocap_quat[world]
        mj_data.qpos[:] = mjx_data.qpos[world]
    for ids, pos, quat in _poses(data):
        mj_data.mocap_pos[np.asarray(ids)] = pos[world]
        mj_data.mocap_quat[np.asarray(ids)] = np.roll(quat[world], 1, axis=-1)
    mujoco.mj_kinematics(mj_model, mj_data)
    mujoco.mj_comPos(mj_model, mj_data)
    mujoco.mj_camlight(mj_model, mj_data)
