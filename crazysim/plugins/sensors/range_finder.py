"""Range finder: a few rays from every drone, measured within the compiled step."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, derived, drone_array, param, state
from crazysim.engine.pytree import device_array
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError
from crazysim.plugins.sensors.sensor import age_at, rate_in
from crazysim.scene.collision import CollisionModel
from crazysim.scene.object_poses import moving_plugins, with_moved_objects
from crazysim.scene.ray_casting import MAX_UNROLLED_GEOMS, RayKernels, cast_rays, raise_to_floor

MULTI_RANGER_DIRECTIONS = {
    "front": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "up": (0, 0, 1),
    "down": (0, 0, -1),
}
RAY_COLOR = (0.1, 0.8, 0.2, 1.0)


class RangeFinder(Plugin):
    """Rays from the centre of mass of every drone that measure distances.

    A ray ignores its own drone, and rods and cables of loads, which are thin. Other drones have their collision shapes.
    """

    MULTI_RANGER: ClassVar[Mapping[str, tuple[int, int, int]]] = MULTI_RANGER_DIRECTIONS
    """Directions of a multi-ranger deck by name, body frame."""

    directions: Param = param(default=None, core=("rays", 3), keep=False)
    """Directions, body frame, of any length; None for ``MULTI_RANGER``. (n_rays, 3)"""
    max_range: Param = param(default=4.0, core=(), scope="shared", positive=True, shapes=((),))
    """Largest distance measured, m. ()"""
    freq: int | None = None
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    drones: bool = False
    """Whether to measure distances to other drones too."""
    visible: bool = False
    """Whether to draw the rays into images."""
    direction: Array = derived(("rays", 3), scope="shared")
    """Unit directions of the rays, body frame. (n_rays, 3)"""
    distance: Array = state(("rays",))
    """Distance along each ray, m; ``max_range`` where nothing is nearer, and before the first measurement.
    (n_worlds, n_drones, n_rays)"""
    taken_step: Array = state(dtype=np.int32)
    """Step in which the distances were measured, negative before the first one. (n_worlds, n_drones, 1)"""
    name: str = "range_finder"

    def bind(self, sim: Simulation) -> RangeFinder:
        rays = np.asarray(
            list(MULTI_RANGER_DIRECTIONS.values()) if self.directions is None else self.directions, np.float64
        )
        if rays.ndim != 2 or rays.shape[1] != 3 or not rays.any(axis=-1).all():
            raise ConfigError(f"expected directions as vectors (n_rays, 3), none of them zero, got {rays.tolist()}")
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return self.with_arrays(
            sim,
            direction=device_array(rays),
            distance=drone_array(sim, self.max_range, len(rays)),
            taken_step=device_array(np.full((sim.n_worlds, sim.n_drones, 1), -1), np.int32),
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        """Return the stage that measures.

        Its scope is a drone; a world if distances to drones or loads are measured; or the whole batch if more geoms can
        move than a fused kernel can unroll.
        """
        visual_model, collision_model = sim.scene.visual_model, sim.scene.collision_model
        movers_by_name = moving_plugins(sim.scene.plugins(), [body.name for body in visual_model.objects])
        colliding_objects = {body.name for body in collision_model.objects}
        objects = tuple(
            body for body in visual_model.objects if body.name in colliding_objects or body.name not in movers_by_name
        )
        # The collision shape of a drone is enough for a few rays.
        model = dataclasses.replace(visual_model, objects=objects, drones=collision_model.drones)
        movers_by_name = {name: plugin for name, plugin in movers_by_name.items() if name in colliding_objects}
        n_movable = sum(len(body.geoms) for body in objects if body.row is not None)
        if self.drones:
            n_movable += sum(
                len(drone_geoms.geoms) * len(drone_geoms.drones or range(sim.n_drones)) for drone_geoms in model.drones
            )
        scope = "batch" if n_movable > MAX_UNROLLED_GEOMS else "world" if self.drones or movers_by_name else "drone"
        period, scene = sim.data.core.freq // rate_in(self, sim.data.core.freq), sim.scene

        def is_due(data: SimData) -> Array:
            return data.core.steps % period == 0

        def measure(data: SimData) -> SimData:
            movers_present = {name: plugin for name, plugin in movers_by_name.items() if plugin.name in data.plugins}
            current_data = with_moved_objects(data, movers_present)
            measured = self.bound(data)._measure(model, current_data, scope == "drone", scene.ray_kernels)
            return self.write(data, measured)

        def measure_if_due(data: SimData) -> SimData:
            return jax.lax.cond(jnp.any(is_due(data)), measure, lambda data: data, data)

        fn = measure_if_due if scope == "batch" and period > 1 else measure
        condition = None if period == 1 else is_due
        reason = f"rays among {n_movable} movable geoms, more than {MAX_UNROLLED_GEOMS}, are cast by a separate kernel"
        measurement_stage = Stage(fn, scope, condition, name="range_finder", unfused_reason=reason)
        return [StagePlacement(measurement_stage, before="increment_steps")]

    def observations(self, data: SimData) -> dict[str, Array]:
        return {"distance": self.distance}

    def age(self, data: SimData) -> Array:
        """Return the time since the distances were measured, s; infinite before the first ones. (..., 1)"""
        return age_at(data, self.read(data).taken_step)

    def draw(self, sim: Simulation, world: int) -> None:
        if not self.visible:
            return
        record, states = self.read(sim.data), sim.data.states
        start = np.asarray(states.pos[world])[:, None]
        direction = rotation.rotate(states.quat[world][:, None], record.direction)
        end = start + np.asarray(record.distance[world])[..., None] * np.asarray(direction)
        for points in np.stack(np.broadcast_arrays(start, end), axis=-2).reshape(-1, 2, 3):
            sim.scene.renderer.overlays.line(points, RAY_COLOR, 2.0, 2.0)

    def _measure(self, model: CollisionModel, data: SimData, is_single_drone: bool, kernels: RayKernels) -> RangeFinder:
        states = data.states
        pos, quat = (states.pos[None], states.quat[None]) if is_single_drone else (states.pos, states.quat)
        direction = rotation.rotate(quat[..., None, :], self.direction)
        n_drones, n_rays = direction.shape[-3:-1]
        origin = jnp.broadcast_to(raise_to_floor(model, pos)[..., None, :], direction.shape)
        ignored_drones = np.repeat(np.arange(n_drones), n_rays) if self.drones else None
        origin, direction = (x.reshape(*pos.shape[:-2], n_drones * n_rays, 3) for x in (origin, direction))
        hits = cast_rays(
            model, data, origin, direction, ignored_drones, self.drones, kernels=kernels, limit=self.max_range
        )
        taken_step = jnp.broadcast_to(data.core.steps[..., None], (*pos.shape[:-1], 1))
        return self.replace(
            distance=jnp.minimum(hits.distance, self.max_range).reshape(self.distance.shape),
            taken_step=taken_step.reshape(self.taken_step.shape),
        )
