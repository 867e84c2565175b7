"""Contacts and depth of a scene as pure functions of the data."""

from __future__ import annotations

import mujoco

from crazysim.scene import collision, contact_report, depth
from crazysim.scene.collision import CollisionModel
from crazysim.scene.objects import SceneObjects
from crazysim.scene.placement import Placing


class PureQueries:
    """The part of ``Scene`` that returns pure functions, and the geoms that these are about."""

    added: SceneObjects
    """ObjectSelection that were added with ``add``."""
    plugins: Placing
    """Returns the plugins of the simulation, some of which place objects."""

    @property
    def mj_model(self) -> mujoco.MjModel:
        """Compiled scene."""
        raise NotImplementedError

    def clear_models(self) -> None:
        """Read the geoms again at the next use, after a compilation."""
        self._collision_model: CollisionModel | None = None
        self._visual_model: CollisionModel | None = None

    @property
    def collision_model(self) -> CollisionModel:
        """Geoms that drones touch; read again after a compilation."""
        model = self.mj_model  # compiles an edited scene
        if self._collision_model is None:
            self._collision_model = collision.collision_model(model, self.added.movable, self.kinds)
        return self._collision_model

    @property
    def visual_model(self) -> CollisionModel:
        """Geoms that cameras see; read again after a compilation."""
        model = self.mj_model  # compiles an edited scene
        if self._visual_model is None:
            self._visual_model = collision.visual_model(model, self.added.movable, self.kinds)
        return self._visual_model

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects that drones can touch, in the order of a contact report."""
        return tuple(body.name for body in self.collision_model.objects)

    def contact_fn(
        self, objects: contact_report.ObjectSelection = None, floor: bool = True, drones: bool = True
    ) -> contact_report.ContactFn:
        """Return ``contacts(data, mocap=None) -> ContactReport``, pure, for the scene as it is now.

        The function takes all worlds or, in a stage, one world or one drone; for a stage of one drone pass
        ``drones=False``. Fields that were not requested are None and are not computed.

        Bodies that were attached to ``spec`` and are moved through ``mjx_data`` are not part of the data: for those
        pass ``mocap=mjx_data``, or the pair ``(mocap_pos, mocap_quat)`` as ``mjx_data`` has them. Objects of plugins,
        such as loads, are where the plugins' records in ``data`` have them; they need the data of a world.

        Args:
            objects: Handles, or names of bodies; None for all, () for none.
            floor: True to report the floor: planes and height fields of the world body.
            drones: True to report the other drones of a world.

        Raises:
            ConfigError: If nothing is requested, or an object does not exist.
        """
        return contact_report.build(self.collision_model, objects, floor, drones, self.plugins)

    def depth_fn(
        self,
        camera: str | int = "fpv_cam",
        width: int = 64,
        height: int = 64,
        drones: bool = True,
        hide_own: bool = True,
        along: depth.Along = "axis",
    ) -> depth.DepthFn:
        """Return ``depth(data, mocap=None) -> Hits``, pure: depth images of all worlds, by one ray for each pixel.

        ``Hits.distance`` is the image in m, (n_worlds, n_cameras, height, width), with ``normal`` and ``number`` (the
        body that was hit) beside it. Inside jit, fields that are not used are not computed. Objects of plugins, such as
        loads, are where the plugins' records in ``data`` have them.

        Args:
            camera: ``fpv_cam`` or ``track_cam`` for the cameras of all drones (n_cameras is n_drones then); or the name
                or id of one camera.
            width: Pixels.
            height: Pixels.
            drones: True for drones to be visible.
            hide_own: True for a drone to be invisible to its own camera.
            along: ``"axis"`` for the distance along the camera's axis, as ``Sim.render`` has it, ``"ray"`` for the
                distance from the camera.

        Raises:
            ConfigError: If the resolution is invalid, or the camera aims at a body.
            UnknownNameError: If there is no such camera.
        """
        objects = (*self.added.movable, *self.visual_model.mocap_bodies)
        cameras = depth.find_cameras(self.mj_model, camera, objects)
        return depth.build(self.visual_model, cameras, width, height, drones, hide_own, along, self.plugins)
