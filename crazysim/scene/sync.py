"""Functions that copy poses from the data to the scene: for all worlds with MJX, or for one world to be drawn."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.core.data import SimData
from crazysim.eager import fetch_rows, jit_eager_calls
from crazysim.scene import mjx
from crazysim.scene.kinematics import N_DUMMY_JOINTS, update_kinematics

COM_CAMERAS = (mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM)
"""Modes of cameras that follow a centre of mass. A sync of all worlds computes centres of mass only for such
cameras."""


HIDDEN_MAP_DEPTH = 1e4
"""Depth at which MuJoCo has the maps that a world does not have, m."""

Poses = tuple[tuple[Any, ...], ...]
"""Mocap ids (n,), positions, world frame, m (n_worlds, n, 3), and attitudes, body to world, xyzw (n_worlds, n, 4), of
all drones, and of all objects with handles, whose poses have a further axis of length 1 after n_worlds. With maps,
their mocap ids (n_maps,), and the index of each world's map (n_worlds, 1)."""


def sync_sim2mjx(data: SimData, mjx_data: mjx.Data, mjx_model: mjx.Model) -> tuple[SimData, mjx.Data]:
    """Sync the MJX data of the scene with the data; return the data with ``core.mjx_synced`` set, and the MJX data."""
    mjx_data = sync_poses(poses_of(data), mjx_data, mjx_model)
    return data.replace(core=data.core.replace(mjx_synced=jnp.asarray(True))), mjx_data


def poses_of(data: SimData) -> Poses:
    """Return the poses of everything in the scene that the data moves."""
    drones, objects = (data.core.drone_mocap_ids, data.states.pos, data.states.quat), data.objects
    if objects is None:
        return (drones,)
    poses = drones, (objects.mocap_ids, objects.pos, objects.quat)
    return poses if objects.map_ids is None else (*poses, (objects.map_ids, objects.map_index))


@jax.jit
def sync_poses(poses: Poses, mjx_data: mjx.Data, mjx_model: mjx.Model) -> mjx.Data:
    """Write poses into the scene, then compute the poses of all bodies, cameras and lights, and the contacts.

    Mocap bodies other than drones and objects with handles (``Handle``) keep their poses in ``mjx_data``.
    """
    for ids, pos, quat in _groups(poses):
        mjx_data = mjx_data.replace(
            mocap_pos=mjx_data.mocap_pos.at[:, ids].set(pos),
            mocap_quat=mjx_data.mocap_quat.at[:, ids].set(jnp.roll(quat, 1, axis=-1)),
        )

    has_joints = mjx_model.njnt > N_DUMMY_JOINTS
    if not has_joints:
        mjx_data = update_kinematics(mjx_model, mjx_data)

    def update_world(world: mjx.Data) -> mjx.Data:
        if has_joints:
            world = mjx.kinematics(_model_with_mocap_poses(mjx_model, world), world)
        if np.isin(mjx_model.cam_mode, COM_CAMERAS).any():
            world = mjx.com_pos(mjx_model, world)
        world = mjx.camlight(mjx_model, world)
        return mjx.collision(mjx_model, world)

    return jax.vmap(update_world)(mjx_data)


def _groups(poses: Poses) -> list[tuple[Array, Array, Array]]:
    drones, *others = poses
    objects = [(ids, pos[:, 0], quat[:, 0]) for ids, pos, quat in others[:1]]
    return [drones, *objects, *[(ids, *_map_poses(len(ids), index)) for ids, index in others[1:]]]  # type: ignore[list-item]


def _map_poses(n_maps: int, index: Array | NDArray) -> tuple[Array, Array]:
    z = jnp.where(index == np.arange(n_maps), 0.0, -HIDDEN_MAP_DEPTH)[..., None]
    return z * np.array([0.0, 0.0, 1.0]), jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (*z.shape[:2], 4))


def _model_with_mocap_poses(mjx_model: mjx.Model, world: mjx.Data) -> mjx.Model:
    # MJX 3.17 applies mocap poses after it has traversed the tree, which leaves the children at the model's poses.
    mocap = np.flatnonzero(mjx_model.body_mocapid >= 0)
    if not np.isin(mjx_model.body_parentid, mocap).any():
        return mjx_model
    norm = jnp.linalg.norm(world.mocap_quat, axis=-1, keepdims=True)
    return mjx_model.replace(
        body_pos=mjx_model.body_pos.at[mocap].set(world.mocap_pos),
        body_quat=mjx_model.body_quat.at[mocap].set(world.mocap_quat / norm),
    )


@jit_eager_calls()
def with_data_poses(data: SimData, worlds: NDArray, poses: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return poses of bodies and joints in selected worlds, with the poses of drones and handles from the data.

    Args:
        worlds: Indices of worlds. (n,)
        poses: Mocap positions, m (n, n_mocap, 3), attitudes, wxyz (n, n_mocap, 4), joint positions (n, n_qpos).
    """
    mocap_pos, mocap_quat, qpos = map(jnp.asarray, poses)
    for ids, pos, quat in _groups(poses_of(data)):
        mocap_pos = mocap_pos.at[:, ids].set(pos[worlds])
        mocap_quat = mocap_quat.at[:, ids].set(jnp.roll(quat[worlds], 1, axis=-1))
    return mocap_pos, mocap_quat, qpos


def host_poses(data: SimData, worlds: NDArray, poses: tuple[NDArray, ...]) -> tuple[NDArray, NDArray]:
    """Return mocap poses as ``with_data_poses``, in NumPy: m (n, n_mocap, 3), and wxyz (n, n_mocap, 4)."""
    mocap_pos, mocap_quat = (np.array(x, float) for x in poses[:2])
    selected_poses = tuple((ids, *(fetch_rows(x, worlds) for x in arrays)) for ids, *arrays in poses_of(data))
    for ids, new_pos, new_quat in _groups(selected_poses):
        mocap_pos[:, np.asarray(ids)], mocap_quat[:, np.asarray(ids)] = new_pos, np.roll(new_quat, 1, axis=-1)
    return mocap_pos, mocap_quat


def update_poses(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> None:
    """Compute the poses of all bodies, geoms, cameras and lights from mocap poses and joint positions."""
    mujoco.mj_kinematics(mj_model, mj_data)
    mujoco.mj_comPos(mj_model, mj_data)
    mujoco.mj_camlight(mj_model, mj_data)


def sync_one_world(
    data: SimData,
    world: int,
    poses: tuple[NDArray, NDArray, NDArray],
    mj_model: mujoco.MjModel,
    mj_data: mujoco.MjData,
) -> None:
    """Write the poses of one world into ``mj_data``, ready to be drawn.

    Args:
        poses: Mocap positions, m (1, n_mocap, 3), attitudes, wxyz (1, n_mocap, 4), joint positions (1, n_qpos). The
            poses of drones and of objects with handles are replaced by their poses in the data.
        mj_data: State to write.
    """
    mj_data.mocap_pos[:], mj_data.mocap_quat[:] = (x[0] for x in host_poses(data, np.array([world]), poses))
    mj_data.qpos[:] = poses[2][0]
    update_poses(mj_model, mj_data)
