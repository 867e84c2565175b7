"""The scene of a simulation: its spec, the compiled model, and queries on the simulation's data."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import mujoco
import numpy as np
from jax import Array
from jax.sharding import Mesh
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments, check_flag
from crazysim.core.data import Objects, SimData
from crazysim.core.settings import check_image_size
from crazysim.drones.airframe import Airframe
from crazysim.errors import ConfigError, expect, require, short_repr
from crazysim.scene import build, collision, contact_report, depth, mjx
from crazysim.scene.appearance import Appearance, RandomColors
from crazysim.scene.collision import CollisionModel
from crazysim.scene.mjx_scene import MjxScene
from crazysim.scene.object_poses import ListPlugins
from crazysim.scene.objects import IDENTITY_QUAT, Handle, SceneObjects, Source
from crazysim.scene.ray_casting import RayKernels
from crazysim.scene.renderer import SceneRenderer
from crazysim.scene.sync import host_poses, poses_of, sync_one_world, with_data_poses

if TYPE_CHECKING:
    from crazysim.lab.scene.maps import MapSource
    from crazysim.lab.scene.splat_images import Renderer, SplatFn
    from crazysim.lab.scene.splats import SplatScene

LARGE_SWARM = 64
"""Smallest number of drones per world for which MJX checks two pairs per drone instead of all pairs."""
BYTES_PER_SPLAT_PIXEL = 20
"""Lower bound of the memory of a pixel of splats, bytes: colour, depth and coverage."""


class Scene:
    """The MuJoCo scene of a simulation.

    The scene is updated lazily. If contacts are requested and something has moved, ``sync`` updates all
    worlds. For an image, ``sync_one`` updates one world. MJX allocates nothing per world before the first ``contacts``
    or use of ``mjx_data``.
    """

    spec: mujoco.MjSpec
    """Editable scene; ``compile`` makes edits take effect."""
    max_geom_pairs: int
    """Largest number of pairs that MJX checks per kind of collision, from the next ``compile`` on; -1 for all."""
    renderer: SceneRenderer
    """Renderers and the overlays of the next image."""
    added_objects: SceneObjects
    """Objects that were added with ``add``."""
    plugins: ListPlugins
    """Function that returns the plugins of the simulation."""
    ray_kernels: RayKernels
    """Kernels that cast rays and answer contact reports."""
    splats: SplatScene | None
    """Splats that the functions with Crazyflow's names draw; None if none are attached."""
    revision: int
    """Number of edits of the spec so far. The compiled model, and the objects and mocap ids in the data, each have the
    revision at which they were made; they are updated when it differs from this number."""
    n_reads: int
    """Number of reads of the compiled scene so far, which tells whether a plugin has read it."""
    environment: str | None
    """Name of the task of an environment that was made of the simulation, after which no objects can be added."""

    def __init__(
        self,
        xml_path: str | Path | None,
        airframes: Sequence[Airframe],
        n_worlds: int,
        n_drones: int,
        freq: int,
        device: jax.Device,
        mesh: Mesh | None,
        plugins: ListPlugins,
        ray_kernels: RayKernels,
    ):
        self.n_worlds, self.n_drones, self.device, self.mesh = n_worlds, n_drones, device, mesh
        self.drone_groups = _group_drones(airframes)
        self.max_geom_pairs = -1 if n_drones < LARGE_SWARM else 2 * n_drones
        self.renderer = SceneRenderer(device)
        self.spec = build.build_spec(xml_path, airframes, freq, self.max_geom_pairs)
        self.added_objects = SceneObjects(n_worlds)
        self.plugins = plugins
        self.ray_kernels = ray_kernels
        self.splats = None
        self.revision = self._compiled_revision = self.n_reads = 0
        self._map_sources: list[Source] = []
        self.environment = None
        self._compile()

    def add(
        self,
        source: Source,
        name: str | None = None,
        *,
        count: int = 1,
        pos: ArrayLike = (0.0, 0.0, 0.0),
        quat: ArrayLike = IDENTITY_QUAT,
        mocap: bool = True,
        **options: Any,
    ) -> Handle:
        """Add objects to the scene, and return the handle that moves and selects them.

        The scene is compiled at its next use, once for all objects that were added since the last compilation. Plugins
        that read the scene, such as range finders, see the objects, whether they were added before or after them. They
        read the scene again at the next use of the simulation, whose step is then compiled again.

        Args:
            source: ``"gate"``, ``"box"``, ``"pole"``, ``"cylinder"``, ``"sphere"``, ``"wall"`` or ``"landing_pad"``; or
                the path of an MJCF file, MJCF text, an ``MjSpec``, or a body of an ``MjSpec``.
            name: Prefix of the bodies' names ``name:0``, ``name:1``, ...; None for the name of the primitive or file.
            pos: Initial positions in every world, world frame, m. (3,), (count, 3) or (n_worlds, count, 3)
            quat: Initial attitudes, body to world, xyzw. (4,), (count, 4) or (n_worlds, count, 4)
            mocap: Whether the objects can be moved, independently in each world; else they stay at ``pos`` in all
                worlds.
            **options: Settings of a primitive: lengths, m, and ``rgba``, (4,) or (count, 4); see
                ``crazysim.scene.primitives``.
        """
        require(
            self.environment is None,
            f"expected objects before an environment is made, got {short_repr(source)} after one of the task "
            f"{self.environment!r}, which would not see it. Use sim.scene.add before DroneEnv(sim, ...), in "
            f"Task.install, or in a new simulation.",
        )
        with self.restore_on_error():
            handle = self.added_objects.add(self.spec, source, name, count, pos, quat, mocap, options)
        self.revision += 1
        return handle

    def repeated(self, n: int, plugins: ListPlugins) -> Scene:
        """Return a scene with the same bodies and with each world ``n`` times, for a second simulation.

        Args:
            plugins: Function that returns the plugins of the second simulation.
        """
        scene = copy.copy(self)
        scene.n_worlds, scene.plugins, scene.mesh = n * self.n_worlds, plugins, None
        scene.spec, scene.added_objects = self.spec.copy(), self.added_objects.repeated(n)
        scene.renderer = SceneRenderer(self.device)
        scene.compile()
        return scene

    def add_map(
        self,
        source: MapSource,
        name: str | None = None,
        *,
        resolution: float = 0.1,
        pos: ArrayLike = (0.0, 0.0, 0.0),
        quat: ArrayLike = IDENTITY_QUAT,
        scale: float | None = None,
        min_points: int = 1,
        rgba: ArrayLike = (0.62, 0.60, 0.57, 1.0),
    ) -> Handle:
        """Add a point cloud or a triangle mesh as one object of boxes that do not move, and return its handle.

        Voxels that contain points, or that triangles meet, are merged into boxes along the axes of the world. A mesh
        need not be convex or closed; its inside is empty.

        Args:
            source: Path of a ``.ply``, ``.pcd``, ``.stl`` or ``.obj`` file; or the points of a cloud, (n_points, 3).
            name: Prefix of the body's name ``name:0``; None for the name of the file, or ``map``.
            resolution: Edge of the voxels, m.
            pos: Origin of the file's frame, world frame, m. (3,)
            quat: Attitude of the file's frame, file to world, xyzw. (4,)
            scale: Metres per unit of the file; None for 1, which requires an extent of the map of 1 cm to 10 km.
            min_points: Smallest number of points in an occupied voxel; more than 1 removes the noise of a scan.

        Raises:
            DamagedFileError: If the file is damaged, cut off, or of another kind.
            ConfigError: If the file does not exist, has no points or non-finite points, or has no plausible scale; or
                if there are too many boxes.
        """
        from crazysim.scene import map_spec

        spec = map_spec(source, resolution, pos, quat, scale, min_points, rgba)
        if name is None:
            name = Path(source).stem if isinstance(source, (str, Path)) else "map"
        return self.add(spec, name, mocap=False)

    def add_maps(self, sources: Sequence[Source], name: str) -> None:
        """Add maps of which each world has one, ``data.objects.map_index``; see ``Maps``."""
        maps, sources = self.added_objects.maps, list(sources)
        require(
            not maps or sources == self._map_sources,
            f"expected the list of {len(maps)} maps that the scene already has, got another one for {name!r}. A scene "
            f"has one list of maps. Use a new simulation.",
        )
        if not maps:
            with self.restore_on_error():
                self.added_objects.add_maps(self.spec, sources, name)
            self._map_sources = sources
            self.revision += 1

    def add_once(self, source: Source, name: str, count: int, **options: Any) -> None:
        """Add ``count`` objects unless they exist: objects of a plugin stay when it is removed or replaced.

        ``options`` are passed to ``add``.
        """
        n_existing = self.added_objects.count_objects(name)
        require(
            n_existing in (0, count),
            f"expected {n_existing} objects {name!r}, which are in the scene already, got {count}: objects stay "
            f"there when a plugin is removed. Use another name=, or a new simulation.",
        )
        if not n_existing:
            self.add(source, name, count=count, **options)

    @contextlib.contextmanager
    def restore_on_error(self) -> Iterator[None]:
        """Remove objects that were added within the block if an error ends the block."""
        snapshot = self.added_objects.take_snapshot(self.spec)
        try:
            yield
        except BaseException:
            if self.added_objects.restore_snapshot(self.spec, snapshot):
                self.revision += 1
            raise

    def compile(self) -> None:
        """Compile the spec, close the window, and reset bodies that are moved through ``mjx_data``."""
        self._compile()
        self.revision += 1  # the spec may have been edited by hand
        self._compiled_revision = self.revision

    def compile_if_edited(self) -> None:
        """Compile the spec if it has been edited since the last compilation; called at every read of the model."""
        self.n_reads += 1
        if self._is_edited:
            self._compile()
            self._compiled_revision = self.revision

    @property
    def _is_edited(self) -> bool:
        return self._compiled_revision != self.revision

    def _compile(self) -> None:
        self.spec.numeric("max_geom_pairs").data = [self.max_geom_pairs]
        mj_model = build.compile_spec(self.spec)
        drone_ids = build.mocap_ids(mj_model, [f"drone:{i}" for i in range(self.n_drones)])
        self._object_ids, self._map_ids = (
            build.mocap_ids(mj_model, names) for names in (self.added_objects.movable, self.added_objects.maps)
        )
        self._drone_ids = drone_ids
        self.renderer.close()
        self._mj_model, self._mj_data = mj_model, mujoco.MjData(mj_model)
        self._mjx = MjxScene(mj_model, self.n_worlds, self.device, self.mesh)
        self._collision_model: CollisionModel | None = None
        self._visual_model: CollisionModel | None = None

    @property
    def mj_model(self) -> mujoco.MjModel:
        """Compiled scene."""
        self.compile_if_edited()
        return self._mj_model

    @property
    def mj_data(self) -> mujoco.MjData:
        """State of the world that ``sync_one`` wrote last, for example for an image."""
        self.compile_if_edited()
        return self._mj_data

    @property
    def drone_mocap_ids(self) -> list[int]:
        """Mocap id of each drone's body in the next compiled model. (n_drones,)"""
        return (
            self._spec_mocap_ids([f"drone:{i}" for i in range(self.n_drones)]) if self._is_edited else self._drone_ids
        )

    def objects(self, previous: Objects | None) -> Objects | None:
        """Return the record of the movable objects: poses of an earlier record, and initial poses of newer objects."""
        ids = self._object_ids, self._map_ids
        if self._is_edited:
            ids = tuple(self._spec_mocap_ids(x) for x in (self.added_objects.movable, self.added_objects.maps))
        return self.added_objects.build_record(previous, *ids)

    def _check_image_memory(self, n_cameras: int, size: tuple[int, int], bytes_per_pixel: float) -> None:
        n_devices = 1 if self.mesh is None else self.mesh.size
        depth.check_image_memory(self.n_worlds * n_cameras, *size, bytes_per_pixel, self.device, n_devices)

    def _spec_mocap_ids(self, names: Sequence[str]) -> list[int]:
        ids = build.spec_mocap_ids(self.spec)
        missing_names = [name for name in names if name not in ids]
        if missing_names:
            raise ConfigError(
                f"expected mocap body {missing_names[0]!r} in the spec, got none. Leave drones and objects in it."
            )
        return [ids[name] for name in names]

    # Pure queries -----------------------------------------------------------------------------------------------------

    @property
    def collision_model(self) -> CollisionModel:
        """Geoms that drones can touch; rebuilt after a compilation."""
        model = self.mj_model  # compiles an edited scene
        if self._collision_model is None:
            objects = self.added_objects
            self._collision_model = collision.collision_model(model, objects.movable, self.drone_groups, objects.maps)
        return self._collision_model

    @property
    def visual_model(self) -> CollisionModel:
        """Geoms that cameras see; rebuilt after a compilation."""
        model = self.mj_model  # compiles an edited scene
        if self._visual_model is None:
            objects = self.added_objects
            self._visual_model = collision.visual_model(model, objects.movable, self.drone_groups, objects.maps)
        return self._visual_model

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects that drones can touch, in the order of a contact report."""
        return tuple(body.name for body in self.collision_model.objects)

    def contact_fn(
        self, objects: contact_report.ObjectSelection = None, floor: bool = True, drones: bool = True
    ) -> contact_report.ContactFn:
        """Return ``contacts(data, mocap=None) -> ContactReport``, pure, for the present scene.

        The function takes all worlds or, in a stage, one world or one drone; in a stage of one drone ``nearest_drone``
        is None. Fields that were not requested are None and are not computed.

        Poses of bodies that were attached to ``spec`` and are moved through ``mjx_data`` are not part of the data. For
        such bodies pass ``mocap=mjx_data``, or the pair ``(mocap_pos, mocap_quat)`` of ``mjx_data``. Objects of
        plugins, such as loads, get their poses from the plugins' records in ``data``; they need the data of a whole
        world.

        Args:
            objects: Handles, or names of bodies; None for all, () for none.
            floor: Whether to report the floor: planes and height fields of the world body.
            drones: Whether to report the other drones of a world.
        """
        return contact_report.build_contact_fn(self.collision_model, objects, floor, drones, self.plugins)

    @check_arguments
    def depth_fn(
        self,
        camera: str | int | depth.DroneCamera = "fpv_cam",
        width: int = 64,
        height: int = 64,
        drones: bool = True,
        hide_own: bool = True,
        along: depth.Along = "axis",
        color: bool = False,
        shadows: bool = True,
        random_colors: RandomColors | None = None,
        color_gradients: bool = False,
    ) -> depth.DepthFn:
        """Return ``depth(data, mocap=None, before=None) -> Hits``, pure: depth images of all worlds, one ray per pixel.

        ``Hits.distance`` is the image in m, (n_worlds, n_cameras, height, width), along with ``normal``, ``point`` and
        ``body_index``, the index of the body that was hit. Inside jit, fields that are not used are not computed.
        Objects of plugins, such as loads, get their poses from the plugins' records in ``data``. In a function of one
        world, such as the observations of a task, images have no axis n_worlds, and the rays are cast without a
        separate kernel. With data of an earlier time as ``before``, ``Hits`` also has where the points of the surfaces
        were then, in the frame of the camera, and which of them were hidden.

        Args:
            camera: ``fpv_cam`` or ``track_cam`` for the cameras of all drones (n_cameras is n_drones then); the name or
                id of one camera; or a ``DroneCamera``.
            width: Width of the images, pixels; ignored for a ``DroneCamera``.
            height: Height of the images, pixels; ignored for a ``DroneCamera``.
            drones: Whether drones are visible.
            hide_own: Whether a drone is invisible to its own camera.
            along: ``"axis"`` for the distance along the camera's axis, as in ``Sim.render``, ``"ray"`` for the
                distance from the camera.
            color: Whether to return ``Hits.color``, the colours that MuJoCo's renderer draws.
            shadows: Whether lights of the scene cast shadows, by a second ray of each pixel.
            random_colors: Changes of the colours in every world and episode; None for the colours of the scene.
            color_gradients: Whether colours are numbers from 0 to 1, with derivatives, instead of uint8.
        """
        if isinstance(camera, depth.DroneCamera):
            height, width = camera.rays.shape[:2]
            cameras = [depth.CarriedCamera.on_drone(camera, drone) for drone in range(self.n_drones)]
        else:
            width, height = check_image_size(width, height)
            objects = (*self.added_objects.movable, *self.visual_model.mocap_bodies)
            cameras = depth.find_cameras(self.mj_model, camera, objects)
        self._check_image_memory(len(cameras), (width, height), depth.BYTES_PER_RAY)
        color, shadows = check_flag("color", color), check_flag("shadows", shadows)
        color_gradients = check_flag("color_gradients", color_gradients)
        require(
            color or not (color_gradients or random_colors),
            "expected color=True with color_gradients or random_colors, got False. Use color=True.",
        )
        if isinstance(camera, depth.DroneCamera):
            # The frame of MuJoCo's cameras: x right, y up, z back.
            rays = [np.stack([-camera.rays[..., 1], camera.rays[..., 2], -camera.rays[..., 0]], axis=-1)] * len(cameras)
        else:
            rays = [depth.pixel_directions(c.fovy, width, height) for c in cameras]
        return depth.build_depth_fn(
            self.visual_model, cameras, rays, drones, hide_own, along, self.plugins, self.ray_kernels,
            camera if isinstance(camera, depth.DroneCamera) else None,
            Appearance(self.mj_model, shadows, random_colors, color_gradients) if color else None,
        )  # fmt: skip

    def splat_fn(
        self,
        camera: str | int | Sequence[str | int] = "fpv_cam",
        width: int = 64,
        height: int = 64,
        background: ArrayLike = (1.0, 1.0, 1.0),
        min_coverage: float = 0.5,
        renderer: Renderer = "auto",
    ) -> SplatFn:
        """Return ``splats(data, gaussians, mocap=None) -> SplatImage``, pure: images of Gaussian splats in all worlds.

        The Gaussians are ``SplatScene.gaussians``, or a list of them with one entry for each map of ``Maps``, of which
        every world sees that of its map. Images have gradients with respect to them and to the poses in ``data``.
        Bodies of the scene are not drawn.

        Args:
            camera: ``fpv_cam`` or ``track_cam`` for the cameras of all drones, or names or ids of cameras.
            width: Width of the images, pixels.
            height: Height of the images, pixels.
            background: Colour behind the splats, red, green and blue from 0 to 1.
            min_coverage: Coverage of a pixel below which its depth is infinite.
            renderer: ``"splax"`` for kernels on NVIDIA GPUs, ``"plain"`` for JAX, in small scenes, or ``"auto"``.

        Raises:
            ImportError: If ``renderer="splax"`` and splax is not installed.
        """
        from crazysim.scene import build_splat_fn

        objects = (*self.added_objects.movable, *self.visual_model.mocap_bodies)
        names = [camera] if isinstance(camera, (str, int, np.integer)) else list(camera)
        cameras = [match for name in names for match in depth.find_cameras(self.mj_model, name, objects)]
        width, height = check_image_size(width, height)
        self._check_image_memory(len(cameras), (width, height), BYTES_PER_SPLAT_PIXEL)
        return build_splat_fn(
            self.visual_model, cameras, width, height, background, min_coverage, renderer, self.device.platform,
            self.plugins,
        )  # fmt: skip

    # State of all worlds ----------------------------------------------------------------------------------------------

    @property
    def mjx_model(self) -> mjx.Model:
        """Compiled scene on the device; made when first read."""
        self.compile_if_edited()
        return self._mjx.model

    @property
    def mjx_data(self) -> mjx.Data:
        """State of the scene in every world at the last sync; allocated when first read."""
        self.compile_if_edited()
        return self._mjx.data

    def assign_mjx(self, mjx_data: mjx.Data) -> None:
        """Store the ``mjx_data`` of a user; ``Sim.mjx_data`` also clears ``core.mjx_synced``."""
        self._mjx.data = mjx_data

    @property
    def is_allocated(self) -> bool:
        """Whether ``mjx_data`` has been allocated."""
        return self._mjx.is_allocated

    def mocap_poses(self) -> tuple[Array, Array]:
        """Return poses of mocap bodies that are moved through ``mjx_data``; all other poses may be out of date.

        Returns:
            Positions, m (n_worlds, n_mocap, 3), and attitudes, wxyz (n_worlds, n_mocap, 4).
        """
        self.compile_if_edited()
        return self._mjx.poses()[:2]

    def host_poses(self, data: SimData, worlds: NDArray) -> tuple[NDArray, NDArray]:
        """Return poses of all mocap bodies in selected worlds as NumPy arrays, without a sync.

        Returns:
            Positions, m (n, n_mocap, 3), and attitudes, body to world, xyzw (n, n_mocap, 4).
        """
        self.compile_if_edited()
        pos, quat = host_poses(data, worlds, self._mjx.poses(worlds))
        return pos, np.roll(quat, -1, axis=-1)

    def shard(self, mesh: Mesh) -> None:
        self.mesh, self.ray_kernels = mesh, dataclasses.replace(self.ray_kernels, mesh=mesh)
        self._mjx.shard(mesh)

    def sync(self, data: SimData) -> None:
        """Bring ``mjx_data`` up to date in all worlds, if the poses in the data are others than at the last sync."""
        self.compile_if_edited()
        self._mjx.sync(poses_of(data))

    def forget_sync(self) -> None:
        """Make the next ``sync`` update ``mjx_data``, whatever the poses are."""
        self._mjx.forget_sync()

    def sync_one(self, data: SimData, world: int) -> None:
        """Bring ``mj_data`` up to date with one world; MJX, which takes seconds to import and compile, is not used."""
        expect(
            isinstance(world, (int, np.integer)) and not isinstance(world, bool) and 0 <= world < self.n_worlds,
            f"a world from 0 to {self.n_worlds - 1}",
            world,
        )
        self.compile_if_edited()
        sync_one_world(data, world, self._mjx.poses(np.array([world])), self._mj_model, self._mj_data)

    # Contact slots and images -----------------------------------------------------------------------------------------

    def contacts(self, data: SimData, body: str | None = None) -> Array:
        """Return True for every contact slot of MJX that touches, after a sync if anything has moved.

        Args:
            body: Name of the body whose slots are returned; None for all bodies.

        Returns:
            (n_worlds, n_slots), bool
        """
        self.compile_if_edited()
        return self._mjx.contacts(poses_of(data), body)

    def render(
        self, mode: str, camera: int | str, cam_config: Mapping[str, ArrayLike] | None, width: int, height: int
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Return or show an image of the world that was synced last, with the overlays; see ``Sim.render``."""
        return self.renderer.render(self.mj_model, self.mj_data, mode, camera, cam_config, width, height)

    def render_worlds(self, data: SimData, worlds: NDArray, camera: int | str, width: int, height: int) -> Array:
        """Return images of a camera in selected worlds, rendered in one call. (n, height, width, 3), uint8

        Raises:
            ImportError: If MuJoCo Warp is not installed.
        """
        self.compile_if_edited()
        poses = with_data_poses(data, worlds, self._mjx.poses(worlds))
        return self.renderer.render_worlds(self._mj_model, poses, camera, width, height)

    def close(self) -> None:
        """Close the window and free the renderers; the next image makes new ones."""
        self.renderer.close()


def _group_drones(airframes: Sequence[Airframe]) -> tuple[tuple[int, ...] | None, ...]:
    groups: dict[int, list[int]] = {}
    for k, airframe in enumerate(airframes):
        groups.setdefault(id(airframe), []).append(k)
    return (None,) if len(groups) == 1 else tuple([tuple(drones) for drones in groups.values()])
