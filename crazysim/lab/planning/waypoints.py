"""Trajectories of minimum snap or jerk through waypoints, with corridors and limits, and a differentiable variant."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.errors import ConfigError, require
from crazysim.lab.planning import timing
from crazysim.lab.planning.corridors import HEIGHT_TOLERANCE, fill_in_corridors
from crazysim.lab.planning.limits import Limits, require_limits
from crazysim.tables import read_floats
from crazysim.trajectories import interpolation
from crazysim.trajectories.interpolation import Floats
from crazysim.trajectories.splines import require_finite, trajectory_from_unit_pieces, unwrap_yaw
from crazysim.trajectories.trajectory import MAX_SIZE, Trajectory, ends_of

YAW_ORDER = 2
"""Order of the yaw derivative in the cost of the yaw. The torque depends on the second derivative (Mellinger and Kumar
2011)."""


def minimum_snap(
    waypoints: ArrayLike,
    durations: ArrayLike | None = None,
    *,
    limits: Limits | None = None,
    yaw: ArrayLike = 0.0,
    corridors: ArrayLike | None = None,
    velocities: ArrayLike | None = None,
    accelerations: ArrayLike | None = None,
    jerks: ArrayLike | None = None,
) -> Trajectory:
    """Plan the trajectory through waypoints with the smallest integral of the squared snap.

    The torque of a multirotor follows from the snap of its path (Mellinger and Kumar, "Minimum snap trajectory
    generation and control for quadrotors", ICRA 2011). Pieces have degree 7, and derivatives up to the sixth are
    continuous. By default the drone starts and ends at rest and passes the other waypoints without a stop.

    Args:
        waypoints: Positions, world frame, m. (n, 3)
        durations: Time from each waypoint to the next, s. None for the shortest durations that meet the limits, in
            ratios that minimise the snap. (n - 1,)
        limits: Limits; required if ``durations`` is None. The path stays between floor and height. A trajectory
            with ``durations`` is checked against the other limits. The separation is not checked; use ``check`` for it.
        yaw: Yaw at the waypoints, rad: one value for all, or one per waypoint. Between waypoints the drone turns the
            shorter way, with the smallest integral of the squared angular acceleration. () or (n,)
        corridors: Largest distance from the line segment between two waypoints, m, infinite for no bound: one value for
            all segments, or one per segment. None for no corridors. () or (n - 1,)
        velocities: Velocities at the waypoints, world frame, m/s, NaN where free. None for rest at both ends and free
            elsewhere. (n, 3)
        accelerations: Accelerations, m/s^2; NaN and None as for ``velocities``. (n, 3)
        jerks: Jerks, m/s^3; NaN and None as for ``velocities``. (n, 3)
    """
    return _plan_trajectory(waypoints, durations, (velocities, accelerations, jerks), limits, yaw, corridors)


def minimum_jerk(
    waypoints: ArrayLike,
    durations: ArrayLike | None = None,
    *,
    limits: Limits | None = None,
    yaw: ArrayLike = 0.0,
    corridors: ArrayLike | None = None,
    velocities: ArrayLike | None = None,
    accelerations: ArrayLike | None = None,
) -> Trajectory:
    """Plan the trajectory through waypoints with the smallest integral of the squared jerk.

    The pieces have degree 5, and derivatives up to the fourth are continuous. Compared with ``minimum_snap``, the path
    is closer to the straight lines and the body rates are less smooth.

    Args:
        waypoints: Positions, world frame, m. (n, 3)
        durations: As for ``minimum_snap``. (n - 1,)
        limits: As for ``minimum_snap``.
        yaw: As for ``minimum_snap``. () or (n,)
        corridors: As for ``minimum_snap``. () or (n - 1,)
        velocities: As for ``minimum_snap``. (n, 3)
        accelerations: As for ``minimum_snap``. (n, 3)
    """
    return _plan_trajectory(waypoints, durations, (velocities, accelerations), limits, yaw, corridors)


def smoothest(waypoints: Array, durations: Array, order: int = 4) -> tuple[Trajectory, Array]:
    """Return the trajectory through waypoints with the smallest integral of a squared derivative, and this integral.

    Order 4 gives the trajectory of ``minimum_snap``, order 3 the trajectory of ``minimum_jerk``: at rest at both ends,
    without limits or corridors, and with zero yaw. It has gradients with respect to waypoints and durations, and works
    in ``jax.jit`` and ``jax.vmap``. Nothing is checked. In float32, up to about ten pieces whose durations vary by less
    than a factor of five are accurate to 1e-3 of the distances; use float64 for more.

    Args:
        waypoints: Positions, world frame, m. (n, 3)
        durations: Time from each waypoint to the next, s. (n - 1,)
        order: Order of the derivative: 2, 3 or 4.

    Returns:
        The trajectory, and the integral, m^2 / s^(2 order - 1). ()
    """
    n_pieces, k = len(durations), order
    dtype = jnp.result_type(waypoints, durations, float)
    waypoints, durations = jnp.asarray(waypoints, dtype), jnp.asarray(durations, dtype)
    time_unit = jnp.mean(durations)
    lengths = (durations / time_unit)[:, None]
    powers = jnp.concatenate([lengths**j for j in range(k)] * 2, axis=-1)  # (n_pieces, 2k)
    cost_blocks = (
        jnp.asarray(interpolation.unit_cost(k), dtype)
        * powers[:, :, None]
        * powers[:, None]
        * (lengths ** (1 - 2 * k))[..., None]
    )
    entries = k * np.arange(n_pieces)[:, None] + np.arange(2 * k)
    size = k * (n_pieces + 1)
    matrix = jnp.zeros((size, size), dtype).at[entries[:, :, None], entries[:, None, :]].add(cost_blocks)

    position_indices, inner_indices = np.arange(0, size, k), np.setdiff1d(np.arange(k, size - k), np.arange(0, size, k))
    values = jnp.zeros((size, 3), dtype).at[position_indices].set(waypoints)
    inner_matrix = matrix[inner_indices[:, None], inner_indices]
    row_scale = 1 / jnp.sqrt(jnp.diagonal(inner_matrix))[:, None]  # gives the scaled matrix a diagonal of ones
    rhs = -matrix[inner_indices[:, None], position_indices] @ waypoints
    values = values.at[inner_indices].set(
        row_scale * jnp.linalg.solve(row_scale * inner_matrix * row_scale.T, row_scale * rhs)
    )

    end_derivatives = values[entries]  # (n_pieces, 2k, 3)
    cost = jnp.sum(end_derivatives * jnp.einsum("pij,pja->pia", cost_blocks, end_derivatives)) * time_unit ** (
        1 - 2 * k
    )
    pos_coefficients = jnp.einsum(
        "cj,pj,pja->pac", jnp.asarray(interpolation.hermite_basis(k), dtype), powers, end_derivatives
    )
    coefficients = jnp.concatenate([pos_coefficients, jnp.zeros_like(pos_coefficients[:, :1])], axis=1)
    return Trajectory(jnp.cumsum(durations), coefficients, jnp.zeros((), bool)), cost


def _plan_trajectory(
    waypoints: ArrayLike,
    durations: ArrayLike | None,
    fixed_derivatives: Sequence[ArrayLike | None],
    limits: Limits | None,
    yaw: ArrayLike,
    corridors: ArrayLike | None,
) -> Trajectory:
    nodes = _waypoint_nodes(waypoints, fixed_derivatives)
    if limits is not None:
        require_limits(limits)
    n_pieces = len(nodes) - 1
    yaw_nodes = np.full((n_pieces + 1, YAW_ORDER, 1), np.nan)
    yaw_nodes[:, 0, 0], yaw_nodes[[0, -1], 1:] = unwrap_yaw(yaw, n_pieces + 1), 0.0
    radii, heights = _corridor_radii(corridors, n_pieces), _height_bounds(limits, nodes[:, 0, 2])

    def solve(lengths: Floats) -> Floats:
        try:
            filled_nodes = interpolation.fill_derivatives(nodes, lengths)
            if np.any(np.isfinite([*radii, *heights])):
                filled_nodes = fill_in_corridors(nodes, lengths, radii, heights)
        except np.linalg.LinAlgError as error:
            raise ConfigError(
                f"expected a unique trajectory, got {n_pieces + 1} waypoints with too few fixed derivatives. Add "
                f"waypoints, or fix the derivatives at the ends."
            ) from error
        pos_coefficients = interpolation.unit_coefficients(filled_nodes, lengths)
        yaw_coefficients = interpolation.unit_coefficients(interpolation.fill_derivatives(yaw_nodes, lengths), lengths)
        return np.concatenate(
            [pos_coefficients, interpolation.pad_degree(yaw_coefficients, pos_coefficients.shape[-1] - 1)], axis=1
        )

    if durations is not None:
        lengths = _check_durations(durations, n_pieces)
        coefficients = solve(lengths)
        if limits is not None and (names := timing.violated_limits(lengths, coefficients, limits)):
            factor = timing.shortest_durations(solve, lengths, limits)[0] / lengths[0]
            raise ConfigError(
                f"expected durations that meet the limits, got a trajectory that exceeds {' and '.join(names)}. "
                f"Multiply the durations by {factor * 1.001:.4g}, or omit them."
            )
        return trajectory_from_unit_pieces(lengths, coefficients)
    if limits is None:
        raise ConfigError("expected durations or limits, got neither. Pass limits=Limits(speed=..., acceleration=...).")
    distances = np.linalg.norm(np.diff(nodes[:, 0], axis=0), axis=-1)
    if not np.all(distances > 0):
        k = int(np.argmin(distances))
        raise ConfigError(
            f"expected waypoints that differ from their neighbours, got {nodes[k, 0].tolist()} as number {k} and "
            f"{k + 1}. Remove one, or pass durations."
        )
    initial_durations = timing.optimal_durations(nodes, timing.trapezoid_durations(distances, limits))
    is_scalable = np.all(np.nan_to_num(nodes[:, 1:]) == 0)  # then the path is the same at any speed
    if is_scalable:
        coefficients = solve(initial_durations)
        return trajectory_from_unit_pieces(
            timing.shortest_durations(lambda _: coefficients, initial_durations, limits), coefficients
        )
    lengths = timing.shortest_durations(solve, initial_durations, limits)
    return trajectory_from_unit_pieces(lengths, solve(lengths))


def _waypoint_nodes(waypoints: ArrayLike, fixed_derivatives: Sequence[ArrayLike | None]) -> Floats:
    positions = read_floats("waypoints", waypoints)
    require(
        positions.ndim == 2 and positions.shape[1] == 3 and len(positions) >= 2,
        f"expected waypoints (n, 3), at least two, got shape {positions.shape}. Pass an array with a row for each "
        f"point.",
    )
    nodes = np.full((len(positions), len(fixed_derivatives) + 1, 3), np.nan)
    nodes[:, 0] = require_finite(positions, "waypoints")
    for k, (name, values) in enumerate(
        zip(("velocities", "accelerations", "jerks"), fixed_derivatives, strict=False), start=1
    ):
        if values is None:
            nodes[[0, -1], k] = 0.0
            continue
        array = read_floats(name, values)
        require(
            array.shape == positions.shape and not np.any(np.abs(array) > MAX_SIZE),
            f"expected finite {name} {positions.shape} of a size up to {MAX_SIZE:g}, NaN where free, got shape "
            f"{array.shape}. Pass one row per waypoint.",
        )
        nodes[:, k] = array
    return nodes


def _corridor_radii(corridors: ArrayLike | None, n_pieces: int) -> Floats:
    radii = read_floats("corridors", np.inf if corridors is None else corridors)
    if radii.shape not in ((), (n_pieces,)) or not np.all(radii > 0):
        raise ConfigError(f"expected positive corridors, one or {n_pieces}, got {corridors!r}. Use inf for no bound.")
    return np.broadcast_to(radii, (n_pieces,))


def _height_bounds(limits: Limits | None, heights: Floats) -> tuple[float, float]:
    low, high = (None, None) if limits is None else (limits.floor, limits.height)
    bounds = -np.inf if low is None else low, np.inf if high is None else high
    for k, z in enumerate(heights):
        if not bounds[0] - HEIGHT_TOLERANCE <= z <= bounds[1] + HEIGHT_TOLERANCE:
            side, name, limit = ("above", "floor", low) if z < bounds[0] else ("below", "height", high)
            raise ConfigError(
                f"expected waypoints {side} the {name} of {limit} m, got number {k} at {z:g} m. Move it, or set "
                f"Limits({name}=...)."
            )
    return bounds


def _check_durations(durations: ArrayLike, n_pieces: int) -> Floats:
    lengths = read_floats("durations", durations)
    require(
        lengths.shape == (n_pieces,),
        f"expected {n_pieces} positive, finite durations, one less than waypoints, got {durations!r}. Pass limits= to "
        "have them chosen.",
    )
    ends_of(lengths)
    return lengths
