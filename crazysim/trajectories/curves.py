"""Trajectories of standard shapes: figure eight, Lissajous, circle, helix, line, hover.

Curves are fitted in float64 by pieces of degree 7. At both ends of a piece, position and first three derivatives equal
the curve's. The remainder of Hermite interpolation in a piece of length h, ``p^(8)(s) t^4 (t - h)^4 / 8!``, is at most
``max |p^(8)| (h / 2)^8 / 8!``. This bound determines the number of pieces.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_flag
from crazysim.errors import ConfigError, require
from crazysim.tables import MAX_NUMBER, read_floats
from crazysim.trajectories.interpolation import unit_coefficients
from crazysim.trajectories.trajectory import MAX_SIZE, Trajectory

FIT_TOLERANCE = 5e-6
"""Largest error of the position of a fitted curve, m. Rounding to float32 adds 6e-8 of a coordinate."""
MAX_PIECES = 20_000
"""Largest number of pieces of a fitted curve."""
PERIOD_RANGE = (1e-3, 1e6)
"""Shortest and longest period, s."""
DEFAULT_PERIOD = 5.0
"""Default period, s."""

Curve = Callable[[np.ndarray, int], np.ndarray]
"""Function from times, s (n,), and an order to the derivative of that order of x, y, z, m, and yaw, rad (n, 4)."""


def figure_eight(
    width: float = 2.0,
    depth: float = 1.0,
    period: float | None = None,
    speed: float | None = None,
    height: float = 1.0,
) -> Trajectory:
    """Trace a horizontal figure eight, ``(width/2 sin wt, depth/2 sin 2wt, height)``, that repeats.

    Args:
        width: Size along x, m.
        depth: Size along y, m.
        period: Period, s; None for 5 s, or for the period that ``speed`` requires.
        speed: Largest speed, m/s, instead of the period; it is reached in the middle.
        height: Height, m.
    """
    width, depth = (float(require_vector(name, x, ())) for name, x in (("width", width), ("depth", depth)))
    return lissajous((width / 2, depth / 2, 0.0), (1, 2, 1), period=period, speed=speed, center=(0.0, 0.0, height))


def lissajous(
    amplitudes: ArrayLike = (1.0, 1.0, 0.2),
    frequencies: ArrayLike = (1, 2, 3),
    phases: ArrayLike = (0.0, 0.0, 0.0),
    period: float | None = None,
    speed: float | None = None,
    center: ArrayLike = (0.0, 0.0, 1.0),
) -> Trajectory:
    """Trace a Lissajous curve, ``center + amplitudes sin(frequencies wt + phases)``, that repeats.

    Args:
        amplitudes: Half of the size along each axis, m. (3,)
        frequencies: Oscillations along each axis in one period, whole numbers. (3,)
        phases: Phase of each oscillation, rad. (3,)
        period: Period, s; None for 5 s, or for the period that ``speed`` requires.
        speed: Upper bound of the speed, m/s, instead of the period. It is reached if all axes are fastest at once.
        center: Centre, world frame, m. (3,)
    """
    a, k, phi, c = (require_vector(n, x) for n, x in zip(("amplitudes", "frequencies", "phases", "center"),
                                                  (amplitudes, frequencies, phases, center), strict=True))  # fmt: skip
    require(not np.any(k != np.round(k)), f"expected frequencies as whole numbers, got {frequencies!r}")
    w = 2 * np.pi / _resolve_period(period, speed, 2 * np.pi * float(np.linalg.norm(a * k)))

    def curve(t: np.ndarray, order: int) -> np.ndarray:
        pos = a * (k * w) ** order * np.sin(k * w * t[:, None] + phi + order * np.pi / 2)
        return np.pad(pos + (c if order == 0 else 0.0), ((0, 0), (0, 1)))

    return fit_curve(curve, 2 * np.pi / w, float(np.max(np.abs(a) * np.abs(k * w) ** 8)) * 3**0.5, repeats=True)


def circle(
    radius: float = 1.0,
    period: float | None = None,
    speed: float | None = None,
    height: float = 1.0,
    along: bool = False,
) -> Trajectory:
    """Trace a level circle around the z axis, counterclockwise from ``(radius, 0, height)``, that repeats.

    Args:
        radius: Radius, m.
        period: Period, s; None for 5 s, or for the period that ``speed`` requires.
        speed: Speed, m/s, instead of the period.
        height: Height, m.
        along: Whether to turn the drone's x axis along its motion; otherwise the yaw is zero.
    """
    return helix(radius, 0.0, 1.0, period, speed, height, along).replace(repeats=np.bool_(True))


def helix(
    radius: float = 1.0,
    climb: float = 0.5,
    turns: float = 3.0,
    period: float | None = None,
    speed: float | None = None,
    height: float = 0.5,
    along: bool = False,
) -> Trajectory:
    """Trace a helix around the z axis, counterclockwise from ``(radius, 0, height)``.

    Args:
        radius: Radius, m.
        climb: Height gained with each turn, m.
        turns: Number of turns.
        period: Time of one turn, s; None for 5 s, or for the time that ``speed`` requires.
        speed: Speed, m/s, instead of the period.
        height: Height of the start, m.
        along: Whether to turn the drone's x axis along its motion; otherwise the yaw is zero.
    """
    require_positive("turns", turns)
    check_flag("along", along)
    lengths = {"radius": radius, "climb": climb, "height": height}
    radius, climb, height = (float(require_vector(name, x, ())) for name, x in lengths.items())
    w = 2 * np.pi / _resolve_period(period, speed, math.hypot(2 * np.pi * radius, climb))

    def curve(t: np.ndarray, order: int) -> np.ndarray:
        shifted_angle = w * t + order * np.pi / 2  # each derivative of a sine or cosine adds a quarter turn
        angle_derivative = (w * t if order == 0 else np.full_like(t, w)) if order < 2 else np.zeros_like(t)
        z = climb / (2 * np.pi) * angle_derivative + (height if order == 0 else 0.0)
        yaw = angle_derivative * along + np.pi / 2 * (along and order == 0)
        x, y = radius * w**order * np.cos(shifted_angle), radius * w**order * np.sin(shifted_angle)
        return np.stack([x, y, z, yaw], axis=-1)

    return fit_curve(curve, 2 * np.pi / w * turns, abs(float(radius)) * w**8)


def line(
    start: ArrayLike, end: ArrayLike, duration: float | None = None, speed: float | None = None, yaw: float = 0.0
) -> Trajectory:
    """Trace a straight line from rest to rest, with acceleration and jerk zero at both ends.

    Args:
        start: First point, world frame, m. (3,)
        end: Last point, world frame, m. (3,)
        duration: Duration, s; None for 5 s, or for the duration that ``speed`` requires.
        speed: Largest speed, m/s, instead of the duration; it is reached in the middle.
        yaw: Yaw, rad.
    """
    a, b = require_vector("start", start), require_vector("end", end)
    # u^4 (35 - 84 u + 70 u^2 - 20 u^3) goes from 0 to 1, with three derivatives equal to zero at both ends. Its slope
    # is at most 140 (1/2)^6 = 35/16.
    time = _resolve_period(duration, speed, 35 / 16 * float(np.linalg.norm(b - a)), "duration")
    c = np.zeros((1, 4, 8))
    c[0, :3] = np.outer(b - a, [0, 0, 0, 0, 35, -84, 70, -20]) / time ** np.arange(8)
    c[0, :, 0] = [*a, require_vector("yaw", yaw, ())]
    return Trajectory.of_pieces([time], c)


def hover(pos: ArrayLike = (0.0, 0.0, 1.0), yaw: float = 0.0, duration: float = 1.0) -> Trajectory:
    """Stay at a point.

    Args:
        pos: The point, world frame, m. (3,)
        yaw: Yaw, rad.
        duration: Duration, s. A trajectory that is appended with ``then`` starts after it.
    """
    _resolve_period(duration, None, 0.0, "duration")
    return Trajectory.of_pieces(
        [duration], np.append(require_vector("pos", pos), require_vector("yaw", yaw, ()))[None, :, None]
    )


def fit_curve(curve: Curve, duration: float, max_eighth_derivative: float, repeats: bool = False) -> Trajectory:
    """Return a smooth curve as a trajectory of pieces of equal length, with errors of at most ``FIT_TOLERANCE``.

    Args:
        curve: The curve; derivatives up to the third are used.
        duration: Length of the curve, s.
        max_eighth_derivative: Upper bound of the eighth derivative of the curve, m/s^8.
        repeats: Whether to start again after the end.
    """
    max_piece_duration = (
        2 * (FIT_TOLERANCE * math.factorial(8) / max_eighth_derivative) ** (1 / 8)
        if max_eighth_derivative > 0
        else math.inf
    )
    if duration / max_piece_duration > MAX_PIECES:
        raise ConfigError(
            f"expected a curve of at most {MAX_PIECES} polynomials within {FIT_TOLERANCE * 1e6:g} um, got one of "
            f"{duration / max_piece_duration:.3g}. Use fewer turns or lower frequencies, or a smaller size."
        )
    n = max(1, math.ceil(duration / max_piece_duration))
    h = duration / n
    knots = np.linspace(0.0, duration, n + 1)
    coefficients = unit_coefficients(np.stack([curve(knots, k) for k in range(4)], axis=1), np.full(n, h))
    return Trajectory.of_pieces(np.full(n, h), coefficients / h ** np.arange(8), repeats)


def _resolve_period(period: float | None, speed: float | None, length: float, name: str = "period") -> float:
    require(
        period is None or speed is None,
        f"expected {name} or speed, got both: {period!r} s and {speed!r} m/s. Leave one out.",
    )
    if speed is None:
        time = require_positive(name, DEFAULT_PERIOD if period is None else period)
    else:
        require_positive("speed", speed)
        require(length != 0, f"expected a curve of some size for a speed of {speed!r} m/s, got a point. Use {name}=.")
        time = length / speed
    if not PERIOD_RANGE[0] <= time <= PERIOD_RANGE[1]:
        raise ConfigError(f"expected a {name} from {PERIOD_RANGE[0]:g} to {PERIOD_RANGE[1]:g} s, got {time:g} s")
    return time


def require_positive(name: str, value: float) -> float:
    """Return the value of a setting as a float after a check that it is positive and finite."""
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, (bool, np.complexfloating))
    require(is_number and 0 < value <= MAX_NUMBER, f"expected {name} as a positive number, got {value!r}")
    return float(value)


def require_vector(name: str, value: ArrayLike, shape: tuple[int, ...] = (3,)) -> NDArray[np.float64]:
    """Return the value of a setting as an array after a check of its shape, and of its numbers against ``MAX_SIZE``."""
    array = read_floats(name, value)
    if array.shape != shape or not np.all(np.abs(array) <= MAX_SIZE):
        kind = "3 finite numbers" if shape else "a finite number"
        raise ConfigError(f"expected {name} as {kind} of a size up to {MAX_SIZE:g}, got {value!r}")
    return array
