"""Limits of trajectories that one or several drones fly, and a check against these limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crazysim.arguments import check_arguments
from crazysim.core.settings import check_settings, setting
from crazysim.drones import AirframeSource, load_airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.errors import expect, require
from crazysim.lab.planning.approaches import Approach, closest_approaches
from crazysim.lab.planning.peaks import QUANTITIES, Peak, find_peaks
from crazysim.lab.planning.piece_table import PieceTable
from crazysim.trajectories.trajectory import Trajectory, trajectory_list

LIMIT_TOLERANCE = 1e-4
"""Fraction of a limit by which a value may exceed it, for the errors of float32. For a height limit below 1 m it is a
fraction of 1 m."""


@dataclass(frozen=True)
class Limits:
    """Limits of trajectories, and of the distance between drones; None for no limit."""

    speed: float | None = setting(default=None, positive=True)
    """Largest speed, m/s."""
    horizontal_speed: float | None = setting(default=None, positive=True)
    """Largest speed in the horizontal plane, m/s."""
    vertical_speed: float | None = setting(default=None, positive=True)
    """Largest speed of climb and descent, m/s."""
    acceleration: float | None = setting(default=None, positive=True)
    """Largest acceleration, m/s^2."""
    jerk: float | None = setting(default=None, positive=True)
    """Largest third derivative of the position, m/s^3."""
    thrust: float | None = setting(default=None, positive=True)
    """Largest collective thrust divided by the weight, more than 1."""
    min_thrust: float | None = setting(default=None, low=0.0)
    """Smallest collective thrust divided by the weight, less than 1."""
    body_rate: float | None = setting(default=None, positive=True)
    """Largest angular velocity, rad/s."""
    yaw_rate: float | None = setting(default=None, positive=True)
    """Largest rate of the yaw, rad/s."""
    height: float | None = setting(default=None, positive=True)
    """Largest height, m."""
    separation: float | None = setting(default=None, positive=True)
    """Smallest distance between the positions of two drones, m."""
    floor: float | None = 0.0
    """Smallest height, m; may be negative."""

    def __post_init__(self) -> None:
        check_settings(self)
        require(
            self.floor is None or self.height is None or self.floor < self.height,
            f"expected a floor below the height of {self.height} m, got {self.floor} m. Lower it, or raise height.",
        )
        require(
            self.thrust is None or self.thrust > 1,
            f"expected a largest thrust of more than 1 weight, got {self.thrust}. A drone with less cannot hover.",
        )
        require(
            self.min_thrust is None or self.min_thrust < 1,
            f"expected a smallest thrust of less than 1 weight, got {self.min_thrust}. With more, it must climb.",
        )

    def as_dict(self) -> dict[str, float]:
        """Return the limits that are not None, by name."""
        fields = dataclasses.fields(self)
        return {field.name: getattr(self, field.name) for field in fields if getattr(self, field.name) is not None}

    def of_airframe(self, airframe: AirframeSource) -> Limits:
        """Return these limits, with the thrust range of an airframe where a thrust limit is None.

        Args:
            airframe: Name of a built-in airframe, path, dict or airframe.
        """
        frame = load_airframe(airframe)
        low, high = (
            frame.n_rotors
            * float(frame.value(f"rotors.{key}", ()))
            / float(frame.value("rigid_body.mass"))
            / GRAVITY_MAGNITUDE
            for key in ("thrust_min", "thrust_max")
        )
        return dataclasses.replace(
            self,
            thrust=high if self.thrust is None else self.thrust,
            min_thrust=low if self.min_thrust is None else self.min_thrust,
        )


@dataclass(frozen=True)
class Violation:
    """A limit that one drone, or a pair of drones, exceeds."""

    limit: str
    """Name of the limit, a field of ``Limits``."""
    drones: tuple[int, ...]
    """Index of the drone, or indices of both drones of a pair."""
    time: float
    """Time at which the limit is exceeded most, s."""
    value: float
    """Value at this time, in the unit of the limit."""
    allowed: float
    """The limit."""
    names: tuple[str, ...]
    """Names of the drones."""

    def __str__(self) -> str:
        unit = "m" if self.limit == "separation" else QUANTITIES[self.limit].unit
        relation = "below" if self.limit == "separation" or QUANTITIES[self.limit].sign < 0 else "above"
        return (
            f"{' and '.join(self.names)}: {self.limit} {self.value:.4g} {unit} at {self.time:.2f} s, {relation} the "
            f"limit of {self.allowed:.4g}"
        )


@dataclass(frozen=True, eq=False)
class Report:
    """Result of a check."""

    violations: tuple[Violation, ...]
    """Violations: one for each drone and limit that it exceeds, and one for each pair that comes too close."""
    closest: tuple[Approach, ...]
    """Closest approach of every pair, nearest pair first; empty for one drone."""
    peaks: Mapping[str, Peak]
    """Largest value of each quantity for every drone, smallest for ``min_thrust`` and ``floor``, with its time."""
    names: tuple[str, ...]
    """Names of the drones. (n_drones,)"""
    duration: float
    """Duration, s."""

    @property
    def ok(self) -> bool:
        """Whether there is no violation."""
        return not self.violations

    def __str__(self) -> str:
        lines = [f"{len(self.names)} drone{'s' * (len(self.names) > 1)}, {self.duration:.2f} s"]
        for name, peak in self.peaks.items():
            k = int(np.argmax(QUANTITIES[name].sign * peak.value))
            lines.append(
                f"{name}: {peak.value[k]:.4g} {QUANTITIES[name].unit} ({self.names[k]} at {peak.time[k]:.2f} s)"
            )
        if self.closest:
            pair = self.closest[0]
            drone_names = " and ".join(self.names[k] for k in pair.drones)
            lines.append(f"separation: {pair.distance:.4g} m ({drone_names} at {pair.time:.2f} s)")
        lines += [f"{len(self.violations) or 'no'} violation{'s' * (len(self.violations) != 1)}"]
        return "\n".join([*lines, *map(str, self.violations)])


def require_limits(limits: Limits) -> None:
    expect(isinstance(limits, Limits), "limits as Limits", limits, "Use Limits(speed=...), or Limits() for none.")


def tolerance_scale(name: str, limit: float) -> float:
    """Return the factor of relative tolerances: the absolute value of a limit, at least 1 m for a height."""
    return max(abs(limit), 1.0) if QUANTITIES[name].orders == (0,) else abs(limit)


@check_arguments
def check(
    trajectories: Trajectory | Sequence[Trajectory],
    limits: Limits,
    airframe: AirframeSource | None = None,
    *,
    starts: ArrayLike = 0.0,
    duration: float | None = None,
    names: Sequence[str] | None = None,
    tolerance: float = 1e-3,
) -> Report:
    """Check trajectories against limits, and find the closest approach of every pair.

    Thrust and body rate are computed for a drone without drag that flies its trajectory exactly (differential
    flatness).

    Args:
        trajectories: One trajectory, or one for each drone: a sequence, or a ``Trajectory`` with one leading axis.
            One trajectory with several ``starts`` is flown by as many drones.
        airframe: Airframe that provides the thrust limits that ``limits`` leaves None; None for no such limits.
        starts: Start of each drone, s, as in ``Follow``; negative if it began before time zero. () or (n_drones,)
        duration: Duration, s; None to end with the last trajectory. A repeating trajectory then ends after one round.
        names: Names of the drones for the report; None for their numbers.
        tolerance: Largest error of a distance, m.
    """
    require_limits(limits)
    flights = trajectory_list(trajectories)
    if len(flights) == 1 and np.ndim(starts) == 1:
        flights *= np.size(starts)
    table = PieceTable.create(flights, starts, duration)
    expect(
        isinstance(names, (Sequence, type(None))) and not isinstance(names, str),
        "names as a list of texts",
        names,
        "Pass one name per trajectory.",
    )
    labels = tuple(names) if names is not None else tuple(f"drone {k}" for k in range(len(flights)))
    require(
        len(labels) == len(flights),
        f"expected {len(flights)} names, one for each drone, got {len(labels)}. Pass one name per trajectory.",
    )
    is_number = isinstance(tolerance, (int, float, np.number))
    require(
        is_number and 0 < tolerance < np.inf, f"expected a positive, finite tolerance, m, got {tolerance!r}. Use 1e-3."
    )
    limit_values = (limits if airframe is None else limits.of_airframe(airframe)).as_dict()
    peaks, closest = find_peaks(table, tuple(QUANTITIES)), tuple(closest_approaches(table, tolerance))
    # Limits of each drone.
    violations = []
    for name, peak in peaks.items():
        if name not in limit_values:
            continue
        limit, sign = limit_values[name], QUANTITIES[name].sign
        for k in np.flatnonzero(sign * (peak.value - limit) > LIMIT_TOLERANCE * tolerance_scale(name, limit)):
            violations.append(
                Violation(name, (int(k),), float(peak.time[k]), float(peak.value[k]), limit, (labels[k],))
            )
    # Distance of each pair.
    separation = limit_values.get("separation", 0.0)
    for pair in closest:
        if pair.distance < separation * (1 - LIMIT_TOLERANCE):
            pair_names = tuple(labels[k] for k in pair.drones)
            violations.append(Violation("separation", pair.drones, pair.time, pair.distance, separation, pair_names))
    return Report(tuple(violations), closest, peaks, labels, table.duration)
