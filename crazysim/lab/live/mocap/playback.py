"""Playback in the compiled step: recorded objects in thousands of worlds, for rollouts and training."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin, Simulation, StagePlacement
from crazysim.core.settings import setting
from crazysim.engine.pytree import PyTree, device_array, leaf
from crazysim.engine.stage import stage
from crazysim.errors import require
from crazysim.scene.objects import Handle


class PlaybackData(PyTree):
    """Poses at equal intervals, and the time of the recording at which each world begins."""

    pos: Array = leaf("shared", 3)
    """Positions, world frame, m. (n_samples, n_objects, 3)"""
    quat: Array = leaf("shared", 3)
    """Attitudes, body to world, xyzw; the sign does not flip between successive samples. (n_samples, n_objects, 4)"""
    vel: Array = leaf("shared", 3)
    """Velocities, world frame, m/s. (n_samples, n_objects, 3)"""
    freq: Array = leaf("shared", 0)
    """Samples per second, Hz. ()"""
    start: Array = leaf("world")
    """Time of the recording at the reset of a world, s. (n_worlds, 1)"""


class Playback(Plugin):
    """Objects that follow sampled poses in every world, and rest after the last sample; see ``Twins.playback``."""

    handles: Sequence[Handle]
    """Handles of one object each, in the order of the samples."""
    pos: ArrayLike
    """Positions, world frame, m. (n_samples, n_objects, 3)"""
    quat: ArrayLike
    """Attitudes, body to world, xyzw. (n_samples, n_objects, 4)"""
    freq: float = setting(positive=True)
    """Samples per second, Hz."""
    start: ArrayLike = 0.0
    """Time of the recording at the reset of a world, s. () or (n_worlds,)"""
    name: str = "playback"

    def record(self, sim: Simulation) -> PlaybackData:
        pos, quat, start = (np.asarray(x, float) for x in (self.pos, self.quat, self.start))
        n = len(self.handles)
        require(
            pos.ndim == 3 and pos.shape[1:] == (n, 3) and quat.shape == (*pos.shape[:2], 4) and len(pos) >= 2,
            f"expected at least two samples of {n} positions and attitudes, got shapes {pos.shape} and {quat.shape}",
        )
        require(
            start.shape in ((), (sim.n_worlds,)), f"expected start of shape () or ({sim.n_worlds},), got {start.shape}"
        )
        signs = np.where((quat[1:] * quat[:-1]).sum(-1) < 0, -1.0, 1.0)
        quat = quat * np.concatenate([np.ones((1, n)), np.cumprod(signs, axis=0)])[..., None]
        vel = np.gradient(pos, 1 / self.freq, axis=0)
        vel[-1] = 0.0
        dtype = sim.data.states.pos.dtype
        return PlaybackData(
            pos=device_array(pos, dtype),
            quat=device_array(quat, dtype),
            vel=device_array(vel, dtype),
            freq=device_array(self.freq, dtype),
            start=device_array(np.broadcast_to(start, sim.n_worlds)[:, None], dtype),
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        del sim
        return [StagePlacement(stage("world")(self.set_object_poses))]

    def set_object_poses(self, data: SimData) -> SimData:
        """Return the data of one world with the objects at their poses."""
        record = self.read(data)
        last_index = record.pos.shape[0] - 1
        sample_time = jnp.clip((data.core.steps / data.core.freq + record.start) * record.freq, 0, last_index)
        previous_index = jnp.minimum(jnp.floor(sample_time), last_index - 1)
        fraction, k = sample_time - previous_index, previous_index.astype(jnp.int32)
        pos, quat, vel = (x[k] + fraction * (x[k + 1] - x[k]) for x in (record.pos, record.quat, record.vel))
        quat = quat / jnp.sqrt(jnp.sum(quat * quat, axis=-1, keepdims=True))
        objects = data.objects
        index_of_row = {handle.rows[0]: i for i, handle in enumerate(self.handles)}

        def replace_rows(old: Array, new: Array) -> Array:
            rows = [
                new[index_of_row[k]] if k in index_of_row else old[..., k, :].reshape(old.shape[-1])
                for k in range(old.shape[-2])
            ]
            return jnp.stack(rows).reshape(old.shape)

        moved_objects = objects.replace(
            pos=replace_rows(objects.pos, pos),
            quat=replace_rows(objects.quat, quat),
            vel=replace_rows(objects.vel, vel),
        )
        return data.replace(objects=moved_objects)
