"""Race courses: poses of gates, obstacles and starts, fixed or drawn at random."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.errors import ConfigError, require
from crazysim.scene.primitives import PRIMITIVES

CELL_SIZE = (1.0, 1.2)
"""Size of the cells of a random course, along x and y, m. The start and each gate are in different cells."""
CELL_MARGIN = (0.5, 0.3)
"""Distance of the cells from the limits of the arena along x and y, m."""
CELL_JITTER = 0.05
"""Largest component of a gate's offset from the middle of its cell, m."""
MAX_TURN = 1.0
"""Largest angle between the axis of a gate of a random course and the leg that leads to the gate, rad."""
START_SPACING = 0.4
"""Distance between neighbouring starts in one world, m."""
START_HEIGHT = 0.4
"""Height of the starts of a random course, m."""

OPENING = 0.45
"""Width and height of a gate's opening, m, unless a track has others."""

GATE_COLOR = PRIMITIVES["gate"][1]
"""Colour of gates, RGBA, unless a task has others."""

Points = Sequence[Sequence[float]]
"""Points or angles, (n, 3)."""


@dataclass(frozen=True)
class Track:
    """A course. The default is the course of levels 0 to 2 of the drone racing project lsy_drone_racing, with the start
    in the air.
    """

    gates_pos: Points = ((0.5, 0.25, 0.7), (1.05, 0.75, 1.2), (-1.0, -0.25, 0.7), (0.0, -0.75, 1.2))
    """Middle of each gate's opening, in the order of the race, m. (n_gates, 3)"""
    gates_rpy: Points = ((0, 0, -0.78), (0, 0, 2.35), (0, 0, 3.14), (0, 0, 0))
    """Roll, pitch and yaw of each gate, rad; drones fly along the x axis of the gate. (n_gates, 3)"""
    obstacles_pos: Points = ((0.0, 0.75, 1.55), (1.0, 0.25, 1.55), (-1.5, -0.25, 1.55), (-0.5, -0.75, 1.55))
    """Upper end of each upright pole, m. (n_obstacles, 3)"""
    start: Sequence[float] = (-1.5, 0.75, 0.4)
    """Middle of the starts of all drones, m. (3,)"""
    low: Sequence[float] = (-2.5, -1.5, 0.0)
    """Lower limits of the arena, m. (3,)"""
    high: Sequence[float] = (2.5, 1.5, 2.0)
    """Upper limits of the arena, m. (3,)"""
    openings: Sequence[Points | float] | None = None
    """Opening of each gate: corners of a convex polygon, left and up of the gate's middle, m (n, 2), or the radius of a
    ball around a waypoint, which drones pass in any direction, m. None for squares of 0.45 m."""
    frames: Sequence[Points | float] | None = None
    """Inner edges of the gates' frames, as ``openings``; None for those of the openings. Drones may have to keep a
    distance from the frame, so that the opening is smaller."""
    lengths: Sequence[float] | None = None
    """Length of each gate along its x axis, m: drones fly through the whole prism. None for gates without length."""
    finish: Sequence[float] | None = None
    """Position behind the last gate at which plans end at rest, m; None if they end at the last gate. (3,)"""

    @property
    def n_gates(self) -> int:
        """Number of gates."""
        return len(self.gates_pos)

    @property
    def n_obstacles(self) -> int:
        """Number of poles."""
        return len(self.obstacles_pos)

    @property
    def grid(self) -> tuple[int, int]:
        """Numbers of cells of a random course along x and y."""
        free_size = (np.asarray(self.high) - np.asarray(self.low))[:2] - 2 * np.array(CELL_MARGIN)
        n_x, n_y = np.floor(free_size / CELL_SIZE + 1e-6).astype(int)
        return int(n_x), int(n_y)


@dataclass(frozen=True)
class Gate:
    """One gate of a track."""

    pos: np.ndarray
    """Middle of the opening, m. (3,)"""
    rot: np.ndarray
    """Rotation matrix, gate to world; drones fly along the x axis. (3, 3)"""
    opening: np.ndarray | float
    """Corners, left and up of the middle, m (n, 2), or radius of a ball, m."""
    frame: np.ndarray | float
    """Inner edge of the frame, as ``opening``."""
    length: float
    """Length along the x axis, m."""

    @property
    def is_ball(self) -> bool:
        return np.ndim(self.opening) == 0

    @property
    def size(self) -> np.ndarray:
        """Width and height of the opening, m. (2,)"""
        return np.full(2, 2.0 * self.opening) if self.is_ball else np.ptp(self.opening, axis=0)

    @property
    def half_planes(self) -> np.ndarray:
        """Half-planes whose intersection is the polygon: outward unit normal, left and up, and distance of the edge
        from the middle, m. (n, 3)
        """
        corners = np.asarray(self.opening)
        edges = np.roll(corners, -1, axis=0) - corners
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=-1) / np.linalg.norm(edges, axis=-1, keepdims=True)
        distances = np.sum(normals * corners, axis=-1)
        inside = np.sum(normals * corners.mean(axis=0), axis=-1)
        return np.where(distances > inside, 1, -1)[:, None] * np.column_stack([normals, distances])


def gates_of_track(track: Track) -> list[Gate]:
    """Return the gates of a track, in the order of the race."""
    n, half = track.n_gates, OPENING / 2
    square = np.array([[half, half], [half, -half], [-half, -half], [-half, half]])
    openings = [square] * n if track.openings is None else [np.asarray(x, float) for x in track.openings]
    frames = openings if track.frames is None else [np.asarray(x, float) for x in track.frames]
    lengths = np.zeros(n) if track.lengths is None else np.asarray(track.lengths, float)
    quat = rotation_matrices(np.asarray(track.gates_rpy, float))
    rows = zip(np.asarray(track.gates_pos, float), quat, openings, frames, lengths.tolist(), strict=True)
    return [Gate(*row) for row in rows]


def gate_body(gate: Gate, bar: float = 0.05, rgba: Sequence[float] = GATE_COLOR) -> str:
    """Return the MJCF of a gate in its own frame: bars around the inner edges of its frame, or a ball of glass.

    Args:
        bar: Radius of the bars, m.
        rgba: Colour; a ball has the opacity 0.3.
    """
    red, green, blue, opacity = rgba
    touch = f'contype="0" conaffinity="2" rgba="{red} {green} {blue} {opacity}"'
    if gate.is_ball:
        ball = f'contype="0" conaffinity="0" rgba="{red} {green} {blue} 0.3"'
        geoms = [f'<geom type="sphere" size="{gate.opening}" {ball}/>']
    else:
        corners = np.asarray(gate.frame)
        inner_radius = np.min(np.abs(dataclasses.replace(gate, opening=corners).half_planes[:, 2]))
        corners = corners * (1 + bar / inner_radius)
        ends = (-gate.length / 2, gate.length / 2) if gate.length else (0.0,)
        rings = [np.insert(corners, 0, x, axis=-1) for x in ends]
        bars = [pair for ring in rings for pair in zip(ring, np.roll(ring, -1, axis=0), strict=True)]
        bars += list(zip(*rings, strict=True)) if gate.length else []
        geoms = [
            f'<geom type="capsule" size="{bar}" fromto="{" ".join(map(str, np.concatenate(pair)))}" {touch}/>'
            for pair in bars
        ]
    return f"<mujoco><worldbody><body>{''.join(geoms)}</body></worldbody></mujoco>"


def rotation_matrices(rpy: np.ndarray) -> np.ndarray:
    """Return the matrices of roll, pitch and yaw, rad, in float64. (n, 3, 3)"""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy).T, np.cos(rpy).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def check_track(track: Track, n_drones: int, jitter: float, is_random: bool) -> Track:
    """Return a track after checking its numbers, its limits and the clearance of its starts.

    Args:
        jitter: Largest sum of the horizontal displacements of a drone and of a gate or obstacle, m.
        is_random: Whether gates and obstacles are placed at random.
    """
    # Shapes and finite numbers.
    shapes = {"gates_pos": (-1, 3), "gates_rpy": (len(track.gates_pos), 3), "obstacles_pos": (-1, 3)}
    for name, shape in (shapes | {"start": (3,), "low": (3,), "high": (3,)}).items():
        value = np.asarray(getattr(track, name), float)
        is_valid = value.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, value.shape, strict=True))
        is_valid |= name == "obstacles_pos" and not value.size
        if not is_valid or (not value.size and name != "obstacles_pos") or not np.all(np.isfinite(value)):
            expected = str(shape).replace("-1", "n")
            raise ConfigError(f"expected {name} of the track as finite numbers, {expected}, got shape {value.shape}")
    low, high = np.asarray(track.low, float), np.asarray(track.high, float)
    require(np.all(high > low), f"expected upper limits of the arena above the lower ones, got {high} and {low}")
    # A random course needs enough cells.
    if is_random:
        n_x, n_y = track.grid
        require(
            n_x * n_y > track.n_gates and (n_x + 1) * (n_y + 1) >= track.n_obstacles,
            f"expected an arena with room for a random course of {track.n_gates} gates and {track.n_obstacles} "
            f"obstacles, got {n_x} x {n_y} cells of {CELL_SIZE[0]} x {CELL_SIZE[1]} m. Start and gates need a cell "
            f"each. Set wider limits with Track(low=..., high=...), or use fewer gates or obstacles.",
        )
        require(n_drones <= 8, f"expected at most 8 drones on a random course, got {n_drones}. Use level 0, 1 or 2.")
        return track
    # Starts that are clear of gates, obstacles and limits.
    starts = np.asarray(track.start) + start_offsets(n_drones)
    has_frame = np.array([not gate.is_ball for gate in gates_of_track(track)])
    for kind, points, clearance in (("gate", track.gates_pos, 0.45), ("obstacle", track.obstacles_pos, 0.15)):
        distance = np.linalg.norm((starts[:, None] - np.reshape(points, (1, -1, 3)))[..., :2], axis=-1)
        if kind == "gate":
            distance = np.where(has_frame, distance, np.inf)  # waypoints are points in the air
        if np.any(distance < clearance + jitter):
            k = int(np.argwhere(distance < clearance + jitter)[0, 1])
            raise ConfigError(
                f"expected {kind} {k + 1} of the track, seen from above, at least {clearance + jitter:.2f} m from "
                f"every start, got {distance[:, k].min():.2f} m. Move it, or the start."
            )
    require(
        np.all(starts >= low + [0.2, 0.2, 0.2]) and np.all(starts <= high - 0.2),
        f"expected starts at least 0.2 m within the limits of the arena and above the floor, got {n_drones} drones "
        f"around {tuple(track.start)}. Move Track(start=...), or set wider limits low= and high=.",
    )
    return track


def start_offsets(n_drones: int) -> np.ndarray:
    """Return the offsets of drones from the start, m: layers of two by two drones; zero for a single drone.

    Returns:
        (n_drones, 3)
    """
    k = np.arange(n_drones)
    offsets = START_SPACING * np.stack([k // 2 % 2, k % 2, k // 4], axis=-1)
    middle = START_SPACING * np.array([n_drones > 2, n_drones > 1, 0]) / 2
    return offsets - middle


def count_random_numbers(track: Track) -> int:
    n_x, n_y = track.grid
    return n_x * n_y + (n_x + 1) * (n_y + 1) + 3 * track.n_gates


def random_course(track: Track, x: Array) -> tuple[Array, Array, Array, Array]:
    """Return a course drawn at random.

    Start and gates are in different cells and obstacles at corners of cells, so that objects never overlap. Gates and
    obstacles have the heights of the track. The axis of a gate deviates by up to 1 rad from the leg to the gate.

    Args:
        track: Track with the heights and numbers of gates and obstacles, and the limits of the arena.
        x: Random numbers in [0, 1), ``count_random_numbers(track)`` of them. (..., n)

    Returns:
        Start, m (..., 3); positions of gates, m (..., n_gates, 3); attitudes of gates, xyzw (..., n_gates, 4);
        positions of obstacles, m (..., n_obstacles, 3).
    """
    n, (n_x, n_y) = track.n_gates, track.grid
    cell_numbers, corner_numbers, shift_numbers, yaw_numbers = jnp.split(
        x, np.cumsum([n_x * n_y, (n_x + 1) * (n_y + 1), 2 * n]), axis=-1
    )
    middle = (np.asarray(track.low)[:2] + np.asarray(track.high)[:2]) / 2
    size = np.array(CELL_SIZE)
    origin = middle - size * (np.array([n_x, n_y]) - 1) / 2

    # Start and gates near the centres of different cells.
    cell = ranks(cell_numbers, n + 1)
    centres = jnp.asarray(origin) + size * jnp.stack([cell % n_x, cell // n_x], axis=-1)
    shift = CELL_JITTER * (2 * shift_numbers.reshape(*x.shape[:-1], n, 2) - 1)
    gates = centres[..., 1:, :] + shift
    start = jnp.concatenate([centres[..., 0, :], jnp.full_like(centres[..., 0, :1], START_HEIGHT)], axis=-1)

    # Gates face along the way from the one before.
    legs = gates - jnp.concatenate([centres[..., :1, :], gates[..., :-1, :]], axis=-2)
    yaw = jnp.arctan2(legs[..., 1], legs[..., 0]) + MAX_TURN * (2 * yaw_numbers - 1)
    quat = rotation.from_rpy(jnp.stack([0 * yaw, 0 * yaw, yaw], axis=-1))

    # Poles at different corners of cells.
    corner = ranks(corner_numbers, track.n_obstacles)
    poles = jnp.asarray(origin - size / 2) + size * jnp.stack([corner % (n_x + 1), corner // (n_x + 1)], axis=-1)
    return start, _add_height(gates, track.gates_pos), quat, _add_height(poles, track.obstacles_pos)


def ranks(x: Array, n: int) -> Array:
    """Return the rank of each of the first ``n`` numbers among all numbers, which is a draw without replacement.

    Args:
        x: Random numbers, at least ``n``. (..., m)
        n: Number of ranks to return.

    Returns:
        Different whole numbers from 0 to m - 1. (..., n)
    """
    # Equal numbers are ranked by their index, so that all ranks are different.
    earlier = np.arange(x.shape[-1])[None] < np.arange(n)[:, None]
    ranked, all_numbers = x[..., :n, None], x[..., None, :]
    return jnp.sum((all_numbers < ranked) | ((all_numbers == ranked) & earlier), axis=-1, dtype=jnp.int32)


def _add_height(xy: Array, points: Points) -> Array:
    height = np.asarray(points, float)[:, 2:].astype(xy.dtype)
    return jnp.concatenate([xy, jnp.broadcast_to(height, (*xy.shape[:-1], 1))], axis=-1)
