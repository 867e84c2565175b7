"""Other simulators that fly attitude commands: C MuJoCo, Crazyflow, RotorPy and gym-pybullet-drones.

Each simulator flies one drone per start, with the mass, the inertia and the largest thrust of crazysim's airframe.
Drag, lag, gravity and the controller that follows the commands are the simulator's own, with two exceptions: C MuJoCo
has the controller and the lag of crazysim, and ``RotorPyRotors`` has the controller of crazysim.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import warnings
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.core.data import SimData, controls_of
from crazysim.core.functional import attitude_control
from crazysim.drones import Airframe, load_airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.dynamics.rotor import quadratic_curve, rotor_vel_of_thrust
from crazysim.envs.actions import hover_rotor_states
from crazysim.lab.validate.closed_forms import with_states
from crazysim.sim.sim import Sim

AIRFRAME = "cf21B_500"
"""Airframe of all simulators."""
COMMAND_PERIOD = 0.02
"""Time between two commands, s."""
CONTROL_PERIOD = 0.004
"""Period of the controllers of RotorPy and gym-pybullet-drones, s."""

States = dict[str, NDArray]
"""``pos``, ``quat``, ``vel`` and ``ang_vel`` of all drones, in crazysim's frames, units and components. (n, k) each"""


class Simulator(Protocol):
    """Drones in flight, one for each start."""

    module: ClassVar[str] = ""
    """Module that must be importable; empty for none."""

    def __init__(self, start: States) -> None: ...

    def fly_period(self, commands: NDArray) -> States:
        """Return the states after one period under attitude commands: roll, pitch, yaw, rad, and thrust, N. (n, 4)"""
        ...


class Crazysim(Simulator):
    """crazysim itself, with its default controller."""

    def __init__(self, start: States) -> None:
        self._sim: Any = Sim(len(start["pos"]), drone=AIRFRAME, control="attitude")
        self._sim.data = with_states(self._sim.data, **_world_rows(start), rotor_vel=_hover_speed(self._sim))

    def fly_period(self, commands: NDArray) -> States:
        self._sim.attitude_control(np.asarray(commands[:, None], np.float32))
        self._sim.step(round(COMMAND_PERIOD * self._sim.freq))
        return _read_states(self._sim.data)


class Crazyflow(Crazysim):
    """Crazyflow, with its controller."""

    module = "crazyflow"

    def __init__(self, start: States) -> None:
        package: Any = importlib.import_module("crazyflow.sim")
        self._sim = package.Sim(n_worlds=len(start["pos"]), drone=AIRFRAME, control="attitude", freq=500)
        own_sim = Sim(drone=AIRFRAME, control="attitude")
        self._sim.data = with_states(self._sim.data, **_world_rows(start), rotor_vel=_hover_speed(own_sim))


class AttitudeController:
    """Crazysim's default controller for another simulator: it turns attitude commands into thrusts of the rotors."""

    def __init__(self, n: int) -> None:
        self._sim = Sim(n, drone=AIRFRAME, control="attitude")
        self._data, self.dt = self._sim.data, 1 / self._sim.freq
        params = self._data.params
        self._curve, speed = params.rpm2thrust, float(_hover_speed(self._sim)[0])
        rise, rise_per_speed, fall, fall_per_speed = np.asarray(params.rotor_dyn_coef, np.float64)[0]
        self.hover_thrust = float(np.asarray(quadratic_curve(jnp.asarray([speed]), self._curve))[0])
        """Thrust of a rotor in hover, N."""
        self.lag = 1 / ((rise + fall) / 2 + (rise_per_speed + fall_per_speed) * speed)
        """Time constant of small changes of the rotor speeds about hover, the mean of both directions, s."""
        pipeline = self._sim.step_pipeline
        n_stages = list(pipeline).index("clip_rotor_vel_cmd") + 1
        stages = [*list(pipeline.values())[:n_stages], pipeline["increment_steps"]]

        @jax.jit
        def control(data: SimData, states: dict[str, Array], thrusts: Array) -> tuple[SimData, Array]:
            rotor_vel = rotor_vel_of_thrust(thrusts, self._curve)
            data = data.replace(states=data.states.replace(**states, rotor_vel=rotor_vel))
            for stage in stages:
                data = stage(data)
            return data, quadratic_curve(controls_of(data).rotor_vel, self._curve)

        self._control = control

    def stage_command(self, commands: NDArray) -> None:
        """Stage attitude commands. (n, 4)"""
        self._data = attitude_control(self._data, commands[:, None])

    def compute_thrusts(self, states: States, thrusts: NDArray) -> NDArray:
        """Advance the controller by a step, and return the commanded thrusts, N. (n, 4)

        Args:
            thrusts: Present thrusts of the rotors, N. (n, 4)
        """
        rows = {name: x.astype(np.float32) for name, x in _world_rows(states).items()}
        self._data, commanded_thrusts = self._control(self._data, rows, thrusts[:, None].astype(np.float32))
        return np.asarray(commanded_thrusts, np.float64)[:, 0]


class Mujoco(Simulator):
    """C MuJoCo: a free body whose rotors are actuators with first-order lag, flown by crazysim's default controller."""

    def __init__(self, start: States) -> None:
        self._controller = AttitudeController(len(start["pos"]))
        model = _mjcf(load_airframe(AIRFRAME), self._controller.lag, self._controller.dt)
        self._model = mujoco.MjModel.from_xml_string(model)
        self._bodies = [mujoco.MjData(self._model) for _ in start["pos"]]
        for k, body in enumerate(self._bodies):
            body.qpos[:3], body.qpos[3:] = start["pos"][k], np.roll(start["quat"][k], 1)
            body.qvel[:3], body.qvel[3:] = start["vel"][k], start["ang_vel"][k]
            body.act[:] = self._controller.hover_thrust

    def fly_period(self, commands: NDArray) -> States:
        self._controller.stage_command(commands)
        for _ in range(round(COMMAND_PERIOD / self._controller.dt)):
            thrusts = self._controller.compute_thrusts(self._states(), np.stack([body.act for body in self._bodies]))
            for body, thrust in zip(self._bodies, thrusts, strict=True):
                body.ctrl[:] = thrust
                self._push(body)
                mujoco.mj_step(self._model, body)
        return self._states()

    def _push(self, body: mujoco.MjData) -> None: ...

    def _states(self) -> States:
        qpos, qvel = (np.stack([getattr(body, name) for body in self._bodies]) for name in ("qpos", "qvel"))
        return {"pos": qpos[:, :3], "quat": np.roll(qpos[:, 3:], -1, axis=-1), "vel": qvel[:, :3],
                "ang_vel": qvel[:, 3:]}  # fmt: skip


class MujocoWithDrag(Mujoco):
    """``Mujoco`` with the linear drag of crazysim's airframe."""

    def __init__(self, start: States) -> None:
        super().__init__(start)
        self._drag = load_airframe(AIRFRAME).matrix("drag.coefficients")

    def _push(self, body: mujoco.MjData) -> None:
        rot = body.xmat[1].reshape(3, 3)  # of the previous step, 2 ms ago
        body.xfrc_applied[1, :3] = rot @ self._drag @ rot.T @ body.qvel[:3]


class RotorPy(Simulator):
    """RotorPy's brushless Crazyflie, with its attitude controller (``cmd_ctatt``), its drag and its lag."""

    module = "torchdiffeq"
    level: ClassVar[str] = "cmd_ctatt"
    """RotorPy's name of the command level."""

    def __init__(self, start: States) -> None:
        self._torch: Any = importlib.import_module("torch")
        module: Any = importlib.import_module("rotorpy.vehicles.multirotor")
        self._torch.set_num_threads(1)  # synchronising threads would take longer than the work on arrays of this size
        n, device = len(start["pos"]), self._torch.device("cpu")
        params = rotorpy_params(load_airframe(AIRFRAME))
        hover_speed = np.sqrt(params["mass"] * GRAVITY_MAGNITUDE / (4 * params["k_eta"]))
        state = {"x": start["pos"], "v": start["vel"], "q": start["quat"], "w": start["ang_vel"],
                 "wind": np.zeros((n, 3)), "rotor_speeds": np.full((n, 4), hover_speed)}  # fmt: skip
        self._state = {name: self._tensor(x) for name, x in state.items()}
        batch_params = module.BatchedMultirotorParams([params] * n, n, device)
        self._drones = module.BatchedMultirotor(batch_params, n, self._state, device, self.level, integrator="rk4")
        self._k_eta = params["k_eta"]
        self._indices = self._torch.arange(n)

    def fly_period(self, commands: NDArray) -> States:
        quat = np.asarray(rotation.from_rpy(jnp.asarray(commands[:, :3])))
        control = {"cmd_thrust": self._tensor(commands[:, 3:]), "cmd_q": self._tensor(quat)}
        for _ in range(round(COMMAND_PERIOD / CONTROL_PERIOD)):
            self._state = self._drones.step(self._state, control, CONTROL_PERIOD, self._indices)
        return self._states()

    def _states(self) -> States:
        names = {"pos": "x", "vel": "v", "quat": "q", "ang_vel": "w"}
        return {name: self._state[rotorpy_name].numpy() for name, rotorpy_name in names.items()}

    def _tensor(self, x: NDArray) -> Any:
        return self._torch.tensor(np.asarray(x, np.float64))


class RotorPyRotors(RotorPy):
    """RotorPy's brushless Crazyflie, with rotor thrusts that are commanded by crazysim's default controller."""

    level = "cmd_motor_thrusts"

    def __init__(self, start: States) -> None:
        super().__init__(start)
        self._controller = AttitudeController(len(start["pos"]))

    def fly_period(self, commands: NDArray) -> States:
        self._controller.stage_command(commands)
        for _ in range(round(COMMAND_PERIOD / self._controller.dt)):
            current_thrust = self._k_eta * self._state["rotor_speeds"].numpy() ** 2
            control = {
                "cmd_motor_thrusts": self._tensor(self._controller.compute_thrusts(self._states(), current_thrust))
            }
            self._state = self._drones.step(self._state, control, self._controller.dt, self._indices)
        return self._states()


class PyBullet(Simulator):
    """gym-pybullet-drones' PyBullet model, with the attitude controller of its ``DSLPIDControl``.

    The state of its body is only a pose and velocities, so one body flies all drones, one after another.
    """

    module = "gym_pybullet_drones"

    def __init__(self, start: States) -> None:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._pybullet: Any = importlib.import_module("pybullet")
            envs: Any = importlib.import_module("gym_pybullet_drones.envs.CtrlAviary")
            control: Any = importlib.import_module("gym_pybullet_drones.control.DSLPIDControl")
            enums: Any = importlib.import_module("gym_pybullet_drones.utils.enums")
            freq, model = round(1 / CONTROL_PERIOD), enums.DroneModel.CF2X
            self._env = envs.CtrlAviary(model, physics=enums.Physics.PYB, pyb_freq=freq, ctrl_freq=freq)
            self._controllers = [control.DSLPIDControl(model) for _ in start["pos"]]
        airframe, pid = load_airframe(AIRFRAME), self._controllers[0]
        max_speed = pid.PWM2RPM_SCALE * pid.MAX_PWM + pid.PWM2RPM_CONST
        self._env.KF = _thrust_max(airframe) / max_speed**2
        self._env.KM, self._env.MAX_RPM = self._env.KF * _torque_per_thrust(airframe), max_speed
        self._body, self._client = int(self._env.DRONE_IDS[0]), self._env.CLIENT
        mass, inertia = airframe.value("rigid_body.mass", ()), airframe.value("rigid_body.inertia", (3,))
        self._pybullet.changeDynamics(
            self._body,
            -1,
            mass=float(mass),
            localInertiaDiagonal=np.asarray(inertia).tolist(),
            physicsClientId=self._client,
        )
        self._current_states = {name: np.array(x, np.float64) for name, x in start.items()}
        for controller, quat in zip(self._controllers, self._current_states["quat"], strict=True):
            controller.last_rpy = np.array(self._pybullet.getEulerFromQuaternion(quat))

    def fly_period(self, commands: NDArray) -> States:
        s = self._current_states
        ang_vel = np.array(
            rotation.rotate(jnp.asarray(s["quat"]), jnp.asarray(s["ang_vel"])), np.float64
        )  # PyBullet's angular velocity is in the world frame
        angles = _intrinsic_angles(commands[:, :3])
        for k, (command, controller) in enumerate(zip(commands, self._controllers, strict=True)):
            self._pybullet.resetBasePositionAndOrientation(
                self._body, s["pos"][k], s["quat"][k], physicsClientId=self._client
            )
            self._pybullet.resetBaseVelocity(self._body, s["vel"][k], ang_vel[k], physicsClientId=self._client)
            speed = np.sqrt(max(command[3], 0) / (4 * self._env.KF))
            pwm, quat = (speed - controller.PWM2RPM_CONST) / controller.PWM2RPM_SCALE, s["quat"][k]
            for _ in range(round(COMMAND_PERIOD / CONTROL_PERIOD)):
                rpm = controller._dslPIDAttitudeControl(CONTROL_PERIOD, pwm, quat, angles[k], np.zeros(3))
                observation = self._env.step(rpm[None])[0][0]
                quat = observation[3:7]
            s["pos"][k], s["quat"][k], s["vel"][k] = observation[:3], quat, observation[10:13]
            ang_vel[k] = observation[13:16]
        s["ang_vel"] = np.array(rotation.rotate_inverse(jnp.asarray(s["quat"]), jnp.asarray(ang_vel)), np.float64)
        return {name: x.copy() for name, x in s.items()}


SIMULATORS: dict[str, type[Simulator]] = {
    "crazysim": Crazysim,
    "C MuJoCo": Mujoco,
    "Crazyflow": Crazyflow,
    "RotorPy": RotorPy,
    "RotorPy, our controller": RotorPyRotors,
    "gym-pybullet-drones": PyBullet,
}
"""Simulators by name."""


def rotorpy_params(airframe: Airframe) -> dict[str, Any]:
    """Return RotorPy's parameters of its brushless Crazyflie, with mass, inertia and rotors of an airframe."""
    defaults = importlib.import_module("rotorpy.vehicles.crazyfliebrushless_params").quad_params
    inertia = airframe.value("rigid_body.inertia", (3,))
    hubs, max_speed = airframe.value("rotors.position", (4, 3)), defaults["rotor_speed_max"]
    k_eta = _thrust_max(airframe) / max_speed**2
    return defaults | {
        "mass": float(airframe.value("rigid_body.mass", ())),
        **dict(zip(("Ixx", "Iyy", "Izz"), map(float, inertia), strict=True)),
        "rotor_pos": {f"r{k + 1}": np.asarray(hub, float) for k, hub in enumerate(hubs)},
        "rotor_directions": np.asarray(airframe.value("rotors.yaw_torque_sign", (4,))),
        "k_eta": k_eta,
        "k_m": k_eta * _torque_per_thrust(airframe),
    }


def _intrinsic_angles(rpy: NDArray) -> NDArray:
    m = np.asarray(rotation.matrix(rotation.from_rpy(jnp.asarray(rpy))), np.float64)
    x, z = np.arctan2(-m[:, 1, 2], m[:, 2, 2]), np.arctan2(-m[:, 0, 1], m[:, 0, 0])
    return np.stack([x, np.arcsin(np.clip(m[:, 0, 2], -1, 1)), z], axis=-1)


def _mjcf(airframe: Airframe, lag: float, timestep: float) -> str:
    inertia = " ".join(f"{x:.9g}" for x in airframe.value("rigid_body.inertia", (3,)))
    hubs, signs = airframe.value("rotors.position", (4, 3)), airframe.value("rotors.yaw_torque_sign", (4,))
    max_thrust, torque_per_thrust = _thrust_max(airframe), _torque_per_thrust(airframe)
    sites = "".join(f'<site name="{k}" pos="{x:.9g} {y:.9g} {z:.9g}"/>' for k, (x, y, z) in enumerate(hubs))
    motors = "".join(
        f'<general site="{k}" gear="0 0 1 0 0 {sign * torque_per_thrust:.9g}" ctrllimited="true" '
        f'ctrlrange="0 {max_thrust:.9g}" dyntype="filter" dynprm="{lag:.9g}"/>'
        for k, sign in enumerate(signs)
    )
    return f"""<mujoco><option timestep="{timestep:.9g}" gravity="0 0 -9.81"/>
    <worldbody><body><freejoint/>
    <inertial pos="0 0 0" mass="{float(airframe.value("rigid_body.mass", ())):.9g}" diaginertia="{inertia}"/>{sites}
    </body></worldbody><actuator>{motors}</actuator></mujoco>"""


def _thrust_max(airframe: Airframe) -> float:
    return float(airframe.value("rotors.thrust_max", ()))


def _torque_per_thrust(airframe: Airframe) -> float:
    max_speed = airframe.rotor_vel_limits[1].max()
    thrust, torque = (
        np.asarray(airframe.value(f"rotors.{name}_curve", (3,)), np.float64) for name in ("thrust", "torque")
    )
    powers = np.array([1.0, max_speed, max_speed**2])
    return float(torque @ powers / (thrust @ powers))


def _hover_speed(sim: Sim) -> NDArray:
    return np.asarray(hover_rotor_states(sim.data.params))


def _world_rows(states: States) -> States:
    return {name: x[:, None] for name, x in states.items()}


def _read_states(data: Any) -> States:
    return {
        name: np.asarray(getattr(data.states, name), np.float64)[:, 0] for name in ("pos", "quat", "vel", "ang_vel")
    }
