"""Following trajectories in the compiled step."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.control.setpoint import Setpoint
from crazysim.core.data import SimData
from crazysim.core.functional import stage_command
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, check_parameter, derived, param
from crazysim.core.settings import setting
from crazysim.core.stages import is_tick
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.tables import ANY_NUMBER, POSITIVE, range_between
from crazysim.trajectories.trajectory import Trajectory, trajectory_list

MIN_SLOT_DEGREE = 7
"""Degree for which slots have room at least, if trajectories can be uploaded later: the degree of minimum snap and of
drone shows."""
DRAWN_TIME = 2.0
"""Duration of the path ahead that is drawn, s."""
N_DRAWN_LINES = 40
"""Number of line segments of the drawn path."""
PATH_COLOR = (0.1, 0.9, 0.3, 0.8)
"""Colour of paths and setpoints, rgba."""


class Follow(Plugin, replaces=("state commands",)):
    """State commands from trajectories, each drone with its own trajectory, start and rate.

    At every tick of the state controller the plugin stages the setpoint of that time. A drone waits at the first point
    of its trajectory until it starts, and stays at the last point after the end, unless the trajectory repeats. Needs
    ``Sim(control="state")``.
    """

    trajectories: Trajectory | Sequence[Trajectory] = dataclasses.field(metadata={"static": True, "keep": False})
    """Trajectories in the first slots: one trajectory, a sequence of them, or a ``Trajectory`` with a leading axis.
    None in the data, which has ``slots``."""
    index: Param = param(default=None, low=0, dtype=np.int32)
    """Slot that a drone follows; with None, drone i follows trajectory i modulo the number of trajectories. (1,)"""
    start: Param = param(default=0.0)
    """Time since the reset of the world at which a drone starts, s. A drone with a negative start is in the middle of
    its trajectory at the reset: with -2 and a rate of 1, at 2 s. Also (n_drones,) as a setting. (1,)"""
    rate: Param = param(default=1.0, positive=True)
    """Factor of the speed along the trajectory, 1: with 2 a drone takes half the time. (1,)"""
    n_slots: int | None = setting(default=None, low=1)
    """Number of slots; None for one per trajectory. Additional slots hold the first trajectory until ``upload``."""
    max_pieces: int | None = setting(default=None, low=1)
    """Largest number of pieces of a trajectory in a slot; None for the largest number among ``trajectories``."""
    visible: bool = True
    """Whether to draw the path ahead and the setpoint of every drone."""
    ends: Array = derived(("slots", "pieces"), scope="shared")
    """End of each piece of the trajectory in each slot, s since its start. (n_slots, max_pieces)"""
    coefficients: Array = derived(("slots", "pieces", 4, "coefficients"), scope="shared")
    """Coefficients as in ``Trajectory``. (n_slots, max_pieces, 4, degree + 1)"""
    repeats: Array = derived(("slots",), scope="shared")
    """Whether a trajectory starts again after its end. (n_slots,)"""
    degrees: tuple[int, ...] = dataclasses.field(default=(), kw_only=True, repr=False)
    """Largest degrees of x, y, z and yaw that a trajectory in a slot may have, -1 where all coefficients are zero; set
    by ``bind``. (4,)"""
    name: str = "follow"

    def bind(self, sim: Simulation) -> Follow:
        if sim.data.controls.state is None:
            raise ConfigError(
                f"expected state commands for {self.name!r} to replace, got control={sim.data.controls.mode.value!r}. "
                f"Use Sim(control='state')."
            )
        # Slots of equal size, with room for uploads.
        trajectories = trajectory_list(self.trajectories)
        n_slots = (
            len(trajectories) if self.n_slots is None else _check_count("n_slots", self.n_slots, len(trajectories))
        )
        n_needed = max(t.n_pieces for t in trajectories)
        n_pieces = n_needed if self.max_pieces is None else _check_count("max_pieces", self.max_pieces, n_needed)
        has_room = self.n_slots is not None or self.max_pieces is not None
        first_trajectory = trajectories[0].padded(n_pieces, MIN_SLOT_DEGREE if has_room else 0)
        slots = Trajectory.stack(
            [first_trajectory, *trajectories[1:], *[first_trajectory] * (n_slots - len(trajectories))]
        )
        # Drones take the trajectories in turn.
        index = np.int32(0) if self.index is None else self.index
        if self.index is None and len(trajectories) > 1 and sim.n_drones > 1:
            index = np.broadcast_to(np.arange(sim.n_drones) % len(trajectories), (sim.n_worlds, sim.n_drones))
        ends, coefficients, repeats = (device_array(x, x.dtype) for x in jax.tree.leaves(slots))
        return self.with_arrays(
            sim,
            ends=ends,
            coefficients=coefficients,
            repeats=repeats,
            index=_check_slot_value(sim, "index", index, n_slots),
            start=_check_slot_value(sim, "start", self.start, n_slots),
            rate=_check_slot_value(sim, "rate", self.rate, n_slots),
            degrees=(slots.degree,) * 4 if has_room else slots.degrees(),
        )

    @property
    def slots(self) -> Trajectory:
        """The trajectories in all slots, with a leading axis over slots."""
        return Trajectory(self.ends, self.coefficients, self.repeats)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        stage_at_ticks = self.stage(self.stage_setpoint, when=lambda data: is_tick(data, data.controls.state.freq))
        return [StagePlacement(stage_at_ticks, before="state_controller")]

    def stage_setpoint(self, data: SimData) -> SimData:
        """Stage the setpoint of one drone."""
        s = self.setpoint(data)
        return stage_command(data, s.command(), s.feedforward())

    def setpoint(self, data: SimData) -> Setpoint:
        """Return the setpoint of one drone now."""
        return self.read(data).setpoint_at(data.core.steps / data.core.freq)

    def setpoint_at(self, t: Array) -> Setpoint:
        """Return the setpoint of one drone at a time of its world, s; of the plugin in ``data.plugins``. ()"""
        rate = self.rate[0]
        return self.slots.evaluate_at_rate(self.index[0], (t - self.start[0]) * rate, rate, self.degrees)

    def observations(self, data: SimData) -> dict[str, Array]:
        s = self.setpoint(data)
        return {"pos_error": s.pos - data.states.pos, "vel_error": s.vel - data.states.vel}

    def uploaded(self, data: SimData, slot: int, trajectory: Trajectory) -> SimData:
        """Return data with another trajectory in a slot; all arrays keep their shapes, so that nothing recompiles.

        Args:
            trajectory: The trajectory, for one drone.
        """
        record = self.read(data)
        n_slots, n_pieces, _, n_coefficients = record.coefficients.shape
        if not 0 <= operator.index(slot) < n_slots:
            raise ConfigError(f"expected a slot from 0 to {n_slots - 1}, got {slot}. Use Follow(..., n_slots=...).")
        if trajectory.ends.ndim != 1 or trajectory.n_pieces > n_pieces or trajectory.degree >= n_coefficients:
            raise ConfigError(
                f"expected one trajectory of at most {n_pieces} pieces and degree {n_coefficients - 1}, got ends of "
                f"shape {trajectory.ends.shape} and degree {trajectory.degree}. Use Follow(..., max_pieces=...)."
            )
        degrees = trajectory.degrees()
        if any(degree > max_degree for degree, max_degree in zip(degrees, record.degrees, strict=True)):
            raise ConfigError(
                f"expected degrees of x, y, z and yaw up to {record.degrees}, those of the first trajectories, got "
                f"{degrees}. Use Follow(..., n_slots=...) to keep room for others."
            )
        leaves = jax.tree.leaves(trajectory.padded(n_pieces, n_coefficients - 1))
        old_arrays = [record.ends, record.coefficients, record.repeats]
        ends, coefficients, repeats = _replace_slot(old_arrays, leaves, np.int32(slot))
        return self.write(data, record.replace(ends=ends, coefficients=coefficients, repeats=repeats))

    def upload(self, sim: Simulation, slot: int, trajectory: Trajectory) -> None:
        """Put another trajectory into a slot of a simulation, between two steps. The step is not compiled again.

        A full reset restores the trajectories of the default data. ``sim.build_default_data()`` makes the current ones
        the default.
        """
        with sim.lock:
            sim.data = self.uploaded(sim.data, slot, trajectory)

    def assign(
        self,
        sim: Simulation,
        index: ArrayLike | None = None,
        start: ArrayLike | None = None,
        rate: ArrayLike | None = None,
    ) -> None:
        """Give drones other slots, starts or rates; None leaves them unchanged.

        Nothing is compiled again, unless one number for all drones becomes one per drone.

        Args:
            index: Slots. (), (n_drones,) or (n_worlds, n_drones)
            start: Times since the reset of the worlds at which the drones start, s; may be negative. (), (n_drones,) or
                (n_worlds, n_drones)
            rate: Factors of the speed along the trajectories, 1. (), (n_drones,) or (n_worlds, n_drones)
        """
        new_values = {
            name: value for name, value in (("index", index), ("start", start), ("rate", rate)) if value is not None
        }
        with sim.lock:
            record = self.read(sim.data)
            numbers = {
                name: _check_slot_value(sim, name, value, len(record.ends)) for name, value in new_values.items()
            }
            shapes = {name: np.broadcast_shapes(x.shape, getattr(record, name).shape) for name, x in numbers.items()}
            record = record.replace(**{name: jnp.broadcast_to(x, shapes[name]) for name, x in numbers.items()})
            sim.data = self.write(sim.data, record)

    def draw(self, sim: Simulation, world: int) -> None:
        if not self.visible:
            return
        record = self.read(sim.data)
        now = float(sim.data.core.steps[world, 0]) / sim.data.core.freq
        slot_values = [
            np.broadcast_to(np.asarray(x)[world] if np.ndim(x) > 1 else np.asarray(x), (sim.n_drones, 1))
            for x in (record.index, record.start, record.rate)
        ]
        paths = np.asarray(_future_paths(record, slot_values, now + np.linspace(0.0, DRAWN_TIME, N_DRAWN_LINES + 1)))
        overlays = sim.scene.renderer.overlays
        overlays.points(paths[:, 0], PATH_COLOR, 0.02)
        for path in paths:
            if np.any(path != path[0]):
                overlays.line(path, PATH_COLOR, 2.0, 2.0)


def _check_slot_value(sim: Simulation, name: str, value: ArrayLike, n_slots: int) -> Array:
    # An array with one axis has a value for each drone, in all worlds.
    if np.shape(value) == (sim.n_drones,):
        value = np.broadcast_to(np.asarray(value), (sim.n_worlds, sim.n_drones))
    elif np.ndim(value) == 1 and np.shape(value) != (1,):
        raise ConfigError(f"expected {name} for each of {sim.n_drones} drones, got {np.size(value)} numbers")
    allowed = {"index": range_between(0, n_slots - 1), "rate": POSITIVE}.get(name, ANY_NUMBER)
    return check_parameter(sim, name, value, (1,), allowed, jnp.int32 if name == "index" else None)


def _check_count(name: str, value: object, minimum: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < minimum:
        raise ConfigError(
            f"expected {name} as an integer of at least {minimum}, which the trajectories need, got {value!r}"
        )
    return int(value)


@jax.jit
def _replace_slot(old_arrays: list[Array], new_arrays: list[Array], slot: Array) -> list[Array]:
    return [x.at[slot].set(y) for x, y in zip(old_arrays, new_arrays, strict=True)]


@jax.jit
def _future_paths(record: Follow, slot_values: list[Array], times: Array) -> Array:
    def drone_path(index: Array, start: Array, rate: Array) -> Array:
        drone_record = record.replace(index=index, start=start, rate=rate)
        return jax.vmap(lambda t: drone_record.setpoint_at(t).pos)(times)

    return jax.vmap(drone_path)(*slot_values)
