"""Commander of one drone: the choice of the active setpoint, as in the firmware of the Crazyflie.

High-level commands plan smooth motions. Streamed setpoints take precedence until they stop: after 0.5 s without a
setpoint the drone holds its position, and after 2 s its motors stop (``COMMANDER_WDT_TIMEOUT_STABILIZE`` and
``_SHUTDOWN`` in commander.h of crazyflie-firmware). Each streamed setpoint discards the planned motion. A motion that
is planned while setpoints are streamed begins at the drone's own state (``commanderSetSetpoint`` in commander.c, and
``crtpCommanderHighLevelGetSetpoint`` in crtp_commander_high_level.c). Until the first command, and after landing, the
motors are off.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.control import Control
from crazysim.errors import ConfigError, require
from crazysim.lab.live.attitude import yaw_from_quat
from crazysim.lab.live.host_trajectory import HostTrajectory
from crazysim.lab.live.swarm.motion import PlannedMotion, nearest_yaw, plan_move
from crazysim.lab.live.swarm.state import DroneState, EstimateFrame

STABILIZE_TIMEOUT, SHUTDOWN_TIMEOUT = 0.5, 2.0
"""Time without a streamed setpoint after which the drone holds its position, and after which its motors stop, s."""
MAX_COORDINATE = 1e3
"""Largest magnitude of a coordinate, m, and of most other numbers in commands."""
SINK_SPEED, MAX_SINK = 0.3, 1.0
"""Speed, m/s, and largest distance, m, by which the setpoint descends further if a landing ends above its target."""
LANDED_HEIGHT, RESTING_SPEED, REST_TIME = 0.01, 0.02, 0.5
"""A landing stops the motors at or below this height above its target, m. It also stops them if the vertical speed is
below this limit, m/s, later than this time after its planned end, s."""
MIN_DURATION, MAX_DURATION = 1e-3, 1e4
"""Limits of durations, s, and of factors of durations."""
N_TRAJECTORIES = 256
"""Largest number of trajectories that a drone holds; their IDs are one byte."""


class Commander:
    """Setpoints of one drone, calculated from commands; all times are simulated, s."""

    def __init__(self, control: Control = Control.state, report: Callable[[str], None] | None = None):
        self.control = control
        self._report = report
        self.group = 0  # bit mask of the groups to which the drone belongs
        self.trajectories: dict[int, HostTrajectory] = {}
        self._compressed_ids: set[int] = set()
        self.reset()

    def reset(self) -> None:
        """Return to the floor with motors off and an estimate in the world's frame; trajectories are kept."""
        self.now = 0.0
        self.pos, self.vel, self.yaw = np.zeros(3), np.zeros(3), 0.0
        self.armed, self.locked = True, False
        self._planned_motion: PlannedMotion | None = None
        self._cached_hover: tuple[PlannedMotion, NDArray] | None = None
        self.estimate_frame: EstimateFrame | None = None
        self._stream: tuple[str, NDArray] | None = None
        self._stream_time, self._release_time = 0.0, math.inf
        self._reference = np.zeros(4)  # position, m, and yaw, rad, that velocity setpoints move
        self._last_goal = np.zeros((3, 4))

    # State ----------------------------------------------------------------------------------------------------------

    @property
    def motors_on(self) -> bool:
        """Whether a command is active."""
        return self.armed and not self.locked and (self._planned_motion is not None or self._stream is not None)

    @property
    def finished(self) -> bool:
        """Whether no planned move is in progress."""
        return self._planned_motion is None or self._planned_motion.has_ended(self.now)

    def goal(self) -> NDArray:
        """Return position and yaw, and their first two derivatives, of the active setpoint or the drone. (3, 4)"""
        if self._stream is not None:
            return self._last_goal
        if self._planned_motion is not None:
            point = self._planned_motion.evaluate(self.now)
            if self._planned_motion.is_landing and self._planned_motion.has_ended(
                self.now
            ):  # the setpoint sinks until the drone has landed
                point[:2, 2] += -min(SINK_SPEED * (self.now - self._planned_motion.end_time), MAX_SINK), -SINK_SPEED
            return point
        return self._drone_motion()

    def in_group(self, mask: int) -> bool:
        """Whether a command with this group mask, 0 for all drones, addresses this drone."""
        return mask == 0 or (mask & self.group) != 0

    # High-level commands --------------------------------------------------------------------------------------------

    def take_off(self, height: float, duration: float, yaw: float | None = None) -> None:
        """Rise to a height, m, within a duration, s; a yaw of None keeps the present yaw."""
        self._move_vertically(height, duration, yaw, is_landing=False)

    def land(self, height: float, duration: float, yaw: float | None = None) -> None:
        """Descend to a height, m, and stop the motors there, or where the drone comes to rest.

        A yaw of None keeps the present yaw. A drone that is still higher at the end, because its controller lags or has
        an offset, descends further.
        """
        self._move_vertically(height, duration, yaw, is_landing=True)

    def go_to(self, goal: ArrayLike, yaw: float, duration: float, relative: bool = False, linear: bool = False) -> None:
        """Move to a position, m (3,), and yaw, rad; if ``relative``, they are added to the present setpoint."""
        goal, (yaw,) = _check_numbers("goal", goal, 3), _check_numbers("yaw", [yaw], 1)
        start = self._motion_start("go_to")
        if relative:
            goal, yaw = goal + start[0, :3], yaw + start[0, 3]
        end = [*goal, nearest_yaw(start[0, 3], yaw)]
        self._planned_motion = PlannedMotion(plan_move(start, end, _check_duration(duration), linear), self.now)

    def stop(self) -> None:
        """Stop the motors."""
        self._planned_motion = self._stream = None

    def upload(self, trajectory_id: int, trajectory: HostTrajectory, compressed: bool = False) -> None:
        """Receive a trajectory.

        Args:
            compressed: Whether the firmware stores it compressed; it can then be neither stretched nor reversed.
        """
        require(
            0 <= trajectory_id < N_TRAJECTORIES,
            f"expected the number of a trajectory from 0 to {N_TRAJECTORIES - 1}, got {trajectory_id}",
        )
        self.trajectories[trajectory_id] = trajectory
        (self._compressed_ids.add if compressed else self._compressed_ids.discard)(trajectory_id)

    def start_trajectory(
        self,
        trajectory_id: int,
        timescale: float = 1.0,
        relative: bool = True,
        reversed: bool = False,
        relative_yaw: bool = False,
    ) -> None:
        """Follow a trajectory that was uploaded.

        Args:
            timescale: Factor of the trajectory's duration.
            relative: Whether to begin at the present setpoint.
            reversed: Whether to follow it from its end to its start.
            relative_yaw: Whether to begin at the present yaw as well.
        """
        if trajectory_id not in self.trajectories:
            raise ConfigError(
                f"expected one of the trajectories {sorted(self.trajectories)}, got {trajectory_id}. Upload it."
            )
        require(
            MIN_DURATION <= timescale <= MAX_DURATION,
            f"expected a timescale from {MIN_DURATION:g} to {MAX_DURATION:g}, got {timescale}",
        )
        if trajectory_id in self._compressed_ids and (timescale != 1 or reversed):
            raise ConfigError(
                f"expected a compressed trajectory at its own speed and direction, got timescale {timescale:g}, "
                f"reversed {bool(reversed)}. The firmware supports others for uncompressed trajectories alone."
            )
        planned_motion = PlannedMotion(self.trajectories[trajectory_id], self.now, timescale, bool(reversed))
        start, first_point = self._motion_start("start_trajectory")[0], planned_motion.evaluate(self.now)[0]
        offset = np.zeros(4)
        if relative:
            offset[:3] = start[:3] - first_point[:3]
            if relative_yaw and trajectory_id not in self._compressed_ids:
                offset[3] = start[3] - nearest_yaw(start[3], first_point[3])
        self._planned_motion = planned_motion._replace(offset=offset)

    # Streamed setpoints ---------------------------------------------------------------------------------------------

    def command(self, level: Control | str, values: ArrayLike) -> None:
        """Stream a command for this drone: the numbers that ``sim.state_control``, ... take. (k,)"""
        level = Control(level)
        self._require_level(level)
        size = {Control.state: 16, Control.rotor_vel: np.size(values)}.get(level, 4)
        self._stream_setpoint("command", _check_numbers(f"{level.value} command", values, size, limit=math.inf))

    def full_state(self, pos: ArrayLike, vel: ArrayLike, acc: ArrayLike, quat: ArrayLike, ang_vel: ArrayLike) -> None:
        """Stream a state: position, m, velocity, m/s, acceleration, m/s^2, attitude, xyzw, body rates, rad/s."""
        parts = [_check_numbers("full state", x, n) for x, n in ((pos, 3), (vel, 3), (acc, 3), (quat, 4), (ang_vel, 3))]
        norm = np.linalg.norm(parts[3])
        if norm < 1e-3:
            raise ConfigError(f"expected a unit quaternion, xyzw, got {list(parts[3])}")
        parts[3] = parts[3] / norm
        self._require_level(Control.state)
        self._stream_setpoint("command", np.concatenate(parts))

    def position(self, pos: ArrayLike, yaw: float) -> None:
        """Stream a position, m (3,), and yaw, rad."""
        self._require_level(Control.state)
        self._stream_setpoint(
            "position", np.append(_check_numbers("position", pos, 3), _check_numbers("yaw", [yaw], 1))
        )

    def velocity(self, vel: ArrayLike, yaw_rate: float) -> None:
        """Stream a velocity, world frame, m/s (3,), and yaw rate, rad/s; a reference position moves with it."""
        self._require_level(Control.state)
        self._stream_setpoint(
            "velocity", np.append(_check_numbers("velocity", vel, 3), _check_numbers("yaw rate", [yaw_rate], 1))
        )

    def hover(self, vx: float, vy: float, yaw_rate: float, height: float) -> None:
        """Stream a horizontal velocity in the axes of the drone's yaw, m/s, yaw rate, rad/s, and height, m."""
        self._require_level(Control.state)
        self._stream_setpoint("hover", _check_numbers("hover setpoint", [vx, vy, yaw_rate, height], 4))

    def attitude(self, roll: float, pitch: float, yaw_rate: float, thrust: float) -> None:
        """Stream roll, pitch, rad, yaw rate, rad/s, and collective thrust, N."""
        self._require_level(Control.attitude)
        self._stream_setpoint("attitude", _check_numbers("attitude setpoint", [roll, pitch, yaw_rate, thrust], 4))

    def notify_setpoints_stop(self, remain_valid: float = 0.0) -> None:
        """Return to high-level commands after a time, s, during which the last setpoint stays active."""
        self._release_time = self.now + max(float(remain_valid), 0.0)

    # Safety ---------------------------------------------------------------------------------------------------------

    def arm(self, armed: bool = True) -> None:
        """Arm the drone; or disarm it, which stops the motors and makes it refuse commands."""
        if not armed:
            self.stop()
        self.armed = bool(armed)

    def emergency(self) -> None:
        """Stop the motors, and refuse commands until a reset."""
        self.stop()
        self.locked = True

    # The estimate ---------------------------------------------------------------------------------------------------

    def set_estimate(self, pos: NDArray, yaw: float, pose: NDArray) -> None:
        """Set the pose of the drone's estimate; commands are in the frame of that estimate from now on.

        Args:
            pos: Position, world frame, m. (3,)
            yaw: Yaw, world frame, rad.
            pose: Position, m, and yaw, rad, of the estimate. (4,)
        """
        self.estimate_frame = EstimateFrame.from_pose(pos, yaw, pose)

    def estimate(self, state: DroneState) -> DroneState:
        """Return the drone's estimate of its state."""
        return state if self.estimate_frame is None else self.estimate_frame.state_to_estimate(state)

    # The loop -------------------------------------------------------------------------------------------------------

    def tick(self, now: float, pos: NDArray, vel: NDArray, yaw: float) -> NDArray | None:
        """Return the active command, of the simulation's level and in the world's frame; None with the motors off.

        Args:
            now: Time, s.
            pos: Position, world frame, m. (3,)
            vel: Velocity, world frame, m/s. (3,)
            yaw: Yaw, world frame, rad.
        """
        frame = self.estimate_frame
        if frame is None:
            return self._active_command(now, pos, vel, yaw)
        command = self._active_command(now, *frame.motion_to_estimate(pos, vel, yaw))
        return None if command is None else frame.command_to_world(self.control, command)

    def _active_command(self, now: float, pos: NDArray, vel: NDArray, yaw: float) -> NDArray | None:
        dt, self.now = now - self.now, now
        self.pos, self.vel, self.yaw = pos, vel, yaw
        if self._stream is not None:
            age = now - self._stream_time
            if now >= self._release_time and self._planned_motion is not None:
                self._stream = None
            elif age > SHUTDOWN_TIMEOUT:
                self.stop()
            elif age > STABILIZE_TIMEOUT and self._stream[0] != "stay":
                self._stream = ("stay", np.append(pos, yaw))
        planned_motion = self._planned_motion
        is_landing_over = (
            planned_motion is not None
            and planned_motion.is_landing
            and planned_motion.has_ended(now)
            and self._has_landed(planned_motion)
        )
        if self._stream is None and is_landing_over:
            self.stop()
        if not self.motors_on:
            return None
        if self._stream is not None:
            return self._streamed_command(dt)
        if planned_motion is None or not planned_motion.has_ended(now) or planned_motion.is_landing:
            return _state_command(*self.goal())
        # The command is calculated only once while the drone hovers.
        if self._cached_hover is None or self._cached_hover[0] is not planned_motion:
            self._cached_hover = (
                planned_motion,
                _state_command(planned_motion.evaluate(now)[0], np.zeros(4), np.zeros(4)),
            )
        return self._cached_hover[1]

    def _has_landed(self, planned_motion: PlannedMotion) -> bool:
        is_standing = self.now > planned_motion.end_time + REST_TIME and abs(self.vel[2]) < RESTING_SPEED
        return is_standing or self.pos[2] <= planned_motion.evaluate(self.now)[0, 2] + LANDED_HEIGHT

    def _streamed_command(self, dt: float) -> NDArray:
        kind, x = self._stream  # type: ignore[misc]
        if self.control != Control.state:
            return self._streamed_attitude(kind, x, dt)
        if kind == "command":
            self._last_goal = np.array([[*x[:3], yaw_from_quat(x[9:13])], [*x[3:6], x[15]], [*x[6:9], 0.0]])
            self._reference = self._last_goal[0].copy()
            return x
        rate = np.zeros(4)
        if kind in ("position", "stay"):
            self._reference = x.copy()
        else:
            c, s = math.cos(self._reference[3]), math.sin(self._reference[3])
            rate = x if kind == "velocity" else np.array([c * x[0] - s * x[1], s * x[0] + c * x[1], 0.0, x[2]])
            self._reference = self._reference + dt * rate
            if kind == "hover":
                self._reference[2] = x[3]
        self._last_goal = np.array([self._reference, rate, np.zeros(4)])
        return _state_command(*self._last_goal)

    def _streamed_attitude(self, kind: str, x: NDArray, dt: float) -> NDArray:
        if kind == "attitude":
            self._reference[3] += dt * x[2]
            return np.array([x[0], x[1], self._reference[3], x[3]])
        if kind == "stay":  # level, with the thrust of the last command
            return np.array([0.0, 0.0, self._reference[3] if self.control == Control.attitude else 0.0, self._thrust])
        return x

    def _stream_setpoint(self, kind: str, values: NDArray) -> None:
        if self._stream is None:
            self._last_goal = self.goal()
            self._reference = self._last_goal[0].copy()
        self._stream, self._stream_time, self._release_time, self._planned_motion = (
            (kind, values),
            self.now,
            math.inf,
            None,
        )
        self._thrust = float(values[3]) if kind in ("command", "attitude") else 0.0

    def _move_vertically(self, height: float, duration: float, yaw: float | None, is_landing: bool) -> None:
        (height,) = _check_numbers("height", [height], 1)
        start_point = self._motion_start("land" if is_landing else "take_off")[0]
        goal = start_point.copy()
        goal[2] = height
        if yaw is not None:
            goal[3] = nearest_yaw(start_point[3], _check_numbers("yaw", [yaw], 1)[0])
        start = np.array([start_point, np.zeros(4), np.zeros(4)])
        self._planned_motion = PlannedMotion(
            plan_move(start, goal, _check_duration(duration)), self.now, is_landing=is_landing
        )

    def _drone_motion(self) -> NDArray:
        return np.array([[*self.pos, self.yaw], [*self.vel, 0.0], [0.0] * 4])

    def _motion_start(self, command: str) -> NDArray:
        # A command that has no effect because of the stream is reported.
        self._require_level(Control.state)
        if self._stream is None:
            return self.goal()
        if math.isinf(self._release_time) and self._report is not None:
            self._report(
                f"expected no streamed setpoints in force before {command}, got some: it begins after "
                f"notify_setpoints_stop, and the next streamed setpoint discards it. Call notify_setpoints_stop first."
            )
        return self._drone_motion()

    def _require_level(self, level: Control) -> None:
        require(
            not self.locked and self.armed,
            f"expected a drone that is armed, got one that is {'locked' if self.locked else 'disarmed'}",
        )
        require(
            level == self.control,
            f"expected a command that Sim(control={self.control.value!r}) takes, got one of level {level.value!r}. "
            f"Use Sim(control={level.value!r}).",
        )


def _check_numbers(name: str, values: ArrayLike, n: int, limit: float = MAX_COORDINATE) -> NDArray:
    try:
        x = np.array(values, float)
    except (TypeError, ValueError):
        raise ConfigError(f"expected {n} numbers for {name}, got {values!r}") from None
    if x.shape != (n,) or not np.isfinite(x).all() or (np.abs(x) > limit).any():
        raise ConfigError(f"expected {n} finite numbers up to {limit:g} for {name}, got {x.tolist()}")
    return x


def _check_duration(value: float) -> float:
    (value,) = _check_numbers("duration", [value], 1, MAX_DURATION)
    require(value >= MIN_DURATION, f"expected a positive duration of at least {MIN_DURATION:g} s, got {value} s")
    return value


def _state_command(point: NDArray, rate: NDArray, second_derivative: NDArray) -> NDArray:
    half_yaw = point[3] / 2
    return np.array(
        [
            *point[:3],
            *rate[:3],
            *second_derivative[:3],
            0.0,
            0.0,
            math.sin(half_yaw),
            math.cos(half_yaw),
            0.0,
            0.0,
            rate[3],
        ]
    )
