"""MJX's model and data of the scene in every world, allocated when first read, synced if poses have changed."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import NDArray

from crazysim.eager import fetch_rows, jit_eager_calls
from crazysim.engine.cache import announce_if_slow
from crazysim.engine.sharding import put_on_device, shard_scene
from crazysim.errors import UnknownNameError
from crazysim.scene import build, mjx
from crazysim.scene.sync import Poses, sync_poses


class MjxScene:
    """``mjx.Model`` and ``mjx.Data`` of one compiled scene."""

    def __init__(self, mj_model: mujoco.MjModel, n_worlds: int, device: jax.Device, mesh: Mesh | None):
        self._mj_model, self._n_worlds, self._device, self._mesh = mj_model, n_worlds, device, mesh
        self._model: mjx.Model | None = None
        self._data: mjx.Data | None = None
        self._initial_poses: tuple[NDArray, ...] | None = None
        self._has_synced = False
        self._synced: list[Any] | None = None
        """Arrays of poses of the last sync; None if the scene may be another one now."""

    @property
    def model(self) -> mjx.Model:
        """Model on the device, shared by all worlds."""
        model = self._model
        if model is None:
            model = build.put_model(self._mj_model, self._device)
            if self._mesh is not None:
                model = jax.device_put(model, NamedSharding(self._mesh, PartitionSpec()))
            self._model = model
        return model

    @property
    def data(self) -> mjx.Data:
        """State of the scene in every world; poses are checked when it is assigned. (n_worlds, ...)"""
        if self._data is None:
            self._data = self._to_device(build.make_data(self._mj_model, self._n_worlds, self._device))
        return self._data

    @data.setter
    def data(self, data: mjx.Data) -> None:
        self._data, self._synced = self._to_device(build.check_poses(data, self._mj_model, self._n_worlds)), None

    @property
    def is_allocated(self) -> bool:
        """Whether ``data`` has been read or assigned."""
        return self._data is not None

    def sync(self, poses: Poses) -> mjx.Data:
        """Return the scene with these poses, which is computed unless they are the very arrays of the last sync.

        Identity suffices, because the values of JAX arrays do not change; NumPy arrays and tracers are always copied.
        The result for tracers is not kept.
        """
        arrays = jax.tree.leaves(poses)
        if self._synced is not None and all(a is b for a, b in zip(arrays, self._synced, strict=True)):
            return self.data
        is_first, self._has_synced = not self._has_synced, True
        with announce_if_slow("importing MJX and compiling contacts", "2 to 4 s") if is_first else nullcontext():
            data = sync_poses(poses, self.data, self.model)
        if not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(data)):
            self._data = data
            self._synced = arrays if all(isinstance(x, jax.Array) for x in arrays) else None
        return data

    def forget_sync(self) -> None:
        """Make the next ``sync`` copy the poses, whatever they are."""
        self._synced = None

    def poses(self, worlds: int | NDArray | None = None) -> tuple[Any, Any, Any]:
        """Return poses of worlds at the last sync, or the model's initial poses if nothing is allocated yet.

        Args:
            worlds: Index or indices of worlds; None for all worlds.

        Returns:
            Mocap positions, m (n, n_mocap, 3), attitudes, wxyz (n, n_mocap, 4), and joint positions (n, n_qpos).
        """
        if self._data is not None:
            pos, quat, qpos = self._data.mocap_pos, self._data.mocap_quat, self._data.qpos
            if worlds is None:
                return pos, quat, qpos
            return fetch_rows(pos, worlds), fetch_rows(quat, worlds), fetch_rows(qpos, worlds)
        if self._initial_poses is None:
            initial_data = mujoco.MjData(self._mj_model)
            defaults = (initial_data.mocap_pos, initial_data.mocap_quat, self._mj_model.qpos0)
            self._initial_poses = tuple(np.array(x) for x in defaults)
        rows = slice(None) if worlds is None else worlds
        pos, quat, qpos = (np.broadcast_to(x, (self._n_worlds, *x.shape))[rows] for x in self._initial_poses)
        return pos, quat, qpos

    def contacts(self, poses: Poses, body: str | None) -> Array:
        """Return True for every contact slot of MJX that touches, after a sync if it is needed.

        Args:
            poses: As for ``sync``.
            body: Name of the body whose slots are returned; None for all bodies.

        Returns:
            (n_worlds, n_slots), bool
        """
        data = self.sync(poses)
        return contact_flags(data) if body is None else body_contact_flags(data, self._mj_model, body)

    def shard(self, mesh: Mesh) -> None:
        self._mesh, self._model, self._has_synced, self._synced = mesh, None, False, None
        if self._data is not None:
            self._data = self._to_device(self._data)

    def _to_device(self, data: mjx.Data) -> mjx.Data:
        return put_on_device(data, self._device) if self._mesh is None else shard_scene(data, self._mesh)


# Contact slots: the rows of MJX's contact arrays. Only these functions read the private arrays.
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
    index = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, body) if isinstance(body, str) else -1
    if index < 0:
        names = [name for name in (mj_model.body(i).name for i in range(mj_model.nbody)) if not name.startswith("_")]
        listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise UnknownNameError(f"expected a body of the scene, {listed}, got {body!r}")
    return index
