"""Time-optimal flights over race tracks at the limits of single rotors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.arguments import check_arguments
from crazysim.drones import Airframe, load_airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE, AirframeSource
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import RPM_TO_RAD_S
from crazysim.envs.tracks import Gate, Track, gates_of_track
from crazysim.errors import expect, optional_import, require
from crazysim.lab.live.attitude import multiply

Floats = NDArray[np.float64]

GUESS_NODES = 10
"""Number of nodes of each leg in the plan of a point mass, with which the search begins."""
GUESS_SPEED = 8.0
"""Speed along the straight legs with which the plan of the point mass begins, m/s."""
GUESS_TURN_RATE = 6.0
"""Rate at which the thrust of the point mass turns at most, rad/s. Drones turn faster, but start and stop turning."""
GUESS_BOW = 0.1
"""Distance of the middle of a leg from the straight line, where the plan of the point mass begins, m."""
MAX_SLOWING = 6.0
"""Largest duration of a leg of the point mass, as a multiple of the duration with which its plan begins."""
MIN_FORCE = 2.0
"""Smallest thrust of the point mass, m/s^2, so that it has a direction everywhere."""
INSET, BEHIND = 1e-3, 1e-5
"""Distances by which crossings stay inside the edge of an opening, and lie behind the plane of a gate, m, so that
rounding makes no plan miss a gate."""
MIN_NODES = 4
"""Smallest number of nodes of a leg."""
MAX_ITERATIONS = 1500
"""Largest number of iterations of a search; 30 to 350 are typical."""
FAR = 1e4
"""Bound of what has no limit: m, m/s, m/s^2 or m/s^3."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A flight over a track. Thrusts are constant between two times."""

    time: Floats
    """Times, s. (n + 1,)"""
    pos: Floats
    """Positions, world frame, m. (n + 1, 3)"""
    vel: Floats
    """Velocities, world frame, m/s. (n + 1, 3)"""
    quat: Floats
    """Attitudes, body to world, xyzw. (n + 1, 4)"""
    ang_vel: Floats
    """Angular velocities, body frame, rad/s. (n + 1, 3)"""
    thrust: Floats
    """Thrusts of the rotors until the next time, with rotor lag those that are commanded, N. (n, n_rotors)"""
    airframe: Airframe
    """Airframe for which the flight was planned."""
    rotor_vel: Floats | None = None
    """Speeds of the rotors, which follow the commanded ``thrust`` with their lag, rpm; None if they follow at once.
    (n + 1, n_rotors)"""

    @property
    def duration(self) -> float:
        """Duration of the flight, s."""
        return float(self.time[-1])


@check_arguments
def plan_race(
    track: Track,
    airframe: AirframeSource = "uzh_cpc",
    *,
    laps: int = 1,
    body_rate: Sequence[float] = (15.0, 15.0, 3.0),
    floor: float | None = 0.0,
    dt: float = 0.04,
    rotor_lag: bool = False,
) -> Plan:
    """Plan the fastest flight through all gates of a track that the rotors of an airframe can fly.

    The flight starts at rest, level, at ``track.start`` with any heading, and ends level and at rest at
    ``track.finish``, or at the last gate if there is none. Drones pass polygons along the gates' x axes and come within
    the radius of waypoints; they are points, so that openings need a margin for their size. The model is the
    simulator's ``first_principles``: a rigid body with linear drag, and rotors with momentum and any thrust from
    ``thrust_min`` to ``thrust_max``, which they reach at once or, with ``rotor_lag``, as the simulator's. Thrusts are
    constant for about ``dt``, and the durations of the legs between gates are free (direct multiple shooting, Bock and
    Plitt 1984, with IPOPT). The search begins from the fastest flight of a point mass whose thrust turns at a limited
    rate, which begins from straight lines.

    Args:
        laps: Number of laps; each begins behind the last gate of the lap before.
        body_rate: Largest roll, pitch and yaw rate, rad/s. (3,)
        floor: Smallest height, m; None for no limit.
        dt: Time between changes of the thrusts, s.
        rotor_lag: Whether rotors follow with the airframe's lag; they then turn as at hover at the start.

    Raises:
        ConfigError: If no flight was found.
    """
    expect(laps >= 1, "at least one lap", laps)
    expect(0 < dt <= 0.5, "dt from 0 to 0.5 s", dt)
    rates = np.asarray(body_rate, float)
    expect(rates.shape == (3,) and np.all(rates > 0), "three positive body rates, rad/s", body_rate)
    loaded = load_airframe(airframe)
    first_principles.Params.create(loaded)
    course = _Course(track, laps, -FAR if floor is None else floor)
    guess = _plan_point_mass(course, loaded)
    return _plan_drone(course, loaded, rates, dt, rotor_lag, *guess)


def fly_open_loop(plan: Plan, substeps: int = 20) -> Floats:
    """Fly the thrusts of a plan with the simulator's dynamics from its start, without control, and return the states.

    Rotors follow as in the plan. Positions then differ from the plan's by the errors of both integrations.

    Args:
        substeps: Number of steps (RK4) between two times of the plan.

    Returns:
        Position, m, velocity, m/s, attitude, xyzw, and angular velocity, rad/s. (n + 1, 13)
    """
    commands, has_lag = plan.airframe.rotor_vel(plan.thrust), plan.rotor_vel is not None

    def derivative(x: jax.Array, speeds: jax.Array) -> jax.Array:
        vel, quat, ang_vel, rotor_vel = x[3:6], x[6:10], x[10:13], x[13:] if has_lag else speeds
        derivatives = first_principles.dynamics(x[:3], quat, vel, ang_vel, speeds, rotor_vel, params=params)
        turn = rotation.multiply(quat, jnp.append(ang_vel / 2, 0.0))
        return jnp.concatenate([*derivatives[:2], turn, *derivatives[2 : 3 + has_lag]])

    def step(x: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        speeds, h = inputs[0], inputs[1] / substeps
        for _ in range(substeps):
            x = _step_rk4(derivative, x, speeds, h)
            x = x.at[6:10].divide(jnp.linalg.norm(x[6:10]))
        return x, x

    speeds = [] if plan.rotor_vel is None else plan.rotor_vel[0]
    start = np.concatenate([plan.pos[0], plan.vel[0], plan.quat[0], plan.ang_vel[0], speeds])
    with jax.enable_x64(True):
        params = first_principles.Params.create(plan.airframe)
        _, states = jax.jit(lambda x, y: jax.lax.scan(step, x, y))(start, (commands, np.diff(plan.time)))
    return np.concatenate([start[None], np.asarray(states)])[:, :13]


class _Course:
    # Legs of a flight, each of which ends at a crossing or at the finish.

    def __init__(self, track: Track, laps: int, floor: float):
        gates = gates_of_track(track)
        # A gate with a length is crossed where it begins and where it ends, and the leg between stays inside.
        crossings: list[tuple[Gate, Floats]] = []
        self.tubes: dict[int, Gate] = {}
        for gate in gates * laps:
            ahead = gate.rot[:, 0] * gate.length / 2
            if gate.length:
                crossings.append((gate, gate.pos - ahead))
                self.tubes[len(crossings)] = gate
            crossings.append((gate, gate.pos + ahead))
        self.crossings, self.floor = crossings, floor
        self.start = np.asarray(track.start, float)
        self.finish = None if track.finish is None else np.asarray(track.finish, float)
        points = [self.start, *(pos for _, pos in crossings)]
        self.points = np.array(points if self.finish is None else [*points, self.finish])

    @property
    def n_legs(self) -> int:
        return len(self.points) - 1

    def bounds(self, leg_ends: NDArray[np.int_], size: int) -> tuple[Floats, Floats]:
        # Of states that begin with position and velocity, which are zero at start and finish.
        low, high = np.full((size, leg_ends[-1] + 1), -FAR), np.full((size, leg_ends[-1] + 1), FAR)
        low[2] = self.floor
        low[:3, 0] = high[:3, 0] = self.start
        low[3:6, 0] = high[3:6, 0] = 0.0
        if self.finish is not None:
            low[:3, -1] = high[:3, -1] = self.finish
            low[3:6, -1] = high[3:6, -1] = 0.0
        return low, high

    def constrain(self, nlp: _Program, states: Any, leg_ends: NDArray[np.int_], balls: bool) -> None:
        for k, (gate, pos) in enumerate(self.crossings):
            offset = states[:3, int(leg_ends[k])] - pos
            if gate.is_ball and balls:
                nlp.add(nlp.ca.dot(offset, offset) / (float(gate.opening) - INSET) ** 2, 0.0, 1.0)
                continue
            if gate.is_ball:  # a cube inside, since searches that begin in the middle of a small ball creep
                half = (float(gate.opening) - INSET) / np.sqrt(3)
                nlp.add(offset, -half, half)
                continue
            axis, planes = gate.rot[:, :1].T, gate.half_planes
            nlp.add(axis @ offset, BEHIND, BEHIND)
            nlp.add(axis @ states[3:6, int(leg_ends[k])], 0.0, FAR)
            # The nodes before and after are on either side: a motion along the plane could touch it without crossing.
            nlp.add(axis @ (states[:3, int(leg_ends[k]) - 1] - pos), -FAR, -BEHIND)
            if leg_ends[k] < leg_ends[-1]:
                nlp.add(axis @ (states[:3, int(leg_ends[k]) + 1] - pos), BEHIND, FAR)
            nlp.add(planes[:, :2] @ gate.rot[:, 1:].T @ offset - planes[:, 2], -FAR, -INSET)
        for leg, gate in self.tubes.items():
            inner = states[:3, int(leg_ends[leg - 1]) + 1 : int(leg_ends[leg])] - gate.pos
            planes = gate.half_planes
            nlp.add(planes[:, :2] @ gate.rot[:, 1:].T @ inner - planes[:, 2], -FAR, 0.0)


class _Program:
    # A nonlinear program that is built up by its variables and constraints.

    def __init__(self, ca: Any):
        self.ca = ca
        self._variables: list[Any] = []
        self._values: list[tuple[Floats, Floats, Floats]] = []
        self._constraints: list[tuple[Any, Floats, Floats]] = []

    def variable(self, guess: Floats, low: Any, high: Any) -> Any:
        symbol = self.ca.MX.sym(f"x{len(self._variables)}", *guess.shape)
        self._variables.append(symbol)
        self._values.append(tuple(np.broadcast_to(x, guess.shape).ravel("F") for x in (guess, low, high)))  # type: ignore[arg-type]
        return symbol

    def add(self, expression: Any, low: float, high: float) -> None:
        flat = self.ca.vec(expression)
        self._constraints.append((flat, np.full(flat.numel(), low), np.full(flat.numel(), high)))

    def solve(self, cost: Any, what: str) -> list[Floats]:
        # Values of the variables, in their order.
        x = self.ca.vertcat(*map(self.ca.vec, self._variables))
        g, low, high = zip(*self._constraints, strict=True)
        options = {"print_level": 0, "sb": "yes", "max_iter": MAX_ITERATIONS, "tol": 1e-5}
        problem = {"x": x, "f": cost, "g": self.ca.vertcat(*g)}
        solver = self.ca.nlpsol("plan", "ipopt", problem, {"ipopt": options, "print_time": False})
        x0, lbx, ubx = map(np.concatenate, zip(*self._values, strict=True))
        result = solver(x0=x0, lbx=lbx, ubx=ubx, lbg=np.concatenate(low), ubg=np.concatenate(high))
        status = solver.stats()["return_status"]
        require(
            solver.stats()["success"],
            f"expected a flight of {what} over the track, got {status!r} from IPOPT. Raise body_rate or thrust, lower "
            f"floor, or check positions and directions of the gates.",
        )
        solution, parts = np.array(result["x"]).ravel(), []
        for variable in self._variables:
            parts.append(solution[: variable.numel()].reshape(variable.shape, order="F"))
            solution = solution[variable.numel() :]
        return parts


def _import_casadi() -> Any:
    with optional_import("time-optimal plans need", "casadi", "racing"):
        import casadi
    return casadi


def _plan_point_mass(course: _Course, airframe: Airframe) -> tuple[Floats, Floats]:
    # Times (n + 1,), and position, velocity and acceleration (9, n + 1).
    ca = _import_casadi()
    strongest = (
        airframe.n_rotors * float(airframe.value("rotors.thrust_max")) / float(airframe.value("rigid_body.mass"))
    )
    n, n_legs = GUESS_NODES, course.n_legs
    leg, ends = np.repeat(np.arange(n_legs), n), n * np.arange(1, n_legs + 1)
    # Legs at constant speed, straight but for a bow to some side: along a vertical line, all sides would be equal.
    points = course.points
    durations = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=-1) / GUESS_SPEED, 0.3)
    share = np.tile(np.arange(n) / n, n_legs)[:, None]
    bow = GUESS_BOW * np.sin(np.pi * share) * np.stack([np.cos(leg), np.sin(leg), 0.0 * leg], axis=-1)
    pos = np.concatenate([points[leg] + share * np.diff(points, axis=0)[leg] + bow, points[-1:]])
    vel = np.gradient(pos, np.concatenate([[0.0], np.cumsum(durations[leg] / n)]), axis=0)
    states = np.concatenate([pos, vel, 0 * pos], axis=-1).T
    low, high = course.bounds(ends, 9)
    low[6:, [0, -1]] = high[6:, [0, -1]] = 0.0
    # Third integrals of a limited jerk.
    program = _Program(ca)
    x = program.variable(states, low, high)
    jerk = program.variable(np.zeros((3, len(leg))), -FAR, FAR)
    legs = program.variable(durations[:, None], 0.02, MAX_SLOWING * durations[:, None])
    p, v, a, j = (ca.SX.sym(name, 3) for name in "pvaj")
    h = ca.SX.sym("h")
    following = [p + h * v + h**2 / 2 * a + h**3 / 6 * j, v + h * a + h**2 / 2 * j, a + h * j]
    step = ca.Function("step", [ca.vertcat(p, v, a), j, h], [ca.vertcat(*following)]).map(len(leg))
    program.add(x[:, 1:] - step(x[:, :-1], jerk, (legs[leg.tolist(), 0] / n).T), 0.0, 0.0)
    program.add(ca.sum1((x[6:9, :] + np.array([[0], [0], [GRAVITY_MAGNITUDE]])) ** 2), MIN_FORCE**2, strongest**2)
    program.add(ca.sum1(jerk**2), 0.0, (strongest * GUESS_TURN_RATE) ** 2)
    course.constrain(program, x, ends, balls=False)
    # A tiny cost of the jerk makes the solution unique where it does not matter.
    states, _, durations = program.solve(ca.sum1(legs) + 1e-6 / len(leg) * ca.sumsqr(jerk), "a point mass")
    return np.concatenate([[0.0], np.cumsum(durations[leg, 0] / n)]), states


def _plan_drone(
    course: _Course, airframe: Airframe, rates: Floats, dt: float, lag: bool, guess_time: Floats, guess: Floats
) -> Plan:
    ca, n_rotors = _import_casadi(), airframe.n_rotors
    mass = float(airframe.value("rigid_body.mass"))
    weakest, strongest = (float(airframe.value(f"rotors.thrust_{side}")) for side in ("min", "max"))
    # Nodes at equal times within each leg of the point mass's flight.
    durations = np.diff(guess_time[::GUESS_NODES])
    counts = np.maximum(np.ceil(durations / dt).astype(int), MIN_NODES)
    leg, ends = np.repeat(np.arange(course.n_legs), counts), np.cumsum(counts)
    time = np.concatenate([[0.0], np.cumsum((durations / counts)[leg])])
    motion = np.array([np.interp(time, guess_time, row) for row in guess])
    force = motion[6:9] + np.array([[0], [0], [GRAVITY_MAGNITUDE]])
    size = np.linalg.norm(force, axis=0)
    quat, ang_vel = _turn_along(force / size, time)
    states = np.concatenate([motion[:6], quat, np.clip(ang_vel, -rates[:, None], rates[:, None])])
    thrust = np.clip(np.tile(mass * size / n_rotors, (n_rotors, 1)), weakest, strongest)
    # With lag, speeds of the rotors, as shares of the largest, are states, and commanded speeds are the inputs.
    inputs, input_low, input_high = thrust[:, :-1], weakest, strongest
    if lag:
        scale = float(airframe.rotor_vel(strongest)[0])
        speeds = airframe.rotor_vel(thrust.T).T / scale
        speeds[:, 0] = airframe.rotor_vel(mass * GRAVITY_MAGNITUDE / n_rotors) / scale
        states, inputs, input_high = np.concatenate([states, speeds]), speeds[:, :-1], 1.0
        input_low = float(airframe.rotor_vel(weakest)[0]) / scale
    # Level and at rest at both ends, with any heading.
    low, high = course.bounds(ends, len(states))
    low[6:10], high[6:10] = -1.1, 1.1
    low[10:13], high[10:13] = -rates[:, None], rates[:, None]
    low[13:, 0] = high[13:, 0] = states[13:, 0]
    still = [0, -1] if course.finish is not None else [0]
    rows = np.ix_([6, 7, 10, 11, 12], still)
    low[rows] = high[rows] = 0.0
    program = _Program(ca)
    x = program.variable(states, low, high)
    u = program.variable(inputs, input_low, input_high)
    legs = program.variable(1.05 * durations[:, None], 0.02, FAR)
    step = _step_function(ca, airframe, scale if lag else None).map(len(leg))
    program.add(x[:, 1:] - step(x[:, :-1], u, (legs[leg.tolist(), 0] / counts[leg].astype(float)).T), 0.0, 0.0)
    program.add(ca.sumsqr(x[6:10, 0]), 1.0, 1.0)
    course.constrain(program, x, ends, balls=True)
    states, inputs, durations = program.solve(ca.sum1(legs), f"{airframe.name!r}")
    time = np.concatenate([[0.0], np.cumsum((durations[:, 0] / counts)[leg])])
    pos, vel, quat, ang_vel, speeds = np.split(states.T, [3, 6, 10, 13], axis=-1)
    if not lag:
        return Plan(time, pos, vel, quat, ang_vel, inputs.T, airframe)
    thrust = np.polynomial.polynomial.polyval(scale * inputs.T, np.atleast_2d(airframe.value("rotors.thrust_curve"))[0])
    return Plan(time, pos, vel, quat, ang_vel, thrust, airframe, scale * speeds)


def _step_function(ca: Any, airframe: Airframe, scale: float | None) -> Any:
    # State after a time with constant inputs, by RK4, with so many substeps that open-loop flights end within
    # centimetres. Inputs are thrusts or, with a scale of rotor speeds, commanded speeds, which the rotors follow.
    n_rotors, substeps = airframe.n_rotors, 2 if scale is None else 6
    x, inputs, h = ca.SX.sym("x", 13 if scale is None else 13 + n_rotors), ca.SX.sym("u", n_rotors), ca.SX.sym("h")
    vel, quat, ang_vel, u = x[3:6], x[6:10], x[10:13], inputs
    q, w = quat[:3], quat[3]
    # Columns of the rotation matrix are the body's axes.
    identity = np.eye(3)
    axes = [e + 2 * w * ca.cross(q, e) + 2 * ca.cross(q, ca.cross(q, e)) for e in map(ca.DM, identity)]
    rot = ca.horzcat(*axes)
    arms = airframe.mixing_matrix * [[airframe.arm], [airframe.arm], [1.0]]
    thrust_curve, torque_curve = (np.atleast_2d(airframe.value(f"rotors.{x}_curve"))[0] for x in ("thrust", "torque"))
    spin = RPM_TO_RAD_S * airframe.value("rotors.yaw_torque_sign") * airframe.value("rotors.inertia")
    k0, k1, k2 = thrust_curve
    ratio, momentum, reaction = torque_curve[2] / k2, airframe.inertia @ ang_vel, 0.0
    if scale is not None:
        rotor_vel, command = scale * x[13:], scale * inputs
        u = k0 + k1 * rotor_vel + k2 * rotor_vel**2
        a0, b0, a1, b1 = map(ca.DM, np.broadcast_to(airframe.value("rotors.lag"), (n_rotors, 4)).T)
        rise, both = command - rotor_vel, command + rotor_vel
        rotor_acc = rise * ca.if_else(rise > 0, a0 + b0 * both, a1 + b1 * both)
        reaction = ca.dot(spin, rotor_acc)
    elif np.any(spin) or not np.allclose(torque_curve, ratio * thrust_curve):
        # The slope of the speed is infinite at no thrust, so that it is left out where nothing depends on it.
        rotor_vel = (-k1 + ca.sqrt(k1**2 - 4 * k2 * (k0 - u))) / (2 * k2)
    else:
        rotor_vel = None
    drag_torque = ratio * u
    if rotor_vel is not None:
        drag_torque = torque_curve[0] + torque_curve[1] * rotor_vel + torque_curve[2] * rotor_vel**2
        momentum = momentum + ca.vertcat(0, 0, -ca.dot(spin, rotor_vel))
    drag = rot @ airframe.matrix("drag.coefficients") @ rot.T @ vel
    acc = (axes[2] * ca.sum1(u) + drag) / float(airframe.value("rigid_body.mass")) - GRAVITY_MAGNITUDE * identity[2]
    turning = ca.vertcat(arms[:2] @ u, arms[2:] @ drag_torque + reaction)
    torque = turning - ca.cross(ang_vel, momentum)
    turn = 0.5 * ca.vertcat(w * ang_vel + ca.cross(q, ang_vel), -ca.dot(q, ang_vel))
    derivative = [vel, acc, turn, np.linalg.inv(airframe.inertia) @ torque]
    derivative += [] if scale is None else [rotor_acc / scale]
    rate = ca.Function("rate", [x, inputs], [ca.vertcat(*derivative)])
    y, d = x, h / substeps
    for _ in range(substeps):
        y = _step_rk4(rate, y, inputs, d)
    y = ca.vertcat(y[:6], y[6:10] / ca.norm_2(y[6:10]), y[10:])
    return ca.Function("step", [x, inputs, h], [y])


def _step_rk4(rate: Any, x: Any, u: Any, h: Any) -> Any:
    # For arrays of JAX and expressions of CasADi.
    k1 = rate(x, u)
    k2 = rate(x + h / 2 * k1, u)
    k3 = rate(x + h / 2 * k2, u)
    k4 = rate(x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _turn_along(axis: Floats, time: Floats) -> tuple[Floats, Floats]:
    # Attitudes, xyzw, and body rates that turn the body's z axis along unit vectors, (3, n), without yaw rate.
    n = axis.shape[1]
    quat, ang_vel = np.zeros((4, n)), np.zeros((3, n))
    quat[3, 0] = 1.0
    for k in range(n - 1):
        # Shortest rotation from one axis to the next, in the world, before the attitude.
        a, b = axis[:, k], axis[:, k + 1]
        turn = np.append(np.cross(a, b), 1 + a @ b)
        turn /= np.linalg.norm(turn)
        quat[:, k + 1] = multiply(turn, quat[:, k])
        ang_vel[:, k] = 2 * multiply(quat[:, k] * [-1, -1, -1, 1], quat[:, k + 1])[:3] / (time[k + 1] - time[k])
    return quat, ang_vel
