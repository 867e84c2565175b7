"""Estimates of the constants of an airframe from a few numbers, as a commented TOML file.

Every number of the file states its formula and source. Measured numbers replace estimates in the file, one by one.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.drones.airframe_checks import MAX_ROTORS
from crazysim.errors import ConfigError, expect, require, short_repr
from crazysim.storage import MAX_TEXT_BYTES, is_file, read_text
from crazysim.tables import POSITIVE, read_number, read_numbers

AIR_DENSITY = 1.225
"""Density of air at sea level in the standard atmosphere, kg/m^3."""
PITCH_RATIO = 0.5
"""Default ratio of the pitch to the diameter of a propeller."""
OUTER_MASS_SHARE = 0.4
"""Fraction of the mass that is located at the rotors; the inertias about z of the built-in airframes correspond to
0.31 to 0.53."""
MERIT_DIAMETERS, FIGURES_OF_MERIT = (0.127, 0.254), (0.44, 0.68)
"""Diameters of propellers of 5 and 10 inches, m, and their figures of merit in hover."""
DRAG_RATE = 0.45
"""Ratio of linear drag to mass, 1/s; the built-in airframes that were identified from flights have 0.29 to 0.58."""
ROTOR_TIME_CONSTANT = 0.05
"""Time constant of rotors up to 10 inches, s."""
MAX_TABLE_ERROR = 0.05
"""Fraction of the largest value of a motor table by which thrust or torque may fall where the speed rises, or by which
two columns of one quantity may differ: an assumption about the errors of data sheets."""
IDLE_THRUST_RATIO = 0.05
"""Ratio of the smallest to the largest thrust of a rotor that is on."""
MOTOR_EFFICIENCY = 0.75
"""Ratio of mechanical to electric power of a motor with its speed controller."""
BATTERY_SHARE = 0.22
"""Ratio of the battery's mass to the drone's mass; a Crazyflie 2.1 Brushless has 0.21."""
BATTERY_ENERGY = 153.0
"""Energy per mass of lithium-polymer batteries, W h/kg."""
CELL_VOLTAGE = 3.7
"""Nominal voltage of a lithium-polymer cell, V."""
CELL_RESISTANCE = 0.015
"""Resistance of a cell times its capacity, ohm A h."""
MAX_DISC_LOADING = 1e4
"""Thrust per disc area above which units must be wrong, N/m^2: an induced velocity of 64 m/s; bumblebee has 1,200."""
MotorTable = str | Path | Mapping[str, ArrayLike]
"""Path of a CSV file, or its columns."""
COLUMNS = {
    "throttle": ("throttle", 1.0),
    "thrust_n": ("thrust", 1.0),
    "thrust_g": ("thrust", 1e-3 * GRAVITY_MAGNITUDE),
    "rpm": ("rpm", 1.0),
    "torque_nm": ("torque", 1.0),
    "power_w": ("power", 1.0),
}
"""Columns of a motor table, with the quantity and its factor to SI units."""
SOURCES = {
    "given": "Given to crazysim airframe new",
    "layout": "{n} rotors at equal angles, {arm:g} m from the centre, numbered clockwise from the one at or right "
    "of the nose; rotors 1, 3, ... turn counter-clockwise seen from above",
    "spins": "Rotors that turn counter-clockwise seen from above have -1: their drag turns the body clockwise",
    "inertia": f"estimate: {OUTER_MASS_SHARE:g} of the mass as points at the rotors, the rest at the centre; inertias "
    "of the built-in airframes correspond to 0.31 to 0.53",
    "thrust_to_weight": "Thrust over weight of {ratio:g}: ratio mass g / number of rotors",
    "thrust_min": f"estimate: {IDLE_THRUST_RATIO:g} thrust_max, rotors that idle",
    "thrust_curve": "estimate: T = C_T rho n^2 D^4 with n in 1/s, rho = 1.225 kg/m^3, C_T = 0.0427 + 0.144 pitch / D = "
    "{ct:.4f}, a fit to APC multirotor propellers in SizingLab/FAST-UAV, surrogate_models.py; {pitch}",
    "torque_curve": "estimate: ideal power T^1.5 / sqrt(2 rho A) over a figure of merit of {merit:.2f}, interpolated "
    "over the diameter between 0.44 (5 inch DA4052, C_T 0.148, C_P 0.103) and 0.68 (10 inch APC SF 10x4.7, C_T 0.119, "
    "C_P 0.048), averages of static tests in the UIUC Propeller Database",
    "rotor_inertia": "estimate: thin rod, m D^2 / 12, of the propeller's mass m = 0.015 kg (D / 0.279 m)^2 (0.53 oz at "
    "11 inch, scaled as in SizingLab/FAST-UAV); the motor's bell is neglected",
    "lag": f"estimate: first order with {ROTOR_TIME_CONSTANT:g} s, longer in proportion to the diameter beyond 0.254 "
    "m; thrust of cf21B_500 has 0.06 s around hover, of hb_x500 (10 inch) 0.045 to 0.071 s",
    "drag": f"estimate: {DRAG_RATE:g} 1/s times the mass; airframes identified from flights (cf21B_500, cf2x_L250, "
    "hb_x500) have 0.35 to 0.57 1/s",
    "cells": "estimate: 1 cell below 0.1 kg, 3 below 0.5 kg, 4 below 3 kg, else 6",
    "battery_mass": f"estimate: capacity times {CELL_VOLTAGE:g} V per cell over {BATTERY_ENERGY:g} W h/kg, as in a "
    "pack of 3.4 A h, 4 cells and 0.329 kg (MK-quadro)",
    "capacity": f"estimate: battery of {BATTERY_SHARE:g} of the mass with {BATTERY_ENERGY:g} W h/kg",
    "resistance": f"estimate: cells times {CELL_RESISTANCE:g} ohm A h / capacity; good cells of several A h have "
    "1 to 4 mohm when new (rchelicopterfun.com, LiPo Internal Resistance)",
    "propeller": "Radius of the propeller that was given",
}
"""Templates of the descriptions of a file's sources, by the name of the source."""


@check_arguments
def estimate_airframe(
    mass: float,
    propeller: float,
    *,
    arm: float | None = None,
    n_rotors: int = 4,
    layout: str = "x",
    positions: ArrayLike | None = None,
    spins: Sequence[int] | None = None,
    thrust_to_weight: float | None = None,
    motor_table: MotorTable | None = None,
    pitch: float | None = None,
    inertia: ArrayLike | None = None,
    time_constant: float | None = None,
    cells: int | None = None,
    capacity: float | None = None,
    resistance: float | None = None,
    name: str = "my_drone",
) -> str:
    """Estimate the constants of an airframe from a few numbers, and return its TOML text.

    The file has the values that the first-principles dynamics, the battery and the controllers without tuned gains
    need, and no gains. Each estimate states its formula and source.

    Args:
        mass: Mass with the battery, kg.
        propeller: Diameter of the propellers, m.
        arm: Distance of the rotors from the centre, m; with ``n_rotors`` and ``layout``.
        n_rotors: Number of rotors on a circle, even.
        layout: ``"x"``: the nose is between two rotors, ``"+"``: the first rotor is at the nose.
        positions: Positions of the rotors from the centre of mass, m, instead of ``arm``; x ahead, y left, z up. (n, 3)
            or (n, 2)
        spins: 1 for rotors that turn counter-clockwise seen from above, -1 for clockwise; by default the signs
            alternate and begin with 1. (n,)
        thrust_to_weight: Largest thrust of all rotors over the weight.
        motor_table: Data sheet of motor and propeller instead of ``thrust_to_weight``: a CSV file, or a dict of
            columns, ``thrust_n`` or ``thrust_g``, and optionally ``rpm``, ``torque_nm``, ``power_w`` (electric) and
            ``throttle``, which is not used.
        pitch: Pitch of the propellers, m; by default half the diameter.
        inertia: Moments of inertia, kg m^2, or a matrix. (3,) or (3, 3)
        time_constant: Time constant of the rotors' speeds, s.
        cells: Number of battery cells in series.
        capacity: Charge of the battery, A h.
        resistance: Internal resistance of the battery, ohm.
    """
    for key, value in (
        ("mass", mass),
        ("propeller", propeller),
        ("arm", arm),
        ("pitch", pitch),
        ("thrust_to_weight", thrust_to_weight),
        ("time_constant", time_constant),
        ("cells", cells),
        ("capacity", capacity),
        ("resistance", resistance),
    ):
        if value is not None:
            read_number(key, value, POSITIVE)
    # Body: mass, inertia, positions of the rotors.
    file = _AirframeFile(name)
    rotor_pos, signs = _rotor_layout(file, arm, n_rotors, layout, positions, spins, propeller)
    file.add("rigid_body", "mass", mass, "kg", "given")
    if inertia is None:
        file.add("rigid_body", "inertia", _estimate_inertia(mass, rotor_pos), "kg m^2", "inertia")
    else:
        file.add("rigid_body", "inertia", read_numbers("inertia", inertia), "kg m^2", "given")
    file.add(
        "rotors",
        "position",
        rotor_pos,
        "m; x ahead, y left, z up, from the centre of mass",
        "layout" if positions is None else "given",
    )
    file.add("rotors", "yaw_torque_sign", signs, "1", "spins" if positions is not None or spins else "layout")
    # Rotors: curves, limits, inertia and lag.
    thrust = _add_thrust(file, mass, len(rotor_pos), propeller, thrust_to_weight, motor_table, pitch)
    _check_units(mass, propeller, rotor_pos, thrust)
    file.add("rotors", "thrust_min", IDLE_THRUST_RATIO * thrust, "N", "thrust_min")
    propeller_mass = 0.015 * (propeller / 0.279) ** 2
    file.add("rotors", "inertia", propeller_mass * propeller**2 / 12, "kg m^2", "rotor_inertia")
    tau = ROTOR_TIME_CONSTANT * max(1.0, propeller / 0.254) if time_constant is None else time_constant
    lag_unit = "1/s, 1/(s rpm) on spin-up; 1/s, 1/(s rpm) on spin-down"
    file.add("rotors", "lag", np.array([1 / tau, 0, 1 / tau, 0]), lag_unit, "given" if time_constant else "lag")
    # Drag, battery and appearance.
    file.add("drag", "coefficients", -DRAG_RATE * mass * np.ones(3), "N s/m", "drag")
    _add_battery(file, mass, cells, capacity, resistance)
    file.add("shape", "propeller_radius", propeller / 2, "m", "propeller")
    return file.text()


class _AirframeFile:
    """Text of an airframe: tables of numbers with units and sources."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.tables: dict[str, list[str]] = {}
        self.sources: dict[str, str] = {}

    def add(self, table: str, key: str, value: ArrayLike, unit: str, source: str, **numbers: Any) -> None:
        if source not in self.sources:
            self.describe(source, SOURCES[source].format(**numbers) if numbers else SOURCES[source])
        line = f'{key} = {{ value = {_toml_value(value)}, unit = "{unit}", source = "{source}" }}'
        self.tables.setdefault(table, []).append(line)

    def describe(self, source: str, text: str) -> None:
        self.sources[source] = text

    def text(self) -> str:
        lines = [
            f"# {self.name}, written by crazysim airframe new. Every number is {{ value, unit, source }}; [sources]",
            "# has the formula and the origin of each. Replace estimates by what you measure.",
            "",
            f"name = {_toml_string(self.name)}",
            "",
            "[sources]",
            *(f"{key} = {_toml_string(text)}" for key, text in self.sources.items()),
        ]
        for table, entries in self.tables.items():
            lines += ["", f"[{table}]", *entries]
        return "\n".join(lines) + "\n"


def _toml_string(text: str) -> str:
    escaped_text = text.replace("\\", "\\\\").replace('"', '\\"')
    expect(escaped_text.isprintable(), "a name of printable characters", text)
    return f'"{escaped_text}"'


def _toml_value(value: Any) -> str:
    if np.ndim(value):
        return f"[{', '.join(_toml_value(item) for item in value)}]"
    return f"{float(value):.6g}" if isinstance(value, (float, np.floating)) else str(int(value))


def _rotor_layout(
    file: _AirframeFile,
    arm: Any,
    n_rotors: int,
    layout: str,
    positions: ArrayLike | None,
    spins: Sequence[int] | None,
    propeller: float,
) -> tuple[NDArray, NDArray]:
    require(
        (arm is None) != (positions is None),
        "expected either arm, with n_rotors and layout, or positions. Use arm=0.11 for a quadrotor.",
    )
    # Rotors on a circle, or at given positions.
    if positions is None:
        expect(layout in ("x", "+"), "layout as 'x' or '+'", layout, "Use positions for any other.")
        require(
            4 <= n_rotors <= MAX_ROTORS and n_rotors % 2 == 0,
            f"expected an even number of rotors from 4 to {MAX_ROTORS}, which alternate, got {n_rotors}. Use "
            "positions and spins.",
        )
        angle_step = 2 * np.pi / n_rotors
        angles = -angle_step * (np.arange(n_rotors) + (0.5 if layout == "x" else 0.0))
        rotor_pos = arm * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
        file.describe("layout", SOURCES["layout"].format(n=n_rotors, arm=arm))
    else:
        rotor_pos = np.asarray(positions, float)
        require(
            rotor_pos.ndim == 2 and rotor_pos.shape[1] in (2, 3) and len(rotor_pos) >= 3,
            f"expected positions of shape (n, 3) or (n, 2) of at least 3 rotors, got {rotor_pos.shape}",
        )
        rotor_pos = np.pad(rotor_pos, ((0, 0), (0, 3 - rotor_pos.shape[1])))
    rotor_pos = np.where(np.abs(rotor_pos) < 1e-9, 0.0, rotor_pos)
    # Propellers at about one height must not overlap.
    gaps = rotor_pos[:, None] - rotor_pos[None]
    is_same_height = (np.abs(gaps[..., 2]) < 0.1 * propeller) & ~np.eye(len(rotor_pos), dtype=bool)
    min_gap = np.min(np.linalg.norm(gaps[..., :2], axis=-1)[is_same_height], initial=np.inf)
    if min_gap < propeller * (1 - 1e-6):
        raise ConfigError(
            f"expected propellers that do not touch, got a diameter of {propeller:g} m and rotors {min_gap:.3g} m "
            f"apart. Use a longer arm, a smaller propeller (5 inches are 0.127 m), or other heights of the rotors."
        )
    # Directions of rotation, alternating by default.
    if spins is None:
        require(
            len(rotor_pos) % 2 == 0,
            f"expected spins for {len(rotor_pos)} rotors, which cannot alternate. Use spins=[1, -1, ...].",
        )
        spins = [1, -1] * (len(rotor_pos) // 2)
    spin_signs = np.asarray(spins)
    expect(
        spin_signs.shape == (len(rotor_pos),)
        and np.all(np.isin(spin_signs, (1, -1)))
        and abs(np.sum(spin_signs)) != len(rotor_pos),
        f"spins of 1 and -1 for {len(rotor_pos)} rotors, and not all equal",
        spins,
    )
    return rotor_pos, -spin_signs


def _estimate_inertia(mass: float, rotor_pos: NDArray) -> NDArray:
    squares = np.einsum("ni,nj->ij", rotor_pos, rotor_pos) / len(rotor_pos)
    matrix = OUTER_MASS_SHARE * mass * (np.trace(squares) * np.eye(3) - squares)
    off_diagonal = matrix - np.diag(np.diag(matrix))
    return np.diag(matrix) if np.max(np.abs(off_diagonal)) < 1e-6 * np.max(matrix) else matrix


def _add_thrust(
    file: _AirframeFile,
    mass: float,
    n_rotors: int,
    diameter: float,
    thrust_to_weight: Any,
    motor_table: MotorTable | None,
    pitch: float | None,
) -> float:
    require(
        (thrust_to_weight is None) != (motor_table is None),
        "expected either thrust_to_weight or motor_table. Use thrust_to_weight=2 for a drone that carries things, "
        "4 for an agile one.",
    )
    # Largest thrust, by its ratio or the table.
    motor_data = {} if motor_table is None else _parse_motor_table(motor_table)
    table_name = (
        f"motor table {Path(motor_table).name}"
        if isinstance(motor_table, (str, Path))
        else "motor table that was given"
    )
    if motor_table is None:
        thrust = thrust_to_weight * mass * GRAVITY_MAGNITUDE / n_rotors
        file.add("rotors", "thrust_max", thrust, "N", "thrust_to_weight", ratio=thrust_to_weight)
    else:
        thrust = float(np.max(motor_data["thrust"]))
        file.describe("motor_thrust", f"Largest thrust of the {table_name}")
        file.add("rotors", "thrust_max", thrust, "N", "motor_thrust")
    # Thrust curve, by the pitch ratio or the table.
    pitch_ratio = PITCH_RATIO if pitch is None else pitch / diameter
    ct = 0.0427 + 0.144 * pitch_ratio
    if "rpm" in motor_data:
        thrust_factor, error = _fit_quadratic(motor_data["rpm"], motor_data["thrust"])
        file.describe("motor_curve", f"Least squares T = k rpm^2 to the {table_name}, off by at most {error:.2g} N")
        source = "motor_curve"
    else:
        thrust_factor, source = ct * AIR_DENSITY * diameter**4 / 3600, "thrust_curve"
    pitch_text = f"pitch {pitch_ratio:g} D" + (" assumed" if pitch is None else "")
    file.add(
        "rotors", "thrust_curve", np.array([0, 0, thrust_factor]), "N, N/rpm, N/rpm^2", source, ct=ct, pitch=pitch_text
    )

    # Torque curve, by momentum theory or the table's torque or power.
    area, rpm_to_rad_s = np.pi * diameter**2 / 4, 2 * np.pi / 60
    merit = float(np.interp(diameter, MERIT_DIAMETERS, FIGURES_OF_MERIT))
    torque_factor, source = thrust_factor**1.5 / np.sqrt(2 * AIR_DENSITY * area) / merit / rpm_to_rad_s, "torque_curve"
    if "rpm" in motor_data and "torque" in motor_data:
        torque_factor, error = _fit_quadratic(motor_data["rpm"], motor_data["torque"])
        file.describe("motor_torque", f"Least squares Q = k rpm^2 to the {table_name}, off by at most {error:.2g} N m")
        source = "motor_torque"
    elif "rpm" in motor_data and "power" in motor_data:
        shaft_torque = MOTOR_EFFICIENCY * motor_data["power"] / (motor_data["rpm"] * rpm_to_rad_s)
        torque_factor, error = _fit_quadratic(motor_data["rpm"], shaft_torque)
        file.describe(
            "motor_power",
            f"estimate: least squares Q = k rpm^2 to the {table_name}, with {MOTOR_EFFICIENCY:g} of the electric power "
            f"at the propeller, off by at most {error:.2g} N m",
        )
        source = "motor_power"
    file.add("rotors", "torque_curve", np.array([0, 0, torque_factor]), "N m, N m/rpm, N m/rpm^2", source, merit=merit)
    return thrust


def _check_units(mass: float, propeller: float, rotor_pos: NDArray, thrust: float) -> None:
    disc_loading, reach = thrust / (np.pi * propeller**2 / 4), float(np.max(np.linalg.norm(rotor_pos, axis=-1)))
    if disc_loading > MAX_DISC_LOADING or reach > 20 * propeller:
        raise ConfigError(
            f"expected mass in kg and lengths in m, got {mass:g} kg, propellers of {propeller:g} m, rotors up to "
            f"{reach:.3g} m from the centre, and {thrust:.3g} N of thrust each: {disc_loading:.3g} N/m^2 of propeller. "
            f"Convert units: 5 inches are 0.127 m."
        )


def _fit_quadratic(rpm: NDArray, values: NDArray) -> tuple[float, float]:
    squares = rpm**2
    k = float(squares @ values / (squares @ squares))
    return k, float(np.max(np.abs(values - k * squares)))


def _parse_motor_table(table: MotorTable) -> dict[str, NDArray]:
    columns = table if isinstance(table, Mapping) else _read_columns(Path(table))
    column_names = ", ".join(COLUMNS)
    column_by_quantity: dict[str, NDArray] = {}
    # Columns in SI units; two columns of one quantity must agree.
    for key, values in columns.items():
        expect(str(key).strip().lower() in COLUMNS, f"columns of a motor table among {column_names}", key)
        quantity, factor = COLUMNS[str(key).strip().lower()]
        try:
            array = np.asarray(values, float) * factor
        except ValueError as error:
            raise ConfigError(f"expected numbers in column {key!r} of the motor table, got {error}") from error
        if array.ndim != 1 or not len(array) or not np.all(np.isfinite(array)) or np.any(array < 0):
            raise ConfigError(
                f"expected finite numbers of at least 0 in column {key!r}, got {short_repr(array.tolist())}"
            )
        previous = column_by_quantity.setdefault(quantity, array)
        if previous.shape == array.shape and np.any(np.abs(previous - array) > MAX_TABLE_ERROR * np.max(previous)):
            k = int(np.argmax(np.abs(previous - array)))
            raise ConfigError(
                f"expected columns of the motor table that agree on the {quantity}, got {previous[k]:.4g} and "
                f"{array[k]:.4g} in row {k + 1}, in SI units. Remove the column that is wrong."
            )
    expect(
        "thrust" in column_by_quantity and np.max(column_by_quantity["thrust"]) > 0,
        "a motor table with a column thrust_n or thrust_g",
        list(columns),
    )
    require(
        len({len(array) for array in column_by_quantity.values()}) == 1,
        "expected columns of equal lengths in the motor table",
    )
    # Rows in which the rotor turns, by ascending speed.
    if "rpm" in column_by_quantity:
        is_running = column_by_quantity["rpm"] > 0
        require(np.any(is_running), "expected a speed above 0 in column 'rpm' of the motor table, got none")
        order = np.argsort(column_by_quantity["rpm"][is_running], kind="stable")
        column_by_quantity = {quantity: array[is_running][order] for quantity, array in column_by_quantity.items()}
        for quantity in ("thrust", "torque"):
            values = column_by_quantity.get(quantity, np.zeros(1))
            fall = np.maximum.accumulate(values) - values
            if np.max(fall) > MAX_TABLE_ERROR * np.max(values):
                k = int(np.argmax(fall))
                raise ConfigError(
                    f"expected a motor table whose {quantity} grows with the speed, got {values[k]:.4g} at "
                    f"{column_by_quantity['rpm'][k]:.6g} rpm, and "
                    f"{np.max(values[:k]):.4g} below that. Check the columns."
                )
    return column_by_quantity


def _read_columns(path: Path) -> dict[str, list[str]]:
    require(is_file(path), f"expected a motor table as an existing CSV file, got {str(path)!r}")
    lines = [line for line in read_text(path, MAX_TEXT_BYTES).splitlines() if line.strip() and line[0] != "#"]
    header, *rows = csv.reader(lines) if lines else [[]]
    require(
        header and rows and not any(len(row) != len(header) for row in rows),
        f"expected a line of names and lines of as many numbers in {str(path)!r}",
    )
    return {key: [row[i] for row in rows] for i, key in enumerate(header)}


def _add_battery(
    file: _AirframeFile, mass: float, cells: int | None, capacity: float | None, resistance: float | None
) -> None:
    n_cells = cells or next(n_cells for n_cells, limit in ((1, 0.1), (3, 0.5), (4, 3.0), (6, np.inf)) if mass < limit)
    charge = capacity or BATTERY_SHARE * mass * BATTERY_ENERGY / (n_cells * CELL_VOLTAGE)
    file.add("battery", "cells", n_cells, "1, in series", "given" if cells else "cells")
    file.add("battery", "capacity", charge, "A h", "given" if capacity else "capacity")
    total_resistance = resistance or n_cells * CELL_RESISTANCE / charge
    file.add("battery", "resistance", total_resistance, "ohm, of all cells", "given" if resistance else "resistance")
    file.add(
        "battery", "mass", n_cells * charge * CELL_VOLTAGE / BATTERY_ENERGY, "kg, part of the drone's", "battery_mass"
    )
