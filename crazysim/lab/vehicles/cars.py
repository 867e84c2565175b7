"""Cars: a population of ground vehicles, driven by commands or along paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import Objects, SimData
from crazysim.core.plugin import Param, Simulation, StagePlacement, check_parameter, nested, param, state
from crazysim.core.population import Population
from crazysim.core.settings import color, default_rates
from crazysim.dynamics.models import GRAVITY
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import PyTree, device_array
from crazysim.errors import ConfigError
from crazysim.lab.vehicles import appearance, starts
from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState, tilted_quat, to_body_frame, to_world_frame
from crazysim.lab.vehicles.following import PathController, PurePursuit, motor_reference, path_state
from crazysim.lab.vehicles.kinematic import kinematic
from crazysim.lab.vehicles.model import VehicleModel, VehicleSource, load_vehicle
from crazysim.lab.vehicles.path import Path
from crazysim.lab.vehicles.single_track import single_track
from crazysim.plugins.effects.ground import HeightField, ground_at
from crazysim.tables import range_between
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
    pos: Param = param(default=None, core=(3,), scope="member")
    """Position of the centre of mass, world frame, m (n_worlds, n_members, 3); of the plugin that is added, x and y
    (2,), or for each; None for the start of the path, or a row along y with gaps of 1 m."""
    yaw: Param = param(default=None, scope="member")
    """Heading, rad, not wrapped; None for the path's heading, or zero. (n_worlds, n_members, 1)"""
    level: Literal["drive", "speed"] = "drive"
    """Command level of cars without a path."""
    path: Path | Trajectory | Sequence[Path | Trajectory] | None = nested(default=None)
    """Path, trajectory, or a sequence of them to follow; None to drive by commands."""
    controller: PathController | None = None
    """Controller that follows paths; None for ``PurePursuit()``."""
    reference: Literal["time", "arc"] = "time"
    """``time`` to keep to the timing of the path; ``arc`` to drive at the speed of the path where the car is."""
    index: Param = param(default=None, whole=True, dtype=np.int32)
    """Index of each car's path; with None, car i follows path i modulo the number of paths. A
    number for each of them, (n_members,), or (n_worlds, n_members, 1), as the data has it."""
    start: Param = param(default=None)
    """Time at which a car is at the start of its path, s; None for zero, or equal intervals for the cars of one closed
    path. (n_worlds, n_members, 1)"""
    trailer: bool = False
    """True for cars that tow a trailer."""
    freq: int | None = None
    """Rate of the controller, Hz, a divisor of the simulation's rate; None for the largest one up to 50 Hz."""
    rgba: ArrayLike | None = color()
    """Colour; None for the default. (4,)"""
    in_scene: bool = True
    """Whether to put the cars into the scene, where they are drawn and reported as contacts of drones."""
    name: str = "cars"
    body_vel: Array = state((2,), scope="member")
    """Forward and left velocity of the centre of mass, body frame, m/s. (n_worlds, n_members, 2)"""
    yaw_rate: Array = state(scope="member")
    """Rate of the heading, rad/s. (n_worlds, n_members, 1)"""
    normal: Array = state((3,), scope="member")
    """Unit normal of the ground below, upwards, world frame; it follows terrain with a time constant of
    ``SETTLING_TIME``. (n_worlds, n_members, 3)"""
    steer: Array = state(scope="member")
    """Steering angle in the middle of the front axle, rad, positive to the left. (n_worlds, n_members, 1)"""
    distance: Array = state(scope="member")
    """Distance that the wheels rolled, m; backwards it decreases. (n_worlds, n_members, 1)"""
    joints: Array | None = state((2,), scope="member", optional=True)
    """Headings of the trailer's drawbar and deck, rad, not wrapped; None without trailers. (n_worlds, n_members, 2)"""
    command: Array = state((2,), scope="member")
    """Motor reference, 1, or speed, m/s, depending on the command level, followed by the steering angle, rad.
    (n_worlds, n_members, 2)"""
    applied_command: Array | None = state((2,), scope="member", optional=True)
    """Motor reference and steering angle, rad, of the last tick of the controller; None at the level ``drive``, where
    they are the command. (n_worlds, n_members, 2)"""
    force: Array = state((3,), scope="member")
    """External force on the centre of mass, world frame, N; kept until it is changed. (n_worlds, n_members, 3)"""
    torque: Array = state((3,), scope="member")
    """External torque, world frame, N m, of which only z acts; kept until it is changed. (n_worlds, n_members, 3)"""
    arc: Array | None = state(scope="member", optional=True)
    """Arc length of the car's projection on its path, m. (n_worlds, n_members, 1)"""
    params: Any = nested(default=None)
    """Parameters of the dynamics, ``CarParams``."""
    memory: Any = nested(default=None)
    """Memory of the path controller."""
    gains: Any = nested(default=None)
    """Gains of the path controller."""
    prefix: ClassVar[str] = "Fleet1Tenth"
    positions: ClassVar[tuple[str, ...]] = ("pos", "yaw", "distance")
    command_field: ClassVar[str | None] = "command"

    @property
    def state(self) -> CarState:
        """State of the dynamics."""
        return CarState(**{name: getattr(self, name) for name in CarState._fields})

    @property
    def quat(self) -> Array:
        """Attitude, body to world, xyzw. (n_worlds, n_members, 4)"""
        return tilted_quat(self.yaw, self.normal)

    @property
    def vel(self) -> Array:
        """Velocity of the centre of mass, world frame, m/s; z is zero even on slopes. (n_worlds, n_members, 3)"""
        return _level_vel(self.yaw, self.body_vel)

    @property
    def ang_vel(self) -> Array:
        """Angular velocity, body frame, rad/s. (n_worlds, n_members, 3)"""
        return _ang_vel_about_z(self.yaw_rate)

    def with_vel(self, vel: Array, ang_vel: Array) -> Cars:
        """Return the cars with other velocities; only the horizontal velocity and the yaw rate are used.

        Args:
            vel: Velocity of the centre of mass, world frame, m/s. (..., 3)
            ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        """
        return self.replace(body_vel=to_body_frame(self.yaw, vel[..., :2]), yaw_rate=ang_vel[..., 2:])

    def with_poses(self, pos: Array, quat: Array) -> Cars:
        yaw = rotation.yaw(quat)[..., None]
        joints = None if self.joints is None else jnp.broadcast_to(yaw, self.joints.shape)
        return self.replace(pos=pos, yaw=yaw, joints=joints)

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

    @property
    def needs_controller(self) -> bool:
        """Whether a controller calculates the motor reference; commands of the level ``drive`` need none."""
        return self.level != "drive" or self.path_controller is not None

    def check_settings(self) -> None:
        super().check_settings()
        if isinstance(self.vehicle, Mapping):
            object.__setattr__(self, "vehicle", self.model)  # hashable

    def bind(self, sim: Simulation) -> Cars:
        vehicle, freq, counts = self.model, sim.data.core.freq, (sim.n_worlds, self.n_members)
        self._check_choices(vehicle)
        paths, controller = self._paths(), self.path_controller
        index = start = arc = gains = memory = None
        control_freq = self.freq or default_rates(freq, {"freq": CONTROL_FREQ}, f" of {self.name!r}")["freq"]
        params = CarParams.create(vehicle, freq, self.trailer)
        # Without a path, cars stand in a row.
        pos, yaw = starts.row_positions(self.n_members), np.zeros((self.n_members, 1))
        if paths is not None and controller is not None:
            controller.check(vehicle, paths)
            index = check_parameter(
                sim, "index", self._path_indices(paths), allowed=range_between(0, paths.n_paths - 1),
                dtype=np.int32, n_members=self.n_members,
            )  # fmt: skip
            index = np.broadcast_to(index, (*counts, 1))
            start = starts.spread_start_times(paths, index, self.n_members) if self.start is None else self.start
            start = np.broadcast_to(check_parameter(sim, "start", start, n_members=self.n_members), (*counts, 1))
            pos, yaw, arc = starts.path_poses(paths, index, start, counts)
            gains, memory = controller.gains(vehicle, params, control_freq), controller.memory()
        # The user's positions take precedence.
        if self.pos is not None:
            check_parameter(sim, "pos", self.pos, (2,), n_members=self.n_members)
            pos = self.pos
        pos = np.broadcast_to(np.asarray(pos, float), (*counts, 2))
        if arc is not None and self.pos is not None:
            arc = starts.project_arcs(paths, index, pos, arc)
        # Wheels stand on the ground.
        height, normal = ground_at(sim.data, device_array(np.concatenate([pos, pos[..., :1]], axis=-1)))
        z = np.asarray(height) + vehicle.number("wheels.radius")
        start_poses = self.replace(pos=np.concatenate([pos, z], axis=-1), yaw=yaw if self.yaw is None else self.yaw)
        zeros = device_array(np.zeros((*counts, 2)))
        cars = start_poses.with_arrays(
            sim,
            freq=control_freq,
            normal=normal,
            applied_command=zeros if self.needs_controller else None,
            params=params,
            path=paths,
            index=index if index is None else device_array(index, np.int32),
            start=start if start is None else device_array(start),
            arc=arc if arc is None else device_array(arc),
            memory=_repeat_for_members(memory, counts),
            gains=gains,
        )
        if self.in_scene:
            appearance.add_to_scene(sim, self, vehicle)
        return cars.replace(joints=device_array(np.tile(cars.yaw, 2))) if self.trailer else cars

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        placements = super().stages(sim)
        return placements if self.needs_controller else placements[1:]

    def control(self, data: SimData) -> Cars:
        controller = self.path_controller
        if controller is None:
            acc = SPEED_GAIN * (self.command[:1] - self.body_vel[:1])
            drive = motor_reference(self.command[:1], acc, self.params)
            return self.replace(applied_command=jnp.concatenate([drive, self.command[1:]]))
        time = data.core.steps / data.core.freq - self.start[0] if self.reference == "time" else None
        offset = controller.reference_offset(self.params)
        tracking = path_state(self.state, self.path, self.index[0], self.arc, offset, time)  # type: ignore[arg-type]
        applied_command, memory = controller.update(self.state, tracking, self.memory, self.gains, self.params)
        return self.replace(applied_command=applied_command, arc=tracking.arc, memory=memory)

    def derivative(self, data: SimData) -> Mapping[str, Array]:
        model = kinematic if self.model.dynamics == "kinematic" else single_track
        command = self.command if self.applied_command is None else self.applied_command
        force, terrain_rates = self.force[:2], {}
        if any(isinstance(record, HeightField) for record in data.plugins.values()):
            force = force - GRAVITY[2] * self.params.mass * self.normal[2:] * self.normal[:2]
            terrain_rates = self._terrain_rates(data)
        wrench = jnp.concatenate([to_body_frame(self.yaw, force), self.torque[2:]])
        rates = model(self.state, command, self.params, wrench)._asdict() | terrain_rates
        return {name: rate for name, rate in rates.items() if rate is not None}

    def _terrain_rates(self, data: SimData) -> dict[str, Array]:
        height, normal = ground_at(data, self.pos)
        vel, settling_rate = self.vel, 1 / max(SETTLING_TIME, 2 / data.core.freq)
        climb_rate = -(normal[:1] * vel[:1] + normal[1:2] * vel[1:2]) / normal[2:]
        settling_vel = settling_rate * (height + self.model.number("wheels.radius") - self.pos[2:])
        return {
            "pos": jnp.concatenate([vel[:2], climb_rate + settling_vel]),
            "normal": settling_rate * (normal - self.normal),
        }

    def move_objects(self, data: SimData) -> Objects:
        return appearance.move_cars(data.objects, self)  # type: ignore[arg-type]

    @property
    def moved_kinds(self) -> tuple[str, ...] | None:
        return appearance.part_names(self)

    @property
    def moves_objects(self) -> bool:
        return self.in_scene

    def _check_choices(self, vehicle: VehicleModel) -> None:
        for name, choices in (("level", ("drive", "speed")), ("reference", ("time", "arc"))):
            if getattr(self, name) not in choices:
                raise ConfigError(f"expected {name} of {self.name!r} as one of {choices}, got {getattr(self, name)!r}")
        for name in ("controller", "index", "start"):
            if getattr(self, name) is not None and self.path is None:
                raise ConfigError(f"expected a path for {name} of {self.name!r}, got none. Use Cars(path=...).")
        if self.trailer and not vehicle.has_trailer:
            raise ConfigError(f"expected a vehicle with a table [trailer], got {vehicle.name!r}. Use 'aiml_head'.")

    def _paths(self) -> Path | None:
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
    return None if record is None else jax.tree.map(lambda x: np.array(np.broadcast_to(x, (*counts, *x.shape))), record)


@jit_eager_calls()
def _level_vel(yaw: Array, body_vel: Array) -> Array:
    level_vel = to_world_frame(yaw, body_vel)
    return jnp.concatenate([level_vel, jnp.zeros_like(yaw)], axis=-1)


@jit_eager_calls()
def _ang_vel_about_z(yaw_rate: Array) -> Array:
    zero = jnp.zeros_like(yaw_rate)
    return jnp.concatenate([zero, zero, yaw_rate], axis=-1)


class Bicycles(Cars):
    """Bicycles of AIMotionLab-Virtual: the motor reference is the torque of the rear wheel, N m; no steering."""

    vehicle: VehicleSource = "bicycle"
    name: str = "bicycles"
    prefix: ClassVar[str] = "Bicycle"


CarData = Cars
"""What ``data.plugins`` has: the same class, with arrays."""
