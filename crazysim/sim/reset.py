"""The reset of a simulation as a pure function, which runs a pipeline."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from crazysim.core.data import SimData, require_data
from crazysim.core.pipeline import Pipeline
from crazysim.core.settings import as_mask
from crazysim.engine import jaxcompat
from crazysim.engine.cache import keep_programs
from crazysim.engine.stage import Stage
from crazysim.errors import expect, require


class Reset:
    """``reset(data, default_data, mask=None) -> data``, pure and compiled.

    The compiled call copies the arrays that it returns unchanged. ``plain`` is the same function without compilation,
    for use inside another compiled function.
    """

    def __init__(self, pipeline: Pipeline, check_data: Callable[[SimData], None] | None = None):
        self._stages, self._check_data = tuple(pipeline.items()), check_data
        self._compiled = jax.jit(self.plain)

    def __call__(self, data: SimData, default_data: SimData, mask: Any = None) -> SimData:
        require_data(data)
        require_data(default_data)
        shared_records = data.plugins.keys() & default_data.plugins.keys()
        layout, default_layout = (
            (
                x.core.n_worlds, x.core.n_drones, x.controls.mode, jax.tree.structure(x.objects),
                [(jax.tree.structure(x.plugins[name]), [*map(jnp.shape, jax.tree.leaves(x.plugins[name]))])
                 for name in sorted(shared_records)],
            )
            for x in (data, default_data)
        )  # fmt: skip
        require(
            layout == default_layout,
            "expected data and default_data of one simulation, got those of two, or of two scenes. Use its "
            "default_data, read after sim.scene.add.",
        )
        mask = as_mask(mask, data.core.steps.shape[:1])
        with keep_programs(enabled=not self._cache_size()):
            return self._compiled(data, default_data, mask)

    def plain(self, data: SimData, default_data: SimData, mask: Any = None) -> SimData:
        """Return the data after a reset, without a compiled call."""
        for x in (data, default_data):
            require_data(x)
            x.check()
        if self._check_data is not None:
            self._check_data(data)
        for name, fn in self._stages:
            with jax.named_scope(name):
                data = fn.apply_in_worlds(data, mask) if isinstance(fn, Stage) else fn(data, default_data, mask)
            expect(
                isinstance(data, SimData),
                f"stage {name!r} of the reset to return the data that it got, with other values",
                data,
                "End its function with return data, or return data.replace(...).",
            )
        return data.replace(core=data.core.replace(mjx_synced=jnp.asarray(False)))

    def lower(self, data: SimData, default_data: SimData, mask: Any = None) -> Any:
        """Return the reset lowered for this data, as ``jax.jit(...).lower`` does."""
        return self._compiled.lower(data, default_data, as_mask(mask, data.core.steps.shape[:1]))

    def _cache_size(self) -> int:
        return jaxcompat.n_compilations(self._compiled)
