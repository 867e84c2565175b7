"""Piloting a drone by keyboard, gamepad and clicks: sticks move the setpoint of a state command."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.control import Control
from crazysim.errors import require
from crazysim.lab.live.attitude import from_yaw, yaw_from_quat
from crazysim.lab.live.loop import Live

Sticks = Callable[[Live], NDArray]
"""Function of the loop that returns forward, left, up and turn left, each from -1 to 1. (4,)"""

STICK_KEYS = (("up", "down"), ("left", "right"), ("w", "s"), ("a", "d"))
"""Pairs of keys: forward and back, left and right, up and down, turn left and turn right."""
MAX_LEAD = 0.7
"""Longest time by which the setpoint leads the drone at full speed, s. The limit keeps the setpoint close when a stick
is released or the drone is held back."""


def keyboard_sticks(live: Live) -> NDArray:
    """Return the stick deflections for the arrow keys and W, S, A, D that are held. (4,)"""
    return np.array([live.keyboard.axis(*keys) for keys in STICK_KEYS])


def move_setpoint(setpoint: ArrayLike, sticks: ArrayLike, dt: float, speed: float, yaw_rate: float) -> NDArray:
    """Return a setpoint after the sticks have moved it for a time ``dt``, in axes that turn with its yaw.

    Args:
        setpoint: Position, world frame, m, and yaw, rad. (4,)
        sticks: Forward, left, up and turn left, from -1 to 1. (4,)
        dt: Time, s.
        speed: Speed at full deflection, m/s.
        yaw_rate: Yaw rate at full deflection, rad/s.
    """
    (x, y, z, yaw), (forward, left, up, turn) = np.asarray(setpoint, float), np.asarray(sticks, float)
    c, s = np.cos(yaw), np.sin(yaw)
    step = speed * dt
    return np.array(
        [x + step * (c * forward - s * left), y + step * (s * forward + c * left), z + step * up,
         np.remainder(yaw + yaw_rate * dt * turn + np.pi, 2 * np.pi) - np.pi]
    )  # fmt: skip


class Pilot:
    """Pilot of the selected drone, a process of a live loop: ``live.add(Pilot())``.

    Arrow keys move the setpoint forwards, backwards and sideways, relative to its yaw; W and S move it up and down; A
    and D turn it. The state controller makes the drone follow. With ``live.on_click = pilot.go_to``, a click
    on the ground in a viewer sends the drone there.
    """

    def __init__(
        self,
        sticks: Sequence[Sticks] = (keyboard_sticks,),
        speed: float = 1.0,
        yaw_rate: float = 1.5,
        low: ArrayLike = (-np.inf, -np.inf, 0.1),
        high: ArrayLike = (np.inf, np.inf, 10.0),
    ):
        for name, value in (("speed", speed), ("yaw_rate", yaw_rate)):
            require(np.isfinite(value) and value > 0, f"expected a positive {name}, got {value!r}")
        self._low, self._high = (np.broadcast_to(np.asarray(x, float), 3) for x in (low, high))
        require((self._low <= self._high).all(), f"expected low <= high, got {low!r} and {high!r}")
        self._sticks, self._speed, self._yaw_rate = tuple(sticks), float(speed), float(yaw_rate)

    def __call__(self, live: Live) -> None:
        require_state_control(live)
        sticks = np.clip(sum(source(live) for source in self._sticks), -1.0, 1.0)
        if live.selected is None or not np.any(sticks):
            return
        command = live.command[live.selected]
        point = move_setpoint(command_setpoint(command), sticks, 1.0 / live.control_freq, self._speed, self._yaw_rate)
        pos = np.asarray(live.sim.data.states.pos, float)[live.selected]
        max_distance = MAX_LEAD * self._speed
        point[:3] = np.clip(np.clip(point[:3], pos - max_distance, pos + max_distance), self._low, self._high)
        hold_setpoint(command, point)

    def go_to(self, live: Live, world: int, point: ArrayLike) -> None:
        """Move the setpoint of the selected drone, if it is in that world, above a point.

        The setpoint keeps its height, but rises to at least 0.5 m and the lower limit of the height. The state
        controllers limit the position error that they correct, so the drone does not overturn on the way.

        Args:
            point: Point, world frame, m. (3,)
        """
        require_state_control(live)
        if live.selected is None or live.selected[0] != world:
            return
        command = live.command[live.selected]
        x, y, _ = np.clip(point, self._low, self._high)
        _, _, z, yaw = command_setpoint(command)
        hold_setpoint(command, [x, y, max(z, self._low[2], 0.5), yaw])


def require_state_control(live: Live) -> None:
    """Check that setpoints can be commanded."""
    require(
        live.sim.control == Control.state,
        f"expected a simulation with control='state', got {live.sim.control.value!r}. Use Sim(control='state').",
    )


def command_setpoint(command: NDArray) -> NDArray:
    """Return position, m, and yaw, rad, of a state command. (4,)"""
    return np.append(command[:3], yaw_from_quat(command[9:13]))


def hold_setpoint(command: NDArray, point: NDArray | Sequence[float]) -> None:
    """Write a setpoint at rest into a state command.

    Args:
        command: State command. (16,)
        point: Position, world frame, m, and yaw, rad. (4,)
    """
    command[:] = 0.0
    command[:3], command[9:13] = point[:3], from_yaw(point[3])
