"""A simulation whose drones accept the commands of real Crazyflies; each drone has a commander."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.control import Control
from crazysim.core.data import SimData
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.dynamics import Dynamics
from crazysim.engine.stage import vmap_drones, vmap_worlds
from crazysim.errors import UnknownNameError, require
from crazysim.lab.live.attitude import from_yaw, rotate, to_rpy
from crazysim.lab.live.loop import Live
from crazysim.lab.live.mocap.source_events import Reports
from crazysim.lab.live.staging import compile_step
from crazysim.lab.live.swarm.commander import Commander
from crazysim.lab.live.swarm.parameters import LIGHT_GROUPS, Parameters, create_parameters
from crazysim.lab.live.swarm.sensors import read_ranges
from crazysim.lab.live.swarm.state import DroneState
from crazysim.plugins.effects import MotorFailure
from crazysim.plugins.estimators import Estimator
from crazysim.sim.sim import Sim
from crazysim.storage import Closeable


class Swarm(Closeable):
    """A simulation of one world, driven by commanders.

        swarm = Swarm(Sim(n_drones=2, control="state"))
        swarm["cf1"].take_off(1.0, 2.0)
        swarm.advance(3.0)

    States are estimates of the filter of ``Sim(estimator=...)`` and its ``IMU``; without a filter they are the true
    states. Commands may come from any thread; hold ``lock`` while another thread advances.

    The simulation advances in one of four ways: by calls of ``advance``; in real time, after ``start``; in a loop that
    calls the swarm, after ``Live.add(swarm)``; or in a live loop that ``advance`` runs, after ``run_in(live)``.
    """

    reports: Reports
    """Refused commands and packets."""
    parameters: list[Parameters]
    """Parameters of each drone; ``set_parameter`` sets them."""
    colors: NDArray
    """Colour of the light of each drone, red, green, blue from 0 to 1. (n_drones, 3)"""

    def __init__(self, sim: Sim, names: Sequence[str] | None = None):
        require(
            sim.n_worlds == 1, f"expected a simulation of one world, got {sim.n_worlds} worlds. Use Sim(n_worlds=1)."
        )
        names = [f"cf{k + 1}" for k in range(sim.n_drones)] if names is None else list(names)
        require(
            len(names) == sim.n_drones and len(set(names)) == len(names),
            f"expected {sim.n_drones} different names, got {names}",
        )
        self.sim, self.names, self.lock = sim, tuple(names), threading.RLock()
        self.commanders = [Commander(sim.control, functools.partial(self._report_refusal, name)) for name in names]
        has_ranger = "front" in read_ranges(sim, 0)
        self.parameters = [Parameters(create_parameters(airframe, has_ranger)) for airframe in sim.airframes]
        self.colors, self.reports = np.zeros((len(names), 3)), Reports()
        self.listeners: list[Callable[[], object]] = []
        self._n_substeps = sim.freq // sim.control_freq
        self._command_size = {Control.state: 16, Control.rotor_vel: sim.data.controls.rotor_vel.shape[-1]}.get(
            sim.control, 4
        )
        self._motor_switch = self._add_motor_switch()
        estimators = [plugin for plugin in sim.plugins.values() if isinstance(plugin, Estimator)]
        self._estimator = next((estimator for estimator in estimators if estimator.control), None)
        self._estimate_fn = jax.jit(vmap_worlds(vmap_drones(self._estimate_drone)))
        self._motors_on = np.ones(len(names), bool)
        self._states: list[DroneState] = []
        self._yaws: list[float] = []
        self._home_pos = np.asarray(sim.data.states.pos[0], float)
        self._thread: threading.Thread | None = None
        self._stop_event = threading.Event()
        self._live: Live | None = None
        self._read_states()
        self._stage_commands()

    def __getitem__(self, name: str) -> Commander:
        return self.commanders[self.index(name)]

    def index(self, name: str) -> int:
        """Return the index of a drone."""
        if name not in self.names:
            raise UnknownNameError(f"expected one of the drones {list(self.names)}, got {name!r}")
        return self.names.index(name)

    @property
    def time(self) -> float:
        """Time of the states, s."""
        return self._states[0].time

    def state(self, drone: int | str) -> DroneState:
        """Return the state of a drone after the last control step."""
        return self._states[self.index(drone) if isinstance(drone, str) else drone]

    def home(self, drone: int | str) -> NDArray:
        """Return the position of a drone when the swarm was made, m. (3,)"""
        return self._home_pos[self.index(drone) if isinstance(drone, str) else drone].copy()

    # Parameters -----------------------------------------------------------------------------------------------------

    def set_parameter(self, drone: int | str, name: str, value: float) -> None:
        """Set a parameter of a drone's firmware, with its effect on commands, estimate and light."""
        k = self.index(drone) if isinstance(drone, str) else drone
        parameters = self.parameters[k]
        with self.lock:
            parameters.set(name, float(value), self.time)
            if name == "hlCommander.groupmask":
                self.commanders[k].group = int(value)
            elif name == "kalman.resetEstimation" and value and parameters.has_initial_pose:
                self.commanders[k].set_estimate(self._states[k].pos, self._yaws[k], parameters.initial_pose)
            elif name.startswith(LIGHT_GROUPS):
                self.colors[k] = parameters.light.color(self.time)

    def set_leds(self, drone: int, packed: NDArray) -> None:
        """Set the LEDs of a drone's ring, 16 bits of red, green and blue (5, 6, 5) each; ``ring.effect`` 13 shows them.

        Args:
            drone: Index of the drone.
            packed: Colours. (12,)
        """
        bits = np.asarray(packed, int)[:, None]
        parameters = self.parameters[drone]
        parameters.light.memory = (bits >> [11, 5, 0] & [31, 63, 31]) / [31, 63, 31]
        parameters.light.update_color(parameters, "memory", self.time)
        self.colors[drone] = parameters.light.color(self.time)

    # Time -----------------------------------------------------------------------------------------------------------

    def __call__(self, live: Live) -> None:
        self._check_loop(live)
        self.update()
        live.lights[0] = self.colors

    def compile(self, live: Live) -> None:
        """Compile the reading of the states; the loop compiles its step."""
        with self.lock:
            self._read_states()

    def run_in(self, live: Live) -> None:
        """Make ``advance`` and ``sleep`` run a live loop, at its speed and with its viewers."""
        self._check_loop(live)
        require(self._thread is None, "expected a swarm that no thread advances, got a running one. Call close first.")
        live.add(self, name="swarm")
        self._live = live

    def _check_loop(self, live: Live) -> None:
        require(
            live.sim is self.sim,
            "expected the loop of the swarm's simulation, got the loop of another simulation. Make a Swarm for it.",
        )

    def update(self) -> None:
        """Read the states and stage the active commands, between two control steps."""
        with self.lock:
            self._read_states()
            self._stage_commands()
            for k, parameters in enumerate(self.parameters):
                if parameters.light.is_fading(self.time - self._n_substeps / self.sim.freq):
                    self.colors[k] = parameters.light.color(self.time)
            for listener in self.listeners:
                listener()

    def advance(self, seconds: float) -> None:
        """Advance by a time, s, rounded to control steps, at the speed of its live loop after ``run_in``."""
        require(self._thread is None, "expected a swarm that no thread advances, got a running one. Use sleep.")
        if self._live is not None:
            if seconds > 0:
                self._live.run(seconds)
        else:
            for _ in range(max(round(seconds * self.sim.freq / self._n_substeps), 0)):
                self.update()
                self.sim.step(self._n_substeps)
        with self.lock:
            self._read_states()

    def sleep(self, seconds: float) -> None:
        """Wait for simulated time to pass, s: advance, or wait for the thread that advances."""
        if self._thread is None:
            self.advance(seconds)
            return
        end = self.time + seconds
        while self.time < end - 1e-9 and self._thread.is_alive():
            time.sleep(0.001)

    def compile_step(self) -> None:
        """Compile a control step before programs wait for answers, as compilation takes longer than their timeouts."""
        with self.lock:
            compile_step(self.sim, self._n_substeps)
            self._read_states()

    def start(self, speed: float = 1.0) -> Swarm:
        """Compile a step, then advance in a thread, in real time or at another speed, and return the swarm."""
        require(self._live is None, "expected a swarm without a live loop, got one after run_in. Use advance or sleep.")
        self.compile_step()
        self._stop_event.clear()
        self._thread = threading.Thread(target=self._run, args=(speed,), name="swarm", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        self._stop_event.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self, speed: float) -> None:
        dt = self._n_substeps / self.sim.freq / speed
        due_time = time.perf_counter()
        while not self._stop_event.is_set():
            with self.lock:
                self.update()
                self.sim.step(self._n_substeps)
            due_time = max(due_time + dt, time.perf_counter() - 0.1)
            self._stop_event.wait(max(due_time - time.perf_counter(), 0.0))

    def _report_refusal(self, name: str, text: str) -> None:
        self.reports.add("refused", name, self.time, text)

    # State and commands ---------------------------------------------------------------------------------------------

    def _add_motor_switch(self) -> MotorFailure | None:
        if self.sim.dynamics != Dynamics.first_principles:
            return None
        return self.sim.add(MotorFailure(name="motor_switch"))

    def _read_states(self) -> None:
        data, states = self.sim.data, self.sim.data.states
        values = [states.pos, states.quat, states.vel, states.ang_vel]
        if self._estimator is not None:
            values = self._estimate_fn(data)
        pos, quat, vel, ang_vel, *measured = (np.asarray(x)[0].astype(float) for x in values)
        now = float(np.asarray(data.core.steps)[0, 0]) / self.sim.freq
        last_states = self._states
        if last_states and now < last_states[0].time:
            for commander in self.commanders:
                commander.reset()
            last_states, self._motors_on = [], np.ones(len(self.names), bool)
        dt = now - last_states[0].time if last_states else 0.0
        last_vel = np.stack([state.vel for state in last_states]) if last_states else vel
        world_acc = (vel - last_vel) / dt if dt > 0 else np.zeros_like(vel)
        acc = rotate(quat * (-1, -1, -1, 1), world_acc + [0.0, 0.0, GRAVITY_MAGNITUDE])
        if last_states and dt == 0:
            acc = np.stack([state.acc for state in last_states])
        acc = measured[0] if measured else acc
        self._yaws = to_rpy(quat)[:, 2].tolist()
        self._states = [DroneState(now, *x) for x in zip(pos, quat, vel, ang_vel, acc, strict=True)]

    def _estimate_drone(self, data: SimData) -> list[Array]:
        estimator, s = self._estimator, data.states
        states = {"pos": s.pos, "quat": s.quat, "vel": s.vel, "ang_vel": s.ang_vel} | estimator.measured_states(data)
        return [states[name] for name in ("pos", "quat", "vel", "ang_vel")] + [estimator.inertial(data)[1]]

    def _stage_commands(self) -> None:
        sim = self.sim
        command = np.zeros((1, len(self.names), self._command_size))
        motors_on = np.ones(len(self.names), bool)
        drones = zip(self.commanders, self._states, self._yaws, strict=True)
        for k, (commander, state, yaw) in enumerate(drones):
            new_command = commander.tick(state.time, state.pos, state.vel, yaw)
            motors_on[k] = new_command is not None
            if new_command is not None:
                command[0, k] = new_command
            elif sim.control == Control.state:
                command[0, k, :3], command[0, k, 9:13] = state.pos, from_yaw(yaw)
        getattr(sim, f"{sim.control.value}_control")(command)
        if self._motor_switch is not None and (motors_on != self._motors_on).any():
            self._motors_on = motors_on
            record = self._motor_switch.read(sim.data)
            shape = record.effectiveness.shape
            effectiveness = jnp.asarray(np.broadcast_to(motors_on[None, :, None], shape), record.effectiveness.dtype)
            sim.data = self._motor_switch.write(sim.data, record.replace(effectiveness=effectiveness))
