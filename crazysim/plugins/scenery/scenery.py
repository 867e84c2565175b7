"""Base of layouts of obstacles that differ between worlds and episodes.

A layout is not stored: the pose of every obstacle follows from two random words of the world by
``random.uniform_at``. So a world has three numbers, whatever the number of obstacles, and the obstacles around a drone
can be found without the poses of all others.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import Objects, SimData
from crazysim.core.plugin import Param, Plugin, Simulation, derived, param, state
from crazysim.core.random import uniform_at, world_key
from crazysim.core.settings import setting
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.geometry import Shape
from crazysim.geometry.distance import point_distance

HIDDEN_DEPTH = 100.0
"""Depth by which obstacles that a layout leaves out are moved down, m."""
MIN_REGION_LENGTH = 1e-3
"""Smallest length by which ``wander`` divides a travelled distance, m, since a region may have no length."""
MAX_OBSTACLES = 10_000
"""Largest number of obstacles of a layout."""
DIFFICULTY_INDEX = np.uint32(2**32 - 1)
"""Index of the random number of a world from which its difficulty is drawn."""


class Model(NamedTuple):
    """Obstacles of one kind."""

    source: str
    """Name of a primitive, or MJCF."""
    options: Mapping[str, Any]
    """Settings of the primitive."""
    shapes: Sequence[tuple[Shape, tuple[float, float, float]]]
    """Shapes of an obstacle, and their positions in its frame, m."""
    pos: np.ndarray
    """Middles of the regions, the squares in which obstacles stand or move, m. They are the positions in the compiled
    scene, by which ray casting sorts the obstacles. (n, 3)"""


class Scenery(Plugin):
    """Base class of layouts of obstacles, drawn again in every world at every reset.

    A subclass defines ``models`` and ``poses``. Tasks call ``sample_layout`` when an episode starts. An obstacle that
    a layout leaves out is 100 m below its position.
    """

    difficulty: Param = param(default=1.0, core=(), scope="world", low=0.0, high=1.0, shapes=((), (2,)))
    """Difficulty, 0 to 1, or a range, lowest and highest, from which it is drawn at every reset of a world.
    (n_worlds, 1)"""
    speed: float = setting(default=0.0, low=0.0)
    """Largest component of the velocities of obstacles that move to and fro in their regions, m/s; 0 for obstacles that
    stand still."""
    free: ArrayLike = setting(default=((0.0, 0.0, 1.0),), shapes=(("any", 3),))
    """Discs that stay free of obstacles, x, y and radius, m. (n, 3)"""
    words: Array = state((2,), scope="world", dtype=np.uint32)
    """Random words from which the layout follows. (n_worlds, 1, 2)"""
    difficulty_range: Array = derived((2,), scope="shared")
    """Lowest and highest difficulty that is drawn. (2,)"""
    name: str = "scenery"

    @property
    def scope(self) -> str:
        return "world"

    @property
    def moved_kinds(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{k}" for k in range(len(self.models())))

    def uniform(self, index: Array | np.ndarray) -> Array:
        """Return random numbers of the layout, from 0 to below 1, by their indices. (...)"""
        return uniform_at(self.words, index, self.difficulty.dtype)

    def models(self) -> Sequence[Model]:
        """Return the obstacles, one entry for each kind."""
        raise NotImplementedError

    def poses(self, data: SimData) -> tuple[Array, Array]:
        """Return the positions, m, and attitudes, xyzw, of the bodies of all obstacles, in the order of ``models``.

        Args:
            data: Data of all worlds or of one world.

        Returns:
            Positions (n_worlds, n, 3) and attitudes (n_worlds, n, 4), without n_worlds in one world
        """
        raise NotImplementedError

    def check_count(self, n: float, remedy: str = "Use a smaller size, or a lower density.") -> None:
        """Check that a layout has few enough obstacles; subclasses do so before they allocate anything."""
        if n > MAX_OBSTACLES:
            raise ConfigError(
                f"expected at most {MAX_OBSTACLES} obstacles in {type(self).__name__}, got {n:.6g}. {remedy}"
            )

    def clearance(self, data: SimData, pos: Array) -> Array:
        """Return the distance from points to the surface of the nearest obstacle, m, negative inside. (...)

        Args:
            data: Data of all worlds, one world, or one drone.
            pos: Points, world frame, m: (n_worlds, n, 3), without n_worlds in one world, or (3,) for one drone.
        """
        obstacle_pos, quat = (x[..., None, :, :] if x.ndim == 3 else x for x in self.poses(data))
        gaps, start = [], 0
        for model in self.models():
            rows = slice(start, start + len(model.pos))
            body_pos = rotation.rotate_inverse(quat[..., rows, :], pos[..., None, :] - obstacle_pos[..., rows, :])
            gaps += [point_distance(shape, body_pos - jnp.asarray(x, pos.dtype)) for shape, x in model.shapes]
            start = rows.stop
        return functools.reduce(jnp.minimum, [jnp.min(gap, axis=-1) for gap in gaps])

    def sample_layout(self, data: SimData, key: Array, difficulty: Array | None = None) -> SimData:
        """Return the data of one world with another layout. Tasks call it in ``spawn``.

        Args:
            data: Data of one world.
            difficulty: Difficulty, 0 to 1; None to draw it from the range of the setting. ()
        """
        layout = self.read(data).replace(words=jax.random.key_data(key)[:2].astype(jnp.uint32))
        if difficulty is None:
            low, high = layout.difficulty_range
            difficulty = low + (high - low) * layout.uniform(DIFFICULTY_INDEX)
        return self.write(data, layout.replace(difficulty=jnp.asarray(difficulty, layout.difficulty.dtype)))

    def bind(self, sim: Simulation) -> Self:
        models = self.models()
        self.check_count(sum(len(model.pos) for model in models))
        for other in sim.scene.plugins():
            if other.name == self.name and isinstance(other, Scenery) and repr(other.models()) != repr(models):
                raise ConfigError(
                    f"expected the obstacles of {self.name!r} that the scene already has, got others. "
                    f"Use sim.replace only to change difficulty=, otherwise use another name= or a new simulation."
                )
        for kind, model in zip(self.moved_kinds, models, strict=True):
            sim.scene.add_once(model.source, kind, len(model.pos), pos=model.pos, **model.options)
        difficulty_range = np.broadcast_to(np.asarray(self.difficulty, np.float64), 2)
        if difficulty_range[0] > difficulty_range[1]:
            raise ConfigError(f"expected a range of difficulty, lowest first, got {self.difficulty!r}")
        difficulty = device_array(np.full((sim.n_worlds, 1), difficulty_range[1]))
        return self.with_arrays(sim, difficulty=difficulty, difficulty_range=device_array(difficulty_range))

    def reset_episode(self, data: SimData) -> SimData:
        return self.sample_layout(data, world_key(data, self.name))

    def move_objects(self, data: SimData) -> Objects:
        objects: Any = data.objects
        pos, quat = self.poses(data)
        start = objects.names.index(f"{self.moved_kinds[0]}:0")
        end = start + pos.shape[0]
        poses = {
            name: jnp.concatenate([old[:start], new.astype(old.dtype), old[end:]])
            for name, old, new in (("pos", objects.pos, pos), ("quat", objects.quat, quat))
        }
        return objects.replace(**poses)

    def wander(self, data: SimData, start: Any, velocity: Any, region_length: Any) -> Array:
        """Return the coordinate of points that move to and fro in their regions, relative to the middle, m. (...)

        Args:
            data: Data of all worlds, one world, or one drone, for the time since the reset.
            start: Random numbers from 0 to 1 that give the coordinates at the reset. (...)
            velocity: Random numbers from 0 to 1 that give the velocities. (...)
            region_length: Length of the regions, m. (...)
        """
        if not self.speed:
            return (start - 0.5) * region_length
        travelled = (data.core.steps / data.core.freq).astype(start.dtype) * (2 * velocity - 1) * self.speed
        phase = (
            start + travelled / jnp.maximum(region_length, MIN_REGION_LENGTH)
        ) / 2  # of a triangle wave with period 1
        phase = phase - jnp.floor(phase)
        return (2 * jnp.minimum(phase, 1 - phase) - 0.5) * region_length

    def is_free(self, pos: Sequence[Any], middle: Sequence[Any], radius: Any, region_length: Any) -> Array:
        """Return True for obstacles that do not meet the discs of ``free``, wherever they move. (...)

        Args:
            pos: Position, x and y, m. Two arrays of shape (...)
            middle: Middle of the square region, x and y, m. Two arrays of shape (...)
            radius: Radius of the circle around an obstacle, m. (...)
            region_length: Length of the sides of the region, m. (...)
        """
        (x, y), radius = (middle, radius + region_length / math.sqrt(2)) if self.speed else (pos, radius)
        is_free = jnp.ones(jnp.shape(pos[0]), bool)
        for free_x, free_y, free_radius in np.asarray(self.free, np.float64).tolist():
            is_free &= (x - free_x) ** 2 + (y - free_y) ** 2 > (free_radius + radius) ** 2
        return is_free
