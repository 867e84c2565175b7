"""The data of a simulation between calls of its compiled step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from crazysim.core.data import SimData
from crazysim.core.pipeline import Pipeline
from crazysim.core.sharding import put, shard
from crazysim.engine.flat import FlatData
from crazysim.engine.step import Step


class Stepper:
    """Data that advances: held flattened from step to step, and as a record where it is read.

    ``step`` is the pure function that advances it.
    """

    step: Step
    """The compiled step, from ``build``."""

    def __init__(self, device: jax.Device, mesh: Mesh | None, engine: str, strict: bool):
        """Set where data is held, and the engine of its steps; ``assign`` and ``build`` give it data and a step.

        Args:
            device: Device of the data.
            mesh: Devices to spread it over instead; None for the one.
            engine: One of ``crazysim.engine.ENGINES``.
            strict: As for ``Step``.
        """
        self.device, self.mesh, self.engine, self.strict = device, mesh, engine, strict
        self._record: SimData | None = None
        self._flat: FlatData | None = None
        self._counts: dict[int, Array] = {}
        self._unsynced: object = None

    @property
    def data(self) -> SimData:
        """The data as a record."""
        if self._record is None:
            self._record = self._flat.data()
        return self._record

    @data.setter
    def data(self, data: SimData) -> None:
        self._record, self._flat = data, None

    def assign(self, data: SimData) -> None:
        """Take data from outside: place it on the device, and clear ``core.mjx_synced``."""
        if data.core.mjx_synced is not self._unsynced:
            # A new array: a user may donate data that was read from here, which must not share arrays with other data.
            data = data.replace(core=data.core.replace(mjx_synced=np.False_))
        self.accept(self.place(data))

    def accept(self, data: SimData) -> None:
        """Take data that is on the device, with ``core.mjx_synced`` false, as compiled calls return it."""
        self.data, self._unsynced = data, data.core.mjx_synced

    def place(self, data: SimData) -> SimData:
        """Return the data with every leaf on the device, or spread over the mesh.

        An edited leaf is wherever JAX puts new arrays by default. An array elsewhere, or one that is not committed to
        its device, would make the next step compile again.
        """
        return put(data, self.device) if self.mesh is None else shard(data, self.mesh)

    def build(self, pipeline: Pipeline) -> Step:
        """Make the step of a pipeline, use it from now on, and return it."""
        if self._flat is not None:
            self.data = self.data  # it was flattened for the step before
        self.step = Step(pipeline, self.engine, self.device.platform, self.mesh, device=self.device, strict=self.strict)
        return self.step

    def advance(self, n_steps: int) -> None:
        """Advance the data; any number of steps uses the same compilation."""
        flat = self.step.flatten(self.data) if self._flat is None else self._flat
        self._flat, self._record = self.step.advance(flat, self._count(n_steps)), None
        self._unsynced = self._flat.leaves[flat.plan.synced]

    def _count(self, n_steps: int) -> Array:
        """Return a number of steps as an array; making one costs more than a step, so they are kept."""
        if n_steps not in self._counts:
            self._counts[n_steps] = jnp.int32(n_steps)
        return self._counts[n_steps]
