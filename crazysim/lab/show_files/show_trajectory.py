"""Trajectories in a show's JSON: chains of Bezier curves, with or without yaw."""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import require, short_repr
from crazysim.lab.trajectory_files import checks
from crazysim.lab.trajectory_files.pieces import require_no_jumps, split_pieces, trajectory_pieces
from crazysim.trajectories.bezier import control_points, power_coefficients, significant_degree
from crazysim.trajectories.splines import trajectory_from_unit_pieces
from crazysim.trajectories.trajectory import Trajectory

ENCODINGS = ("COMPRESSED", "POLY4D")
"""Formats in which a Crazyflie receives a trajectory."""
MAX_DEGREE = 7
"""Highest degree of a curve."""
COEFFICIENT_TOLERANCE = 1e-6
"""Largest coefficient that may be left out to lower the degree of a curve, m or rad."""


def parse_trajectory(value: object, location: str, yaw_control: object = None) -> tuple[Trajectory, str]:
    """Return the trajectory in a ``trajectory.json``, from the start of the show on, and its encoding.

    Each point is ``[t, [x, y, z], [control points]]``: the end of a Bezier curve that begins at the previous point,
    with up to six inner control points. Times count from ``takeoffTime``; the vehicle rests at the first point
    until its time. A fourth coordinate is the yaw, degrees. Other keys are ignored.

    Args:
        value: The JSON object.
        location: File and location in it, for messages.
        yaw_control: Skybrush's ``yawControl`` object, whose setpoints, degrees, are connected linearly and replace the
            yaw of the points; None if there is none.
    """
    value = checks.require_object(value, location)
    checks.require_version_one(value, location)
    encoding = value.get("type", ENCODINGS[0])
    if encoding not in ENCODINGS:
        checks.raise_error(f"type {' or '.join(ENCODINGS)}", short_repr(encoding), location)
    points = checks.require_array(value.get("points"), checks.MAX_POINTS, f"{location}, points")
    if not points:
        checks.raise_error("at least one point", "none", location)
    for key in ("takeoffTime", "landingTime"):
        if value.get(key) is not None:
            checks.require_number(value[key], f"{location}, {key}", 0.0, checks.MAX_TIME)
    takeoff = float(value.get("takeoffTime") or 0.0)

    times, curves, last_point = [], [], None
    n_axes = len(points[0][1]) if _is_point(points[0]) else 3
    for i, point in enumerate(points):
        point_location = f"{location}, point {i}"
        if not _is_point(point):
            checks.raise_error("[time, [x, y, z], [control points]]", short_repr(point), point_location)
        times.append(checks.require_number(point[0], point_location, 0.0, checks.MAX_TIME))
        end = checks.require_numbers(point[1], [n_axes] if i else [3, 4], checks.MAX_COORDINATE, point_location)
        handles = (
            checks.require_array(point[2], MAX_DEGREE - 1, f"{point_location}, control points")
            if len(point) > 2
            else []
        )
        if last_point is None and handles:
            checks.raise_error("no control points of the first point", f"{len(handles)}", point_location)
        if last_point is not None:
            handle_points = [
                checks.require_numbers(x, [n_axes], checks.MAX_COORDINATE, point_location) for x in handles
            ]
            curves.append(np.stack([last_point, *handle_points, end]))
        last_point = end
    checks.require_ascending(np.array(times), checks.MIN_LENGTH, location)
    start = takeoff + times[0]
    if times[-1] + takeoff > checks.MAX_TIME:
        checks.raise_error(f"at most {checks.MAX_TIME:g} s", f"{times[-1] + takeoff:g} s", location)
    first_curve = curves[0][:1] if curves else np.asarray(last_point)[None]
    ends = [takeoff + t for t in times[1:]]
    if start >= checks.MIN_LENGTH or not curves:  # a shorter rest is added to the first curve
        ends, curves = [max(start, checks.MIN_LENGTH), *ends], [first_curve, *curves]
    return _make_trajectory(np.array(ends), curves, yaw_control, location), encoding


def _is_point(point: object) -> TypeGuard[list[Any]]:
    return isinstance(point, list) and 2 <= len(point) <= 3 and isinstance(point[1], list)


def _make_trajectory(ends: NDArray, curves: list, yaw_control: object, location: str) -> Trajectory:
    degree = max(len(curve) for curve in curves) - 1
    c = np.zeros((len(curves), 4, max(degree, 1) + 1))
    for k, curve in enumerate(curves):
        c[k, : curve.shape[1], : len(curve)] = power_coefficients(curve)
    c[:, 3] = np.deg2rad(c[:, 3])
    if yaw_control is not None:
        ends, c = _with_yaw(ends, c, yaw_control, f"{location}, yawControl")
    return trajectory_from_unit_pieces(np.diff(ends, prepend=0.0), c)


def _with_yaw(ends: NDArray, coefficients: NDArray, yaw_control: object, location: str) -> tuple[NDArray, NDArray]:
    # The times of the setpoints count from the start of the show, unlike those of the points.
    value = checks.require_object(yaw_control, location)
    checks.require_version_one(value, location)
    setpoints = checks.require_array(value.get("setpoints"), checks.MAX_POINTS, location)
    if not setpoints:
        return ends, coefficients
    pairs = np.array(
        [
            checks.require_numbers(x, [2], checks.MAX_COORDINATE, f"{location}, entry {i}")
            for i, x in enumerate(setpoints)
        ]
    )
    times, yaw = pairs[:, 0], np.deg2rad(pairs[:, 1])
    checks.require_ascending(times, checks.MIN_LENGTH, location)
    ends, coefficients = split_pieces(ends, coefficients, times)
    starts = np.concatenate([[0.0], ends[:-1]])
    coefficients[:, 3] = 0.0
    coefficients[:, 3, 0] = np.interp(starts, times, yaw)
    coefficients[:, 3, 1] = np.interp(ends, times, yaw) - coefficients[:, 3, 0]
    return ends, coefficients


def format_trajectory(trajectory: Trajectory, encoding: str = "COMPRESSED", with_yaw: bool = True) -> dict[str, Any]:
    """Return a trajectory as the contents of a ``trajectory.json``.

    Curves have degree 1, 3 or 7 in a compressed trajectory, and degree 1 to 7 in any other.

    Args:
        trajectory: Trajectory of one vehicle.
        encoding: ``COMPRESSED`` or ``POLY4D``.
        with_yaw: Whether to write the yaw as the fourth coordinate, degrees.
    """
    require(encoding in ENCODINGS, f"expected type {' or '.join(ENCODINGS)}, got {encoding!r}. Use one of these.")
    ends, c = trajectory_pieces(trajectory)
    degrees = (1, 3, 7) if encoding == "COMPRESSED" else range(1, MAX_DEGREE + 1)
    c = c if with_yaw else c[:, :3]
    require_no_jumps(ends, c)
    dtype = np.asarray(trajectory.coefficients).dtype

    def format_point(point: NDArray) -> list[float]:
        point = np.array(point)
        point[3:] = np.rad2deg(point[3:])
        return [float(str(x)) for x in point.astype(dtype)]

    points: list[Any] = [[0.0, format_point(c[0, :, 0]), []]]
    for end, axes in zip(ends, c, strict=True):
        lowest_degree = significant_degree(axes, COEFFICIENT_TOLERANCE)
        require(
            lowest_degree <= MAX_DEGREE,
            f"expected polynomials of degree {MAX_DEGREE} at most, got degree {lowest_degree}",
        )
        degree = min(d for d in degrees if d >= lowest_degree)
        curve = control_points(axes[:, : degree + 1], degree)
        points.append([float(end), format_point(curve[-1]), [format_point(x) for x in curve[1:-1]]])
    return {
        "version": 1,
        "points": points,
        "takeoffTime": 0.0,
        "landingTime": float(ends[-1]),
        "type": encoding,
    }
