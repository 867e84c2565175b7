"""Fleets: the drones of a running simulation, moved by commands."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.live.attitude import from_yaw
from crazysim.lab.live.commands import Command, Hover, Land, LoadShow, SetParameter, Start, StartShow, TakeOff, Upload
from crazysim.lab.live.host_trajectory import HostTrajectory
from crazysim.lab.live.loop import Live
from crazysim.lab.live.server import CommandQueue
from crazysim.lab.show_files.lights import Lights
from crazysim.plugins.follow import Follow
from crazysim.sim.sim import Sim
from crazysim.trajectories import Trajectory, hover, line

VERTICAL_SPEED = 0.5
"""Mean speed of take-off and landing, m/s."""
MIN_VERTICAL_DURATION = 1.0
"""Shortest duration of take-off and landing, s."""
MAX_PIECES = 256
"""Default largest number of pieces of a trajectory."""
MAX_DEGREE = 7
"""Highest degree of a trajectory."""

log = logging.getLogger(__name__)


class Fleet:
    """The drones of a simulation of one world, each on a trajectory that commands replace.

        sim = Sim(n_drones=3, control="state")
        fleet = Fleet(sim)
        fleet.apply([TakeOff(None, 0.5)])
        sim.step(500)

    Commands take effect between two steps; nothing is compiled again. A command that cannot be carried out is logged,
    and the drone continues its trajectory. A new ID is assigned to the next free drone.
    """

    parameters: list[dict[str, float]]
    """Parameters of each drone's firmware that commands have set, by name."""

    def __init__(
        self,
        sim: Sim,
        ids: Mapping[int, int] | None = None,
        max_pieces: int = MAX_PIECES,
        teleport: bool = True,
        name: str = "fleet",
    ):
        require(
            sim.n_worlds == 1,
            f"expected one world, got {sim.n_worlds}. Use Follow.upload for trajectories in several worlds.",
        )
        self.sim, self.teleport = sim, teleport
        self.ids = dict(ids or {})
        require(
            len(set(self.ids.values())) == len(self.ids) and all(0 <= i < sim.n_drones for i in self.ids.values()),
            f"expected one drone of {sim.n_drones} for each ID, got {self.ids}",
        )
        pos = np.asarray(sim.data.states.pos[0], float)
        self._active_trajectories = [_hover_trajectory(np.append(p, 0.0)) for p in pos]
        self._start_times = np.zeros(sim.n_drones)
        self._uploaded_trajectories: dict[int, Trajectory] = {}
        self._awaits_first_trajectory = [True] * sim.n_drones
        self.parameters = [{} for _ in range(sim.n_drones)]
        self._lights: Lights | None = None
        self._show_start: float | None = None
        drones = np.arange(sim.n_drones)[None]
        self.follow = Follow(
            self._active_trajectories, index=drones, start=np.zeros((1, sim.n_drones)), n_slots=sim.n_drones,
            max_pieces=max_pieces, visible=False, name=name,
        )  # fmt: skip
        sim.add(self.follow)
        sim.build_default_data()

    def apply(self, commands: Iterable[Command]) -> int:
        """Carry out commands between two steps, and return the number of commands that succeeded.

        Args:
            commands: Commands, in order; a command that cannot be carried out is logged.
        """
        n_succeeded = 0
        for command in commands:
            try:
                self._apply_command(command)
                n_succeeded += 1
            except ConfigError as error:
                log.warning("%s refused: %s", type(command).__name__, error)
        return n_succeeded

    def reset(self) -> None:
        """Make every drone hover at its position; received trajectories are kept. Call it after ``sim.reset()``."""
        self._awaits_first_trajectory = [True] * self.sim.n_drones
        self._show_start = None
        for drone, pos in enumerate(np.asarray(self.sim.data.states.pos[0], float)):
            self._assign_trajectory(drone, _hover_trajectory(np.append(pos, 0.0)))
            self._awaits_first_trajectory[drone] = drone not in self._uploaded_trajectories

    def colors(self) -> NDArray:
        """Return the present colours of the LEDs, from the received show once it has started. (n_drones, 3)"""
        colors = np.zeros((self.sim.n_drones, 3))
        if self._lights is not None and self._show_start is not None:
            show_colors = self._lights.colors([self._current_time() - self._show_start])[0]
            colors[: len(show_colors)] = show_colors
        return colors

    def setpoint(self, drone: int) -> NDArray:
        """Return the present setpoint of a drone: position, m, and yaw, rad. (4,)"""
        return HostTrajectory.from_trajectory(self._active_trajectories[drone]).setpoint(
            self._current_time() - self._start_times[drone]
        )

    def _current_time(self) -> float:
        return float(self.sim.time[0, 0])

    def _apply_command(self, command: Command) -> None:
        if isinstance(command, LoadShow):
            show = command.show
            require(
                show.n_drones <= self.sim.n_drones,
                f"expected a show of at most {self.sim.n_drones} drones, got {show.n_drones}",
            )
            trajectories = [_remove_padding(show.trajectory(i)) for i in range(show.n_drones)]
            for trajectory in trajectories:
                self._check_trajectory(trajectory)
            for drone, trajectory in enumerate(trajectories):
                self._receive_trajectory(drone, trajectory)
            self._lights, self._show_start = show.lights, None
        elif isinstance(command, StartShow):
            require(self._uploaded_trajectories, "expected trajectories to start, got none. Upload some first.")
            for drone in self._uploaded_trajectories:
                self._start_trajectory(drone, relative=False)
            self._show_start = self._current_time()
        else:
            if isinstance(command, Upload):
                self._check_trajectory(command.trajectory)
            drones = self._find_drones(command.drone)
            if isinstance(command, Start) and any(drone not in self._uploaded_trajectories for drone in drones):
                raise ConfigError("expected a trajectory to start, got none. Upload one first.")
            for drone in drones:
                self._apply_to_drone(command, drone)

    def _apply_to_drone(self, command: Command, drone: int) -> None:
        if isinstance(command, Upload):
            self._receive_trajectory(drone, command.trajectory)
            return
        if isinstance(command, SetParameter):
            self.parameters[drone][command.name] = command.value
            log.info("drone %d: %s = %g", drone, command.name, command.value)
            return
        setpoint = self.setpoint(drone)
        if isinstance(command, Start):
            self._start_trajectory(drone, command.relative)
        elif isinstance(command, Hover):
            self._assign_trajectory(drone, _hover_trajectory(setpoint))
        elif isinstance(command, TakeOff):
            self._assign_trajectory(drone, _vertical_trajectory(setpoint, command.height))
        elif isinstance(command, Land):
            self._assign_trajectory(drone, _vertical_trajectory(setpoint, 0.0))

    def _find_drones(self, drone_id: int | None) -> list[int]:
        if drone_id is None:
            return list(range(self.sim.n_drones))
        if drone_id not in self.ids:
            free_drones = sorted(set(range(self.sim.n_drones)) - set(self.ids.values()))
            require(free_drones, f"expected one of the IDs {sorted(self.ids)}, got {drone_id}: no drone is free")
            self.ids[drone_id] = free_drones[0]
            log.info("ID %d is drone %d", drone_id, free_drones[0])
        return [self.ids[drone_id]]

    def _check_trajectory(self, trajectory: Trajectory) -> None:
        n_pieces = self.follow.read(self.sim.data).ends.shape[1]
        require(
            np.ndim(trajectory.ends) == 1 and trajectory.degree <= MAX_DEGREE,
            f"expected a trajectory of one vehicle of degree {MAX_DEGREE} or less, got ends of shape "
            f"{np.shape(trajectory.ends)} and degree {trajectory.degree}. Fit shorter pieces.",
        )
        require(
            trajectory.n_pieces <= n_pieces,
            f"expected a trajectory of at most {n_pieces} pieces, got {trajectory.n_pieces}. Use "
            f"Fleet(..., max_pieces={trajectory.n_pieces}).",
        )

    def _receive_trajectory(self, drone: int, trajectory: Trajectory) -> None:
        self._uploaded_trajectories[drone] = trajectory
        if self.teleport and self._awaits_first_trajectory[drone]:
            start_point = HostTrajectory.from_trajectory(trajectory).setpoint(0.0)
            states = self.sim.data.states
            pos = states.pos.at[0, drone].set(jnp.asarray(start_point[:3], states.pos.dtype))
            quat = states.quat.at[0, drone].set(jnp.asarray(from_yaw(start_point[3]), states.quat.dtype))
            self.sim.data = self.sim.data.replace(states=states.replace(pos=pos, quat=quat))
            self._assign_trajectory(drone, _hover_trajectory(start_point))
        self._awaits_first_trajectory[drone] = False

    def _start_trajectory(self, drone: int, relative: bool) -> None:
        trajectory = self._uploaded_trajectories[drone]
        if relative:
            trajectory = trajectory.moved(
                (self.setpoint(drone) - HostTrajectory.from_trajectory(trajectory).setpoint(0.0))[:3]
            )
        self._assign_trajectory(drone, trajectory)

    def _assign_trajectory(self, drone: int, trajectory: Trajectory) -> None:
        data = self.follow.uploaded(self.sim.data, drone, trajectory)
        record, now = self.follow.read(data), self._current_time()
        start = record.start.at[0, drone, 0].set(jnp.asarray(now, record.start.dtype))
        self.sim.data = self.follow.write(data, record.replace(start=start))
        self._active_trajectories[drone], self._start_times[drone] = trajectory, now
        self._awaits_first_trajectory[drone] = False


def _hover_trajectory(point: NDArray) -> Trajectory:
    return hover(point[:3], float(point[3]))


def _vertical_trajectory(point: NDArray, height: float) -> Trajectory:
    seconds = max(abs(height - float(point[2])) / VERTICAL_SPEED, MIN_VERTICAL_DURATION)
    return line(point[:3], [point[0], point[1], height], seconds, yaw=float(point[3]))


def _remove_padding(trajectory: Trajectory) -> Trajectory:
    ends = np.asarray(trajectory.ends, float)
    n = max(int(np.searchsorted(ends, ends[-1])) + 1, 1)
    host_trajectory = jax.tree.map(np.asarray, trajectory)
    return host_trajectory.replace(ends=host_trajectory.ends[:n], coefficients=host_trajectory.coefficients[:n])


class RemoteCommands:
    """Process that carries out the commands in a queue: ``live.add(RemoteCommands(fleet, server))``."""

    def __init__(self, fleet: Fleet, queue: CommandQueue):
        self._fleet, self._queue = fleet, queue

    def __call__(self, live: Live) -> None:
        self._fleet.apply(self._queue.commands())
        live.lights[0] = self._fleet.colors()

    def reset(self, live: Live) -> None:
        """Make the drones hover at their positions after a reset or a jump in time."""
        self._fleet.reset()
