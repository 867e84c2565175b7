"""Commands to drones as immutable records, and their parsing from messages."""

from __future__ import annotations

import math
from dataclasses import dataclass

from crazysim.errors import ConfigError, require
from crazysim.lab.live.framing import Message, ShowFile
from crazysim.lab.show_files import Show
from crazysim.lab.show_files.show_trajectory import parse_trajectory
from crazysim.lab.show_files.skyc import parse_show
from crazysim.lab.trajectory_files import checks
from crazysim.trajectories import Trajectory

MAX_HEIGHT = 100.0
"""Greatest height of a take-off, m."""


@dataclass(frozen=True)
class TakeOff:
    """Take off to a height, m, above the floor."""

    drone: int | None
    """ID of the drone; None for all."""
    height: float
    """Height, m."""


@dataclass(frozen=True)
class Land:
    """Land below the present position."""

    drone: int | None
    """ID of the drone; None for all."""


@dataclass(frozen=True)
class Hover:
    """Stay at the present setpoint."""

    drone: int | None
    """ID of the drone; None for all."""


@dataclass(frozen=True, eq=False)
class Upload:
    """Receive a trajectory, to be started later."""

    drone: int | None
    """ID of the drone; None for all."""
    trajectory: Trajectory
    """Trajectory."""


@dataclass(frozen=True)
class Start:
    """Start the trajectory that was received last."""

    drone: int | None
    """ID of the drone; None for all."""
    relative: bool = False
    """Whether the trajectory is shifted to start at the present setpoint."""


@dataclass(frozen=True)
class SetParameter:
    """Change a parameter of the drone's firmware."""

    drone: int | None
    """ID of the drone; None for all."""
    name: str
    """Name of the parameter."""
    value: float
    """New value."""


@dataclass(frozen=True)
class StartShow:
    """Start the trajectories of all drones that have received one."""


@dataclass(frozen=True, eq=False)
class LoadShow:
    """Receive the trajectories of a show; the first trajectory is for the first drone."""

    show: Show
    """Show."""


Command = TakeOff | Land | Hover | Upload | Start | SetParameter | StartShow | LoadShow
"""A command to one drone or to all drones."""


def parse_command(message: Message | ShowFile, drone: int | None = None) -> Command:
    """Return the command in a message.

    Args:
        drone: ID of the drone if the message has none; None for all.
    """
    if isinstance(message, ShowFile):
        return LoadShow(parse_show(message.content, "a received show"))
    drone = drone if message.drone is None else message.drone or None  # ID 00 addresses all drones
    name, argument = message.command, message.argument
    if name in ("upload", "traj"):
        if message.payload is None:
            raise ConfigError(f"expected a trajectory in JSON after {name!r}, got none")
        value = checks.parse_json(message.payload, "a received trajectory")
        return Upload(drone, parse_trajectory(value, "a received trajectory")[0])
    require(message.payload is None, f"expected no JSON after {name!r}, got one")
    if name == "takeoff":
        return TakeOff(drone, _parse_number(argument, 0.0, MAX_HEIGHT))
    if name == "start":
        require(
            argument.lower() in ("absolute", "abs", "relative", "rel", ""),
            f"expected start_absolute or start_relative, got {argument!r}",
        )
        return Start(drone, argument.lower().startswith("rel"))
    if name == "param":
        parameter, separator, value = argument.partition("=")
        require(separator and parameter, f"expected param_NAME=VALUE, got {argument!r}")
        return SetParameter(drone, parameter, _parse_number(value, -math.inf, math.inf))
    commands_without_argument = {"land": Land, "hover": Hover}
    if name in commands_without_argument:
        return commands_without_argument[name](drone)
    if name == "show":
        return StartShow()
    raise ConfigError(f"expected takeoff, land, hover, upload, start, param or show, got {name!r}")


def _parse_number(text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ConfigError(f"expected a number, got {text[:40]!r}") from None
    require(
        math.isfinite(value) and low < value <= high,
        f"expected a number above {low:g} and up to {high:g}, got {value!r}",
    )
    return value
