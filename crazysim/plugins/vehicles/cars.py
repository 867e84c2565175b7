"""Cars: a population of ground vehicles, driven by commands or along paths."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import Objects, SimData
from crazysim.core.plugin import Simulation, StagePlacement, param
from crazysim.core.population import Population
from crazysim.core.settings import color, default_rates
from crazysim.dynamics.models import GRAVITY
from crazysim.engine.pytree import PyTree, device_array
from crazysim.engine.stage import Stage, is_tick
from crazysim.errors import ConfigError
from crazysim.plugins.effects.ground import HeightField, ground_at
from crazysim.plugins.vehicles import appearance, starts
from crazysim.plugins.vehicles.car_data import CarData
from crazysim.plugins.vehicles.car_params import CarParams
from crazysim.plugins.vehicles.car_state import to_body_frame
from crazysim.plugins.vehicles.following import PathController, PurePursuit, motor_reference, path_state
from crazysim.plugins.vehicles.kinematic import kinematic
from crazysim.plugins.vehicles.model import VehicleModel, VehicleSource, load_vehicle
from crazysim.plugins.vehicles.path import Path
from crazysim.plugins.vehicles.single_track import single_track
from crazysim.trajectories import Trajectory

CONTROL_FREQ = 50
"""Default rate of the controllers, Hz, lowered to the next divisor of the simulation's rate."""
SPEED_GAIN = 4.0
"""Acceleration per error of the speed at the command level ``speed``, 1/s."""
SETTLING_TIME = 0.02
"""Time constant with which height and tilt of a car follow the ground, s, as with stiff springs."""


class Cars(Population):
    """Cars, driven by commands, or along paths by a controller, on level ground or on terrain.

    A command is the motor reference and the steering angle at the level ``drive``, and the speed and the steering angle
    at the level ``speed``. It stays in force until the next command. With a path the cars need no commands. On terrain
    the dynamics are the same as on level ground, plus the pull of the slope; height and tilt follow the ground. Wheels
    do not leave the ground.
    """

    members: int | Sequence[str] = 1
    """Number of cars in each world, or their names."""
    vehicle: VehicleSource = "f1tenth_ros"
    """Vehicle model, as for ``load_vehicle``."""
    pos: ArrayLike | None = param(default=None, keep=False)
    """Positions at the start, x and y, m; None for the start of the path, or a row along y with gaps of 1 m.
    (2,), (n_members, 2) or (n_worlds, n_members, 2)"""
    yaw: ArrayLike | None = param(default=None, keep=False)
    """Headings at the start, rad; None for the path's heading, or zero. (), (n_members,) or (n_worlds, n_members)"""
    level: Literal["drive", "speed"] = "drive"
    """Command level of cars without a path."""
    path: Path | Trajectory | Sequence[Path | Trajectory] | None = None
    """Path, trajectory, or a sequence of them to follow; None to drive by commands."""
    controller: PathController | None = None
    """Controller that follows paths; None for ``PurePursuit()``."""
    reference: Literal["time", "arc"] = "time"
    """``time`` to keep to the timing of the path; ``arc`` to drive at the speed of the path where the car is."""
    index: ArrayLike | None = param(default=None, keep=False)
    """Index of each car's path; with None, car i follows path i modulo the number of paths. (), (n_members,) or
    (n_worlds, n_members)"""
    start: ArrayLike | None = param(default=None, keep=False)
    """Time at which a car is at the start of its path, s; None for zero, or equal intervals for the cars of one closed
    path. (), (n_members,) or (n_worlds, n_members)"""
    trailer: bool = False
    """True for cars that tow a trailer."""
    freq: int | None = None
    """Rate of the controller, Hz, a divisor of the simulation's rate; None for the largest one up to 50 Hz."""
    rgba: ArrayLike | None = color()
    """Colour; None for the default. (4,)"""
    in_scene: bool = True
    """True to put the cars into the scene, where they are drawn and reported as contacts of drones."""
    name: str = "cars"
    prefix: ClassVar[str] = "Fleet1Tenth"
    positions: ClassVar[tuple[str, ...]] = ("pos", "yaw", "distance")
    command_field: ClassVar[str | None] = "command"

    def with_poses(self, record: CarData, pos: Array, quat: Array) -> CarData:
        yaw = rotation.yaw(quat)[..., None]
        joints = None if record.joints is None else jnp.broadcast_to(yaw, record.joints.shape)
        return record.replace(pos=pos, yaw=yaw, joints=joints)

    @property
    def control_freq(self) -> int | None:
        return self.freq

    @property
    def model(self) -> VehicleModel:
        """The vehicle model."""
        return load_vehicle(self.vehicle)

    @property
    def path_controller(self) -> PathController | None:
        """The controller that follows the path; None without a path."""
        if self.path is None:
            return None
        return PurePursuit() if self.controller is None else self.controller

    def control_freq_in(self, freq: int) -> int:
        """Return the rate of the controller, Hz, in a simulation at ``freq``, Hz."""
        if self.freq is not None:
            return self.freq
        return default_rates(freq, {"freq": CONTROL_FREQ}, f" of {self.name!r}")["freq"]

    def record(self, sim: Simulation) -> CarData:
        self.check(sim)
        vehicle, freq, counts = self.model, sim.data.core.freq, (sim.n_worlds, self.n_members)
        self._check_settings(vehicle)
        paths, controller = self._paths(), self.path_controller
        index = start = arc = gains = memory = None
        params = CarParams.create(vehicle, freq, self.trailer)
        pos, yaw = starts.row_positions(self.n_members), np.zeros((self.n_members, 1))
        if paths is not None and controller is not None:
            controller.check(vehicle, paths)
            index = starts.member_numbers("index", self._path_indices(paths), counts, paths.n_paths)
            start_times = starts.spread_start_times(paths, index, self.n_members) if self.start is None else self.start
            start = starts.member_numbers("start", start_times, counts)
            pos, yaw, arc = starts.path_poses(paths, index, start, counts)
            gains, memory = controller.gains(vehicle, params, self.control_freq_in(freq)), controller.memory()
        if self.pos is not None:
            pos = starts.member_array("pos", self.pos, counts, (2,))
        if self.yaw is not None:
            yaw = starts.member_array("yaw", np.asarray(self.yaw)[..., None], counts, (1,))
        pos, yaw = (np.broadcast_to(x, (*counts, x.shape[-1])) for x in (pos, yaw))
        if arc is not None and self.pos is not None:
            arc = starts.project_arcs(paths, index, pos, arc)
        height, normal = ground_at(sim.data, device_array(np.concatenate([pos, pos[..., :1]], axis=-1)))
        z = np.asarray(height) + vehicle.number("wheels.radius")
        zero = np.zeros((*counts, 1))
        zeros_2, zeros_3 = np.concatenate([zero] * 2, axis=-1), np.concatenate([zero] * 3, axis=-1)
        needs_controller = self.level != "drive" or controller is not None
        record = self.create(
            sim,
            CarData,
            pos=np.concatenate([pos, z], axis=-1),
            yaw=yaw,
            body_vel=zeros_2,
            yaw_rate=zero,
            normal=np.asarray(normal),
            steer=zero,
            distance=zero,
            joints=np.concatenate([yaw, yaw], axis=-1) if self.trailer else None,
            command=zeros_2,
            applied_command=zeros_2 if needs_controller else None,
            force=zeros_3,
            torque=zeros_3,
            params=params,
            path=paths,
            index=index,
            start_time=start,
            arc=arc,
            memory=_repeat_for_members(memory, counts),
            gains=gains,
        )
        if self.in_scene:
            appearance.add_to_scene(sim, self, vehicle)
        return record

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        """Return the stages of controller and integration; commands of the level ``drive`` need no controller."""
        placements = [x for x in Population.stages(self, sim) if x.name != f"{self.name}_control"]
        if self.path_controller is None and self.level == "drive":
            return placements
        name, condition = (
            f"{self.name}_control",
            functools.partial(is_tick, freq=self.control_freq_in(sim.data.core.freq)),
        )
        return [StagePlacement(Stage(self._run_controller, self.name, condition, name=name), name=name), *placements]

    def control(self, data: SimData) -> CarData:
        car = self.read(data)
        controller = self.path_controller
        if controller is None:
            acc = SPEED_GAIN * (car.command[:1] - car.body_vel[:1])
            drive = motor_reference(car.command[:1], acc, car.params)
            return car.replace(applied_command=jnp.concatenate([drive, car.command[1:]]))
        time = data.core.steps / data.core.freq - car.start_time[0] if self.reference == "time" else None
        tracking = path_state(car.state, car.path, car.index[0], car.arc, controller.reference_offset(car.params), time)
        applied_command, memory = controller.update(car.state, tracking, car.memory, car.gains, car.params)
        return car.replace(applied_command=applied_command, arc=tracking.arc, memory=memory)

    def derivative(self, data: SimData) -> Mapping[str, Array]:
        car = self.read(data)
        model = kinematic if self.model.dynamics == "kinematic" else single_track
        command = car.command if car.applied_command is None else car.applied_command
        force, terrain_rates = car.force[:2], {}
        if any(isinstance(record, HeightField) for record in data.plugins.values()):
            force = force - GRAVITY[2] * car.params.mass * car.normal[2:] * car.normal[:2]
            terrain_rates = self._terrain_rates(data, car)
        wrench = jnp.concatenate([to_body_frame(car.yaw, force), car.torque[2:]])
        rates = model(car.state, command, car.params, wrench)._asdict() | terrain_rates
        return {name: rate for name, rate in rates.items() if rate is not None}

    def _terrain_rates(self, data: SimData, car: CarData) -> dict[str, Array]:
        """Return the rates of position and normal of one car that follows terrain."""
        height, normal = ground_at(data, car.pos)
        vel, settling_rate = car.vel, 1 / max(SETTLING_TIME, 2 / data.core.freq)
        climb_rate = -(normal[:1] * vel[:1] + normal[1:2] * vel[1:2]) / normal[2:]
        settling_vel = settling_rate * (height + self.model.number("wheels.radius") - car.pos[2:])
        return {
            "pos": jnp.concatenate([vel[:2], climb_rate + settling_vel]),
            "normal": settling_rate * (normal - car.normal),
        }

    def move_objects(self, data: SimData) -> Objects:
        return appearance.move_cars(data.objects, self, self.read(data))  # type: ignore[arg-type]

    @property
    def moved_kinds(self) -> tuple[str, ...] | None:
        return appearance.part_names(self)

    @property
    def moves_objects(self) -> bool:
        return self.in_scene

    def _check_settings(self, vehicle: VehicleModel) -> None:
        """Check settings that are not numbers."""
        for name, choices in (("level", ("drive", "speed")), ("reference", ("time", "arc"))):
            if getattr(self, name) not in choices:
                raise ConfigError(f"expected {name} of {self.name!r} as one of {choices}, got {getattr(self, name)!r}")
        for name in ("controller", "index", "start"):
            if getattr(self, name) is not None and self.path is None:
                raise ConfigError(f"expected a path for {name} of {self.name!r}, got none. Use Cars(path=...).")
        if self.trailer and not vehicle.has_trailer:
            raise ConfigError(f"expected a vehicle with a table [trailer], got {vehicle.name!r}. Use 'aiml_head'.")

    def _paths(self) -> Path | None:
        """Return all paths in one record."""
        if self.path is None:
            return None
        paths = [self.path] if isinstance(self.path, (Path, Trajectory)) else self.path
        if not isinstance(paths, Sequence) or not all(isinstance(x, (Path, Trajectory)) for x in paths):
            raise ConfigError(
                f"expected a Path, a Trajectory or a sequence of them, got {self.path!r}. Use "
                f"Path.of_points([(0, 0), (1, 0), (2, 1)])."
            )
        return Path.stack([Path.of_trajectory(x) if isinstance(x, Trajectory) else x for x in paths])

    def _path_indices(self, paths: Path) -> ArrayLike:
        return np.arange(self.n_members) % paths.n_paths if self.index is None else self.index


def _repeat_for_members(record: PyTree | None, counts: tuple[int, int]) -> PyTree | None:
    """Return the record of one member repeated for all members."""
    return None if record is None else jax.tree.map(lambda x: np.array(np.broadcast_to(x, (*counts, *x.shape))), record)


class Bicycles(Cars):
    """Bicycles of AIMotionLab-Virtual: the motor reference is the torque of the rear wheel, N m; no steering."""

    vehicle: VehicleSource = "bicycle"
    name: str = "bicycles"
    prefix: ClassVar[str] = "Bicycle"
