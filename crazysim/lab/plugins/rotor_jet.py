"""Forces of the jet of a drone's rotors on the surfaces of loads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, StagePlacement, derived, param, state
from crazysim.core.settings import setting
from crazysim.drones.airframe_estimate import AIR_DENSITY
from crazysim.dynamics.rotor import RPM_TO_RAD_S
from crazysim.engine.pytree import device_array
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError
from crazysim.lab.plugins.jet_table import JetTable
from crazysim.lab.plugins.panels import shape_panels
from crazysim.plugins.effects.downwash import collective_thrust, hover_jet_speed, mean_rotor_vel, stream_diameter
from crazysim.plugins.effects.grid import MAX_FUSED_VALUES, UNFUSED_REASON, interpolate, is_inside
from crazysim.plugins.effects.moving_air import needs_rotors
from crazysim.plugins.payloads.colliders import CollidingPlugin
from crazysim.plugins.payloads.point_load import LoadForce

PANELS_PER_LENGTH = 2
"""Default number of panels along the longest edge of a load."""


class RotorJet(LoadForce, requires=needs_rotors):
    """Jet of a drone's rotors on the panels of loads, from tables or an analytic jet; needs rotors.

    The force on a panel of area A with the outward normal n is ``-P A n`` for a pressure P of a table, and ``rho v
    max(-v.n, 0) A`` for air of velocity v relative to the load: the momentum of the air that arrives. The analytic jet
    is the same as in ``Downwash``. A table is interpolated linearly between nodes and between rotor speeds, and is zero
    outside its grid. Below the smallest rotor speed of the table the jet decreases to zero with the speed; above the
    largest rotor speed it stays constant.
    """

    table: JetTable | None = setting(default=None, keep=False)
    """Pressure or velocity around the drone; None for the analytic jet."""
    load: str = "load"
    """Name of the plugin of the loads, a ``SlungLoad`` or a ``Hook``."""
    panel: float | None = setting(default=None, positive=True)
    """Largest edge of a panel, m; None for half the longest edge of the load."""
    all_drones: bool = False
    """True for the jets of all drones of a world on each load; False for the jet of the load's own drone."""
    air_density: Param = param(default=AIR_DENSITY, positive=True)
    """Density of air, kg/m^3. (1,)"""
    propeller_radius: Param = param(default=None, airframe="shape.propeller_radius", positive=True)
    """Radius of a propeller, m, for the analytic jet; None for the airframe's. (1,)"""
    force: Array = state((3,))
    """Force on the load, world frame, N. (n_worlds, n_drones, 3)"""
    torque: Array = state((3,))
    """Torque about the centre of the load's shape, world frame, N m. (n_worlds, n_drones, 3)"""
    diameter: Array = derived()
    """Diameter of the fully contracted jet of a drone, m. (1,)"""
    speeds: Array | None = derived(("tables",), scope="shared")
    """Mean rotor speeds of the tables, rad/s; None for the analytic jet. (n_tables,)"""
    pressure: Array | None = derived(("tables", "x", "y", "z"), scope="shared")
    """Pressures, Pa; None without pressures. (n_tables, n_x, n_y, n_z)"""
    velocity: Array | None = derived(("tables", "x", "y", "z", 3), scope="shared")
    """Velocities of the air, body frame of the drone, m/s; None without velocities. (n_tables, n_x, n_y, n_z, 3)"""
    origin: Array | None = derived((3,), scope="shared")
    """First node relative to the drone's centre of mass, body frame, m; None for the analytic jet. (3,)"""
    spacing: Array | None = derived((3,), scope="shared")
    """Distance between nodes, m; None for the analytic jet. (3,)"""
    name: str = "rotor_jet"

    @property
    def companions(self) -> Mapping[str, type]:
        return {self.load: CollidingPlugin}

    def bind(self, sim: Simulation) -> RotorJet:
        loads: Any = sim.plugins[self.load]
        if loads.coupling != "drone":
            raise ConfigError(
                f"expected loads of one drone each, got {self.load!r}, which hangs from all drones of a world. Use "
                f"SlungLoad or Hook."
            )
        bound, table = self.with_arrays(sim), {} if self.table is None else self.table.checked()._asdict()
        dtype = bound.propeller_radius.dtype
        arrays: Any = {name: None if x is None else device_array(x, dtype) for name, x in table.items()}
        return bound.replace(diameter=stream_diameter(sim, bound.propeller_radius), **arrays)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        loads: Any = sim.plugins[self.load]
        shape = loads.shape()
        edge = 2 * max(shape.size) / PANELS_PER_LENGTH if self.panel is None else self.panel
        panels = shape_panels(shape, edge)

        def apply_jets(data: SimData) -> SimData:
            jet, body, s = self.bound(data), loads.body(data), data.states
            arm = rotation.rotate(body.quat[..., None, :], jnp.asarray(panels.pos, s.pos.dtype))
            normal = rotation.rotate(body.quat[..., None, :], jnp.asarray(panels.normal, s.pos.dtype))
            pressure: Any = 0.0
            for k in range(s.pos.shape[-2]) if self.all_drones else (None,):
                pressure = pressure + jet.pressure_on(data, k, body.pos[..., None, :] + arm, normal, body.vel)
            force = pressure * jnp.asarray(panels.area, s.pos.dtype)
            torque = jnp.sum(rotation.cross(arm, force), axis=-2)
            return self.write(data, jet.replace(force=jnp.sum(force, axis=-2), torque=torque))

        n_values = 0 if self.table is None else sum(np.size(x) for x in (self.table.pressure, self.table.velocity))
        scope = "world" if self.all_drones else "drone" if n_values <= MAX_FUSED_VALUES else "batch"
        return [StagePlacement(Stage(apply_jets, scope, batched=not self.all_drones, unfused_reason=UNFUSED_REASON))]  # type: ignore[arg-type]

    def observations(self, data: SimData) -> dict[str, Array]:
        return {"force": self.force}

    def pressure_on(self, data: SimData, drone: int | None, pos: Array, normal: Array, vel: Array) -> Array:
        """Return the force of a drone's jet per area of panels, world frame, Pa. (..., n, 3)

        Args:
            data: Data of one drone, one world or all worlds.
            drone: Index of the drone whose jet acts; None for each load's own drone.
            pos: Centres of the panels, world frame, m. (..., n, 3)
            normal: Outward normals of the panels, world frame. (..., n, 3)
            vel: Velocity of the loads, world frame, m/s. (..., 3)
        """
        s = data.states
        drone_values = (s.pos, s.quat, mean_rotor_vel(data), collective_thrust(data), self.diameter, self.air_density)
        if drone is not None:
            drone_values = tuple(x if x.ndim == 1 else x[drone] for x in drone_values)
        # Insert an axis for the panels.
        drone_pos, quat, rotor_vel, thrust, diameter, density = (x[..., None, :] for x in drone_values)
        offset = pos - drone_pos

        def momentum_flux(air_vel: Array) -> Array:
            relative_vel = air_vel - vel[..., None, :]
            closing_speed = -rotation.dot(relative_vel, normal)
            # Only air in the jet transfers momentum: still air outside it exerts no force on a load that moves.
            is_in_jet = rotation.dot(air_vel, air_vel) > 0
            return jnp.where(is_in_jet & (closing_speed > 0), density * closing_speed, 0.0) * relative_vel

        if self.speeds is None:
            axis = rotation.z_axis(quat)
            return momentum_flux(-hover_jet_speed(offset, axis, thrust, diameter, density) * axis)
        speed = rotor_vel * RPM_TO_RAD_S
        jet_factor, table = table_position(speed, self.speeds)
        # With tables, ``origin`` and ``spacing`` are arrays.
        cell = (rotation.rotate_inverse(quat, offset) - self.origin) / self.spacing  # type: ignore[operator]
        shape = self.velocity.shape if self.pressure is None else self.pressure.shape
        jet_factor = jnp.where(is_inside(shape[1:4], cell)[..., None], jet_factor, 0.0)
        table_index = jnp.concatenate([jnp.broadcast_to(table, (*cell.shape[:-1], 1)), cell], axis=-1)
        total: Any = 0.0
        if self.pressure is not None:
            total = total - jet_factor * interpolate(self.pressure, table_index)[..., None] * normal
        if self.velocity is not None:
            total = total + momentum_flux(rotation.rotate(quat, jet_factor * interpolate(self.velocity, table_index)))
        return total


def table_position(speed: Array, speeds: Array) -> tuple[Array, Array]:
    """Return the factor of the jet below the smallest rotor speed, and the position of a speed between tables.

    Args:
        speed: Rotor speed, rad/s. (..., 1)
        speeds: Rotor speeds of the tables, ascending, rad/s. (k,)

    Returns:
        Factor, 0 to 1 (..., 1), and position in units of tables, 0 to k - 1 (..., 1).
    """
    jet_factor = rotation.clip(speed / speeds[0], 0.0, 1.0)
    intervals = [
        rotation.clip((speed - speeds[i]) / (speeds[i + 1] - speeds[i]), 0.0, 1.0) for i in range(speeds.shape[0] - 1)
    ]
    return jet_factor, sum(intervals, jnp.zeros_like(speed))
