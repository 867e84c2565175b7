"""Poses of mocap bodies that were attached to ``sim.spec`` and are moved through ``mjx_data``, as inputs of queries."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import Objects, SimData
from crazysim.errors import ConfigError
from crazysim.scene.collision import CollisionModel

MocapPoses = Any
"""``mjx_data``, or its pair ``(mocap_pos, mocap_quat)``: m (n_worlds, n_mocap, 3), and wxyz (n_worlds, n_mocap, 4). In
a function of one world, both have no axis ``n_worlds``."""


def with_mocap_bodies(model: CollisionModel, data: SimData, mocap: MocapPoses) -> SimData:
    """Return the data with the poses of a model's ``mocap_bodies`` appended to the poses of objects with handles.

    Args:
        model: Model that is queried.
        data: Simulation, one world of it, or one drone.
        mocap: Poses of all mocap bodies; None to return the data unchanged.
    """
    if mocap is None or not model.mocap_bodies:
        return data
    has_worlds = data.states.pos.ndim == 3
    dtype, ids = data.states.pos.dtype, np.array(model.mocap_ids)
    pos, quat = (jnp.take(x, ids, axis=-2).astype(dtype) for x in _pose_pair(mocap, data if has_worlds else None))
    quat = jnp.roll(quat, -1, axis=-1)
    quat = quat / jnp.linalg.norm(quat, axis=-1, keepdims=True)
    if has_worlds:
        pos, quat = pos[:, None], quat[:, None]
    names: tuple[str, ...] = ()
    map_index = None if data.objects is None else data.objects.map_index
    if data.objects is not None:
        names = data.objects.names
        pos, quat = (jnp.concatenate(x, axis=-2) for x in ((data.objects.pos, pos), (data.objects.quat, quat)))
    # Queries need poses only.
    objects = Objects(pos, quat, None, None, (*names, *model.mocap_bodies), map_index=map_index)  # type: ignore[arg-type]
    return data.replace(objects=objects)


def require_poses(model: CollisionModel, names: Iterable[str], mocap: MocapPoses) -> None:
    """Check that poses are passed if any of the named bodies is moved through ``mjx_data``."""
    missing = [name for name in names if name in model.mocap_bodies]
    if missing and mocap is None:
        raise ConfigError(
            f"expected the pose of body {missing[0]!r}, which is moved through sim.mjx_data and not part of the data. "
            f"Pass mocap=sim.mjx_data, add the body with sim.scene.add, or leave it out with objects=."
        )


def _pose_pair(mocap: MocapPoses, data: SimData | None) -> tuple[Array, Array]:
    pos, quat = mocap if isinstance(mocap, (tuple, list)) else (mocap.mocap_pos, mocap.mocap_quat)
    pos, quat = jnp.asarray(pos), jnp.asarray(quat)
    n = None if data is None else data.states.pos.shape[0]
    for name, x, size in (("mocap_pos", pos, 3), ("mocap_quat", quat, 4)):
        is_valid = x.ndim == (2 if n is None else 3) and x.shape[-1] == size and (n is None or x.shape[0] == n)
        if not is_valid:
            axes = "(n_mocap, " if n is None else f"({n}, n_mocap, "
            raise ConfigError(f"expected {name} of shape {axes}{size}), got {x.shape}. Pass mocap=sim.mjx_data.")
    return pos, quat
