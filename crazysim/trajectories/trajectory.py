"""Trajectories: position and yaw of one vehicle over time, as piecewise polynomials."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments, check_flag
from crazysim.control.setpoint import Setpoint
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import PyTree, float_dtype, leaf
from crazysim.errors import ConfigError, expect, require
from crazysim.tables import read_floats
from crazysim.trajectories.interpolation import unit_coefficients

MAX_COUNTED_PIECES = 16
"""Largest number of pieces of a single trajectory at which ``_find_piece`` counts ends instead of bisecting."""
MAX_SIZE = 1e6
"""Largest coordinate, m, angle, rad, or number of oscillations."""
N_DERIVATIVES = 4
"""Highest derivative of a setpoint: snap."""


class Trajectory(PyTree):
    """Position and yaw of one vehicle as piecewise polynomials of time; leading axes hold several trajectories.

    Each piece is a polynomial of ``u`` in [0, 1], the time since its start divided by its length; this limits rounding
    errors in float32. Before its start a trajectory is at rest at its first point. After its end it is at rest at its
    last point, or starts again if ``repeats`` is True.
    """

    ends: Array = leaf("shared", 1)
    """End of each piece, s since the start of the trajectory, ascending. Padding repeats the last end. (n_pieces,)"""
    coefficients: Array = leaf("shared", 3)
    """Coefficients of x, y, z, m, and yaw, rad, in each piece, constant term first, as polynomials in ``u``.
    (n_pieces, 4, degree + 1)"""
    repeats: Array = leaf("shared", 0)
    """Whether the trajectory starts again after its end. ()"""

    @staticmethod
    def of_pieces(durations: ArrayLike, coefficients: ArrayLike, repeats: bool = False) -> Trajectory:
        """Join pieces that are polynomials in seconds, computed in float64 on the host.

        Args:
            durations: Length of each piece, s. (n_pieces,)
            coefficients: Coefficients of x, y, z, m, and yaw, rad, in each piece, constant term first, as polynomials
                in the time since its start, s. An omitted yaw is zero. (n_pieces, 4, degree + 1) or (n_pieces, 3,
                degree + 1)
            repeats: Whether to start again after the end.
        """
        lengths, c = read_floats("durations", durations), read_floats("coefficients", coefficients)
        require(
            lengths.ndim == 1 and lengths.size and c.ndim == 3 and c.shape[1] in (3, 4) and len(c) == len(lengths),
            f"expected durations (n_pieces,) and coefficients (n_pieces, 4, degree + 1), or (n_pieces, 3, "
            f"degree + 1) without yaw, got shapes {lengths.shape} and {c.shape}. Pass one set of coefficients "
            "per piece.",
        )
        ends = ends_of(lengths)
        if c.shape[1] == 3:
            c = np.concatenate([c, np.zeros_like(c[:, :1])], axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            c = (c * lengths[:, None, None] ** np.arange(c.shape[2])).astype(float_dtype())
        require(
            c.shape[2] and np.all(np.isfinite(c)),
            f"expected coefficients finite in {c.dtype.name}, at least one for each axis, got shape {c.shape}. Check "
            "the input for NaN and for numbers that are too large.",
        )
        return Trajectory(ends, c, np.bool_(check_flag("repeats", repeats)))  # type: ignore[arg-type]

    @property
    def n_pieces(self) -> int:
        """Number of pieces, including padding."""
        return self.ends.shape[-1]

    @property
    def degree(self) -> int:
        """Largest degree of the polynomials."""
        return self.coefficients.shape[-1] - 1

    @property
    def duration(self) -> Array:
        """Time from the start to the end, s. (...)"""
        return self.ends[..., -1]

    @check_arguments
    @jit_eager_calls()
    def evaluate(self, t: ArrayLike) -> Setpoint:
        """Evaluate the setpoint of one trajectory at one time, with derivatives up to snap.

        Where two pieces meet, the later piece is evaluated. Use ``jax.vmap`` for several trajectories or times.

        Args:
            t: Time since the start of the trajectory, s. ()
        """
        return _build_setpoint(self.derivatives(t, N_DERIVATIVES))

    @check_arguments
    def evaluate_one(self, index: Array | int, t: ArrayLike) -> Setpoint:
        """Evaluate the setpoint of one of several trajectories at one time, with derivatives up to snap.

        It reads only the coefficients of one piece and a few ends, so the cost hardly depends on the number of
        trajectories.

        Args:
            index: Index along the single leading axis, clipped to the valid range. ()
            t: Time since the start of the trajectory, s. ()
        """
        return self.evaluate_at_rate(index, t, 1.0)

    def evaluate_at_rate(
        self, index: Array | int, t: ArrayLike, rate: Array | float, degrees: Sequence[int] | None = None
    ) -> Setpoint:
        """Evaluate the setpoint of one of several trajectories, flown ``rate`` times as fast.

        Args:
            index: Index along the single leading axis, as for ``evaluate_one``. ()
            t: Time since the start in the trajectory's own time, s. ()
            rate: Advance of the trajectory's own time per second of flight. ()
            degrees: Largest degrees of x, y, z and yaw over all pieces, -1 for an axis that is zero; coefficients of
                higher degrees are ignored. None to use ``degree`` for all axes. (4,)
        """
        ends, coefficients = jnp.asarray(self.ends), jnp.asarray(self.coefficients)
        require(
            ends.ndim == 2,
            f"expected trajectories along one leading axis, got ends of shape {ends.shape}. Use evaluate(t) for a "
            f"single trajectory, and Trajectory.stack for several.",
        )
        # Piece at this time, and the time within it.
        end, repeats = _clipped_entry(ends, index, ends.shape[1] - 1), _clipped_entry(jnp.asarray(self.repeats), index)
        local_time, is_active = _local_time(jnp.asarray(t, ends.dtype), end, repeats)
        piece = _find_piece(ends, index, local_time)
        start = jnp.where(piece > 0, _clipped_entry(ends, index, piece - 1), 0.0)
        inverse = _inverse_length(jnp, _clipped_entry(ends, index, piece) - start)
        u, piece_coefficients = (local_time - start) * inverse, _clipped_entry(coefficients, index, piece)
        # Axes of equal degree are evaluated together.
        degrees = [self.degree] * 4 if degrees is None else degrees
        derivatives_by_axis: dict[int, list[Array]] = {}
        for degree in sorted(set(degrees)):
            axes = [k for k, d in enumerate(degrees) if d == degree]
            derivatives = _polynomial_derivatives(piece_coefficients[np.array(axes), : degree + 1], u, N_DERIVATIVES)
            derivatives_by_axis.update((axis, [x[k] for x in derivatives]) for k, axis in enumerate(axes))
        values = [jnp.stack([derivatives_by_axis[axis][k] for axis in range(4)]) for k in range(N_DERIVATIVES + 1)]
        return _build_setpoint(_scale_derivatives(values, jnp.where(is_active, inverse * rate, 0.0)))

    @check_arguments
    def derivatives(self, t: ArrayLike, order: int) -> list[Array]:
        """Evaluate x, y, z, m, and yaw, rad, of one trajectory at one time, and their derivatives up to an order.

        Args:
            t: Time since the start of the trajectory, s. ()
            order: Highest derivative to compute, at most 4.

        Returns:
            Values, their first derivatives, and so on. (4,) each
        """
        self._require_single("evaluate_one(index, t)")
        require(
            (shape := jnp.asarray(t).shape) == (),
            f"expected one time, got shape {shape}. Use jax.vmap(trajectory.evaluate)(times) for several.",
        )
        expect(
            not isinstance(order, bool) and isinstance(order, (int, np.integer)) and 0 <= order <= N_DERIVATIVES,
            f"an order from 0 to {N_DERIVATIVES}",
            order,
        )
        xp, n = _array_module(self), self.n_pieces
        starts = xp.concatenate([xp.zeros_like(self.ends[:1]), self.ends[:-1]])
        # A table with one row for each piece needs a single lookup. The parts of a row begin at multiples of four.
        piece_columns = [starts, _inverse_length(xp, self.ends - starts), xp.zeros((2, n), self.ends.dtype)]
        table = xp.concatenate([xp.vstack(piece_columns).T, self.coefficients.reshape(n, -1)], axis=1)
        local_time, is_active = _local_time(jnp.asarray(t, self.ends.dtype), self.ends[-1], self.repeats)
        piece = _find_piece(jnp.asarray(self.ends)[None], 0, local_time)
        row = jnp.asarray(table).at[piece].get(mode="promise_in_bounds")
        derivatives = _polynomial_derivatives(row[4:].reshape(4, -1), (local_time - row[0]) * row[1], order)
        return _scale_derivatives(derivatives, jnp.where(is_active, row[1], 0.0))

    def degrees(self) -> tuple[int, ...]:
        """Return the largest degree with a nonzero coefficient of x, y, z and yaw, or -1 for none, on the host.

        If the coefficients are traced, as under ``jax.jit``, it is ``degree`` for every axis.
        """
        if isinstance(self.coefficients, jax.core.Tracer):
            return (self.degree,) * 4
        c = np.asarray(self.coefficients)
        is_used = np.any(c.reshape(-1, *c.shape[-2:]) != 0, axis=0)
        return tuple([int(np.max(np.flatnonzero(row), initial=-1)) for row in is_used])

    @staticmethod
    def stack(trajectories: Sequence[Trajectory]) -> Trajectory:
        """Stack several trajectories in one record with a new first axis, padded to common sizes.

        Args:
            trajectories: Single trajectories.
        """
        trajectories = trajectory_list(trajectories)
        n_pieces, degree = max(t.n_pieces for t in trajectories), max(t.degree for t in trajectories)
        padded_trajectories = [t.padded(n_pieces, degree) for t in trajectories]
        xp = _array_module(padded_trajectories)
        return jax.tree.map(lambda *leaves: xp.stack(leaves), *padded_trajectories)

    def unstacked(self) -> list[Trajectory]:
        """Split a record into the trajectories along its leading axis; a single trajectory gives a list of one."""
        if np.ndim(self.ends) == 1:
            return [self]
        return [jax.tree.map(lambda x, k=k: x[k], self) for k in range(len(self.ends))]

    def padded(self, n_pieces: int, degree: int) -> Trajectory:
        """Pad this trajectory of one vehicle to at least ``n_pieces`` pieces and a degree of ``degree``.

        Added pieces have no length and stay at the last point.
        """
        self._require_single("unstacked()")
        xp = _array_module(self)
        n_added_pieces, n_added_degrees = max(0, n_pieces - self.n_pieces), max(0, degree - self.degree)
        ends = xp.concatenate([self.ends, xp.broadcast_to(self.ends[-1:], (n_added_pieces,))])
        coefficients = xp.pad(self.coefficients, ((0, 0), (0, 0), (0, n_added_degrees)))
        end_pose = xp.sum(coefficients[-1:], axis=-1, keepdims=True)
        rest_piece = xp.pad(end_pose, ((0, 0), (0, 0), (0, self.degree + n_added_degrees)))
        rest_piece = xp.broadcast_to(rest_piece, (n_added_pieces, *rest_piece.shape[1:]))
        return self.replace(ends=ends, coefficients=xp.concatenate([coefficients, rest_piece]))

    def repeat(self, n: int | None = None) -> Trajectory:
        """Repeat this trajectory of one vehicle several times in succession.

        A closed curve such as a circle repeats without end. ``repeat(n)`` ends it after n rounds, so that another
        trajectory can follow by ``then``; ``repeat()`` makes any trajectory start again after its end.

        Args:
            n: Number of rounds before the trajectory ends; None to repeat without end.
        """
        if n is None:
            return self.replace(repeats=np.bool_(True))
        require(
            not isinstance(n, bool) and isinstance(n, (int, np.integer)) and n >= 1,
            f"expected a number of rounds of at least 1, got {n!r}. Use None for no end.",
        )
        self._require_single("unstacked()")
        xp = _array_module(self)
        rounds = xp.arange(n, dtype=self.ends.dtype)[:, None] * self.ends[-1]
        return Trajectory(
            (rounds + self.ends).reshape(-1),
            xp.tile(self.coefficients, (n, 1, 1)),
            np.bool_(False),  # type: ignore
        )

    def then(self, other: Trajectory, transition: float = 0.0) -> Trajectory:
        """Append another trajectory to this one of one vehicle; it starts when this one ends.

        Without a transition, a difference between this trajectory's end and the other one's start is a jump of the
        position, or of the velocity, for example from rest into a curve.

        Args:
            transition: Duration of an additional piece of degree 7 that connects the two trajectories, s; 0 for none.
                Velocity, acceleration and jerk are continuous, and the yaw turns the shorter way.
        """
        expect(isinstance(other, Trajectory), "a trajectory to follow", other, "Use a.then(b).")
        self._require_single("unstacked()")
        other._require_single("unstacked()")
        if self.repeats or other.repeats:
            position = "first" if self.repeats else "second"
            raise ConfigError(
                f"expected trajectories that end, got a {position} one that repeats without end. Use its repeat(n), "
                f"such as repeat(1) for one round."
            )
        is_number = isinstance(transition, (int, float, np.number)) and not isinstance(transition, bool)
        require(
            is_number and 0 <= transition <= MAX_SIZE,
            f"expected a transition from 0 to {MAX_SIZE:g} s, got {transition!r}. Use for example 1.0.",
        )
        # A piece of degree 7 joins the derivatives at both ends.
        if transition > 0:
            before, after = self._end_derivatives(at_end=True), other._end_derivatives(at_end=False)
            # The yaw turns the shorter way.
            yaw_shift = 2 * np.pi * np.round((before[0, 3] - after[0, 3]) / (2 * np.pi))
            after[0, 3] += yaw_shift
            lengths = np.array([transition], float)
            coefficients = unit_coefficients(np.stack([before, after]), lengths).astype(self.coefficients.dtype)
            ends = lengths.astype(self.ends.dtype)
            piece = Trajectory(ends, coefficients, np.bool_(False))  # type: ignore[arg-type]
            shifted_coefficients = other.coefficients + np.pad([[yaw_shift]], ((3, 0), (0, other.degree))).astype(
                coefficients.dtype
            )
            return self.then(piece).then(other.replace(coefficients=shifted_coefficients))
        # Both with the same degree, in one record.
        degree = max(self.degree, other.degree)
        first, second = self.padded(0, degree), other.padded(0, degree)
        xp = _array_module([first, second])
        return first.replace(
            ends=xp.concatenate([first.ends, first.ends[-1] + second.ends]),
            coefficients=xp.concatenate([first.coefficients, second.coefficients]),
        )

    def _require_single(self, remedy: str) -> None:
        require(
            np.ndim(self.ends) == 1,
            f"expected a trajectory of one vehicle, got several, with ends of shape {np.shape(self.ends)}. Use "
            f"{remedy} of them.",
        )

    def _end_derivatives(self, at_end: bool) -> np.ndarray:
        lengths = np.diff(np.asarray(self.ends, float), prepend=0.0)
        k = np.flatnonzero(lengths > 0)[-1 if at_end else 0]
        coefficients = np.asarray(self.coefficients[k], float).T
        return np.array([polyval(float(at_end), polyder(coefficients, m)) / lengths[k] ** m for m in range(4)])

    def moved(self, offset: ArrayLike = (0.0, 0.0, 0.0), yaw: ArrayLike = 0.0) -> Trajectory:
        """Rotate the trajectory around the z axis of the world, then translate it; leading axes are allowed.

        Args:
            offset: Displacement, m. (3,)
            yaw: Angle of the rotation, rad, which is also added to the yaw. ()
        """
        for name, value, shape in (("offset", offset, (3,)), ("yaw", yaw, ())):
            is_concrete = not isinstance(value, jax.core.Tracer)
            array = np.asarray(value) if is_concrete else value
            is_finite = is_concrete and array.dtype.kind in "iuf" and np.all(np.abs(array) <= MAX_SIZE)
            expect(
                array.shape == shape and (not is_concrete or is_finite),
                f"{name} as finite numbers of shape {shape} and a size up to {MAX_SIZE:g}",
                value,
            )
        xp = _array_module([self, offset, yaw])
        c, offset = self.coefficients, xp.asarray(offset, self.coefficients.dtype)
        cos, sin = xp.cos(yaw).astype(c.dtype), xp.sin(yaw).astype(c.dtype)
        x, y = cos * c[..., 0, :] - sin * c[..., 1, :], sin * c[..., 0, :] + cos * c[..., 1, :]
        rotated_coefficients = xp.stack([x, y, c[..., 2, :], c[..., 3, :]], axis=-2)
        constant = rotated_coefficients[..., :1] + xp.append(offset, xp.asarray(yaw, c.dtype))[:, None]
        return self.replace(coefficients=xp.concatenate([constant, rotated_coefficients[..., 1:]], axis=-1))


def ends_of(durations: NDArray[np.float64]) -> NDArray:
    """Return the end of each piece, s, after a check of the durations, s. (n_pieces,)"""
    with np.errstate(over="ignore", invalid="ignore"):
        ends = np.cumsum(durations).astype(float_dtype())
        steps = np.diff(ends, prepend=0.0)
    if not np.all(np.isfinite(ends)) or not np.all(durations > 0) or not np.all(steps > 0):
        k = int(np.argmin(np.where(np.isfinite(steps), steps, -np.inf)))
        raise ConfigError(
            f"expected finite, positive durations that add up to ascending times in {ends.dtype.name}, "
            f"got {durations[k]!r} s for piece {k}. Merge pieces that are too short."
        )
    return ends


def trajectory_list(trajectories: Trajectory | Sequence[Trajectory]) -> list[Trajectory]:
    """Return trajectories as a list of single ones.

    Args:
        trajectories: One trajectory, a sequence of single trajectories, or a ``Trajectory`` with one
            leading axis.
    """
    is_stack = isinstance(trajectories, Trajectory)
    items = trajectories.unstacked() if is_stack else list(trajectories) if np.iterable(trajectories) else []
    expect(
        items and all(isinstance(t, Trajectory) and np.ndim(t.ends) == 1 for t in items),
        "at least one trajectory, each of one vehicle",
        trajectories,
        "Pass a list with one per drone.",
    )
    return items


def _array_module(tree: object) -> Any:
    return jnp if any(isinstance(x, jax.Array) for x in jax.tree.leaves(tree)) else np


def _clipped_entry(x: Array, *index: Array | int) -> Array:
    return x.at[index].get(mode="clip", wrap_negative_indices=False)


def _local_time(t: Array, end: Array, repeats: Array) -> tuple[Array, Array]:
    local_time = jnp.where(t < 0, 0.0, t)
    # floor is a vector instruction; lax.rem would call a function for each number.
    local_time = local_time - jnp.where(repeats, end * lax.floor(local_time / end), 0.0)
    local_time = jnp.where(local_time > end, end, jnp.where(local_time < 0, 0.0, local_time))
    return local_time, (t >= 0) & (repeats | (t <= end))


def _inverse_length(xp: Any, length: Array) -> Array:
    return 1 / xp.where(length > 0, length, xp.ones_like(length))


def _scale_derivatives(derivatives: list[Array], rate: Array) -> list[Array]:
    factors = itertools.accumulate([rate] * (len(derivatives) - 1), lambda a, b: a * b)
    return [derivatives[0], *(x * factor for x, factor in zip(derivatives[1:], factors, strict=True))]


def _build_setpoint(derivatives: list[Array]) -> Setpoint:
    pos, vel, acc, jerk, snap = derivatives
    return Setpoint(
        pos=pos[:3], vel=vel[:3], acc=acc[:3], jerk=jerk[:3], snap=snap[:3],
        yaw=pos[3:], yaw_rate=vel[3:], yaw_acc=acc[3:],
    )  # fmt: skip


def _find_piece(ends: Array, index: Array | int, t: Array) -> Array:
    n = ends.shape[1]
    if len(ends) == 1 and n <= MAX_COUNTED_PIECES:
        return jnp.sum(ends[0, :-1] <= t, dtype=jnp.int32)
    low = jnp.zeros(jnp.shape(t), jnp.int32)
    for k in reversed(range((n - 1).bit_length())):
        middle = jnp.minimum(low + 2**k, n - 1)
        low = jnp.where(_clipped_entry(ends, index, middle - 1) <= t, middle, low)
    return low


def _polynomial_derivatives(coefficients: Array, u: Array, order: int) -> list[Array]:
    # The scheme, repeated on its own partial results, gives ``p^(k)(u) / k!``.
    columns = [coefficients[..., k] for k in reversed(range(coefficients.shape[-1]))]
    if not columns:
        return [jnp.zeros(coefficients.shape[:-1], coefficients.dtype)] * (order + 1)
    taylor = columns[:1]
    for column in columns[1:]:
        products = [taylor[0] * u + column]
        products += [taylor[k] * u + taylor[k - 1] for k in range(1, len(taylor))]
        taylor = [*products, taylor[-1]][: order + 1]
    taylor += [jnp.zeros_like(columns[0])] * (order + 1 - len(taylor))
    return [math.factorial(k) * value for k, value in enumerate(taylor)]
