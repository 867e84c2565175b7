"""Light shows: trajectories and lights of named drones, together with cues and settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.show_files.lights import Lights
from crazysim.trajectories.trajectory import Trajectory


@dataclass(frozen=True)
class Cue:
    """A named instant of a show."""

    time: float
    """Time since the start of the show, s."""
    name: str
    """Name of the cue."""


@dataclass(frozen=True)
class ParameterChange:
    """A change of a firmware parameter of one drone during a show."""

    time: float
    """Time since the start of the show, s."""
    name: str
    """Name of the parameter, such as ``stabilizer.controller``."""
    value: float
    """New value."""


@dataclass(frozen=True, eq=False)
class Show:
    """A light show: the contents of a ``.skyc`` file."""

    names: tuple[str, ...]
    """Names of the drones, all different."""
    trajectories: Trajectory
    """Trajectories of the drones, stacked. They start with the show, at time zero. (n_drones, ...)"""
    lights: Lights
    """Lights of the drones, stacked. (n_drones, ...)"""
    cues: tuple[Cue, ...] = ()
    """Cues, in order of time."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the show other than its cues, as in ``show.json``. The entry ``validation`` has maxAltitude, m,
    maxVelocityXY and maxVelocityZ, m/s, and minDistance, m."""
    homes: NDArray = None  # type: ignore[assignment]  # replaced at construction
    """Home position of each drone, m; None for the start of its trajectory. (n_drones, 3)"""
    landings: NDArray = None  # type: ignore[assignment]  # replaced at construction
    """Landing position of each drone, m; None for the end of its trajectory. (n_drones, 3)"""
    parameters: tuple[tuple[ParameterChange, ...], ...] = ()
    """Changes of firmware parameters, one tuple for each drone; empty for no changes."""
    encodings: tuple[str, ...] = ()
    """Format in which each Crazyflie receives its trajectory: ``COMPRESSED`` or ``POLY4D``. If empty, all receive
    ``COMPRESSED``."""
    environment: str = "indoor"
    """Environment, ``indoor`` or ``outdoor``."""
    meta: Mapping[str, Any] = field(default_factory=dict)
    """Metadata, such as ``title``."""

    def __post_init__(self) -> None:
        n = len(self.names)
        if not n or len(set(self.names)) != n:
            raise ConfigError(
                f"expected one or more drones with different names, got {list(self.names)[:10]}. Rename those that "
                "repeat."
            )
        start, end = self._end_points(0.0), self._end_points(self.duration)
        defaults = {
            "homes": start[:, :3],
            "landings": end[:, :3],
            "parameters": ((),) * n,
            "encodings": ("COMPRESSED",) * n,
        }
        for name, default in defaults.items():
            value = getattr(self, name)
            if value is None or (isinstance(value, tuple) and not value):
                object.__setattr__(self, name, default)
        sizes = {name: len(getattr(self, name)) for name in defaults}
        sizes |= {"trajectories": len(self.trajectories.ends), "lights": len(self.lights.times)}
        wrong_sizes = {name: size for name, size in sizes.items() if size != n}
        require(
            not wrong_sizes,
            f"expected one entry for each of {n} drones, got {wrong_sizes}. Pass as many as there are names.",
        )

    @property
    def n_drones(self) -> int:
        """Number of drones."""
        return len(self.names)

    @property
    def duration(self) -> float:
        """Time until the last trajectory ends, s."""
        return float(np.max(self.trajectories.ends))

    def trajectory(self, drone: int) -> Trajectory:
        """Return the trajectory of one drone."""
        return jax.tree.map(lambda x: x[drone], self.trajectories)

    def light(self, drone: int) -> Lights:
        """Return the lights of one drone."""
        return jax.tree.map(lambda x: x[drone], self.lights)

    def replace(self, **changes: Any) -> Show:
        """Return a copy with the given fields replaced."""
        return dataclasses.replace(self, **changes)

    def _end_points(self, time: float) -> NDArray:
        coefficients = np.asarray(self.trajectories.coefficients, float)
        return coefficients[:, 0, :, 0] if time <= 0 else coefficients[:, -1].sum(-1)
