"""Simulators that fly rotor commands: crazysim, l2f, C MuJoCo, RotorPy and Crazyflow.

All but Crazyflow fly quadrotors of any mass, inertia, arm, thrust and lag; drag is the simulator's own.
"""

from __future__ import annotations

import functools
import importlib
import json
from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.core.plugin import drawn_data
from crazysim.drones import airframe_names, load_airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.dynamics.first_principles import Params
from crazysim.envs.actions import hover_rotor_states
from crazysim.lab.export.rl_tools import RAPTOR_ROTORS, RAPTOR_YAW_TORQUE_SIGNS
from crazysim.lab.plugins.random_airframe import CRAZYFLIE_ARM, CRAZYFLIE_MASS, RandomAirframe, quadrotor_params
from crazysim.lab.validate.closed_forms import with_states
from crazysim.lab.validate.simulators import States
from crazysim.sim.sim import Sim

STEP_MS = 1
"""Step of all simulators, ms."""
N_STARTS = 10
"""Number of starts of each built-in airframe."""
CRAZYFLOW_AIRFRAMES = ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350")
"""Airframes of Crazyflow that take rotor commands."""


class Quadrotors(NamedTuple):
    """Quadrotors whose thrust is proportional to the square of the rotor speed."""

    mass: NDArray
    """Mass, kg. (n,)"""
    thrust: NDArray
    """Largest thrust of a rotor, N. (n,)"""
    arm: NDArray
    """Distance of each rotor from both axes, m. (n,)"""
    inertia: NDArray
    """Moments of inertia, kg m^2. (n, 3)"""
    lag: NDArray
    """Time constants of rising and of falling rotor speeds, s. (n, 2)"""
    torque: NDArray
    """Drag torque of a rotor per thrust, m. (n,)"""

    @staticmethod
    def sample(n: int = 256) -> Quadrotors:
        """Draw quadrotors from the ranges that RAPTOR was trained on.

        rl-tools at commit e43ae4bc, ``src/foundation_policy/pre_training/sample_dynamics_parameters.cpp``, about the
        Crazyflie of ``rl/environments/l2f/parameters/dynamics/crazyflie.h``.
        """
        draw = np.random.default_rng(0).uniform
        mass = draw(0.02 ** (1 / 3), 5 ** (1 / 3), n) ** 3
        thrust = draw(1.5, 5, n) * mass * GRAVITY_MAGNITUDE / 4
        arm = CRAZYFLIE_ARM * np.cbrt(mass / CRAZYFLIE_MASS) * draw(0.9, 1.1, n)
        inertia = np.sqrt(2) * arm * thrust / draw(40, 1200, n)
        ratio = np.array([9.416556729130406e-06, 9.644051701582312e-06, 1.745951732253285e-05]) / 9.416556729130406e-06
        lag = np.stack([draw(0.03, 0.1, n), draw(0.03, 0.3, n)], axis=-1)
        return Quadrotors(mass, thrust, arm, inertia[:, None] * ratio, lag, draw(0.005, 0.05, n))

    @property
    def hover_action(self) -> NDArray:
        """Action, from -1 to 1, of rotors that carry the weight. (n, 4)"""
        speed = np.sqrt(self.mass * GRAVITY_MAGNITUDE / (4 * self.thrust))  # over the largest
        return np.repeat((2 * speed - 1)[..., None], 4, axis=-1)

    @property
    def rotors(self) -> NDArray:
        """Positions of the rotors, m, in RAPTOR's order. (n, 4, 3)"""
        return self.arm[:, None, None] * np.array([(*signs, 0) for signs in RAPTOR_ROTORS])

    @property
    def params(self) -> Params:
        """Parameters of crazysim. (n, 1, ...) each"""
        n = len(self.mass)
        column = {name: jnp.asarray(x, jnp.float32).reshape(n, 1, -1) for name, x in self._asdict().items()}
        arm = column.pop("arm")
        return _expand(quadrotor_params(_default_params("cf21B_500"), arms=(arm, arm), **column), n)


def built_in_airframes() -> Params:
    """Return the parameters of all built-in quadrotors with rotor speeds, each ``N_STARTS`` times. (n, 1, ...) each"""
    # hb_x500 has no rotor speeds
    names = [name for name in airframe_names() if "rotors.thrust_curve" in load_airframe(name).values]
    return jax.tree.map(lambda *x: jnp.repeat(jnp.stack(x), N_STARTS, axis=0)[:, None], *map(_default_params, names))


def drawn_airframes(n: int = 1000) -> Params:
    """Return the parameters of airframes that ``RandomAirframe`` draws. (n, 1, ...) each"""
    sim = Sim(n, drone="cf21B_500", control="rotor_vel")
    sim.add(RandomAirframe())
    sim.reset()
    return _expand(drawn_data(sim.data).params, n)


@functools.cache
def _default_params(drone: str) -> Params:
    return Sim(drone=drone, control="rotor_vel").data.params


def _expand(params: Params, n: int) -> Params:
    return jax.tree.map(lambda x, one: jnp.broadcast_to(x, (n, 1, *one.shape)), params, _default_params("cf21B_500"))


class Drones(Protocol):
    """Drones in flight."""

    module: ClassVar[str] = ""
    """Module that must be importable; empty for none."""
    hover_action: NDArray
    """Action, from -1 to 1, of rotors that carry the weight, at which they start. (n, 4)"""

    def __init__(self, fleet: Any, start: States) -> None: ...

    def observe(self) -> NDArray:
        """Return position, rotation matrix, row by row, velocity and angular velocity, body frame. (n, 18)"""
        ...

    def step(self, action: NDArray) -> None:
        """Advance by ``STEP_MS`` under commanded rotor speeds, from -1 to 1, in RAPTOR's order. (n, 4)"""
        ...


class Crazysim(Drones):
    """crazysim itself, with the Runge-Kutta method of order 4."""

    def __init__(self, fleet: Quadrotors | Params, start: States) -> None:
        params = fleet.params if isinstance(fleet, Quadrotors) else fleet
        self._sim: Any = Sim(
            len(start["pos"]), drone="cf21B_500", control="rotor_vel", integrator="rk4", freq=1000 // STEP_MS
        )
        self._sim.data = self._sim.data.replace(params=params)
        self._fly_from(start, params)

    def _fly_from(self, start: States, params: Params) -> None:
        self._half = np.asarray(params.rotor_vel_max)[:, 0] / 2
        hover = np.broadcast_to(hover_rotor_states(params)[:, 0], (len(self._half), 4))
        self.hover_action = hover / self._half - 1
        rows = {name: x[:, None] for name, x in start.items()}
        self._sim.data = with_states(self._sim.data, **rows, rotor_vel=hover[:, None])

    def observe(self) -> NDArray:
        s = self._sim.data.states
        return _observation(*(np.asarray(x, np.float64)[:, 0] for x in (s.pos, s.quat, s.vel, s.ang_vel)))

    def step(self, action: NDArray) -> None:
        self._sim.rotor_vel_control((self._half * (action + 1))[:, None].astype(np.float32))
        self._sim.step()


class L2f(Drones):
    """The simulator of RAPTOR's training, with the Runge-Kutta method of order 4 and without drag.

    The number of drones is a power of 2.
    """

    module = "l2f"

    def __init__(self, fleet: Quadrotors, start: States) -> None:
        l2f: Any = importlib.import_module("l2f")
        self._batch: Any = l2f.vector_selector[len(fleet.mass)]
        batch = self._batch
        self.hover_action = fleet.hover_action
        device, self._rng, world = l2f.Device(), batch.VectorRng(), batch.VectorEnvironment()
        parameters, self._state, self._next_state = batch.VectorParameters(), batch.VectorState(), batch.VectorState()
        batch.initialize_rng(device, self._rng, 0)
        batch.initialize_environment(device, world)
        batch.initial_parameters(device, world, parameters)
        batch.initial_state(device, world, parameters, self._state)
        for i, drone in enumerate(self._state.states):
            q = Quadrotors(*(x[i] for x in fleet))
            file = json.loads(l2f.parameters_to_json(device, world.environments[i], parameters.parameters[i]))
            file["integration"]["dt"] = STEP_MS / 1000
            numbers = {
                "mass": q.mass, "rotor_positions": q.arm * np.sign(file["dynamics"]["rotor_positions"]),
                "J": np.diag(q.inertia), "J_inv": np.diag(1 / q.inertia),
                "rotor_thrust_coefficients": [[0, 0, float(q.thrust)]] * 4,
                "rotor_torque_constants": np.full(4, q.torque), "rotor_time_constants_rising": np.full(4, q.lag[0]),
                "rotor_time_constants_falling": np.full(4, q.lag[1]),
            }  # fmt: skip
            file["dynamics"] |= {name: np.asarray(value).tolist() for name, value in numbers.items()}
            l2f.parameters_from_json(device, world.environments[i], json.dumps(file), parameters.parameters[i])
            drone.position, drone.orientation = start["pos"][i].tolist(), np.roll(start["quat"][i], 1).tolist()
            drone.linear_velocity, drone.angular_velocity = start["vel"][i].tolist(), start["ang_vel"][i].tolist()
            drone.rpm = ((q.hover_action + 1) / 2).tolist()
        self._world = device, world, parameters
        self._observed = np.zeros((len(fleet.mass), world.OBSERVATION_DIM), np.float32)

    def observe(self) -> NDArray:
        self._batch.observe(*self._world, self._state, self._observed, self._rng)
        return self._observed[:, :18].astype(np.float64)

    def step(self, action: NDArray) -> None:
        self._batch.step(*self._world, self._state, action.astype(np.float32), self._next_state, self._rng)
        self._state.assign(self._next_state)


class Mujoco(Drones):
    """C MuJoCo: free bodies without drag, whose thrusts lag by the mean of both time constants."""

    def __init__(self, fleet: Quadrotors, start: States) -> None:
        n, rollout = len(fleet.mass), importlib.import_module("mujoco.rollout")
        self.hover_action, self._thrust = fleet.hover_action, fleet.thrust[:, None]
        models = [mujoco.MjModel.from_xml_string(_mjcf(fleet, k)) for k in range(n)]
        self._rollout, data = rollout.Rollout(nthread=2), [mujoco.MjData(models[0]) for _ in range(2)]
        self._advance = lambda state, control: self._rollout.rollout(models, data, state, control)[0]
        quat, act = np.roll(start["quat"], 1, axis=-1), self._thrusts(self.hover_action)
        state = (np.zeros((n, 1)), start["pos"], quat, start["vel"], start["ang_vel"], act)
        self._state = np.concatenate(state, axis=-1)  # time, qpos, qvel, act

    def _thrusts(self, action: NDArray) -> NDArray:
        return self._thrust * ((np.clip(action, -1, 1) + 1) / 2) ** 2

    def observe(self) -> NDArray:
        pos, quat, vel, ang_vel = np.split(self._state[:, 1:14], [3, 7, 10], axis=-1)
        return _observation(pos, np.roll(quat, -1, axis=-1), vel, ang_vel)

    def step(self, action: NDArray) -> None:
        self._state = self._advance(self._state, self._thrusts(action)[:, None])[:, -1]


class RotorPy(Drones):
    """RotorPy, with the drag of its brushless Crazyflie and speeds that lag by the mean of both time constants."""

    module = "torchdiffeq"

    def __init__(self, fleet: Quadrotors, start: States) -> None:
        self._torch: Any = importlib.import_module("torch")
        multirotor: Any = importlib.import_module("rotorpy.vehicles.multirotor")
        defaults = importlib.import_module("rotorpy.vehicles.crazyfliebrushless_params").quad_params
        self._torch.set_num_threads(1)  # synchronising threads would take longer than the work on arrays of this size
        n, device = len(fleet.mass), self._torch.device("cpu")
        self.hover_action, self._half = fleet.hover_action, defaults["rotor_speed_max"] / 2
        params = [
            defaults
            | dict(zip(("Ixx", "Iyy", "Izz"), map(float, inertia), strict=True))
            | {
                "mass": float(mass), "k_eta": thrust / (2 * self._half) ** 2,
                "k_m": torque * thrust / (2 * self._half) ** 2,
                "rotor_pos": {f"r{i + 1}": hub for i, hub in enumerate(hubs)},
                "rotor_directions": np.array(RAPTOR_YAW_TORQUE_SIGNS), "tau_m": float(np.mean(lag)),
            }
            for mass, thrust, inertia, lag, torque, hubs in zip(
                fleet.mass, fleet.thrust, fleet.inertia, fleet.lag, fleet.torque, fleet.rotors, strict=True
            )
        ]  # fmt: skip
        state = {"x": start["pos"], "v": start["vel"], "q": start["quat"], "w": start["ang_vel"],
                 "wind": np.zeros((n, 3)), "rotor_speeds": self._half * (self.hover_action + 1)}  # fmt: skip
        self._state = {name: self._torch.tensor(np.asarray(x, np.float64)) for name, x in state.items()}
        batch_params = multirotor.BatchedMultirotorParams(params, n, device)
        self._drones = multirotor.BatchedMultirotor(batch_params, n, self._state, device, integrator="rk4")
        self._indices = self._torch.arange(n)

    def observe(self) -> NDArray:
        return _observation(*(self._state[name].numpy() for name in ("x", "q", "v", "w")))

    def step(self, action: NDArray) -> None:
        control = {"cmd_motor_speeds": self._torch.tensor(self._half * (action + 1))}
        self._state = self._drones.step(self._state, control, STEP_MS / 1000, self._indices)


class Crazyflow(Drones):
    """Crazyflow, with its own airframes."""

    module = "crazyflow"

    def __init__(self, fleet: NDArray, start: States) -> None:
        names = np.unique(fleet)
        self._parts = [np.flatnonzero(fleet == name) for name in names]
        self._drones = [
            _CrazyflowAirframe(name, {key: x[part] for key, x in start.items()})
            for name, part in zip(names, self._parts, strict=True)
        ]
        self.hover_action = self._join([drones.hover_action for drones in self._drones])

    def _join(self, arrays: list[NDArray]) -> NDArray:
        return np.concatenate(arrays)[np.argsort(np.concatenate(self._parts))]

    def observe(self) -> NDArray:
        return self._join([drones.observe() for drones in self._drones])

    def step(self, action: NDArray) -> None:
        for part, drones in zip(self._parts, self._drones, strict=True):
            drones.step(action[part])


class _CrazyflowAirframe(Crazysim):
    def __init__(self, fleet: str, start: States) -> None:
        n, package = len(start["pos"]), importlib.import_module("crazyflow.sim")
        self._sim: Any = package.Sim(n_worlds=n, drone=fleet, control="rotor_vel", freq=1000 // STEP_MS)
        self._fly_from(start, jax.tree.map(lambda x: jnp.broadcast_to(x, (n, 1, *x.shape)), _default_params(fleet)))


SIMULATORS: dict[str, type[Drones]] = {
    "crazysim": Crazysim,
    "l2f": L2f,
    "C MuJoCo": Mujoco,
    "Crazyflow": Crazyflow,
    "RotorPy": RotorPy,
}
"""Simulators by name."""


def _observation(pos: NDArray, quat: NDArray, vel: NDArray, ang_vel: NDArray) -> NDArray:
    matrix = np.asarray(_rotation_matrix(quat), np.float64).reshape(-1, 9)
    return np.concatenate([pos, matrix, vel, ang_vel], axis=-1)


_rotation_matrix = jax.jit(rotation.matrix)


def _mjcf(q: Quadrotors, k: int) -> str:
    inertia = " ".join(f"{x:.9g}" for x in q.inertia[k])
    sites = "".join(f'<site name="{i}" pos="{x:.9g} {y:.9g} {z:.9g}"/>' for i, (x, y, z) in enumerate(q.rotors[k]))
    motors = "".join(
        f'<general site="{i}" gear="0 0 1 0 0 {sign * q.torque[k]:.9g}" dyntype="filterexact" '
        f'dynprm="{np.mean(q.lag[k]):.9g}"/>'
        for i, sign in enumerate(RAPTOR_YAW_TORQUE_SIGNS)
    )
    return f"""<mujoco><option timestep="{STEP_MS / 1000}" gravity="0 0 -9.81"><flag autoreset="disable"/></option>
    <worldbody><body><freejoint/><inertial pos="0 0 0" mass="{q.mass[k]:.9g}" diaginertia="{inertia}"/>{sites}
    </body></worldbody><actuator>{motors}</actuator></mujoco>"""
