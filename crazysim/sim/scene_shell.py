"""The scene of a simulation: reading it, editing it, and bringing it up to date before it is read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

import mujoco
from jax import Array
from numpy.typing import NDArray

from crazysim.deprecation import warn_renamed
from crazysim.scene import mjx
from crazysim.scene.build import use_boxes
from crazysim.scene.contacts import body_id
from crazysim.scene.depth import Along
from crazysim.scene.overlays import Overlays
from crazysim.scene.queries import SceneQueries
from crazysim.scene.render import Viewer
from crazysim.scene.report import ContactReport, Objects
from crazysim.scene.scene import Scene

if TYPE_CHECKING:
    from crazysim.core.data import SimData
    from crazysim.core.registry import PluginRegistry
    from crazysim.engine import Stepper

T = TypeVar("T")


class SceneAttribute(Generic[T]):
    """An attribute of ``Sim`` that reads and writes an attribute of ``sim.scene``, or of its renderer."""

    def __init__(self, doc: str, of_renderer: bool = False):
        """Take the documentation of the attribute, and where it is."""
        self.__doc__ = doc
        self._of_renderer = of_renderer

    def __set_name__(self, _owner: type, name: str) -> None:
        self._name = name

    def __get__(self, sim: Any, _owner: type) -> T:
        return getattr(self._holder(sim), self._name) if sim is not None else self  # type: ignore[return-value]

    def __set__(self, sim: Any, value: T) -> None:
        setattr(self._holder(sim), self._name, value)

    def _holder(self, sim: Any) -> Any:
        return sim.scene.renderer if self._of_renderer else sim.scene


class SceneShell:
    """The part of ``Sim`` that concerns its scene."""

    data: SimData
    """Everything that changes."""
    n_worlds: int
    """Number of worlds."""
    n_drones: int
    """Number of drones in each world."""
    plugins: PluginRegistry
    """Plugins, which draw overlays."""
    _scene: Scene
    _stepper: Stepper
    _queries: SceneQueries

    @property
    def scene(self) -> Scene:
        """The MuJoCo scene; ``scene.add`` adds objects."""
        return self._scene

    spec = SceneAttribute[mujoco.MjSpec]("Editable scene; ``build_mjx`` makes edits take effect.")
    mj_model = SceneAttribute[mujoco.MjModel]("Compiled scene.")
    mj_data = SceneAttribute[mujoco.MjData]("State of the world that was drawn last.")
    mjx_model = SceneAttribute["mjx.Model"]("Compiled scene on the device; made when first read.")
    max_geom_pairs = SceneAttribute[int](
        "Most pairs that MJX checks per kind of collision, from the next ``build_mjx`` on; -1 for all."
    )
    max_visual_geom = SceneAttribute[int]("Most overlays of one image.", of_renderer=True)
    overlays = SceneAttribute[Overlays]("Lines, points, labels and text of the next image.", of_renderer=True)
    viewer = SceneAttribute[Viewer | None]("Renderer of one world; None before the first image.", of_renderer=True)

    @property
    def marks(self) -> Overlays:
        """Deprecated name of ``overlays``."""
        warn_renamed("Sim.marks", "Sim.overlays")
        return self.overlays

    @property
    def mjx_data(self) -> mjx.Data:
        """The scene's state in every world at its last sync; made when first read, and returned as it is.

        Assigning to it makes the scene stale. Poses of bodies other than drones, ``mocap_pos`` and ``mocap_quat``,
        must be one per world and finite, or it raises a ValueError.
        """
        return self._scene.mjx_data

    @mjx_data.setter
    def mjx_data(self, mjx_data: mjx.Data) -> None:
        self._scene.mjx_data = mjx_data
        self.data = self.data

    def build_mjx(self) -> None:
        """Compile ``spec`` again after an edit; closes the viewer, and leaves the simulation's data as it is.

        Raises:
            ConfigError: If the spec does not compile or has lost a drone; the old scene stays then.
        """
        self._scene.compile()

    def sync(self, world: int | None = None) -> None:
        """Bring the scene up to date, if anything has changed since the last sync.

        Args:
            world: World to write into ``mj_data``, without touching the others; None for all, in ``mjx_data``.

        Raises:
            ValueError: If the world does not exist.
        """
        if world is not None:
            self._require_world(world)
        self._scene.compile_if_edited()
        self._stepper.data = self._scene.sync(self._placed(), world)

    def _require_world(self, world: int) -> None:
        if not 0 <= world < self.n_worlds:
            raise ValueError(f"expected a world from 0 to {self.n_worlds - 1}, got {world}")

    def _placed(self) -> SimData:
        """Return the data with the objects of plugins, such as loads, at their poses."""
        return self.plugins.placed(self.data)

    def contacts(self, body: str | None = None) -> Array:
        """Return which contact slots touch, after a sync if anything has changed.

        A slot is a pair of geoms that may touch; ``mj_model`` and MJX decide which pair it is. From 64 drones a world
        on MJX keeps only ``max_geom_pairs`` pairs, the nearest; set it to -1 and call ``build_mjx`` for all.

        Args:
            body: Name of a body, such as ``"drone:0"``, to which a slot must belong; None for all.

        Returns:
            (n_worlds, n_slots), bool

        Raises:
            ValueError: If the scene has no such body.
        """
        if body is not None:
            body_id(self.mj_model, body)  # a wrong name raises before anything changes
        self.sync()
        return self._scene.contacts(body)

    def contact_report(self, objects: Objects = None, floor: bool = True, drones: bool = True) -> ContactReport:
        """Return the contacts and distances of every drone: to the floor, to objects, to other drones.

        Computed by JAX from the poses in the data. Bodies that were attached to ``spec`` and are moved through
        ``mjx_data`` are where ``mjx_data`` has them. Fields that were not requested are None and are not computed.

        Args:
            objects: Handles from ``scene.add``, or names of bodies; None for all, () for none.
            floor: True to report the floor.
            drones: True to report the other drones of a world.

        Raises:
            ValueError: If nothing is requested, or an object does not exist.
        """
        return self._queries.contact_report(self._placed(), objects, floor, drones)

    def depth(
        self,
        camera: str | int = "fpv_cam",
        width: int = 64,
        height: int = 64,
        drones: bool = True,
        hide_own: bool = True,
        along: Along = "axis",
    ) -> Array:
        """Return depth images of all worlds, m; see ``scene.depth_fn``. (n_worlds, n_cameras, height, width)

        Infinite where nothing is hit.

        Raises:
            ValueError: If the camera does not exist, or the resolution is not positive.
        """
        return self._queries.depth(self._placed(), camera, width, height, drones, hide_own, along)

    def render(
        self,
        mode: str = "human",
        world: int = 0,
        camera: int | str = -1,
        cam_config: dict[str, Any] | None = None,
        width: int = 1920,
        height: int = 1080,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Render one world; all arguments take effect at every call.

        Args:
            mode: ``"human"`` draws into a window until the user closes it; ``"rgb_array"`` returns an image
                (height, width, 3) of type uint8, ``"depth_array"`` the distance along the camera's axis, m
                (height, width), ``"rgbd_tuple"`` both.
            world: Index of the world.
            camera: Name or id; -1 is the free camera. Drones carry ``fpv_cam:i`` and ``track_cam:i``.
            cam_config: Settings of the free camera: lookat, distance, azimuth, elevation.
            width: Pixels. A window is resized when it changes; the user may resize it too.
            height: Pixels.

        Raises:
            ValueError: If the world, camera, mode or a setting does not exist.
            RenderError: If this machine cannot draw.
        """
        self.sync(world)
        return self._image(mode, world, camera, cam_config, width, height)

    def draw(
        self,
        mode: str = "rgb_array",
        world: int = 0,
        camera: int | str = -1,
        cam_config: dict[str, Any] | None = None,
        width: int = 1920,
        height: int = 1080,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Render one world as ``render`` does, and leave ``mjx_data`` as it is, even where there is only one world.

        The first image comes seconds earlier, as MJX is neither imported nor compiled for it. Views and films use it.

        Args:
            mode: As in ``render``.
            world: As in ``render``.
            camera: As in ``render``.
            cam_config: As in ``render``.
            width: Pixels.
            height: Pixels.

        Returns:
            Same as ``render``.

        Raises:
            ValueError: If the world, camera, mode or a setting does not exist.
            RenderError: If this machine cannot draw.
        """
        self._require_world(world)
        self._scene.compile_if_edited()
        self._scene.sync_one(self._placed(), world)
        return self._image(mode, world, camera, cam_config, width, height)

    def _image(
        self,
        mode: str,
        world: int,
        camera: int | str,
        cam_config: dict[str, Any] | None,
        width: int,
        height: int,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Render the world that was synced last, with the overlays of plugins."""
        before = self.overlays.copy()
        try:
            self.plugins.draw(world)
            return self._scene.render(mode, camera, cam_config, width, height)
        except Exception:
            self.overlays.restore(before)  # without what plugins have drawn, which draw again for the next image
            raise

    def close(self) -> None:
        """Close the window and free the renderers."""
        self._scene.close()


def use_box_collision(sim: SceneShell, enable: bool = True) -> None:
    """Let drones touch with boxes instead of spheres, or with spheres again; compiles the scene again.

    Boxes follow the drone's outline more closely and cost more to check.
    """
    use_boxes(sim.spec, sim.n_drones, enable)
    sim.build_mjx()
