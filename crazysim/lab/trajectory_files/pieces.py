"""Pieces of a trajectory on the host, without padding, for files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, expect, require
from crazysim.trajectories.bezier import restrict_interval
from crazysim.trajectories.trajectory import Trajectory

MAX_JUMPS = np.array([1e-3, 1e-3, 1e-3, np.deg2rad(0.1)])
"""Largest difference between the start of a piece and the end of the previous piece that is not regarded as a jump: x,
y, z, m, and yaw, rad. (4,)"""

ROUNDING = 1e-5
"""Fraction of a coordinate that may be due to float32 rounding."""


def trajectory_pieces(trajectory: Trajectory) -> tuple[NDArray, NDArray]:
    """Return the ends of a trajectory's pieces and their coefficients, in float64.

    Times are the shortest decimals that represent the times of the trajectory, so that 0.1 s is written as 0.1.

    Args:
        trajectory: Trajectory of one vehicle.

    Returns:
        Ends, s (n_pieces,), and coefficients of x, y, z, m, and yaw, rad, constant term first, in each piece's time
        scaled to [0, 1] (n_pieces, 4, degree + 1).
    """
    expect(isinstance(trajectory, Trajectory), "a trajectory", trajectory, "Use figure_eight(), for example.")
    ends = np.asarray(trajectory.ends)
    require(
        ends.ndim == 1,
        f"expected a trajectory of one vehicle, got ends of shape {ends.shape}. Save each one by itself, or all as "
        f"a show.",
    )
    times = np.array([float(str(x)) for x in ends])
    has_length = np.diff(times, prepend=0.0) > 0
    return times[has_length], np.asarray(trajectory.coefficients, float)[has_length]


def require_no_jumps(ends: NDArray, coefficients: NDArray) -> None:
    """Check that every piece begins where the previous piece ends, for formats that store only the ends of pieces.

    Args:
        ends: End of each piece, s. (n_pieces,)
        coefficients: Coefficients of x, y, z, m, and yaw, rad, in the pieces' times scaled to [0, 1]. (n_pieces, 4,
            degree + 1)
    """
    end_values = coefficients[:-1].sum(axis=-1)
    jumps = np.abs(coefficients[1:, :, 0] - end_values)
    is_jump = np.argwhere(jumps > MAX_JUMPS[: jumps.shape[1]] + ROUNDING * np.abs(end_values))
    if len(is_jump):
        piece, axis = is_jump[0]
        size = jumps[piece, axis]
        text = f"yaw of {np.rad2deg(size):.3g} degrees" if axis == 3 else f"{'xyz'[axis]} of {size:.3g} m"
        raise ConfigError(
            f"expected pieces that begin where the one before ends, which this format requires, got a jump in {text} "
            f"at {ends[piece]:g} s. Use moved() to align the parts, or join them by a line."
        )


def split_pieces(ends: NDArray, coefficients: NDArray, times: NDArray) -> tuple[NDArray, NDArray]:
    """Return pieces that are also split at ``times``, as their ends and coefficients.

    Args:
        ends: End of each piece, s. (n_pieces,)
        coefficients: Coefficients in the pieces' times scaled to [0, 1]. (n_pieces, k, degree + 1)
        times: Times, s. (n,)
    """
    inner_times = times[(times > 0) & (times < ends[-1])]
    cuts = np.union1d(ends, inner_times)
    cuts = cuts[np.diff(cuts, append=np.inf) > 1e-6]  # cuts within a microsecond are one cut
    cuts[-1] = ends[-1]
    cut_starts = np.concatenate([[0.0], cuts[:-1]])
    starts, lengths = np.concatenate([[0.0], ends[:-1]]), np.diff(ends, prepend=0.0)
    piece = np.minimum(np.searchsorted(ends, 0.5 * (cut_starts + cuts)), len(ends) - 1)
    parts = [
        restrict_interval(coefficients[k], (start - starts[k]) / lengths[k], (end - starts[k]) / lengths[k])
        for k, start, end in zip(piece, cut_starts, cuts, strict=True)
    ]
    return cuts, np.stack(parts)
