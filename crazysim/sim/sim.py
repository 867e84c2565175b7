"""The simulation as an object: it holds data, pipelines and scene, and calls pure functions in order."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import mujoco
import numpy as np
from jax import Array
from jax.sharding import Mesh
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments, check_flag
from crazysim.control import Control, Controller
from crazysim.control.controllers import DEFAULT_CONTROLLER
from crazysim.core import functional as F
from crazysim.core.airframes import AirframeSource, drone_names, find_common_airframe
from crazysim.core.data import SimData, as_key, object_names, require_memory_of_worlds
from crazysim.core.integration import Integrator
from crazysim.core.pipeline import BuiltPipeline, Pipeline
from crazysim.core.plugin import Plugin, check_plugin_list
from crazysim.core.random import seed_sim
from crazysim.core.settings import positive_integer
from crazysim.core.stages import build_step_pipeline, clip_floor_pos, increment_steps, reset
from crazysim.drones import Airframe, Drone
from crazysim.dynamics import Dynamics
from crazysim.dynamics.parameters import rotor_vel_limits
from crazysim.engine import Step, explain
from crazysim.engine.cache import keep_programs
from crazysim.engine.jaxcompat import require_unforked_process
from crazysim.engine.pytree import device_array
from crazysim.engine.sharding import shard
from crazysim.errors import ConfigError
from crazysim.plugins.plugin_registry import P, PluginRegistry
from crazysim.scene import mjx
from crazysim.scene.build import use_boxes
from crazysim.scene.contact_report import ContactReport, ObjectSelection
from crazysim.scene.depth import Along
from crazysim.scene.mjx_scene import body_id
from crazysim.scene.overlays import Overlays
from crazysim.scene.queries import SceneQueries
from crazysim.scene.ray_casting import RayKernels
from crazysim.scene.render import ModelRenderer
from crazysim.scene.scene import Scene
from crazysim.scene.sync import sync_sim2mjx
from crazysim.sim.adopt import VehicleKind, read_vehicles, vehicle_poses
from crazysim.sim.configuration import Configuration, initial_plugins
from crazysim.sim.members import Member, find_member, locked
from crazysim.sim.reset import Reset
from crazysim.sim.rollout import KeepFunction, Policy, get_states, run_rollout
from crazysim.sim.stepper import Stepper

if TYPE_CHECKING:
    from crazysim.plugins.estimators import Estimator

__all__ = [
    "Sim",
    "clip_floor_pos",
    "increment_steps",
    "reset",
    "rotor_vel_limits",
    "seed_sim",
    "sync_sim2mjx",
    "use_box_collision",
]


class Sim:
    """Worlds of drones that advance together.

    ``data`` holds everything that changes. ``step_pipeline`` and ``reset_pipeline`` hold the stages that change it.
    ``spec`` describes the scene. Physics does not depend on the scene, which is updated lazily, when contacts or images
    are requested.

    Threads may share a simulation: a lock lets only one call at a time change its data.
    """

    lock: threading.RLock
    """Lock held by calls that change data. Hold it to change data that another thread steps: ``with sim.lock:
    sim.data = load.release(sim.data)``."""
    plugins: PluginRegistry
    """The plugins by name, in the order in which they were added."""

    @keep_programs()
    def __init__(
        self,
        n_worlds: int = 1,
        n_drones: int = 1,
        drone: AirframeSource | Sequence[AirframeSource] = Drone.cf21B_500,
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
        strict: bool = False,
        controller: str | Controller | Sequence[str | Controller] = DEFAULT_CONTROLLER,
        switch: Callable[..., Array] | ArrayLike | None = None,
        estimator: str | Estimator | None = None,
        aero: str | None = None,
        plugins: Sequence[Plugin] = (),
    ):
        require_unforked_process()
        rates = {
            Control.state: state_freq,
            Control.attitude: attitude_freq,
            Control.body_rate: body_rate_freq,
            Control.force_torque: force_torque_freq,
        }
        self.lock = threading.RLock()
        self.configuration = c = Configuration.create(
            n_worlds, n_drones, drone, dynamics, control, integrator, freq, rates, device, mesh, engine, strict,
            controller, switch,
        )  # fmt: skip
        first_plugins = initial_plugins(plugins, estimator, aero)
        self.n_worlds, self.n_drones, self.freq = c.n_worlds, c.n_drones, c.freq
        self.dynamics, self.control, self.integrator = c.dynamics, c.control, c.integrator
        self.airframes = c.airframes
        self.drone_names = drone_names(c.airframes)
        self.device, self.mesh, self.engine = c.device, mesh, engine

        self.plugins = PluginRegistry(self)  # type: ignore[arg-type]  # properties serve as attributes
        ray_kernels = RayKernels.choose(engine, self.device, mesh, strict)
        self._scene = Scene(
            xml_path, self.airframes, self.n_worlds, self.n_drones, self.freq, self.device, mesh, self.plugins.values,
            ray_kernels,
        )  # fmt: skip
        self._adopted_revision = self._scene.revision  # of the scene whose objects are in the data
        self._stepper = Stepper(self.device, mesh, engine, strict)
        self._queries = SceneQueries(self._scene)
        self._seed = as_key(rng_key)
        try:
            self.build_data()
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            raise ConfigError(
                f"expected a number of worlds that fits into memory, got n_worlds={n_worlds}: {error}. Use fewer."
            ) from error
        self._default_data = self._stepper.data

        stages = build_step_pipeline(self.control, self.dynamics, self.integrator, c.controller)
        self._built_step = BuiltPipeline(
            "step_pipeline", stages, lambda p: self._stepper.build(p, self.plugins.data_check(self._default_data))
        )
        self._built_reset = BuiltPipeline(
            "reset_pipeline", {"reset": reset}, lambda p: Reset(p, self.plugins.plugin_check())
        )
        for plugin in first_plugins:
            self.add(plugin)

    def _use_scene(self, scene: Scene) -> None:
        self._scene, self._queries, self._adopted_revision = scene, SceneQueries(scene), scene.revision
        self.build_data()
        self._default_data = self._stepper.data

    @classmethod
    @check_arguments
    def from_mjcf(
        cls,
        xml_path: str | Path,
        n_worlds: int = 1,
        *,
        kinds: Mapping[str, VehicleKind] | None = None,
        plugins: Sequence[Plugin] = (),
        **settings: Any,
    ) -> Sim:
        """Make a simulation with the vehicles of an MJCF, at their poses; everything else in the file is the scene.

        Vehicles are children of the world body that have a joint, or are mocap bodies, and have a name made of a prefix
        and a number: ``Crazyflie_0``, ``Bumblebee_2``. They keep their names. Their bodies are replaced by the bodies
        of the airframes.

        Args:
            kinds: Airframes, or subclasses of ``Population``, for prefixes other than those in
                ``crazysim.sim.adopt.known_kinds()``.
            plugins: Plugins, which are added when all vehicles are at their poses.
            **settings: Further arguments of ``Sim``.

        Raises:
            ConfigError: If the file cannot be read, or has no drone.
        """
        check_plugin_list("plugins", plugins)
        spec, drones, populations = read_vehicles(xml_path, kinds or {})
        sim = cls(n_worlds, len(drones), [v.kind for v in drones], xml_path=spec, **settings)  # type: ignore[arg-type]
        sim.drone_names = tuple([v.name for v in drones])
        states = sim.data.states
        pos, quat = vehicle_poses(drones, states.pos)
        sim.data = sim.data.replace(states=states.replace(pos=pos, quat=quat))
        for kind, members in populations.items():
            plugin = sim.add(kind([v.name for v in members]))
            record = plugin.read(sim.data).with_poses(*vehicle_poses(members, states.pos))
            sim.data = plugin.write(sim.data, record)
        sim.build_default_data()
        for plugin in plugins:
            sim.add(plugin)
        return sim

    def __getstate__(self) -> Any:
        raise TypeError(
            "expected an object that can be pickled or copied, got a simulation, or an environment with one. Make it "
            "again with the same settings, and pickle or copy its data: sim.data, or the state of an environment."
        )

    @property
    def airframe(self) -> Airframe:
        """Airframe of all drones, if they have only one."""
        return find_common_airframe(self.airframes)

    @property
    def drone(self) -> str:
        """Name of the airframe of all drones, if they have only one."""
        return self.airframe.name

    # Names ------------------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones, then of the members of all populations."""
        return (*self.drone_names, *self.plugins.members)

    @check_arguments
    def __getitem__(self, name: str) -> Member:
        return find_member(self, self.plugins, name, self._stepper.stage_command)  # type: ignore[arg-type]  # as in __init__

    # Data -------------------------------------------------------------------------------------------------------------

    @property
    def data(self) -> SimData:
        """Everything that changes. An assignment makes the scene stale, and clears ``core.mjx_synced``."""
        self._adopt_scene()
        return self._stepper.data

    @data.setter
    @locked
    def data(self, data: SimData) -> None:
        self._adopt_scene()
        self.configuration.check(data, self._default_data)
        self._stepper.assign(self._adapt_to_scene(data))
        self._scene.forget_sync()

    @property
    def default_data(self) -> SimData:
        """The data that resets restore."""
        self._adopt_scene()
        return self._default_data

    @default_data.setter
    def default_data(self, data: SimData) -> None:
        self._adopt_scene()
        self.configuration.check(data, self._default_data)
        self._default_data = self._stepper.put_on_device(self._adapt_to_scene(data))

    def _adopt_scene(self) -> None:
        # Only these plugins compile the scene.
        if self._adopted_revision == self._scene.revision and not self.plugins.is_stale:
            return
        with self.lock, jax.ensure_compile_time_eval():  # keeps arrays from becoming tracers inside a user's trace
            if self._adopted_revision != self._scene.revision:
                self._adopted_revision = self._scene.revision
                self._stepper.assign(self._update_objects(self._stepper.data))
                self._default_data = self._stepper.put_on_device(self._update_objects(self._default_data))
                self.plugins.is_stale = True
            self.plugins.refresh()

    def _adapt_to_scene(self, data: SimData) -> SimData:
        if object_names(data) != object_names(self._default_data):
            data = self._update_objects(data)
        return self.plugins.adapt_records(data, self._default_data)

    def _update_objects(self, data: SimData) -> SimData:
        ids = device_array(self._scene.drone_mocap_ids, np.int32)
        return data.replace(core=data.core.replace(drone_mocap_ids=ids), objects=self._scene.objects(data.objects))

    @property
    def time(self) -> Array:
        """Time since each world's last reset, s. (n_worlds, 1)"""
        return F.time(self.data)

    @locked
    def build_data(self) -> SimData:
        """Replace the data by the data of drones at rest, with new records of all plugins, and return the new data."""
        c, freqs = self.configuration, dict(self.configuration.control_freqs)

        def create(n_worlds: int) -> SimData:
            return SimData.create(
                n_worlds, c.n_drones, c.dynamics, c.control, c.airframes, c.freq, freqs, self._scene.drone_mocap_ids,
                self._seed, c.controller,
            )  # fmt: skip

        require_memory_of_worlds(create, c.n_worlds, c.n_drones, self.device, getattr(self.mesh, "size", 1))
        data = create(c.n_worlds)
        self._stepper.assign(data.replace(objects=self._scene.objects(None)))
        self.plugins.build_records()
        return self.data

    def build_default_data(self) -> SimData:
        """Make the present data the data that resets restore, and return it."""
        self.default_data = self.data
        return self.default_data

    @locked
    def shard(self, mesh: Mesh) -> SimData:
        """Distribute data, default data and scene over devices, and return the data."""
        default = self.default_data
        self.mesh = self._stepper.mesh = mesh
        self.data = shard(self.data, mesh)
        self.default_data = shard(default, mesh)
        self._scene.shard(mesh)
        self.plugins.is_stale = True  # images need other kernels
        self._queries = SceneQueries(self._scene)
        self.build_step_fn()
        return self.data

    @locked
    def seed(self, seed: int) -> None:
        """Set the seed of all random numbers drawn from now on."""
        self._seed = as_key(seed)
        self.data = seed_sim(self.data, self._seed)

    # Plugins ----------------------------------------------------------------------------------------------------------

    @locked
    @check_arguments
    def add(self, plugin: P, name: str | None = None) -> P:
        """Add an effect, a sensor, a log or any other plugin, and return it.

        The plugin's record is added to ``plugins`` of the data and the default data, and objects that it adds to the
        scene are added to ``data.objects``. Nothing else in the data changes. Its stages are added to the step
        pipeline, and its influences and states to the integration. The step is compiled again.

        Args:
            name: Name of the added plugin; None for ``plugin.name``.
        """
        return self.plugins.add(plugin, name)

    @locked
    @check_arguments
    def remove(self, plugin: Plugin | str) -> None:
        """Remove a plugin, with its record and its stages; stages that it had replaced return.

        Objects that it moved, such as loads, stay in the scene where they are.
        """
        self.plugins.remove(plugin)

    @locked
    def replace(self, plugin: P) -> P:
        """Replace the settings of the plugin of the same name, and return the new plugin; its states are unchanged.

        If only numbers change (fields declared with ``param``), nothing is compiled, unless a number that was None, or
        was left out because it was zero, gets another value.
        """
        return self.plugins.replace(plugin)

    # Commands ---------------------------------------------------------------------------------------------------------

    # A command moves nothing, so it does not make the scene stale. All methods have the arguments and errors of
    # ``crazysim.core.functional.state_control``.

    @property
    def control_freq(self) -> int:
        """Rate at which staged commands take effect, Hz; for rotor speeds, the rate of physics steps."""
        return self.configuration.control_freqs.get(self.configuration.control, self.configuration.freq)

    @property
    def controllable(self) -> Array:
        """True in worlds where a staged command takes effect at the next step. (n_worlds, 1)"""
        return F.controllable(self.data)

    @locked
    def state_control(
        self,
        controls: ArrayLike | None = None,
        check_finite: bool = False,
        *,
        pos: ArrayLike | None = None,
        vel: ArrayLike | None = None,
        acc: ArrayLike | None = None,
        yaw: ArrayLike | None = None,
        feedforward: ArrayLike | None = None,
    ) -> None:
        """Stage a full-state setpoint: (n_worlds, n_drones, 16), or ``pos`` and other parts.

        ``pos``, ``vel``, ``acc`` and ``yaw`` broadcast; ``feedforward`` has its full shape, (n_worlds, n_drones, 8).
        """
        data = self._stepper.data_or_shapes
        self._stepper.stage_command(
            *F.check_setpoint(data, controls, check_finite, pos=pos, vel=vel, acc=acc, yaw=yaw, feedforward=feedforward)
        )

    @locked
    def attitude_control(self, controls: ArrayLike, check_finite: bool = False) -> None:
        """Stage roll, pitch, yaw, rad, and collective thrust, N. (n_worlds, n_drones, 4)"""
        self._stage_command(Control.attitude, controls, check_finite)

    @locked
    def body_rate_control(self, controls: ArrayLike, check_finite: bool = False) -> None:
        """Stage body rates, rad/s, and collective thrust, N. (n_worlds, n_drones, 4)"""
        self._stage_command(Control.body_rate, controls, check_finite)

    @locked
    def force_torque_control(self, controls: ArrayLike, check_finite: bool = False) -> None:
        """Stage collective thrust, N, and body torque, N m. (n_worlds, n_drones, 4)"""
        self._stage_command(Control.force_torque, controls, check_finite)

    @locked
    def rotor_vel_control(self, controls: ArrayLike, check_finite: bool = False) -> None:
        """Command rotor speeds, rpm. (n_worlds, n_drones, n_rotors)"""
        self._stage_command(Control.rotor_vel, controls, check_finite)

    def _stage_command(self, control: Control, command: ArrayLike, check_finite: bool) -> None:
        self._stepper.stage_command(F.check_command(self._stepper.data_or_shapes, control, command, check_finite))

    # Pipelines --------------------------------------------------------------------------------------------------------

    @property
    def step_pipeline(self) -> Pipeline:
        """Stages of a step by name, in their order. An edit takes effect at the next step, which compiles again."""
        self._adopt_scene()
        return self._built_step.stages

    @step_pipeline.setter
    def step_pipeline(self, pipeline: Pipeline) -> None:
        self._built_step.stages = pipeline

    @property
    def reset_pipeline(self) -> Pipeline:
        """Functions of a reset by name, in order. An edit takes effect at the next reset, which compiles again."""
        return self._built_reset.stages

    @reset_pipeline.setter
    def reset_pipeline(self, pipeline: Pipeline) -> None:
        self._built_reset.stages = pipeline

    @property
    @locked
    def step_fn(self) -> Step:
        """The step of the pipeline as it is now, ``step(data, n_steps=1) -> data``, pure."""
        self._adopt_scene()
        self.plugins.check()
        return self._built_step.fn()

    @property
    @locked
    def reset_fn(self) -> Reset:
        """The reset of the pipeline as it is now, ``reset(data, default_data, mask=None) -> data``, pure."""
        self._adopt_scene()
        self.plugins.check()
        return self._built_reset.fn()

    @locked
    def build_step_fn(self) -> Step:
        """Build a new step of the pipeline as it is now, and use it; ``step(data, n_steps=1) -> data``, pure.

        If plugins read the scene, the step is for the present scene, and refuses data after an edit of the scene.
        """
        self._adopt_scene()
        return self._built_step.build()

    @locked
    def build_reset_fn(self) -> Reset:
        """Build a new reset of the pipeline as it is now, and use it; ``reset(data, default_data, mask=None)``."""
        self._adopt_scene()
        return self._built_reset.build()

    # Stepping ---------------------------------------------------------------------------------------------------------

    @locked
    def step(self, n_steps: int = 1) -> None:
        """Advance every world by a number of physics steps; any number uses the same compilation."""
        n_steps = positive_integer("n_steps", n_steps)
        self._adopt_scene()
        self.plugins.check()
        self._built_step.fn()
        self._stepper.advance(n_steps)

    @locked
    @check_arguments
    def rollout(
        self,
        policy: Policy,
        params: Any = None,
        n_control_steps: int = 1,
        *,
        keep: KeepFunction = get_states,
        every: int = 1,
        progress: bool = False,
    ) -> Any:
        """Fly many control steps in one compiled call, and return a record of them.

        A control step evaluates the policy, stages its command, and steps until the next command takes effect. Between
        two ticks of the controller, the simulation first steps to the next tick, unless worlds are at different ones.

        Args:
            policy: ``policy(params, data) -> command``, for all worlds at once; compiled once for each function
                object.
            params: The policy's parameters, any tree of arrays.
            n_control_steps: Number of control steps; a multiple of ``every``.
            keep: ``keep(data)`` returns what to record after a control step, any tree of arrays.
            every: Control steps from one record to the next.
            progress: Whether to show a bar, which needs tqdm, where stderr is a terminal.

        Returns:
            The results of ``keep``, with time in front. (n_control_steps // every, ...)
        """
        n_substeps = self.freq // self.control_freq
        n_control_steps = positive_integer("n_control_steps", n_control_steps)
        self._stepper.count_steps(n_substeps)  # to the next tick
        self._stepper.count_steps(n_substeps, n_control_steps)
        data, records = run_rollout(
            self.step_fn, self.data, policy, params, n_control_steps, check_flag("progress", progress), every,
            n_substeps=n_substeps, keep=keep, wait=True,
        )  # fmt: skip
        self._stepper.accept(data)
        return records

    def explain(self, measure: bool = False) -> str:
        """Explain in a few lines which engine runs the step, which stages it fuses, and why it does not fuse others.

        If rays were cast, for images or for many movable objects, a last line says how.

        Args:
            measure: Whether to measure the cost of stages that are not fused, which compiles a second step.
        """
        step, rays = explain(self.step_fn, self.data, check_flag("measure", measure)), self._scene.ray_kernels.last_used
        return f"{step}\nrays: {rays}" if rays else step

    @locked
    def reset(self, mask: ArrayLike | None = None) -> None:
        """Reset all worlds, or the worlds of a mask, to ``default_data`` by the reset pipeline.

        Args:
            mask: True in worlds to reset, of type bool; None for all. (n_worlds,)
        """
        self._stepper.accept(self.reset_fn(self.data, self.default_data, mask))

    # Scene ------------------------------------------------------------------------------------------------------------

    @property
    def scene(self) -> Scene:
        """The MuJoCo scene; ``scene.add`` adds objects."""
        return self._scene

    @property
    def spec(self) -> mujoco.MjSpec:
        """Editable scene; ``build_mjx`` makes edits take effect."""
        return self._scene.spec

    @property
    def mj_model(self) -> mujoco.MjModel:
        """Compiled scene."""
        return self._scene.mj_model

    @property
    def mj_data(self) -> mujoco.MjData:
        """State of the world that was drawn last, or passed to ``sync``."""
        return self._scene.mj_data

    @property
    def mjx_model(self) -> mjx.Model:
        """Compiled scene on the device; created on first read."""
        return self._scene.mjx_model

    @property
    def mjx_data(self) -> mjx.Data:
        """The scene's state in every world at its last sync; created on first read, and returned without a sync.

        Assigning to it makes the scene stale. It raises a ValueError if ``mocap_pos`` and ``mocap_quat``, which also
        hold the poses of bodies other than drones, are not one per world and body, or are NumPy arrays with NaN or
        infinity.
        """
        return self._scene.mjx_data

    @mjx_data.setter
    def mjx_data(self, mjx_data: mjx.Data) -> None:
        self._scene.assign_mjx(mjx_data)
        self.data = self.data

    @property
    def max_geom_pairs(self) -> int:
        """Largest number of pairs that MJX checks per kind of collision, from the next ``build_mjx`` on; -1 for all."""
        return self._scene.max_geom_pairs

    @max_geom_pairs.setter
    def max_geom_pairs(self, n_pairs: int) -> None:
        is_all = isinstance(n_pairs, (int, np.integer)) and n_pairs == -1
        self._scene.max_geom_pairs = -1 if is_all else positive_integer("max_geom_pairs", n_pairs)

    @property
    def overlays(self) -> Overlays:
        """Lines, points, labels and text of the next image."""
        return self._scene.renderer.overlays

    @property
    def max_visual_geom(self) -> int:
        """Largest number of overlays in one image."""
        return self._scene.renderer.max_visual_geom

    @max_visual_geom.setter
    def max_visual_geom(self, limit: int) -> None:
        self._scene.renderer.max_visual_geom = limit

    @property
    def viewer(self) -> ModelRenderer | None:
        """Renderer of one world; None before the first image."""
        return self._scene.renderer.viewer

    def build_mjx(self) -> None:
        """Compile ``spec`` again after an edit; closes the viewer, and leaves the simulation's data as it is."""
        self._scene.compile()

    @locked
    def sync(self, world: int | None = None) -> None:
        """Bring the scene up to date: all worlds if anything has changed since the last sync, or one.

        Args:
            world: World that is written into ``mj_data``, without a sync of other worlds; None for a sync of all worlds
                in ``mjx_data``.
        """
        data = self._data_with_moved_objects()
        if world is not None:
            self._scene.sync_one(data, world)
        else:
            self._scene.sync(data)
            self._stepper.set_synced(True)

    def _data_with_moved_objects(self) -> SimData:
        return self.plugins.with_moved_objects(self.data)

    @locked
    def contacts(self, body: str | None = None) -> Array:
        """Find which contact slots touch, after a sync if anything has changed.

        A slot is a pair of geoms that may touch; ``mj_model`` and MJX decide which pair it is. With 64 or more
        drones per world MJX keeps only the nearest ``max_geom_pairs``; set it to -1 and call ``build_mjx`` for all.

        Args:
            body: Name of a body, such as ``"drone:0"``, to return False for slots of other bodies; None for all slots.

        Returns:
            (n_worlds, n_slots), bool
        """
        if body is not None:
            body_id(self.mj_model, body)  # a wrong name raises before anything changes
        slots = self._scene.contacts(self._data_with_moved_objects(), body)
        self._stepper.set_synced(True)
        return slots

    def contact_report(self, objects: ObjectSelection = None, floor: bool = True, drones: bool = True) -> ContactReport:
        """Report the contacts and distances of every drone: to the floor, to objects, to other drones.

        JAX computes the report from the poses in the data, and from the poses in ``mjx_data`` of other bodies that can
        move. Fields that were not requested are None and are not computed.

        Args:
            objects: Handles from ``scene.add``, or names of bodies; None for all, () for none.
            drones: Whether to report the other drones of a world.
        """
        return self._queries.contact_report(self._data_with_moved_objects(), objects, floor, drones)

    @check_arguments
    def depth(
        self,
        camera: str | int = "fpv_cam",
        width: int = 64,
        height: int = 64,
        drones: bool = True,
        hide_own: bool = True,
        along: Along = "axis",
    ) -> Array:
        """Take depth images of all worlds, m; see ``scene.depth_fn``. (n_worlds, n_cameras, height, width)

        Infinite where nothing is hit.
        """
        return self._queries.depth(self._data_with_moved_objects(), camera, width, height, drones, hide_own, along)

    def render(
        self,
        mode: str = "human",
        world: int = 0,
        camera: int | str = -1,
        cam_config: Mapping[str, ArrayLike] | None = None,
        width: int = 1920,
        height: int = 1080,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Render one world; all arguments take effect at every call.

        Only the world that is rendered is brought up to date, by MuJoCo; ``mjx_data`` stays as it is.

        Args:
            mode: ``"human"`` draws into a window until the user closes it; ``"rgb_array"`` returns an image
                (height, width, 3) of type uint8, ``"depth_array"`` the distance along the camera's axis, m
                (height, width), ``"rgbd_tuple"`` both.
            camera: Name or id; -1 is the free camera. Drones carry ``fpv_cam:i`` and ``track_cam:i``.
            cam_config: Settings of the free camera: lookat, distance, azimuth, elevation.
            width: Pixels. A window is resized when it changes; the user may resize it too.
            height: Pixels.

        Raises:
            RenderError: If this machine cannot draw.
        """
        self._scene.sync_one(self._data_with_moved_objects(), world)
        saved_overlays = self.overlays.copy()
        try:
            self.plugins.draw(world)
            return self._scene.render(mode, camera, cam_config, width, height)
        except Exception:
            self.overlays.restore(saved_overlays)  # plugins draw again for the next image
            raise

    def close(self) -> None:
        """Close the window and free the renderers."""
        self._scene.close()


def use_box_collision(sim: Sim, enable: bool = True) -> None:
    """Let drones touch with boxes instead of spheres, or with spheres again; compiles the scene again.

    Boxes follow the drone's outline more closely and cost more to check.
    """
    use_boxes(sim.spec, sim.n_drones, check_flag("enable", enable))
    sim.build_mjx()
