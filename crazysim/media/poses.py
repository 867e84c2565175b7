"""Poses of all mocap bodies of the scene, read from the data without a sync of the MuJoCo scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crazysim.sim.sim import Sim


def mocap_poses(sim: Sim, worlds: int | NDArray) -> tuple[NDArray, NDArray]:
    """Return poses of all mocap bodies: drones, objects, and bodies of plugins, such as loads.

    Args:
        sim: Simulation.
        worlds: Indices of worlds. (n,)

    Returns:
        Positions, world frame, m (n, n_mocap, 3), and attitudes, body to world, xyzw (n, n_mocap, 4).
    """
    data = sim.plugins.with_moved_objects(sim.data)
    base_pos, base_quat = sim.scene.mocap_poses()
    pos = np.array(np.asarray(base_pos)[worlds], float)
    quat = np.roll(np.asarray(base_quat, float)[worlds], -1, axis=-1)
    ids = np.asarray(data.core.drone_mocap_ids)
    pos[:, ids], quat[:, ids] = np.asarray(data.states.pos)[worlds], np.asarray(data.states.quat)[worlds]
    if data.objects is not None:
        ids = np.asarray(data.objects.mocap_ids)
        pos[:, ids], quat[:, ids] = (np.asarray(x)[worlds, 0] for x in (data.objects.pos, data.objects.quat))
    return pos, quat
