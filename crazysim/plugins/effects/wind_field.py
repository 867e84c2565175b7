"""Wind that varies in space: velocities of the air on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, derived, drone_array, param, state
from crazysim.core.random import uniform, world_key
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.plugins.effects.grid import MAX_FUSED_VALUES, UNFUSED_REASON, Grid, interpolate
from crazysim.plugins.effects.moving_air import BodiesInAir, MovingAir, needs_drag, with_moving_air


class WindField(MovingAir, Plugin, requires=needs_drag):
    """Wind from velocities on a grid, as drag of the velocity relative to the air; needs a model with drag.

    Velocities are interpolated trilinearly between the nodes. Outside the grid they have the values of its border. They
    are looked up once a step, at drones and at loads with drag. Several winds add up.
    """

    field: Any = param(core=("x", "y", "z", 3), scope="shared")
    """Velocities of the air, world frame, m/s: a ``Grid``, and in the data its values. (n_x, n_y, n_z, 3)"""
    offset: Param = param(default=(0.0, 0.0, 0.0), core=(3,))
    """Displacement of the grid, world frame, m. (3,)"""
    scale: Param = param(default=1.0)
    """Factor of all velocities, 1. (1,)"""
    spread: Param = param(default=None, core=(3,), low=0.0)
    """Largest random displacement along each axis, m, drawn uniformly for each world and episode; None for no random
    displacement. (3,)"""
    origin: Array = derived((3,), scope="shared")
    """Position of the first node, world frame, m. (3,)"""
    spacing: Array = derived((3,), scope="shared")
    """Distance between nodes along x, y and z, m. (3,)"""
    shift: Array = state((3,), optional=True)
    """Random displacement in this episode, m; None without one. (n_worlds, n_drones, 3)"""
    air_vel: Array = state((3,))
    """Velocity of the air at the drone, world frame, m/s. (n_worlds, n_drones, 3)"""
    name: str = "wind_field"

    def bind(self, sim: Simulation) -> WindField:
        if not isinstance(self.field, Grid):
            raise ConfigError(
                f"expected field as a Grid of velocities, got {type(self.field).__name__}. Use "
                f"WindField(Grid(velocities, origin, spacing)) or WindField(load_wind_grid(path))."
            )
        grid = self.field.checked("field", 3)
        dtype = sim.data.states.pos.dtype
        return self.with_arrays(
            sim,
            field=device_array(grid.values, dtype),
            origin=device_array(grid.origin, dtype),
            spacing=device_array(grid.spacing, dtype),
            shift=None if self.spread is None else drone_array(sim, 0.0, 3),
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        is_small = np.size(self.field.values) <= MAX_FUSED_VALUES
        scope = "drone" if is_small else "batch"
        return [StagePlacement(self.stage(self.look_up, scope, batched=True, unfused_reason=UNFUSED_REASON))]

    @property
    def resets_episode(self) -> bool:
        return self.spread is not None

    def influence(self, data: SimData) -> SimData:
        return with_moving_air(data, self.velocity_at_drone(data))

    def velocity_at_drone(self, data: SimData) -> Array:
        return self.air_vel

    def velocity_at(self, pos: Array) -> Array:
        """Return the velocity of the air at a position, world frame, m/s. (..., 3)"""
        grid_pos = pos - self.origin - self.offset
        grid_pos = grid_pos if self.shift is None else grid_pos - self.shift
        return self.scale * interpolate(self.field, grid_pos / self.spacing)

    def reset_episode(self, data: SimData) -> SimData:
        sample = 2 * uniform(world_key(data, self.name), (3,), self.shift.dtype) - 1
        return self.write(data, self.replace(shift=self.spread * sample))

    def look_up(self, data: SimData) -> SimData:
        """Return the data with the velocity of the air at a drone, and at its loads the sum over all wind fields."""
        data = self.write(data, self.replace(air_vel=self.velocity_at(data.states.pos)))
        fields = [x for x in data.plugins.values() if isinstance(x, WindField)]
        loads = {name: x for name, x in data.plugins.items() if isinstance(x, BodiesInAir) and x.wind_vel is not None}
        loads_in_wind = {
            name: x.replace(wind_vel=sum(f.velocity_at(x.pos) for f in fields)) for name, x in loads.items()
        }
        return data.replace(plugins=data.plugins | loads_in_wind)
