"""The scene as an object: a spec, what it compiles to, and whether it shows what the simulation has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import NDArray

from crazysim.core.data import Objects, SimData
from crazysim.core.settings import positive
from crazysim.core.sharding import place_scene, put
from crazysim.drones.airframe import Airframe
from crazysim.errors import ConfigError
from crazysim.scene import build, collision, contacts, depth, mjx, report
from crazysim.scene.batch_render import BatchRenderer
from crazysim.scene.collision import CollisionModel
from crazysim.scene.objects import IDENTITY, Handle, add_bodies, as_poses
from crazysim.scene.overlays import Marks
from crazysim.scene.rays import Hits
from crazysim.scene.render import Viewer
from crazysim.scene.report import ContactReport
from crazysim.scene.sync import poses_of, sync_one_world, sync_sim2mjx

LARGE_SWARM = 64
"""From this many drones a world on, MJX checks two pairs per drone instead of every pair."""


class Scene:
    """What MuJoCo holds of a simulation.

    ``sync`` alone decides whether it is up to date; ``contacts`` and ``draw`` read what the last sync left. Nothing
    is held per world before the first question.
    """

    spec: mujoco.MjSpec
    """The scene to be edited; ``compile`` has an edit take effect."""
    max_geom_pairs: int
    """Cap on the pairs MJX checks per kind of collision, from the next ``compile`` on; -1 for none."""
    marks: Marks
    """What is drawn over the next picture."""
    viewer: Viewer | None
    """What draws; made for the first picture."""

    def __init__(
        self,
        xml_path: str | Path | None,
        airframe: Airframe,
        n_worlds: int,
        n_drones: int,
        freq: int,
        device: jax.Device,
        mesh: Mesh | None,
    ):
        """Build and compile the spec.

        Args:
            xml_path: A MJCF scene without drones; None for floor, light and sky.
            airframe: What the drones look like.
            n_worlds: Number of worlds.
            n_drones: Number of drones in each.
            freq: Physics steps per second, Hz.
            device: Where the scene of all worlds lives.
            mesh: Devices that it is spread over instead, if any.

        Raises:
            ConfigError: If the scene cannot be read or compiled.
        """
        self.n_worlds, self.n_drones, self.device, self.mesh = n_worlds, n_drones, device, mesh
        self.max_geom_pairs = -1 if n_drones < LARGE_SWARM else 2 * n_drones
        self.marks = Marks()
        self.viewer = None
        self._batch: tuple[Any, BatchRenderer] | None = None
        self.spec = build.build_spec(xml_path, airframe, n_drones, freq, self.max_geom_pairs)
        self.handles: list[Handle] = []
        self._starts: list[tuple[NDArray, NDArray]] = []
        self.revision = 0
        """Number of changes so far of what the data holds of the scene: its objects and mocap ids."""
        self.compile()

    def add(
        self,
        what: Any,
        name: str | None = None,
        *,
        count: int = 1,
        pos: Any = (0.0, 0.0, 0.0),
        quat: Any = IDENTITY,
        mocap: bool = True,
        **options: Any,
    ) -> Handle:
        """Add objects to the scene, and return the handle that they are moved and asked for by.

        The scene is compiled anew at the next use, once for all that was added since the last.

        Args:
            what: ``"gate"``, ``"box"``, ``"pole"``, ``"sphere"``, ``"wall"`` or ``"landing_pad"``; or the path of an
                MJCF file, MJCF text, an ``MjSpec``, or a body of one.
            name: The bodies are called ``name:0``, ``name:1``, ...; None for the primitive's or the file's name.
            count: How many.
            pos: Where they are, world frame, m, at the start of every world. (3,), (count, 3) or (n_worlds, count, 3)
            quat: Their attitudes, body to world, xyzw. The same shapes with 4
            mocap: Whether they can be moved, in each world for itself; else they stand at ``pos`` in all worlds.
            **options: Settings of a primitive: lengths in m, ``rgba``. ``crazysim.scene.objects`` lists them.

        Raises:
            ConfigError: If a name is taken, MJCF does not compile (with the compiler's words), or a setting cannot be.
        """
        name = _name(what) if name is None else name
        numbers = tuple(range(positive("count", count)))
        taken = sorted({body.name for body in self.spec.bodies} & {name, *(f"{name}:{k}" for k in numbers)})
        if taken or name == "drone":
            raise ConfigError(f"the scene has a body {(taken or ['drone:0'])[0]!r} already; choose another name=")
        n_worlds = self.n_worlds if mocap else None
        poses = [
            np.broadcast_to(np.asarray(as_poses(x, what, count, size, n_worlds)), (n_worlds or 1, count, size))
            for x, what, size in ((pos, "pos", 3), (quat, "quat", 4))
        ]
        poses[1] = poses[1] / np.linalg.norm(poses[1], axis=-1, keepdims=True)
        names = [f"{name}:{k}" for k in numbers]
        add_bodies(self.spec, what, names, poses[0][0], poses[1][0], mocap, options)
        first = sum(len(handle.places) for handle in self.handles)
        handle = Handle(name, numbers, tuple(first + k for k in numbers) if mocap else ())
        self.handles.append(handle)
        if mocap:
            self._starts.append((poses[0], poses[1]))
        self.edited = True
        self.revision += 1
        return handle

    def compile(self) -> None:
        """Have the spec as it is now take effect; closes the viewer, and forgets where users moved bodies by hand.

        Raises:
            ConfigError: If the spec does not compile or has lost a drone; the old scene stays then.
        """
        self.spec.numeric("max_geom_pairs").data = [self.max_geom_pairs]
        mj_model = build.compile_spec(self.spec)
        drones = [f"drone:{i}" for i in range(self.n_drones)]
        self._drone_ids = build.mocap_ids(mj_model, drones)
        self._object_ids = build.mocap_ids(mj_model, self._movable())
        self.close()
        self._mj_model, self._mj_data = mj_model, mujoco.MjData(mj_model)
        self._mjx_model: mjx.Model | None = None
        self._mjx_data: mjx.Data | None = None
        self._solids: CollisionModel | None = None
        self._visible: CollisionModel | None = None
        self.edited = False
        self.revision += 1
        self.invalidate()

    def compile_if_edited(self) -> None:
        """Compile, if something was added since."""
        if self.edited:
            self.compile()

    @property
    def mj_model(self) -> mujoco.MjModel:
        """What the spec was compiled to."""
        self.compile_if_edited()
        return self._mj_model

    @property
    def mj_data(self) -> mujoco.MjData:
        """The one world that was drawn last."""
        self.compile_if_edited()
        return self._mj_data

    @property
    def drone_mocap_ids(self) -> list[int]:
        """Mocap id of each drone's body, as in the next compiled model. (n_drones,)"""
        return self._ids([f"drone:{i}" for i in range(self.n_drones)]) if self.edited else self._drone_ids

    def objects(self, before: Objects | None) -> Objects | None:
        """Return the record of the movable objects: those of one before where they are, new ones at their start."""
        if not self._starts:
            return None
        pos, quat = (jnp.asarray(np.concatenate(xs, axis=1), float)[:, None] for xs in zip(*self._starts, strict=True))
        vel = jnp.zeros_like(pos)
        if before is not None:
            n = len(before.names)
            pos, quat, vel = (
                jnp.concatenate([old.astype(new.dtype), new[..., n:, :]], axis=-2)
                for old, new in ((before.pos, pos), (before.quat, quat), (before.vel, vel))
            )
        ids = self._ids(self._movable()) if self.edited else self._object_ids
        return Objects(pos, quat, vel, jnp.asarray(ids, jnp.int32), self._movable())

    def _ids(self, names: Sequence[str]) -> list[int]:
        """Return mocap ids in the spec, which are those of the compiled model; nothing is compiled.

        Raises:
            ConfigError: If the spec has lost one of the bodies.
        """
        ids = build.spec_mocap_ids(self.spec)
        lost = [name for name in names if name not in ids]
        if lost:
            raise ConfigError(f"the scene has lost {lost[0]!r}; drones and objects with handles must stay in the spec")
        return [ids[name] for name in names]

    def _movable(self) -> tuple[str, ...]:
        return tuple(body for handle in self.handles if handle.movable for body in handle.bodies)

    # All worlds, with MJX -----------------------------------------------------------------------------------

    @property
    def mjx_model(self) -> mjx.Model:
        """The model on the device; made when first read."""
        self.compile_if_edited()
        model = self._mjx_model
        if model is None:
            model = build.put_model(self.mj_model, self.device)
            if self.mesh is not None:
                model = jax.device_put(model, NamedSharding(self.mesh, PartitionSpec()))
            self._mjx_model = model
        return model

    @property
    def mjx_data(self) -> mjx.Data:
        """The scene of every world, as it was last synced; made when first read, and returned as it is."""
        self.compile_if_edited()
        if self._mjx_data is None:
            self._mjx_data = self._place(build.make_data(self.mj_model, self.n_worlds, self.device))
        return self._mjx_data

    @mjx_data.setter
    def mjx_data(self, mjx_data: mjx.Data) -> None:
        self._mjx_data = self._place(build.check_poses(mjx_data, self.mj_model, self.n_worlds))
        self.invalidate()

    def shard(self, mesh: Mesh) -> None:
        """Spread the worlds over devices; what is not yet made will be made there."""
        self.mesh = mesh
        self._mjx_model = None
        if self._mjx_data is not None:
            self.mjx_data = self._mjx_data

    def _place(self, mjx_data: mjx.Data) -> mjx.Data:
        return put(mjx_data, self.device) if self.mesh is None else place_scene(mjx_data, self.mesh)

    # Up to date or not --------------------------------------------------------------------------------------

    def invalidate(self) -> None:
        """Have the next question sync: something has moved, or may have."""
        self._synced = False

    def sync(self, data: SimData, world: int | None = None) -> SimData:
        """Bring the scene up to date: all of it, or ``mj_data`` with the one world that is to be drawn.

        The only way to a fresh scene. A single world is drawn without touching the others; where there is only
        one, or all are fresh already, that is the whole scene. Whether a sync is due is known on the host.

        Returns:
            The data, its flag set if the whole scene was synced.
        """
        if not self._synced and (world is None or (self.n_worlds == 1 and self._mjx_holds_it())):
            data, self._mjx_data = sync_sim2mjx(data, self.mjx_data, self.mjx_model)
            self._synced = True
        if world is not None:
            sync_one_world(data, self._mjx_data, world, self.mj_model, self.mj_data)
        return data

    def _mjx_holds_it(self) -> bool:
        """Return whether contacts can be asked for; what MJX cannot hold can still be drawn."""
        try:
            return self.mjx_model is not None
        except ConfigError:
            return False

    # SceneQueries ----------------------------------------------------------------------------------------------

    def contacts(self, body: str | None = None) -> Array:
        """Return which contact slots, of one body or of all, touched at the last sync. (n_worlds, n_slots)

        Raises:
            UnknownNameError: If the scene has no such body.
        """
        if body is None:
            return contacts.contact_flags(self.mjx_data)
        return contacts.body_contact_flags(self.mjx_data, self.mj_model, body)

    @property
    def solids(self) -> CollisionModel:
        """What drones can touch, as shapes; read anew after a compilation."""
        self.compile_if_edited()
        if self._solids is None:
            self._solids = collision.read(self._mj_model, self._movable())
        return self._solids

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects that drones can touch, in the order of a contact report."""
        return tuple(solid.name for solid in self.solids.objects)

    @property
    def visible(self) -> CollisionModel:
        """What cameras see, as shapes: a mesh as its convex hull, nothing that is more than half transparent."""
        self.compile_if_edited()
        if self._visible is None:
            self._visible = collision.read(self._mj_model, self._movable(), touching=False)
        return self._visible

    def depth_fn(
        self,
        camera: str | int = "fpv_cam",
        width: int = 64,
        height: int = 64,
        drones: bool = True,
        hide_own: bool = True,
        along: depth.Along = "axis",
    ) -> Callable[[SimData], Hits]:
        """Return ``fn(data) -> Hits``, pure: what cameras see in all worlds, by casting a ray for each pixel.

        The hits' ``distance`` is the picture (n_worlds, n_cameras, height, width) in m, with ``normal`` and ``number``
        (what was hit) beside it; what is not used is not computed inside jit.

        Args:
            camera: ``fpv_cam`` or ``track_cam`` for those of all drones, then n_cameras is n_drones; or the name or id
                of one camera.
            width: Pixels.
            height: Pixels.
            drones: Whether drones are seen.
            hide_own: Whether a drone's camera does not see that drone.
            along: Whether to measure along the camera's ``axis``, as ``Sim.render`` does, or along the ``ray``.

        Raises:
            ConfigError: If the resolution cannot be, or the camera's place is not known to the data.
            UnknownNameError: If there is no such camera.
        """
        cameras = depth.find_cameras(self.mj_model, camera, self._movable())
        return depth.build(self.visible, cameras, width, height, drones, hide_own, along)

    def contact_fn(
        self, objects: report.Objects = None, floor: bool = True, drones: bool = True
    ) -> Callable[[SimData], ContactReport]:
        """Return ``fn(data) -> ContactReport``, pure, for the scene as it is now.

        It takes all worlds, or in a stage one world or one drone; a stage of one drone asks with ``drones=False``.
        What is left out costs nothing.

        Args:
            objects: Handles, or names of bodies; None for all, () for none.
            floor: Whether to report the floor: planes and height fields of the world itself.
            drones: Whether to report the other drones of a world.

        Raises:
            ConfigError: If nothing is asked for, or an object is not there or is moved by hand.
        """
        return report.build(self.solids, objects, floor, drones)

    def pictures(self, data: SimData, worlds: NDArray, camera: int | str, width: int, height: int) -> Array:
        """Return what a camera of the scene sees in some worlds, in one call. (n, height, width, 3), uint8

        Raises:
            ImportError: If MuJoCo Warp is not installed.
            ConfigError: If it is the free camera, one that does not exist, or the size cannot be.
        """
        model, key = self.mj_model, (camera, width, height, len(worlds))  # what was added is in the model from here on
        if self._batch is None or self._batch[0] != key:  # one, for each holds the scene of all its worlds
            self._batch = None
            renderer = BatchRenderer(model, camera, width, height, len(worlds), self.device)
            self._batch = (key, renderer)
        return self._batch[1](*poses_of(data, self._mjx_data, worlds, model))

    def draw(
        self, mode: str, camera: int | str, cam_config: dict[str, Any] | None, width: int, height: int
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Draw the world that was synced last, with the marks; ``Sim.render`` says what the arguments are."""
        if self.viewer is None:
            self.viewer = Viewer(self.mj_model, self.mj_data, self.marks.limit + self.mj_model.ngeom)
        picture = self.viewer.render(mode, camera, cam_config, width, height, self.marks)
        self.marks.clear()
        return picture

    @property
    def max_visual_geom(self) -> int:
        """Most marks that one picture takes."""
        return self.marks.limit

    @max_visual_geom.setter
    def max_visual_geom(self, limit: int) -> None:
        self.marks.limit = positive("max_visual_geom", limit)
        self.close()

    def close(self) -> None:
        """Close the window and free what pictures needed; the next picture makes it anew."""
        if self.viewer is not None:
            self.viewer.close()
            self.viewer = None
        self._batch = None


def _name(what: Any) -> str:
    """Return what objects are called that are given no name."""
    if isinstance(what, mujoco.MjsBody):
        return what.name or "object"
    if isinstance(what, mujoco.MjSpec):
        return what.modelname or "object"
    return Path(what).stem if isinstance(what, Path) or (isinstance(what, str) and "<" not in what) else "object"
