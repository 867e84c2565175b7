"""Paths on the ground: curves by arc length with signed curvature, projection onto them, and their timing.

``following.PathState`` explains references by time and by arc length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike, NDArray

from crazysim.engine.pytree import PyTree, float_dtype, leaf
from crazysim.errors import ConfigError
from crazysim.lab.planning.piece_table import PieceTable
from crazysim.rotation import clip
from crazysim.trajectories import interpolation
from crazysim.trajectories.splines import spline
from crazysim.trajectories.trajectory import Trajectory

MAX_PIECE_LENGTH = 0.1
"""Largest length of a piece of a path, m."""
MAX_PIECES = 100_000
"""Largest number of pieces of a path."""
N_SAMPLES = 8193
"""Number of samples of a curve for the integral of its arc length by the trapezoidal rule."""
N_TIMES = 257
"""Number of samples of the arc length as a function of time."""
NEWTON_STEPS = 2
"""Number of Newton steps of a projection, which begins at the result of the previous tick."""
MAX_NEWTON_STEP = 0.5
"""Largest displacement in one Newton step, m."""
STOPPING_LENGTH = 0.5
"""Distance from the end of an open path at which a reference by arc length begins to slow down, m."""
MIN_SPEED_FRACTION = 0.1
"""Smallest speed of a reference by arc length on a path ``of_trajectory``, as a fraction of the path's largest speed,
so that vehicles at rest can start. Only the slowdown at the end of an open path goes below it."""
MIN_CURVED_SPEED_FRACTION = 0.05
"""Parametric speed, as a fraction of its maximum, below which the curvature is set to zero."""
N_REPEATED_POINTS = 12
"""Number of points of a closed path that are repeated at both ends, so that its spline is smooth where it closes."""

Floats = NDArray[np.float64]


class PathPoint(NamedTuple):
    """A path at one arc length."""

    pos: Array
    """Position, world frame, m. (2,)"""
    tangent: Array
    """Unit tangent in the direction of increasing arc length. (2,)"""
    curvature: Array
    """Signed curvature, 1/m, positive where the path turns to the left. (1,)"""


class Path(PyTree):
    """One or several paths on the ground, parametrised by arc length, with their timing.

    Each piece is a polynomial of degree 5 that has the curve's position, tangent and curvature at both ends, so that
    the curvature is continuous. All pieces of a path have the same length.
    """

    coefficients: Array = leaf("shared", 4)
    """Coefficients of x and y, m, in each piece, constant term first, as a function of the fraction of the piece's
    length. Padding repeats the last piece. (n_paths, n_pieces, 2, 6)"""
    length: Array = leaf("shared", 1)
    """Length of each path, m. (n_paths,)"""
    spacing: Array = leaf("shared", 1)
    """Length of the pieces of each path, m. (n_paths,)"""
    closed: Array = leaf("shared", 1)
    """Whether a path ends at its start. (n_paths,)"""
    speeds: Array = leaf("shared", 2)
    """Speed at the start of each piece, m/s; negative to drive backwards. (n_paths, n_pieces)"""
    progress: Array = leaf("shared", 3)
    """Arc length, m, and its rate, m/s, at equally spaced times from start to end. (n_paths, n_times, 2)"""
    duration: Array = leaf("shared", 1)
    """Time from start to end, s. (n_paths,)"""

    @staticmethod
    def of_trajectory(trajectory: Trajectory, backwards: bool = False) -> Path:
        """Return the path and the timing of a trajectory's x and y; closed if the trajectory repeats.

        Args:
            trajectory: Trajectory of one vehicle.
            backwards: Whether to drive along the path in reverse gear.
        """
        pieces, curve = _horizontal_curve(trajectory)

        times = np.linspace(0.0, pieces.duration, N_SAMPLES)
        speed = np.hypot(*curve(times, 1).T)
        sample_times = np.linspace(0.0, pieces.duration, N_TIMES)
        arc = _arc_length(times, speed)
        progress = np.stack([np.interp(sample_times, times, arc), np.hypot(*curve(sample_times, 1).T)], axis=1)
        return _path_of_curve(curve, times, speed, progress, bool(np.asarray(trajectory.repeats)), backwards)

    @staticmethod
    def of_points(points: ArrayLike, speed: float = 1.0, closed: bool = False) -> Path:
        """Fit the smoothest path through points, at a constant speed.

        The path is a quintic spline, parametrised by the cumulative chord length.

        Args:
            points: Points, x and y, world frame, m; a closed path does not repeat its first point. (n_points, 2)
            speed: Speed, m/s; negative to drive backwards.
            closed: Whether the path ends at its start.
        """
        xy = np.asarray(points, float)
        if xy.ndim != 2 or xy.shape[1] != 2 or len(xy) < 3 or not np.all(np.isfinite(xy)):
            raise ConfigError(
                f"expected at least three points (n_points, 2), finite, got shape {xy.shape}. Use "
                f"Path.of_points([(0, 0), (1, 0), (2, 1)])."
            )
        if not np.isfinite(speed) or speed == 0:
            raise ConfigError(
                f"expected a speed other than zero, m/s, got {speed!r}. Use speed=1.0, or a negative one to reverse."
            )
        if closed:
            xy = xy[np.arange(-N_REPEATED_POINTS, len(xy) + N_REPEATED_POINTS + 1) % len(xy)]
        chords = np.hypot(*np.diff(xy, axis=0).T)
        if not np.all(chords > 0):
            raise ConfigError(
                f"expected points that differ from their neighbours, got {xy[np.argmin(chords)].tolist()} twice. Leave "
                f"one out; a closed path does not repeat its first point."
            )
        knots = np.concatenate([[0.0], np.cumsum(chords)])
        trajectory = spline(knots, np.pad(xy, ((0, 0), (0, 1))), at_rest=False)
        start, end = (knots[N_REPEATED_POINTS], knots[-1 - N_REPEATED_POINTS]) if closed else (0.0, knots[-1])
        _, curve = _horizontal_curve(trajectory)

        parameters = np.linspace(start, end, N_SAMPLES)
        parametric_speed = np.hypot(*curve(parameters, 1).T)
        length = _arc_length(parameters, parametric_speed)[-1]
        progress = np.stack([np.linspace(0.0, length, N_TIMES), np.full(N_TIMES, abs(speed))], axis=1)
        return _path_of_curve(curve, parameters, parametric_speed, progress, closed, speed < 0, abs(speed))

    @staticmethod
    def stack(paths: Sequence[Path]) -> Path:
        """Stack several paths in one record."""
        if not paths:
            raise ConfigError("expected at least one path, got none. Use Path.stack([Path.of_points(points)]).")
        n = max(path.n_pieces for path in paths)
        padded_paths = []
        for path in paths:
            n_missing = n - path.n_pieces
            last = np.repeat(path.coefficients[:, -1:], n_missing, axis=1)
            coefficients = np.concatenate([path.coefficients, last], axis=1)
            speeds = np.concatenate([path.speeds, np.repeat(path.speeds[:, -1:], n_missing, axis=1)], axis=1)
            padded_paths.append(path.replace(coefficients=coefficients, speeds=speeds))
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *padded_paths)

    @property
    def n_paths(self) -> int:
        """Number of paths."""
        return self.coefficients.shape[0]

    @property
    def n_pieces(self) -> int:
        """Largest number of pieces of a path."""
        return self.coefficients.shape[1]

    @property
    def goes_backwards(self) -> bool:
        """Whether any path is driven backwards; computed on the host."""
        return bool(np.any(np.asarray(self.speeds) < 0))

    def point_at(self, index: Array | int, s: Array) -> PathPoint:
        """Return the point of a path at an arc length; closed paths start again, open paths stay at their ends.

        Args:
            index: Index of the path. ()
            s: Arc length, m. ()
        """
        piece, u = self._locate(index, s)
        return _evaluate(_entry_at(self.coefficients, index, piece), u)

    def speed_at(self, index: Array | int, s: Array) -> Array:
        """Return the speed at an arc length, m/s. (1,)

        It decreases linearly to zero over the last ``STOPPING_LENGTH`` of an open path.
        """
        piece, _ = self._locate(index, s)
        slowdown = clip((_entry_at(self.length, index) - s) / STOPPING_LENGTH, 0.0, 1.0)
        slowdown_factor = jnp.where(_entry_at(self.closed, index), 1.0, slowdown)
        return (slowdown_factor * _entry_at(self.speeds, index, piece))[None]

    def time_reference(self, index: Array | int, t: Array) -> tuple[Array, Array]:
        """Return the arc length, m, and the speed, m/s, at a time. (1,) each

        On an open path the vehicle rests before the start and after the end. On a closed path the motion continues in
        both directions, and the arc length increases with every lap.

        Args:
            index: Index of the path. ()
            t: Time since the start, s. ()
        """
        duration, is_closed = _entry_at(self.duration, index), _entry_at(self.closed, index)
        laps = jnp.where(is_closed, lax.floor(t / duration), 0.0)
        lap_time = clip(t - laps * duration, 0.0, duration)
        step = duration / (N_TIMES - 1)
        node = jnp.minimum(lax.floor(lap_time / step), N_TIMES - 2.0)
        k, u = node.astype(jnp.int32), lap_time / step - node
        (s0, v0), (s1, v1) = _entry_at(self.progress, index, k), _entry_at(self.progress, index, k + 1)
        ds, v0, v1 = s1 - s0, v0 * step, v1 * step
        c2, c3 = 3 * ds - 2 * v0 - v1, v0 + v1 - 2 * ds  # cubic Hermite interpolation
        s = s0 + u * (v0 + u * (c2 + u * c3))
        is_moving = is_closed | ((t >= 0) & (t <= duration))
        v = jnp.where(is_moving, (v0 + u * (2 * c2 + 3 * u * c3)) / step, 0.0)
        sign = jnp.where(_entry_at(self.speeds, index, 0) < 0, -1.0, 1.0)
        return (s + laps * _entry_at(self.length, index))[None], (sign * v)[None]

    def project(self, index: Array | int, pos: Array, guess: Array) -> Array:
        """Project a position to a path, from a guess nearby; return the arc length of the nearest point, m. ()

        Newton's method, with steps ``along_error / (1 - curvature lateral_error)`` of at most ``MAX_NEWTON_STEP``. The
        errors are the components of the offset along the tangent and to its left. Usable in compiled code.
        On a closed path the arc length increases with every lap.

        Args:
            index: Index of the path. ()
            pos: Position, world frame, m. (2,)
            guess: Arc length nearby, m. ()
        """
        s, length, is_closed = guess, _entry_at(self.length, index), _entry_at(self.closed, index)
        for _ in range(NEWTON_STEPS):
            point = self.point_at(index, s)
            offset = pos - point.pos
            along_error = offset[0] * point.tangent[0] + offset[1] * point.tangent[1]
            lateral_error = point.tangent[0] * offset[1] - point.tangent[1] * offset[0]
            s = s + clip(
                along_error / jnp.maximum(1 - point.curvature[0] * lateral_error, 0.2),
                -MAX_NEWTON_STEP,
                MAX_NEWTON_STEP,
            )
            s = jnp.where(is_closed, s, clip(s, 0.0, length))
        return s

    def nearest_arc(self, index: int, pos: ArrayLike) -> float:
        """Return the arc length, m, of the sample of a whole path that is nearest to a position, on the host.

        Args:
            pos: Position, world frame, m. (2,)
        """
        n_pieces = round(float(self.length[index]) / float(self.spacing[index]))
        u = np.linspace(0.0, 1.0, 9)[:-1]
        powers = u[:, None] ** np.arange(6)
        points = np.einsum("uk,pak->pua", powers, np.asarray(self.coefficients[index][:n_pieces], float)).reshape(-1, 2)
        k = int(np.argmin(np.sum((points - np.asarray(pos, float)[:2]) ** 2, axis=1)))
        return k / 8 * float(self.spacing[index])

    def initial_pose(self, index: int, start: float) -> tuple[Floats, float, float]:
        """Return position, m (2,), heading of the vehicle, rad, and arc length, m, at time zero, on the host.

        Args:
            start: Time at which the vehicle is at the start of the path, s.
        """
        point, arc = jax.device_get(_point_at_time(self, np.int32(index), np.asarray(-start, float_dtype())))
        x, y = np.asarray(point.tangent, float) * (-1 if np.asarray(self.speeds)[index, 0] < 0 else 1)
        return np.asarray(point.pos, float), float(np.arctan2(y, x)), float(arc[0])

    def _locate(self, index: Array | int, s: Array) -> tuple[Array, Array]:
        length, spacing = _entry_at(self.length, index), _entry_at(self.spacing, index)
        s_in_lap = s - length * lax.floor(s / length)
        position = jnp.where(_entry_at(self.closed, index), s_in_lap, clip(s, 0.0, length)) / spacing
        piece = clip(lax.floor(position), 0.0, lax.floor(length / spacing - 0.5))
        return piece.astype(jnp.int32), position - piece


@jax.jit
def _point_at_time(path: Path, index: Array, t: Array) -> tuple[PathPoint, Array]:
    arc, _ = path.time_reference(index, t)
    return path.point_at(index, arc[0]), arc


def _horizontal_curve(trajectory: Trajectory) -> tuple[PieceTable, Callable[[Floats, int], Floats]]:
    pieces = PieceTable.create([trajectory])
    return pieces, lambda t, order: pieces.evaluate(np.zeros(len(t), int), t, order)[:, :2]


def _path_of_curve(
    curve: Callable[[Floats, int], Floats],
    parameters: Floats,
    parametric_speed: Floats,
    progress: Floats,
    closed: bool,
    backwards: bool,
    speed: float | None = None,
) -> Path:
    arc = _arc_length(parameters, parametric_speed)
    if not arc[-1] > 1e-3:
        raise ConfigError(
            f"expected a path longer than 1 mm, got {arc[-1]:.3g} m. Omit path to let the cars stand still."
        )
    if not arc[-1] <= MAX_PIECES * MAX_PIECE_LENGTH:
        raise ConfigError(
            f"expected a path of at most {MAX_PIECES * MAX_PIECE_LENGTH:g} m, got {arc[-1]:.4g} m. Split it."
        )
    moving_samples = np.flatnonzero(parametric_speed > 1e-3 * parametric_speed.max())
    if len(moving_samples) != moving_samples[-1] - moving_samples[0] + 1:
        stop = parameters[moving_samples[0] + np.argmax(np.diff(moving_samples) > 1)]
        x, y = curve(np.array([stop]), 0)[0]
        raise ConfigError(
            f"expected a path that stops only at its ends, got one without a tangent at ({x:.3g}, {y:.3g}) m. Split it "
            f"there."
        )
    n = max(4, int(np.ceil(arc[-1] / MAX_PIECE_LENGTH)))
    nodes = np.interp(np.linspace(0.0, arc[-1], n + 1), arc, parameters)
    # At rest the tangent is undefined.
    inner_nodes = np.clip(nodes, parameters[moving_samples[0]], parameters[moving_samples[-1]])
    pos, vel, acc = curve(nodes, 0), curve(inner_nodes, 1), curve(inner_nodes, 2)
    if closed and not np.allclose(pos[0], pos[-1], atol=1e-3):
        raise ConfigError(
            f"expected a closed path that ends at its start, got a gap of {np.hypot(*(pos[0] - pos[-1])):.3g} m. Let "
            f"the trajectory end where it starts, or not repeat."
        )
    node_speed = np.hypot(*vel.T)[:, None]
    tangent = vel / node_speed
    curvature = (acc - np.sum(acc * tangent, axis=1, keepdims=True) * tangent) / node_speed**2
    # Near rest the curvature of a polynomial grows without bound.
    curvature[node_speed[:, 0] < MIN_CURVED_SPEED_FRACTION * parametric_speed.max()] = 0.0
    spacing = arc[-1] / n
    derivatives = np.stack([pos, tangent, curvature], axis=1)
    coefficients = interpolation.unit_coefficients(derivatives, np.full(n, spacing))
    speeds = (
        np.full(n, speed)
        if speed is not None
        else np.maximum(node_speed[:-1, 0], MIN_SPEED_FRACTION * parametric_speed.max())
    )
    duration = progress[-1, 0] / speed if speed is not None else parameters[-1]
    arrays = (coefficients, arc[-1], spacing, speeds * (-1 if backwards else 1), progress, duration)
    coefficients, length, spacing, speeds, progress, duration = (np.asarray(x, float_dtype())[None] for x in arrays)
    return Path(coefficients, length, spacing, np.array([closed]), speeds, progress, duration)  # type: ignore[arg-type]


def _arc_length(parameters: Floats, parametric_speed: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum((parametric_speed[1:] + parametric_speed[:-1]) / 2 * np.diff(parameters))])


def _evaluate(coefficients: Array, u: Array) -> PathPoint:
    x = [coefficients[:, k] for k in range(6)]
    pos = x[0] + u * (x[1] + u * (x[2] + u * (x[3] + u * (x[4] + u * x[5]))))
    derivative = x[1] + u * (2 * x[2] + u * (3 * x[3] + u * (4 * x[4] + u * 5 * x[5])))
    second_derivative = 2 * x[2] + u * (6 * x[3] + u * (12 * x[4] + u * 20 * x[5]))
    inverse_length = lax.rsqrt(derivative[0] * derivative[0] + derivative[1] * derivative[1])
    curvature = (
        (derivative[0] * second_derivative[1] - derivative[1] * second_derivative[0])
        * inverse_length
        * inverse_length
        * inverse_length
    )
    return PathPoint(pos, derivative * inverse_length, curvature[None])


def _entry_at(x: Array, *index: Array | int) -> Array:
    return jnp.asarray(x).at[index].get(mode="clip", wrap_negative_indices=False)
