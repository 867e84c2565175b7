"""The simulation as an object: it holds data, pipeline and scene, and calls them in order."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.sharding import Mesh
from numpy.typing import NDArray

from crazysim.control import Control
from crazysim.core import functional as F
from crazysim.core.data import SimData, as_key, require_pair
from crazysim.core.integration import Integrator
from crazysim.core.pipeline import Pipeline
from crazysim.core.random import seed_sim
from crazysim.core.registry import PluginRegistry
from crazysim.core.settings import as_mask, control_freqs, find_device, member, physics_freq, positive
from crazysim.core.sharding import put, shard
from crazysim.core.stages import build_step_pipeline, clip_floor_pos, increment_steps, reset
from crazysim.drones import Airframe, Drone, load_airframe
from crazysim.dynamics import Dynamics
from crazysim.dynamics.core import require_support
from crazysim.engine import Step, build_reset, explain
from crazysim.engine.plain import ResetFn
from crazysim.engine.rollout import Keep, Policy, states_of
from crazysim.engine.rollout import run as run_rollout
from crazysim.engine.step import Apart
from crazysim.scene import mjx
from crazysim.scene.build import use_boxes
from crazysim.scene.contacts import body_id
from crazysim.scene.depth import Along
from crazysim.scene.overlays import Marks
from crazysim.scene.queries import SceneQueries
from crazysim.scene.render import Viewer
from crazysim.scene.report import ContactReport, Objects
from crazysim.scene.scene import Held, Scene
from crazysim.scene.sync import sync_sim2mjx
from crazysim.sim.plugins import PluginMethods

__all__ = ["Sim", "clip_floor_pos", "increment_steps", "reset", "seed_sim", "sync_sim2mjx", "use_box_collision"]


class Sim(PluginMethods):
    """Worlds of drones that advance together.

    ``data`` holds everything that changes, ``step_pipeline`` and ``reset_pipeline`` what happens to it, ``spec``
    the scene. Physics never touches the scene: it is brought up to date when contacts or pictures are asked for.
    """

    def __init__(
        self,
        n_worlds: int = 1,
        n_drones: int = 1,
        drone: str | Path | Mapping[str, Any] | Airframe = Drone.cf21B_500,
        dynamics: Dynamics | str = Dynamics.default,
        control: Control | str = Control.default,
        integrator: Integrator | str = Integrator.default,
        freq: int = 500,
        state_freq: int | None = None,
        attitude_freq: int | None = None,
        body_rate_freq: int | None = None,
        force_torque_freq: int | None = None,
        device: str | jax.Device = "cpu",
        xml_path: str | Path | None = None,
        rng_key: int | Array = 0,
        *,
        mesh: Mesh | None = None,
        engine: str = "auto",
    ):
        """Build the scene's spec, the data and both pipelines; nothing of MuJoCo is allocated per world.

        Args:
            n_worlds: Number of worlds.
            n_drones: Number of drones in each.
            drone: Name of a built-in airframe, path of a TOML file, dict, or airframe.
            dynamics: Dynamics model.
            control: Command level.
            integrator: Integration scheme.
            freq: Physics steps per second, Hz.
            state_freq: Rate of the state controller, Hz; 100, or the largest divisor of ``freq`` below.
            attitude_freq: Rate of the attitude controller, Hz; 500, or the largest divisor of ``freq`` below.
            body_rate_freq: Rate of the body-rate controller, Hz; as ``attitude_freq``.
            force_torque_freq: Rate of the allocation, Hz; as ``attitude_freq``.
            device: Where the data lives: a platform such as ``"cpu"`` or ``"gpu"``, or a device.
            xml_path: MJCF scene; None for floor, light and sky.
            rng_key: Seed, or a key.
            mesh: Devices to spread the worlds over, from ``crazysim.core.sharding.world_mesh``.
            engine: How a step is executed: ``"plain"``, ``"lanes"`` or ``"fused"``; ``"auto"`` takes the fastest that
                can run the step pipeline here. ``explain`` tells which that is.

        Raises:
            ValueError: Any argument that cannot be, with what came and what was needed.
        """
        self.n_worlds = positive("n_worlds", n_worlds)
        self.n_drones = positive("n_drones", n_drones)
        self.freq = physics_freq(freq)
        self.dynamics = member(Dynamics, "dynamics", dynamics)
        self.control = member(Control, "control", control)
        self.integrator = member(Integrator, "integrator", integrator)
        require_pair(self.dynamics, self.control)
        self.airframe = load_airframe(drone)
        require_support(self.airframe, self.dynamics)
        self.drone = self.airframe.name
        self.device = find_device(device)
        self.mesh = mesh
        self.engine = engine
        asked = {
            Control.state: state_freq,
            Control.attitude: attitude_freq,
            Control.body_rate: body_rate_freq,
            Control.force_torque: force_torque_freq,
        }
        self._freqs = control_freqs(self.control, self.freq, asked)

        self._scene = Scene(xml_path, self.airframe, self.n_worlds, self.n_drones, self.freq, self.device, mesh)
        self._seed = as_key(rng_key)
        self._counts: dict[int, Array] = {}
        self._queries = self._new_queries()
        self._whole: SimData | None = None
        self._apart: Apart | None = None
        self._cleared: Any = None
        self.plugins = PluginRegistry(self)
        self.build_data()
        self.build_default_data()
        self._scene.on_compile = self._adopt_scene

        self.step_pipeline: Pipeline = build_step_pipeline(self.control, self.dynamics, self.integrator)
        self.reset_pipeline: Pipeline = {"reset": reset}
        self.build_step_fn()
        self.build_reset_fn()

    # Data ---------------------------------------------------------------------------------------------------

    def _new_queries(self) -> SceneQueries:
        kernels = self.mesh is None and self.engine in ("auto", "fused")
        return SceneQueries(self._scene, self.device.platform if kernels else None)

    @property
    def data(self) -> SimData:
        """Everything that changes. Assigning to it makes the scene stale, and clears ``core.mjx_synced``."""
        return self._data

    @property
    def _data(self) -> SimData:
        """The data, put together when somebody wants it, with what has been added to the scene."""
        self._scene.compile_if_edited()
        if self._whole is None:
            self._whole = self._apart.data()
        return self._whole

    @_data.setter
    def _data(self, data: SimData) -> None:
        self._whole, self._apart = data, None

    @data.setter
    def data(self, data: SimData) -> None:
        if data.core.mjx_synced is not self._cleared:
            # A new array, for what is read from here may be donated, and must then be nobody else's.
            data = data.replace(core=data.core.replace(mjx_synced=np.False_))
        self._advance(self._place(data))

    def _advance(self, data: SimData) -> None:
        self._data, self._cleared = data, data.core.mjx_synced
        self._scene.invalidate()

    def _place(self, data: SimData) -> SimData:
        """Return the data with every leaf on the simulation's device; what is there already is not touched.

        An edited leaf lives wherever JAX puts new arrays by default, and an array elsewhere, or one that is merely
        not bound to its device, would have the next step compiled anew.
        """
        return put(data, self.device) if self.mesh is None else shard(data, self.mesh)

    @property
    def time(self) -> Array:
        """Time since each world's last reset, s. (n_worlds, 1)"""
        return self.data.core.steps / self.freq

    @property
    def control_freq(self) -> int:
        """Rate at which commands are taken over, Hz; with rotor commands that is every step."""
        return self._freqs.get(self.control, self.freq)

    @property
    def controllable(self) -> Array:
        """In which worlds the next step takes over a staged command. (n_worlds, 1)"""
        return F.controllable(self.data)

    def build_data(self) -> SimData:
        """Return new data at rest, as at construction, with a new record of every plugin; make it the simulation's."""
        data = SimData.create(
            self.n_worlds,
            self.n_drones,
            self.dynamics,
            self.control,
            self.airframe,
            self.freq,
            self._freqs,
            self._scene.drone_mocap_ids,
            self._seed,
        )
        self.data = data.replace(objects=self._scene.objects(None))
        self.plugins.build_records()
        return self.data

    @property
    def default_data(self) -> SimData:
        """What resets return to."""
        self._scene.compile_if_edited()
        return self._default_data

    @default_data.setter
    def default_data(self, data: SimData) -> None:
        self._default_data = data

    def build_default_data(self) -> SimData:
        """Make the data as it is now what resets return to, and return it."""
        self.default_data = self.data
        return self.default_data

    def shard(self, mesh: Mesh) -> SimData:
        """Spread data, default data and scene over devices, and return the data."""
        self.mesh = mesh
        self.data = self.data
        self.default_data = shard(self.default_data, mesh)
        self._scene.shard(mesh)
        self._queries = self._new_queries()
        self.build_step_fn()
        return self.data

    def seed(self, seed: int) -> None:
        """Set the seed of all random numbers drawn from now on.

        Raises:
            ValueError: If it is no integer.
        """
        self._seed = as_key(seed)
        self.data = seed_sim(self.data, self._seed)

    # Stepping -----------------------------------------------------------------------------------------------

    def step(self, n_steps: int = 1) -> None:
        """Advance every world by a number of physics steps; any number uses the same compilation."""
        n_steps = positive("n_steps", n_steps)
        self._scene.compile_if_edited()
        apart = self._step.take_apart(self._data) if self._apart is None else self._apart
        self._apart, self._whole = self._step.advance(apart, self._count(n_steps)), None
        self._cleared = self._apart.leaves[apart.plan.shown]
        self._scene.invalidate()

    def _count(self, n_steps: int) -> Array:
        """Return a number of steps where the step wants it; making a device's number anew costs more than a step."""
        if n_steps not in self._counts:
            self._counts[n_steps] = jnp.int32(n_steps)
        return self._counts[n_steps]

    def rollout(
        self,
        policy: Policy,
        params: Any = None,
        n_control_steps: int = 1,
        *,
        keep: Keep = states_of,
        every: int = 1,
        progress: bool = False,
    ) -> Any:
        """Fly many control steps in one compiled call, and return what was kept on the way.

        A control step asks the policy for a command, stages it, and steps until the next command is taken over.

        Args:
            policy: ``policy(params, data) -> command``, for all worlds at once; a function that stays the same object
                is compiled once.
            params: The policy's parameters, any tree of arrays.
            n_control_steps: How many; a multiple of ``every``.
            keep: ``keep(data)`` is what is kept after a control step, any tree of arrays.
            every: Control steps from one that is kept to the next.
            progress: Whether to show a bar, which needs tqdm.

        Returns:
            What ``keep`` returned, with time in front. (n_control_steps // every, ...)

        Raises:
            ValueError: If a number cannot be, or the policy returns a command of another shape.
        """
        data, kept = run_rollout(
            self._step, self.data, policy, params, n_control_steps, progress, every,
            n_substeps=self.freq // self.control_freq, keep=keep,
        )  # fmt: skip
        self._advance(data)
        return kept

    def explain(self) -> str:
        """Return in a few lines which engine runs the step, what it fuses, and what it cannot fuse and why."""
        return explain(self._step, self.data)

    def reset(self, mask: Any = None) -> None:
        """Bring all worlds, or those of a mask, back to ``default_data``, and run the reset pipeline.

        Args:
            mask: Which worlds, of type bool; None for all. (n_worlds,)

        Raises:
            ValueError: If the mask has another shape or type.
        """
        self._advance(self._reset(self.data, self.default_data, as_mask(mask, self.n_worlds)))

    def state_control(self, controls: Any, check_finite: bool = False) -> None:
        """Stage a full-state setpoint; see ``crazysim.core.functional.state_control``. (n_worlds, n_drones, 16)"""
        self._command(F.state_control(self.data, controls, check_finite))

    def attitude_control(self, controls: Any, check_finite: bool = False) -> None:
        """Stage roll, pitch, yaw, rad, and collective thrust, N. (n_worlds, n_drones, 4)"""
        self._command(F.attitude_control(self.data, controls, check_finite))

    def body_rate_control(self, controls: Any, check_finite: bool = False) -> None:
        """Stage body rates, rad/s, and collective thrust, N. (n_worlds, n_drones, 4)"""
        self._command(F.body_rate_control(self.data, controls, check_finite))

    def force_torque_control(self, controls: Any, check_finite: bool = False) -> None:
        """Stage collective thrust, N, and body torque, N m. (n_worlds, n_drones, 4)"""
        self._command(F.force_torque_control(self.data, controls, check_finite))

    def rotor_vel_control(self, controls: Any, check_finite: bool = False) -> None:
        """Command rotor speeds, rpm. (n_worlds, n_drones, n_rotors)"""
        self._command(F.rotor_vel_control(self.data, controls, check_finite))

    def _command(self, data: SimData) -> None:
        self._data = data  # a command moves nothing: the scene stays as fresh as it was

    def build_step_fn(self) -> Step:
        """Make the step pipeline as it is now take effect; return ``step(data, n_steps=1) -> data``, pure."""
        if self._whole is not None or self._apart is not None:
            self._data = self._data  # whole: it is taken apart for one step function
        self._step = Step(self.step_pipeline, self.engine, self.device.platform, self.mesh)
        return self._step

    def build_reset_fn(self) -> ResetFn:
        """Make the reset pipeline as it is now take effect; return ``reset(data, default_data, mask=None)``, pure."""
        self._reset = build_reset(self.reset_pipeline)
        return self._reset

    # Scene --------------------------------------------------------------------------------------------------

    @property
    def scene(self) -> Scene:
        """What MuJoCo holds; ``scene.add`` adds objects."""
        return self._scene

    spec = Held[mujoco.MjSpec]("The scene, to be edited; ``build_mjx`` has an edit take effect.")
    mj_model = Held[mujoco.MjModel]("What ``spec`` was compiled to.")
    mj_data = Held[mujoco.MjData]("The one world that was drawn last.")
    mjx_model = Held[mjx.Model]("The scene's model on the device; made when first read.")
    max_geom_pairs = Held[int]("Cap on the pairs MJX checks per kind of collision, from the next ``build_mjx`` on.")
    max_visual_geom = Held[int]("Most marks that one picture takes.")
    marks = Held[Marks]("What is drawn over the next picture.")
    viewer = Held[Viewer | None]("What draws; made for the first picture.")

    @property
    def mjx_data(self) -> mjx.Data:
        """The scene's state in every world, as it was last synced; made when first read, and returned as it is.

        Assigning to it makes the scene stale. Poses of bodies that are no drones, ``mocap_pos`` and ``mocap_quat``,
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

    def _adopt_scene(self) -> None:
        """Have the data know what the scene holds now."""
        ids = self._scene.drone_mocap_ids

        def adopted(data: SimData) -> SimData:
            core = data.core.replace(drone_mocap_ids=jnp.asarray(ids, jnp.int32))
            return data.replace(core=core, objects=self._scene.objects(data.objects))

        self.data = adopted(self.data)
        self.default_data = self._place(adopted(self.default_data))

    def contacts(self, body: str | None = None) -> Array:
        """Return which contact slots touch, after bringing the scene up to date if anything has changed.

        A slot is a pair of geoms that may touch; which pair it is, ``mj_model`` and MJX decide. From 64 drones a
        world on MJX keeps only ``max_geom_pairs`` pairs, the nearest; set it to -1 and call ``build_mjx`` for all.

        Args:
            body: Name of a body, such as ``"drone:0"``, to which a slot must belong; None for all.

        Returns:
            (n_worlds, n_slots), bool

        Raises:
            ValueError: If the scene has no such body.
        """
        if body is not None:
            body_id(self.mj_model, body)  # a wrong name is told before anything is touched
        self._data = self._scene.sync(self._data)
        return self._scene.contacts(body)

    def contact_report(self, objects: Objects = None, floor: bool = True, drones: bool = True) -> ContactReport:
        """Return what each drone touches, and how far it is from the rest: floor, objects, other drones.

        Pure JAX on the drones' poses: neither MuJoCo nor anything that was drawn takes part.

        Args:
            objects: Handles from ``scene.add``, or names of bodies; None for all, () for none.
            floor: Whether to report the floor.
            drones: Whether to report the other drones of a world. What is left out costs nothing, and is None.

        Raises:
            ValueError: If nothing is asked for, or an object is not there or is moved by hand.
        """
        return self._queries.contact_report(self.data, objects, floor, drones)

    def depth(
        self,
        camera: str | int = "fpv_cam",
        width: int = 64,
        height: int = 64,
        drones: bool = True,
        hide_own: bool = True,
        along: Along = "axis",
    ) -> Array:
        """Return what cameras of all worlds measure, m; see ``scene.depth_fn``. (n_worlds, n_cameras, height, width)

        Infinite where nothing is hit.

        Raises:
            ValueError: If the camera does not exist, or the resolution cannot be.
        """
        return self._queries.depth(self.data, camera, width, height, drones, hide_own, along)

    def render(
        self,
        mode: str = "human",
        world: int = 0,
        camera: int | str = -1,
        cam_config: dict[str, Any] | None = None,
        width: int = 1920,
        height: int = 1080,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Draw one world; every argument counts at every call.

        Args:
            mode: ``"human"`` draws into a window, which its user may close for good; ``"rgb_array"`` returns a picture
                (height, width, 3) of type uint8, ``"depth_array"`` the distance along the camera's axis, m
                (height, width), ``"rgbd_tuple"`` both.
            world: Which world.
            camera: Name or id; -1 is the free camera. Drones carry ``fpv_cam:i`` and ``track_cam:i``.
            cam_config: Settings of the free camera: lookat, distance, azimuth, elevation.
            width: Pixels. A window takes it when it opens and when it changes; its user may resize it.
            height: Pixels.

        Raises:
            ValueError: If the world, camera, mode or a setting does not exist.
            RenderError: If this machine cannot draw.
        """
        if not 0 <= world < self.n_worlds:
            raise ValueError(f"world {world} does not exist; worlds go from 0 to {self.n_worlds - 1}")
        self._data = self._scene.sync(self._data, world)
        self.plugins.draw(world)
        return self._scene.draw(mode, camera, cam_config, width, height)

    def close(self) -> None:
        """Close the window and free what pictures needed."""
        self._scene.close()


def use_box_collision(sim: Sim, enable: bool = True) -> None:
    """Let drones touch with boxes instead of spheres, or with spheres again; compiles the scene anew.

    Boxes follow the drone's outline more closely and cost more to check.
    """
    use_boxes(sim.spec, sim.n_drones, enable)
    sim.build_mjx()
