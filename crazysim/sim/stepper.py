"""The data of a simulation between calls of its compiled step."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from crazysim.core.data import SimData
from crazysim.core.functional import put_command, stage_command
from crazysim.core.pipeline import Pipeline
from crazysim.eager import is_traced
from crazysim.engine.cache import announce_if_slow
from crazysim.engine.host_call import HostLeaves
from crazysim.engine.plan import Plan
from crazysim.engine.record import MAX_STEPS
from crazysim.engine.sharding import put_on_device, shard
from crazysim.engine.step import FlatData, Step
from crazysim.errors import ConfigError, require
from crazysim.sim.rollout import stage_flat

ANNOUNCEMENT_DELAY = 5.0
"""Time after which the compilation of a step is announced, s: most take less, filters with many states take more."""


class Stepper:
    """Data that is advanced in place: flattened between steps, and returned as a record when it is read.

    ``step`` is the pure function that advances it.
    """

    step: Step
    """The compiled step, from ``build``."""

    def __init__(self, device: jax.Device, mesh: Mesh | None, engine: str, strict: bool):
        self.device, self.mesh, self.engine, self.strict = device, mesh, engine, strict
        self._data: SimData | FlatData | None = None
        self._shapes: tuple[Plan, SimData] | None = None
        """Plan of the last flattened data, and its shapes, types and devices."""
        self._step_counts: dict[int, Array] = {}
        """Arrays of numbers of steps that ``advance`` received."""
        self._is_flagged = False
        """Whether ``core.mjx_synced`` is true in the data."""
        self._max_step_count: int | None = None
        """Largest number of steps of a world since its reset, or an upper bound; None if unknown."""
        self._last_count: tuple[object, int] = (None, 0)
        """Step counts that were read last, and their maximum."""
        self._compiled_step: Step | None = None
        """Step of the last call of ``advance``."""

    @property
    def data(self) -> SimData:
        data: Any = self._data
        return data.data() if isinstance(data, FlatData) else data

    @data.setter
    def data(self, data: SimData) -> None:
        if not (isinstance(self._data, FlatData) and self._data.is_record(data)):
            self._data = data

    @property
    def data_or_shapes(self) -> SimData:
        """The data as a record, or a record of its shapes, types and devices if the data is flattened."""
        flat = self._data
        if not isinstance(flat, FlatData):
            return self.data
        if self._shapes is None or self._shapes[0] is not flat.plan:
            self._shapes = (
                flat.plan,
                jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), flat.data()),
            )
        return self._shapes[1]

    def stage_command(self, command: Any, feedforward: Any = None) -> None:
        """Stage a command that was checked with ``data_or_shapes``; flattened data stays flattened.

        Args:
            command: Command in the units of the command level, which must not be changed afterwards.
                (n_worlds, n_drones, k)
            feedforward: Feedforward of a setpoint; None for the default of ``crazysim.core.functional.stage_command``.
        """
        if isinstance(self._data, FlatData):
            _require_values(command, feedforward)
            self._data = stage_flat(self._data, self.data_or_shapes, command, feedforward)
            return
        data = self.data
        feedforward = None if feedforward is None else put_command(data, feedforward)
        data = stage_command(data, put_command(data, command), feedforward)
        _require_values(data)
        self._data = data

    def set_synced(self, flag: bool) -> None:
        """Set ``core.mjx_synced``, in which users read whether the scene matches the data."""
        if flag == self._is_flagged:
            return
        # A new array: a user may donate data that was read from here, which must not share arrays with other data.
        data = self._data
        if isinstance(data, FlatData):
            i = int(data.plan.leaf_indices.core.mjx_synced)
            sharding = None if isinstance(data.leaves, HostLeaves) else data.leaves[i].sharding
            self._data = data.replace([i], [np.bool_(flag) if sharding is None else jax.device_put(flag, sharding)])
        else:
            core = self.data.core
            new_flag = jax.device_put(np.bool_(flag), core.mjx_synced.sharding)
            self._data = self.data.replace(core=core.replace(mjx_synced=new_flag))
        self._is_flagged = flag

    def assign(self, data: SimData) -> None:
        """Replace the data by data of the caller: put it on the device, and clear ``core.mjx_synced``."""
        if self._data is None or data.core.steps is not self.data.core.steps:
            self._max_step_count = None
        if self._is_flagged or self._data is None or data.core.mjx_synced is not self.data.core.mjx_synced:
            # A new array, as in ``set_synced``.
            data = data.replace(core=data.core.replace(mjx_synced=np.False_))
        self.data, self._is_flagged = self.put_on_device(data), False

    def accept(self, data: SimData) -> None:
        """Replace the data by data on the device, as compiled calls return it."""
        _require_values(data)
        self.data = data
        self.set_synced(False)

    def put_on_device(self, data: SimData) -> SimData:
        """Return the data with every leaf on the device, or distributed over the mesh.

        JAX puts an edited leaf on its default device. A leaf on another device, or one that is not committed to its
        device, would make the next step compile again.
        """
        _require_values(data)
        return put_on_device(data, self.device) if self.mesh is None else shard(data, self.mesh)

    def build(self, pipeline: Pipeline, check_data: Callable[[SimData], None] | None = None) -> Step:
        """Make the step of a pipeline, use it from now on, and return it; ``check_data`` is as for ``Step``."""
        self._data = self.data  # it may be flattened for the previous step
        self.step = Step(
            pipeline, self.engine, self.device.platform, self.mesh, device=self.device, strict=self.strict,
            check_data=check_data,
        )  # fmt: skip
        return self.step

    def advance(self, n_steps: int) -> None:
        """Advance the data. One compilation serves all numbers of steps."""
        self.count_steps(n_steps)
        is_first, self._compiled_step = self._compiled_step is not self.step, self.step
        with announce_if_slow("compiling the step", "5 to 40 s", ANNOUNCEMENT_DELAY) if is_first else nullcontext():
            flat = self._data if isinstance(self._data, FlatData) else self.step.flatten(self.data)
            if flat.plan.host_call is None:
                flat_after = self.step.advance(flat, self._as_array(n_steps))
                _require_values(flat_after.leaves[:1])  # all are traced, or none
            else:
                flat_after = self.step.advance_on_host(flat, n_steps)
        self._data = flat_after
        self.set_synced(False)

    def count_steps(self, n_steps: int, times: int = 1) -> None:
        """Count steps that are about to be taken.

        Args:
            times: Number of times that they will be taken.
        """
        n_steps *= times
        if self._max_step_count is None or self._max_step_count + n_steps > MAX_STEPS:
            steps = self.data.core.steps
            if self._last_count[0] is not steps:  # the same data may be assigned repeatedly
                self._last_count = steps, int(np.asarray(steps).max())  # waits for the device, so not in every call
            self._max_step_count = self._last_count[1]
        if self._max_step_count + n_steps > MAX_STEPS:
            freq = self.data.core.freq
            raise ConfigError(
                f"expected at most {MAX_STEPS} steps between two resets, {MAX_STEPS / freq / 86400:.1f} days at {freq} "
                f"Hz, got {n_steps} after {self._max_step_count}. Use sim.reset(), or a lower freq."
            )
        self._max_step_count += n_steps

    def _as_array(self, n_steps: int) -> Array:
        if n_steps not in self._step_counts:
            with jax.default_device(self.device):
                self._step_counts[n_steps] = jnp.int32(n_steps)
        return self._step_counts[n_steps]


def _require_values(*values: Any) -> None:
    require(
        not is_traced(values),
        "expected arrays with values, got traced ones, of a function inside jit, grad or vmap, which a simulation "
        "cannot keep. Use functions of data there: those of crazysim.core.functional, and sim.build_step_fn().",
    )
