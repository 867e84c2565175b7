"""The simulation as an object: it holds data, pipelines and scene, and calls pure functions in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh

from crazysim.control import Control, Controller
from crazysim.control.controllers import CASCADE
from crazysim.core import functional as F
from crazysim.core.airframes import AirframeSource, airframe_of, drone_names
from crazysim.core.data import SimData, as_key
from crazysim.core.integration import Integrator
from crazysim.core.random import seed_sim
from crazysim.core.registry import PluginRegistry
from crazysim.core.settings import as_mask, positive
from crazysim.core.sharding import shard
from crazysim.core.stages import build_step_pipeline, clip_floor_pos, increment_steps, reset
from crazysim.drones import Airframe, Drone
from crazysim.dynamics import Dynamics
from crazysim.dynamics.parameters import rotor_vel_limits
from crazysim.engine import Stepper, explain
from crazysim.engine.rollout import Keep, Policy, states_of
from crazysim.engine.rollout import run as run_rollout
from crazysim.pytree import on_device
from crazysim.scene.queries import SceneQueries
from crazysim.scene.scene import Scene
from crazysim.scene.sync import sync_sim2mjx
from crazysim.sim.adopt import adopt
from crazysim.sim.commands import Commands
from crazysim.sim.configuration import Configuration
from crazysim.sim.members import Member, find_member
from crazysim.sim.pipelines import Pipelines
from crazysim.sim.plugins import PluginMethods
from crazysim.sim.scene_shell import SceneShell, use_box_collision

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


class Sim(Commands, Pipelines, PluginMethods, SceneShell):
    """Worlds of drones that advance together.

    ``data`` holds everything that changes, ``step_pipeline`` and ``reset_pipeline`` the stages that change it, ``spec``
    the scene. Physics does not depend on the scene, which is updated lazily, when contacts or images are requested.
    """

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
        controller: str | Controller | Sequence[str | Controller] = CASCADE,
        switch: Any = None,
    ):
        """Build the scene's spec, the data and both pipelines; MuJoCo allocates nothing per world.

        Args:
            n_worlds: Number of worlds.
            n_drones: Number of drones in each.
            drone: Name of a built-in airframe, path of a TOML file, dict, or airframe; or a list of these, one for each
                drone, whose length is then ``n_drones``.
            dynamics: Dynamics model.
            control: Command level.
            integrator: Integration scheme.
            freq: Physics steps per second, Hz.
            state_freq: Rate of the state controller, Hz; 100, or the largest divisor of ``freq`` below.
            attitude_freq: Rate of the attitude controller, Hz; 500, or the largest divisor of ``freq`` below.
            body_rate_freq: Rate of the body-rate controller, Hz; as ``attitude_freq``.
            force_torque_freq: Rate of the allocation, Hz; as ``attitude_freq``.
            device: Device of the data: a platform such as ``"cpu"`` or ``"gpu"``, or a device.
            xml_path: MJCF scene; None for floor, light and sky.
            rng_key: Seed, or a key.
            mesh: Devices to spread the worlds over, from ``crazysim.core.sharding.world_mesh``.
            engine: Engine that executes steps, one of ``crazysim.engine.ENGINES``; ``"auto"`` takes the fastest that
                can run the step pipeline here. ``explain`` says which that is.
            strict: True to raise an error where a slower engine would be taken with an ``EngineWarning``.
            controller: Controller that follows the commands: a name of ``crazysim.control.controllers.CONTROLLERS``, a
                ``crazysim.control.Controller``, or ``"crazyflow"`` for the cascade of Crazyflow; or a list of several.
                The rates above replace its own.
            switch: Chooses among several controllers: a function ``(state, setpoint, time) -> index`` of one drone, or
                indices, () or (n_worlds, n_drones).

        Raises:
            ValueError: If an argument is invalid, with what was expected.
        """
        rates = {
            Control.state: state_freq,
            Control.attitude: attitude_freq,
            Control.body_rate: body_rate_freq,
            Control.force_torque: force_torque_freq,
        }
        self.configuration = c = Configuration.create(
            n_worlds,
            n_drones,
            drone,
            dynamics,
            control,
            integrator,
            freq,
            rates,
            device,
            mesh,
            engine,
            strict,
            controller,
            switch,
        )
        self.n_worlds, self.n_drones, self.freq = c.n_worlds, c.n_drones, c.freq
        self.dynamics, self.control, self.integrator = c.dynamics, c.control, c.integrator
        self.airframes = c.airframes
        self.drone_names = drone_names(c.airframes)
        self.device, self.mesh, self.engine = c.device, mesh, engine

        self._scene = Scene(xml_path, self.airframes, self.n_worlds, self.n_drones, self.freq, self.device, mesh)
        self._revision = self._scene.revision
        self._stepper = Stepper(self.device, mesh, engine, strict)
        self._queries = self._new_queries()
        self._seed = as_key(rng_key)
        self.plugins = PluginRegistry(self)  # type: ignore[arg-type]  # properties serve as attributes
        self._scene.plugins = self.plugins.values
        self.build_data()
        self.build_default_data()

        self.step_pipeline = build_step_pipeline(self.control, self.dynamics, self.integrator, c.controller)
        self.reset_pipeline = {"reset": reset}
        self.build_step_fn()
        self.build_reset_fn()

    @classmethod
    def from_mjcf(
        cls, xml_path: str | Path, n_worlds: int = 1, *, kinds: Mapping[str, Any] | None = None, **settings: Any
    ) -> Sim:
        """Return a simulation with the vehicles of an MJCF, at their poses; everything else there is the scene.

        Vehicles are the children of the world with a joint, or mocap bodies, whose names are a prefix and a number:
        ``Crazyflie_0``, ``Bumblebee_2``. They keep their names. Their bodies are replaced by those of the airframes.

        Args:
            xml_path: MJCF file.
            n_worlds: Number of worlds.
            kinds: Airframes, or subclasses of ``Population``, by further prefixes; ``crazysim.sim.adopt.known_kinds``
                returns those that are known.
            **settings: Further arguments of ``Sim``.

        Raises:
            UnknownNameError: If a prefix is unknown, with those that are known.
            ConfigError: If the file cannot be read, two bodies have the same name, or there is no drone.
        """
        return adopt(cls, xml_path, n_worlds, kinds, settings)

    @property
    def airframe(self) -> Airframe:
        """Airframe of all drones.

        Raises:
            ConfigError: If the drones have several.
        """
        return airframe_of(self.airframes)

    @property
    def drone(self) -> str:
        """Name of the airframe of all drones.

        Raises:
            ConfigError: If the drones have several airframes.
        """
        return self.airframe.name

    # Names --------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones, then of the members of all populations."""
        return (*self.drone_names, *self.plugins.members)

    def __getitem__(self, name: str) -> Member:
        """Return a view of a drone or member by its name, to read and to command: ``sim["Crazyflie_0"].pos``.

        Raises:
            UnknownNameError: If there is none of that name.
        """
        return find_member(self, name)

    # Data ---------------------------------------------------------------------------------------------------

    def _new_queries(self) -> SceneQueries:
        kernels = self.mesh is None and self.engine in ("auto", "fused")
        return SceneQueries(self._scene, self.device.platform if kernels else None, self.configuration.strict)

    @property
    def data(self) -> SimData:
        """Everything that changes. Assigning to it makes the scene stale, and clears ``core.mjx_synced``."""
        self._adopt_scene()
        return self._stepper.data

    @data.setter
    def data(self, data: SimData) -> None:
        self._stepper.assign(data)
        self._scene.invalidate()

    @property
    def default_data(self) -> SimData:
        """The data that resets return to."""
        self._adopt_scene()
        return self._default_data

    @default_data.setter
    def default_data(self, data: SimData) -> None:
        self._default_data = data

    def _adopt_scene(self) -> None:
        """Give the data the objects and mocap ids of an edited scene; the scene itself is not compiled."""
        if self._revision == self._scene.revision:
            return
        self._revision = self._scene.revision
        self.data = self._with_scene(self._stepper.data)
        self._default_data = self._stepper.place(self._with_scene(self._default_data))

    def _with_scene(self, data: SimData) -> SimData:
        ids = on_device(self._scene.drone_mocap_ids, np.int32)
        return data.replace(core=data.core.replace(drone_mocap_ids=ids), objects=self._scene.objects(data.objects))

    @property
    def time(self) -> Array:
        """Time since each world's last reset, s. (n_worlds, 1)"""
        return F.time(self.data)

    def build_data(self) -> SimData:
        """Return new data at rest, as at construction, with a new record of every plugin; make it the simulation's."""
        data = SimData.create(
            self.n_worlds,
            self.n_drones,
            self.dynamics,
            self.control,
            self.airframes,
            self.freq,
            dict(self.configuration.control_freqs),
            self._scene.drone_mocap_ids,
            self._seed,
            self.configuration.controller,
        )
        self.data = data.replace(objects=self._scene.objects(None))
        self.plugins.build_records()
        return self.data

    def build_default_data(self) -> SimData:
        """Make the data as it is now the data that resets return to, and return it."""
        self.default_data = self.data
        return self.default_data

    def shard(self, mesh: Mesh) -> SimData:
        """Spread data, default data and scene over devices, and return the data."""
        default = self.default_data
        self.mesh = self._stepper.mesh = mesh
        self.data = self.data
        self.default_data = shard(default, mesh)
        self._scene.shard(mesh)
        self._queries = self._new_queries()
        self.build_step_fn()
        return self.data

    def seed(self, seed: int) -> None:
        """Set the seed of all random numbers drawn from now on.

        Raises:
            ValueError: If it is not an integer.
        """
        self._seed = as_key(seed)
        self.data = seed_sim(self.data, self._seed)

    # Stepping -----------------------------------------------------------------------------------------------

    def step(self, n_steps: int = 1) -> None:
        """Advance every world by a number of physics steps; any number uses the same compilation."""
        n_steps = positive("n_steps", n_steps)
        self._adopt_scene()
        self._take_edits()
        self._stepper.advance(n_steps)
        self._scene.invalidate()

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
        """Fly many control steps in one compiled call, and return a record of them.

        A control step evaluates the policy, stages its command, and steps until the next command takes effect.

        Args:
            policy: ``policy(params, data) -> command``, for all worlds at once; compiled once for each function
                object.
            params: The policy's parameters, any tree of arrays.
            n_control_steps: Number of control steps; a multiple of ``every``.
            keep: ``keep(data)`` returns what to record after a control step, any tree of arrays.
            every: Control steps from one record to the next.
            progress: True to show a bar, which needs tqdm.

        Returns:
            The results of ``keep``, with time in front. (n_control_steps // every, ...)

        Raises:
            ValueError: If a number is invalid, or the policy returns a command of another shape.
        """
        data, kept = run_rollout(
            self.step_fn, self.data, policy, params, n_control_steps, progress, every,
            n_substeps=self.freq // self.control_freq, keep=keep,
        )  # fmt: skip
        self._advance(data)
        return kept

    def explain(self, measure: bool = False) -> str:
        """Return in a few lines which engine runs the step, which stages it fuses, and which it does not and why.

        Args:
            measure: True to measure the cost of stages that are not fused, which compiles a second step.
        """
        return explain(self.step_fn, self.data, measure)

    def reset(self, mask: Any = None) -> None:
        """Return all worlds, or those of a mask, to ``default_data``, and run the reset pipeline.

        Args:
            mask: True in worlds to reset, of type bool; None for all. (n_worlds,)

        Raises:
            ValueError: If the mask has another shape or type.
        """
        self._advance(self.reset_fn(self.data, self.default_data, as_mask(mask, self.n_worlds)))

    def _advance(self, data: SimData) -> None:
        """Take data that a compiled call returned."""
        self._stepper.accept(data)
        self._scene.invalidate()
