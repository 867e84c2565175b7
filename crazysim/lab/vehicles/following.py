"""Controllers that follow paths: base class with path errors and speed control, pure pursuit, and Stanley's law."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple, dataclass_transform

import jax.numpy as jnp
from jax import Array

from crazysim.core.plugin import as_tuples
from crazysim.core.settings import check_settings, setting
from crazysim.engine.pytree import PyTree
from crazysim.errors import ConfigError
from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState, to_world_frame
from crazysim.lab.vehicles.model import VehicleModel
from crazysim.lab.vehicles.path import Path
from crazysim.rotation import clip, safe_arctan2


class PathState(NamedTuple):
    """A vehicle relative to its path at one instant.

    Offset, heading error and curvature refer to the path in the direction in which the vehicle points. If the path is
    driven backwards, this direction is opposite to the direction of the path.

    A reference by time prescribes the position along the path and the speed at each time. A reference by arc length
    prescribes only the speed, at the position where the vehicle is.
    """

    path: Path
    """The paths."""
    index: Array
    """Index of the vehicle's path. ()"""
    arc: Array
    """Arc length of the projection of the vehicle, m. (1,)"""
    offset: Array
    """Distance of the vehicle's projected point from the path, m, positive if the point is left of the path. (1,)"""
    heading_error: Array
    """Heading relative to the path, rad, from -pi to pi, positive to the left. (1,)"""
    curvature: Array
    """Signed curvature of the path, 1/m. (1,)"""
    speed: Array
    """Reference speed, m/s; negative backwards. (1,)"""
    lag: Array
    """Distance along the path from the vehicle to its reference position at this time, m, positive if the vehicle
    points towards it; zero for a reference by arc length. (1,)"""

    @property
    def direction(self) -> Array:
        """1 forwards and -1 backwards. (1,)"""
        return jnp.where(self.speed < 0, -1.0, 1.0)


def path_state(
    state: CarState, path: Path, index: Array, guess: Array, reference_offset: Array, time: Array | None
) -> PathState:
    """Return the state of a vehicle relative to its path.

    Args:
        index: Index of the vehicle's path. ()
        guess: Arc length near the projection of the vehicle, m. (1,)
        reference_offset: Distance from the centre of mass forwards to the point of the vehicle that is projected, m.
            (1,)
        time: Time since the start for a reference by time, s; None for a reference by arc length. ()
    """
    heading = jnp.concatenate([jnp.cos(state.yaw), jnp.sin(state.yaw)])
    reference_pos = state.pos[:2] + reference_offset * heading
    arc = path.project(index, reference_pos, guess[0])
    point = path.point_at(index, arc)
    is_backwards = path.speed_at(index, jnp.zeros_like(arc)) < 0
    sign = jnp.where(is_backwards, -1.0, 1.0)
    tangent, offset = sign * point.tangent, reference_pos - point.pos
    cross = tangent[0] * heading[1] - tangent[1] * heading[0]
    dot = tangent[0] * heading[0] + tangent[1] * heading[1]
    if time is None:
        speed, lag = path.speed_at(index, (arc - sign * reference_offset)[0]), jnp.zeros_like(guess)
    else:
        reference_arc, speed = path.time_reference(index, time)
        lag = sign * (reference_arc - arc) + reference_offset  # of the centre of mass
    return PathState(
        path=path,
        index=index,
        arc=arc[None],
        offset=(tangent[0] * offset[1] - tangent[1] * offset[0])[None],
        heading_error=safe_arctan2(cross, dot)[None],
        curvature=sign * point.curvature,
        speed=speed,
        lag=lag,
    )


def motor_reference(speed: Array, acc: Array, car: CarParams) -> Array:
    """Return the motor reference that holds a speed and accelerates from it, on level ground. (..., 1)

    Args:
        speed: Speed, m/s. (..., 1)
        acc: Acceleration, m/s^2. (..., 1)
    """
    sign = speed / jnp.sqrt(speed * speed + car.slip_speed * car.slip_speed)
    damping, friction = car.drive[..., 1:2] + car.rolling[..., :1], car.drive[..., 2:] + car.rolling[..., 1:]
    force = (car.mass + car.towed_mass) * acc + damping * speed + friction * sign
    return force / car.drive[..., :1]


@dataclass_transform(frozen_default=True, field_specifiers=(setting, dataclasses.field))
@dataclasses.dataclass(frozen=True, kw_only=True)
class PathController:
    """Base class of controllers that follow paths, including their speed control.

    A subclass lists its settings as annotated fields with defaults and overrides ``steering``; it becomes a frozen
    dataclass. Its methods are pure and written for one vehicle.
    """

    can_reverse: ClassVar[bool] = True
    """Whether the controller can drive backwards."""
    position_gain: float = setting(default=4.0, low=0.0)
    """Acceleration per distance from a reference by time, 1/s^2."""
    speed_gain: float = setting(default=4.0, low=0.0)
    """Acceleration per error of the speed, 1/s."""
    reference_max: float = setting(default=0.25, low=0.0)
    """Largest magnitude of the motor reference, in the unit of the vehicle's motor reference."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        dataclasses.dataclass(frozen=True)(cls)

    def __post_init__(self) -> None:
        check_settings(self)
        for field in dataclasses.fields(self):  # cars with equal controllers have data of one structure
            object.__setattr__(self, field.name, as_tuples(getattr(self, field.name)))

    def check(self, vehicle: VehicleModel, path: Path) -> None:
        """Check that the controller suits vehicle and path."""
        name = type(self).__name__
        if path.goes_backwards and not self.can_reverse:
            raise ConfigError(
                f"expected a path that {name} can drive forwards, got negative speeds. Use PurePursuit() or PathLQR()."
            )
        if not vehicle.number("steering.angle_max") > 0:
            raise ConfigError(f"expected a vehicle that steers for {name}, got {vehicle.name!r}, which cannot")

    def gains(self, vehicle: VehicleModel, car: CarParams, freq: int) -> PyTree | None:
        """Return gains in a record of leaves of scope ``shared`` or ``parameter``, or None.

        Args:
            freq: Rate of the controller, Hz.
        """
        return None

    def memory(self) -> PyTree | None:
        """Return the memory of one vehicle at the start, in a record of leaves of scope ``member``, or None."""
        return None

    def reference_offset(self, car: CarParams) -> Array:
        """Return the distance from the centre of mass to the point of the vehicle that follows the path, m. (1,)"""
        return jnp.zeros_like(car.front)

    def steering(
        self, state: CarState, tracking: PathState, memory: Any, gains: Any, car: CarParams
    ) -> tuple[Array, Any]:
        """Return the steering angle, rad (1,), and the memory.

        Args:
            tracking: The vehicle relative to its path.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define steering")

    def driving(self, state: CarState, tracking: PathState, gains: Any, car: CarParams) -> Array:
        """Return the motor reference that reduces the errors of speed and, for a reference by time, position. (1,)"""
        acc = self.position_gain * tracking.lag + self.speed_gain * (tracking.speed - state.body_vel[:1])
        return motor_reference(tracking.speed, acc, car)

    def update(
        self, state: CarState, tracking: PathState, memory: Any, gains: Any, car: CarParams
    ) -> tuple[Array, Any]:
        """Return motor reference and steering angle, rad (2,), and the memory."""
        steer, memory = self.steering(state, tracking, memory, gains, car)
        drive = clip(self.driving(state, tracking, gains, car), -self.reference_max, self.reference_max)
        return jnp.concatenate([drive, clip(steer, -car.steer_max, car.steer_max)]), memory


class PurePursuit(PathController):
    """Pure pursuit: the rear axle drives on the circle to a point ahead on the path.

    The steering angle d is ``tan(d) = L 2 y / (x^2 + y^2)`` with the wheelbase L and the point (x, y) relative to the
    rear axle; the formula also holds backwards. Coulter, "Implementation of the Pure Pursuit Path Tracking Algorithm",
    1992. The controller needs no gains. It cuts corners: where the curvature jumps, the offset is about a tenth of the
    jump times the square of the look-ahead distance.
    """

    lookahead: float = setting(default=0.3, positive=True)
    """Look-ahead distance at standstill, m."""
    lookahead_time: float = setting(default=0.25, low=0.0)
    """Growth of the look-ahead distance with speed, s."""

    def reference_offset(self, car: CarParams) -> Array:
        return -car.rear

    def steering(
        self, state: CarState, tracking: PathState, memory: Any, gains: Any, car: CarParams
    ) -> tuple[Array, Any]:
        distance = self.lookahead + self.lookahead_time * jnp.abs(state.body_vel[0])
        goal = tracking.path.point_at(tracking.index, tracking.arc[0] + distance).pos
        axle = state.pos[:2] - car.rear * jnp.concatenate([jnp.cos(state.yaw), jnp.sin(state.yaw)])
        offset = to_world_frame(-state.yaw, goal - axle)
        squared_distance = offset[:1] * offset[:1] + offset[1:] * offset[1:]
        # Past the end of an open path the goal is the end of the path. Its distance may be arbitrarily small.
        curvature = 2 * offset[1:] / jnp.maximum(squared_distance, 0.25 * self.lookahead * self.lookahead + 1e-4)
        return jnp.arctan((car.front + car.rear) * curvature), memory


class Stanley(PathController):
    """Stanley's law: front wheels along the path, plus an angle that grows with the offset of the front axle.

    The steering angle is ``-heading_error - arctan(k offset / (v_0 + v))`` with the speed v (Hoffmann, Tomlin,
    Montemerlo and Thrun, "Autonomous Automobile Trajectory Tracking for Off-Road Driving", 2007). Forwards only.
    """

    can_reverse: ClassVar[bool] = False
    gain: float = setting(default=2.5, low=0.0)
    """Gain k, 1/s."""
    soft_speed: float = setting(default=0.5, positive=True)
    """Speed v_0 that is added to the vehicle's speed, so that slow vehicles steer gently, m/s."""

    def reference_offset(self, car: CarParams) -> Array:
        return car.front

    def steering(
        self, state: CarState, tracking: PathState, memory: Any, gains: Any, car: CarParams
    ) -> tuple[Array, Any]:
        speed = self.soft_speed + jnp.abs(state.body_vel[:1])
        return -tracking.heading_error - jnp.arctan(self.gain * tracking.offset / speed), memory
