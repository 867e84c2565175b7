"""Figures of a flown show: closest approaches, collisions and tracking errors."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.lab.shows.flight import ShowFlight

N_LISTED_COLLISIONS = 5
"""Largest number of collisions that a summary lists."""


def sampled_approaches(times: ArrayLike, pos: ArrayLike) -> tuple[NDArray, NDArray]:
    """Find the least distance of every pair of drones, and the time at which it occurs.

    Between samples the drones are assumed to move at constant velocities, so that the squared distance is a parabola in
    time. The parabola is fitted through the closest sample and its neighbours.

    Args:
        times: Times of the samples, s, in equal steps. (n,)
        pos: Positions, m. (n, n_drones, 3)

    Returns:
        Distances, m, infinite on the diagonal, and times, s. (n_drones, n_drones) each
    """
    t, p = np.asarray(times, float), np.asarray(pos)
    n, n_drones = p.shape[:2]
    x = np.ascontiguousarray(np.transpose(p, (2, 1, 0)))  # time last, so that the reduced axis is contiguous
    distance, closest_times = np.full((n_drones, n_drones), np.inf), np.zeros((n_drones, n_drones))
    for i in range(n_drones - 1):
        squares = np.zeros((n_drones - 1 - i, n), x.dtype)
        for axis in x:
            difference = axis[i + 1 :] - axis[i]
            difference *= difference
            squares += difference
        minimum, time = _refine_approach(squares, t)
        distance[i, i + 1 :] = distance[i + 1 :, i] = np.sqrt(minimum)
        closest_times[i, i + 1 :] = closest_times[i + 1 :, i] = time
    return distance, closest_times


def _refine_approach(squares: NDArray, times: NDArray) -> tuple[NDArray, NDArray]:
    rows, n = np.arange(len(squares)), squares.shape[1]
    k = squares.argmin(axis=1)
    if n < 3:
        return squares[rows, k].astype(float), times[k]
    middle = np.clip(k, 1, n - 2)
    before, centre, after = (squares[rows, middle + d].astype(float) for d in (-1, 0, 1))
    slope, curvature = (after - before) / 2, after - 2 * centre + before
    offset = np.where(curvature > 0, -slope / np.where(curvature > 0, curvature, 1.0), k - middle)
    offset = np.clip(offset, -1.0, 1.0)
    minimum = centre + slope * offset + curvature * offset**2 / 2
    return np.maximum(np.minimum(minimum, squares[rows, k]), 0.0), times[middle] + offset * (times[1] - times[0])


def tracking_rms(flight: ShowFlight) -> dict[str, float]:
    """Return the root mean square of every drone's distance from its planned position, m, by name."""
    errors = flight.pos - flight.planned
    mean = np.einsum("tnk,tnk->n", errors, errors, dtype=float) / len(errors)
    return dict(zip(flight.show.names, np.sqrt(mean).tolist(), strict=True))


def collisions(flight: ShowFlight) -> list[dict[str, Any]]:
    """Find the pairs of drones whose collision spheres touched, with the time of first contact, sorted by time."""
    contact_distance = 2 * collision_radius(flight)
    distance, _ = sampled_approaches(flight.times, flight.pos)
    pairs = []
    for i, j in np.argwhere(np.triu(distance < contact_distance, 1)):
        distances = np.linalg.norm(flight.pos[:, i] - flight.pos[:, j], axis=-1)
        first = int(np.argmax(distances <= max(contact_distance, distances.min())))
        pairs.append({"drones": [flight.show.names[i], flight.show.names[j]], "time": float(flight.times[first])})
    return sorted(pairs, key=lambda pair: pair["time"])


def collision_radius(flight: ShowFlight) -> float:
    """Return the radius of a drone's collision sphere, m."""
    model = flight.sim.mj_model
    return float(model.geom_size[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "col_sphere:0"), 0])


def report(flight: ShowFlight) -> dict[str, Any]:
    """Report the figures of a flight as JSON, planned and flown separately.

    The entries ``planned`` and ``flown`` have ``closest``, a list of ``{"drones": [name, name], "distance": m, "time":
    s}`` of every pair, the closest first, and ``duration``, s; ``flown`` also has ``tracking_rms``, m, by name.
    """
    return {
        "planned": {"closest": _closest_pairs(flight, flight.planned), "duration": flight.duration},
        "flown": {
            "closest": _closest_pairs(flight, flight.pos),
            "tracking_rms": tracking_rms(flight),
            "duration": flight.duration,
        },
    }


def _closest_pairs(flight: ShowFlight, pos: NDArray) -> list[dict[str, Any]]:
    distance, closest_times = sampled_approaches(flight.times, pos)
    first, second = np.triu_indices(len(distance), 1)
    names = flight.show.names
    order = np.argsort(distance[first, second], kind="stable")
    rows = zip(
        first[order].tolist(), second[order].tolist(), distance[first, second][order].tolist(),
        closest_times[first, second][order].tolist(), strict=True,
    )  # fmt: skip
    return [{"drones": [names[i], names[j]], "distance": d, "time": t} for i, j, d, t in rows]


def summary(flight: ShowFlight, figures: dict[str, Any]) -> str:
    """Summarise the figures of a flight as text.

    Args:
        figures: Result of ``report``.
    """
    rms = figures["flown"]["tracking_rms"]
    worst_drone = max(rms, key=rms.__getitem__)
    lines = [
        f"{flight.show.n_drones} drones, {flight.duration:.1f} s, computed in {flight.wall_s:.2f} s, "
        f"{flight.duration / flight.wall_s:.0f} times real time",
        f"tracking error    {100 * float(np.sqrt(np.mean(np.square(list(rms.values()))))):.1f} cm RMS, largest "
        f"{100 * rms[worst_drone]:.1f} cm ({worst_drone})",
    ]
    limit = flight.show.settings.get("validation", {})
    limit = limit.get("minDistance") if isinstance(limit, dict) else None
    for kind in ("planned", "flown"):
        pairs = figures[kind]["closest"]
        if not pairs:
            continue
        pair_text = ", ".join(
            f"{' and '.join(pair['drones'])} {pair['distance']:.2f} m at {pair['time']:.1f} s" for pair in pairs[:3]
        )
        lines.append(f"closest, {kind:8} {pair_text}")
        if isinstance(limit, (int, float)):
            n = sum(pair["distance"] < limit for pair in pairs)
            lines.append(f"                  {n} of {len(pairs)} pairs closer than the show's {limit:g} m")
    collided_pairs = collisions(flight)
    collision_text = ", ".join(
        f"{' and '.join(pair['drones'])} at {pair['time']:.1f} s" for pair in collided_pairs[:N_LISTED_COLLISIONS]
    )
    lines.append(f"collisions        {len(collided_pairs)}{': ' + collision_text if collided_pairs else ''}")
    return "\n".join(lines)
