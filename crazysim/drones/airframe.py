"""Airframes: the constants of a drone type."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.drones.keys import GUIDE, LAYOUT
from crazysim.errors import ConfigError, require

TUNED_TABLES = ("fitted", "controller", "geometric", "mellinger", "pid", "residual")
"""Tables of gains and fits."""


GRAVITY_MAGNITUDE = 9.81
"""Gravitational acceleration, m/s^2: the value with which the airframes were identified, also used by the Crazyflie's
firmware (``GRAVITY_MAGNITUDE`` in physicalConstants.h)."""


class Drone(StrEnum):
    """Names of the built-in airframes."""

    cf21B_500 = "cf21B_500"
    cf21B_500_idsia = "cf21B_500_idsia"
    cf2x_L250 = "cf2x_L250"
    cf2x_P250 = "cf2x_P250"
    cf2x_T350 = "cf2x_T350"
    hb_x500 = "hb_x500"
    crazyflie = "crazyflie"
    bumblebee = "bumblebee"
    bumblebee_lab = "bumblebee_lab"
    uzh_cpc = "uzh_cpc"
    uzh_5inch = "uzh_5inch"


@dataclass(frozen=True, eq=False)
class Airframe:
    """Constants of a drone type, as plain numbers in SI units (rotor speeds in rpm)."""

    name: str
    """Name: the key ``name``, or else the file's stem; ``custom`` for a dict without that key."""
    values: Mapping[str, NDArray[np.float64]]
    """All numbers by dotted path, such as ``rigid_body.mass``, as float64 arrays, without units and sources."""
    not_inherited_reason: str = ""
    """Reason why gains and fits of the base are missing, for messages; empty if all were inherited."""

    def table(self, path: str) -> Mapping[str, Any]:
        """Return a table by its dotted path, such as ``controller.state``."""
        node: Any = self.tables
        for part in path.split("."):
            node = node.get(part) if isinstance(node, Mapping) else None
            if not isinstance(node, Mapping):
                raise ConfigError(
                    f"airframe {self.name!r} has no table [{path}], only {sorted(self.tables)}. "
                    f"{self.missing_reason(path)}Add [{path}] to the airframe; {GUIDE} lists its keys."
                )
        return node

    def value(self, path: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
        """Return one number or array by its dotted path, such as ``rigid_body.mass``.

        Args:
            shape: Expected shape; None for any.
        """
        if path not in self.values:
            raise ConfigError(
                f"airframe {self.name!r} has no value {path!r}. {self.missing_reason(path)}"
                f"{_lookup_advice(path, self.values)}"
            )
        value = self.values[path]
        require(
            shape is None or value.shape == shape,
            f"airframe {self.name!r}: expected {path} of shape {shape}, got {value.shape}",
        )
        return value

    def matrix(self, path: str) -> NDArray[np.float64]:
        """Return a matrix that is given whole or as its diagonal, such as ``drag.coefficients``. (3, 3)"""
        value = self.value(path)
        return np.diag(value) if value.ndim == 1 else value

    def rotor_vel(self, thrust: ArrayLike) -> NDArray[np.float64]:
        """Return the speeds at which the rotors give a thrust, from their curves, rpm. (..., 1) or (..., n_rotors)

        Args:
            thrust: Thrust of each rotor, N. (..., 1) or (..., n_rotors)
        """
        k0, k1, k2 = np.atleast_2d(self.value("rotors.thrust_curve")).T
        return (-k1 + np.sqrt(k1**2 - 4 * k2 * (k0 - np.asarray(thrust)))) / (2 * k2)

    def missing_reason(self, path: str) -> str:
        """Return why a table or value of the base was not inherited, with a space at the end; empty if it was."""
        return (
            f"{self.not_inherited_reason} "
            if self.not_inherited_reason and path.partition(".")[0] in TUNED_TABLES
            else ""
        )

    @functools.cached_property
    def tables(self) -> Mapping[str, Any]:
        """All tables, as in the file."""
        tables: dict[str, Any] = {}
        for path, value in self.values.items():
            *parents, key = path.split(".")
            node = tables
            for parent in parents:
                node = node.setdefault(parent, {})
            node[key] = value
        return tables

    @property
    def n_rotors(self) -> int:
        """Number of rotors."""
        return len(self.value("rotors.position"))

    @property
    def inertia(self) -> NDArray[np.float64]:
        """Inertia about the centre of mass, body frame, kg m^2. (3, 3)"""
        return self.matrix("rigid_body.inertia")

    @property
    def arm(self) -> float:
        """Largest distance of a rotor from the body's x or y axis, m: the scale of the mixing matrix."""
        return float(np.max(np.abs(self.value("rotors.position")[:, :2])))

    @property
    def mixing_matrix(self) -> NDArray[np.float64]:
        """Matrix from rotor thrusts to torque divided by the arm. (3, n_rotors)

        A rotor at (x, y) with thrust f exerts the torque (y f, -x f), so the rows are y / arm, -x / arm and
        the sign of the torque that its drag exerts on the body about z.
        """
        position = self.value("rotors.position")
        sign = self.value("rotors.yaw_torque_sign")
        return np.stack([position[:, 1] / self.arm, -position[:, 0] / self.arm, sign])

    @property
    def rotor_vel_limits(self) -> NDArray[np.float64]:
        """Speeds of a rotor at ``rotors.thrust_min`` and ``rotors.thrust_max``, rpm. (2, 1 or n_rotors)"""
        return self.rotor_vel([[self.value("rotors.thrust_min", ())], [self.value("rotors.thrust_max", ())]])

    @property
    def full_thrust_voltage(self) -> float | None:
        """Motor voltage at which a rotor reaches ``rotors.thrust_max``, V; None if the airframe has no such curve."""
        if "battery.thrust_over_voltage" not in self.values:
            return None
        excess = self.value("battery.thrust_over_voltage") - [self.value("rotors.thrust_max"), 0, 0, 0]
        roots = np.polynomial.polynomial.polyroots(excess)
        voltages = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(np.min(voltages)) if len(voltages) else None

    def __repr__(self) -> str:
        return f"Airframe({self.name!r})"


AirframeSource = str | Path | Mapping[str, Any] | Airframe
"""Name of a built-in airframe, path of a TOML file, dict, or airframe."""


def airframe_names() -> tuple[str, ...]:
    """Return the names of the built-in airframes."""
    return tuple(drone.value for drone in Drone)


def _lookup_advice(path: str, paths: Iterable[str]) -> str:
    table, _, key = path.rpartition(".")
    return (
        f"Add {key} to its table [{table}]; {GUIDE} lists all keys."
        if path in LAYOUT.keys
        else LAYOUT.suggestion(path, paths)
    )
