"""Contact response: normal forces, friction and bounces of drones at floor and objects.

Without contact response the floor only stops drones. The method is time stepping on velocities (Moreau 1988; the
convex form of Todorov 2014): after a step, impulses at the contact points change the velocity so that the drone no
longer approaches the surface. An overlap is pushed out with a time constant, so that the ground is soft and no drone is
thrown out of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, SimState
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, param, state
from crazysim.core.settings import MAX_FRICTION, MAX_ITERATIONS, MAX_SOFTNESS, check_softness, setting
from crazysim.engine.stage import Stage
from crazysim.plugins.contacts.contact_points import (
    DroneBoxes,
    Surface,
    collision_boxes,
    contact_points,
    find_surfaces,
    is_ground,
    select_airframe,
)
from crazysim.plugins.contacts.impulse import Material, inertia_matrix, velocity_after_contact
from crazysim.plugins.contacts.load_contacts import (
    load_names,
    load_plugins,
    resolve_drone_contacts,
    resolve_load_contacts,
    resolve_surface_contacts,
)
from crazysim.plugins.payloads.colliders import CollidingPlugin
from crazysim.scene.contact_report import ObjectSelection, select_bodies


class ContactResponse(Plugin):
    """Response of floor and objects to contacts with drones and loads; replaces the stage ``clip_floor_pos``.

    Drones do not push each other (see ``DroneCollisions``), and objects do not move. Drones can ride on members of
    populations, such as cars. The centre of a drone that stands on the floor is half the height of its collision box
    above the floor. Objects stop loads and empty hooks. The flat floor stops them even without this plugin. Loads and
    hooks that are among ``objects`` exchange impulses with drones and with each other.
    """

    objects: ObjectSelection = setting(default=None, keep=False)
    """Handles, or names of bodies; None for all bodies in the scene, () for the floor alone."""
    friction: Param = param(default=0.6, low=0.0, high=MAX_FRICTION, shapes=((),))
    """Coulomb's coefficient between drone and surface, 1. (1,)"""
    restitution: Param = param(default=0.2, low=0.0, high=1.0, shapes=((),))
    """Ratio of the speeds after and before a bounce, 0 to 1. (1,)"""
    softness: Param = param(default=0.03, positive=True, high=MAX_SOFTNESS, shapes=((),))
    """Time constant with which an overlap is pushed out, s; at least two steps. (1,)"""
    iterations: int = setting(default=8, low=1, high=MAX_ITERATIONS)
    """Iterations of the solver, for simultaneous contact points."""
    impulse: Array = state((3,))
    """Impulse of all surfaces and loads in the last step, world frame, N s. (n_worlds, n_drones, 3)"""
    name: str = "contact_response"

    @property
    def material(self) -> Material:
        """Parameters of the contacts."""
        return Material(self.friction, self.restitution, self.softness)

    def bind(self, sim: Simulation) -> ContactResponse:
        check_softness(sim.data.core.freq, self.softness)
        return self.with_arrays(sim)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        boxes = collision_boxes(sim)
        plugins = load_plugins(sim)
        names = load_names(sim, plugins)
        surfaces = find_surfaces(sim, self.objects)

        def respond(data: SimData) -> SimData:
            results = [
                (drone_group, self.bound(data).states_after_contact(data, surfaces, box)) for drone_group, box in boxes
            ]
            states, response = select_airframe(results, data.core.drone_id)
            return self.write(data.replace(states=states), response)

        placements = [StagePlacement(Stage(respond, "drone"), before="measurements", replaces="clip_floor_pos")]
        obstacles = [surface for surface in surfaces if not is_ground(surface)]
        can_touch_drones = any(body.name in names for body in select_bodies(sim.scene.collision_model, self.objects))
        for plugin in plugins:
            placements += self._load_stages(plugin, obstacles, boxes if can_touch_drones else [], sim.n_drones)
        return placements

    def _load_stages(
        self, plugin: CollidingPlugin, obstacles: list[Surface], boxes: DroneBoxes, n_drones: int
    ) -> list[StagePlacement]:
        colliders = plugin.colliders()
        can_touch_each_other = len(colliders) > 1 or (plugin.coupling == "drone" and n_drones > 1)

        def respond_to_surfaces(data: SimData) -> SimData:
            if plugin.name not in data.plugins:
                return data
            for collider in colliders:
                data = resolve_surface_contacts(data, collider, obstacles, self.bound(data).material, self.iterations)
            return data

        def respond_to_drones(data: SimData) -> SimData:
            if plugin.name not in data.plugins:
                return data
            response = self.bound(data)
            impulse = response.impulse
            for collider in colliders:
                data, load_impulse = resolve_drone_contacts(data, collider, response.material, boxes)
                impulse = impulse + load_impulse
            return self.write(data, response.replace(impulse=impulse))

        def respond_to_loads(data: SimData) -> SimData:
            if plugin.name not in data.plugins:
                return data
            return resolve_load_contacts(data, colliders, self.bound(data).material)

        stages = []
        if obstacles:
            stages.append((Stage(respond_to_surfaces, plugin.coupling), f"{self.name}_of_{plugin.name}"))
        if boxes:
            stages.append((Stage(respond_to_drones, "world"), f"{self.name}_of_{plugin.name}_and_drones"))
            if can_touch_each_other:
                stages.append((Stage(respond_to_loads, "world"), f"{self.name}_between_{plugin.name}"))
        return [StagePlacement(stage, before="measurements", name=name) for stage, name in stages]

    def states_after_contact(
        self, data: SimData, surfaces: list[Surface], box: np.ndarray
    ) -> tuple[SimState, ContactResponse]:
        """Return the states with the velocities after contact, and the impulses, for drones with boxes of one size."""
        states, params = data.states, data.params
        old_vel = jnp.concatenate([rotation.rotate_inverse(states.quat, states.vel), states.ang_vel], axis=-1)
        points, inertia = contact_points(data, surfaces, box), inertia_matrix(params.mass, params.J)
        new_vel = velocity_after_contact(points, old_vel, params.mass, inertia, self.material, self.iterations)
        impulse = params.mass * rotation.rotate(states.quat, new_vel[..., :3] - old_vel[..., :3])
        states = states.replace(vel=rotation.rotate(states.quat, new_vel[..., :3]), ang_vel=new_vel[..., 3:])
        return states, self.replace(impulse=impulse)
