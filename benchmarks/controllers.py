"""Controllers compared on the same flights: a line for each controller and airframe, and a line for its cost.

    python benchmarks/controllers.py [--controllers auto indi ...] [--drones cf21B_500 my_drone.toml ...] [--speed 2]

- hover: distance from the setpoint, at a height of 1 m, 5 s after the take-off from the floor, m
- tracking: RMS distance from the setpoint on a figure eight 2 m wide, over 9 s from a start on it, m; its largest speed
  is ``--speed``
- pushed, pushed_largest: distance 5 s after a sideways force of a tenth of the weight sets in, and largest distance, m
- heavier: distance after 5 s of hovering with 20% more mass, m
- home: fraction of the flights from random attitudes at 5 rad/s that end within 0.1 m of the setpoint, after 15 s
- lost_178: height lost from rest at a roll of 178 degrees, m
- overshoot_attitude, overshoot_body_rate: largest overshoot after the steps of ``COMMAND_STEPS``, fraction of a step
- error_attitude, error_body_rate: largest error 2 s after these steps and later, fraction of a step
- steps_per_s: physics steps of many worlds that hover, in calls of 100 steps; omitted with --worlds 0

Without --drones, the airframes are all built-in airframes with rotors, and with the dynamics ``first_principles`` three
generic airframes (``generic_airframes``). A controller is left out for an airframe that lacks its constants.
``tracking_lqr`` only flies the figure eight.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import engine_name, medians, report, round_digits, seconds
from scipy.spatial.transform import Rotation

from crazysim import Sim, load_airframe
from crazysim.control import TrackingLQR
from crazysim.core import functional as F
from crazysim.drones import Airframe
from crazysim.dynamics.models import supported_drones
from crazysim.envs.actions import hover_rotor_states
from crazysim.errors import ConfigError
from crazysim.trajectories import figure_eight

CONTROLLERS = ("auto", "crazyflow", "mellinger", "pid", "geometric", "lqr", "tracking_lqr", "indi")
GAIN_INTERVAL = 0.15
"""Time between gains of tracking_lqr, s; 60 intervals last 9 s."""
COMMAND_STEPS = {
    "attitude": ((0, 0.1), (0, 0.5), (1, -0.5), (2, 0.5), (2, 2.5)),
    "body_rate": ((0, 0.5), (0, 3.0), (1, -3.0), (2, 0.5), (2, 2.0)),
}
"""Axes and sizes of the steps of the command at each level, rad or rad/s."""
START_HEIGHT = 100.0
"""Height of the flights that may fall, m."""
TAKE_OFF_WORLD, TRACKING_WORLD, PUSHED_WORLD, HEAVY_WORLD, INVERTED_WORLD, FIRST_TUMBLING_WORLD = range(6)
"""Index of the world of each flight; the tumbling drones have all worlds from the last index on."""


def generic_airframe(
    name: str,
    mass: float,
    radius: float,
    n_rotors: int,
    inertia: list[float],
    thrust_max: float,
    rpm: float,
    lag_rate: float,
) -> Airframe:
    """Return a generic airframe: rotors on a circle that hover at ``rpm``, without constants of controllers."""
    angles = 2 * np.pi * (np.arange(n_rotors) + 0.5) / n_rotors
    k2 = mass * 9.81 / n_rotors / rpm**2
    return load_airframe(
        {
            "name": name,
            "rigid_body": {"mass": mass, "inertia": inertia},
            "rotors": {
                "position": np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles], -1).tolist(),
                "yaw_torque_sign": [1, -1] * (n_rotors // 2),
                "thrust_min": 0.02 * thrust_max,
                "thrust_max": thrust_max,
                "inertia": 1e-3 * inertia[2],
                "thrust_curve": [0.0, 0.0, k2],
                "torque_curve": [0.0, 0.0, 0.015 * k2],
                "lag": [lag_rate, 0.0, 0.7 * lag_rate, 0.0],
            },
            "drag": {"coefficients": [-0.15 * mass] * 3},
        }
    )


def generic_airframes() -> list[Airframe]:
    """Return a quadrotor with propellers of 3 inches, a quadrotor with propellers of 5 inches, and a hexarotor."""
    return [
        generic_airframe("quad_3_inch", 0.25, 0.07, 4, [2.5e-4, 2.5e-4, 4.2e-4], 2.2, 15e3, 30.0),
        generic_airframe("quad_5_inch", 1.2, 0.12, 4, [5e-3, 5e-3, 9e-3], 12.0, 11e3, 20.0),
        generic_airframe("hexa", 4.0, 0.35, 6, [0.08, 0.08, 0.14], 16.0, 5.5e3, 10.0),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--drones", nargs="+", help="airframes; by default all with rotors and three generic ones")
    parser.add_argument(
        "--dynamics", default="first_principles", help="dynamics model; only controller auto flies fitted models"
    )
    parser.add_argument("--controllers", nargs="+", default=CONTROLLERS)
    parser.add_argument("--speed", type=float, default=2.0, help="largest speed along the figure eight, m/s")
    parser.add_argument("--attitudes", type=int, default=100, help="random attitudes of each airframe")
    parser.add_argument("--worlds", type=int, default=16384, help="worlds of the measurement of cost; 0 for none")
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    names = args.drones or supported_drones(args.dynamics)
    is_first_principles = args.dynamics == "first_principles"
    airframes = [load_airframe(name) for name in names] + (
        generic_airframes() if is_first_principles and not args.drones else []
    )
    for name in args.controllers:
        supported_airframes = [airframe for airframe in airframes if is_supported(name, airframe, args.dynamics)]
        if supported_airframes:
            rows = fly_airframes(name, supported_airframes, args.speed, args.attitudes, args.dynamics, args.device)
            for level in COMMAND_STEPS:
                if not is_first_principles or not is_supported(name, supported_airframes[0], args.dynamics, level):
                    continue
                for drone, row in step_response_metrics(name, supported_airframes, level, args.device).items():
                    rows[drone] |= row
            for drone, row in rows.items():
                row = {key: round_digits(value) for key, value in row.items()}
                report(args.device, benchmark="controllers", controller=name, drone=drone, speed=args.speed, **row)
    if args.worlds:
        report_cost(args)


def is_supported(name: str, airframe: Airframe, dynamics: str, level: str = "state") -> bool:
    """Return True if a controller takes commands of a level and an airframe has the numbers that it needs."""
    try:
        Sim(drone=airframe, dynamics=dynamics, control=level, controller=make_controller(name))
    except ConfigError:
        return False
    return True


def make_controller(name: str, speed: float = 2.0) -> Any:
    """Return the argument ``controller`` of ``Sim`` for the name of a controller."""
    if name == "tracking_lqr":
        path = figure_eight(2.0, 1.0, speed=speed, height=1.0)
        return TrackingLQR(jax.vmap(path.evaluate)(GAIN_INTERVAL * np.arange(60, dtype=np.float32)), dt=GAIN_INTERVAL)
    return name


def fly_airframes(
    name: str,
    airframes: list[Airframe],
    speed: float,
    n_attitudes: int,
    dynamics: str = "first_principles",
    device: str = "cpu",
) -> dict[str, dict[str, float]]:
    """Return the metrics of a controller by airframe. All fly at once: every world has one drone of each airframe."""
    n_worlds, n_drones = FIRST_TUMBLING_WORLD + n_attitudes, len(airframes)
    controller = make_controller(name, speed)
    sim = Sim(n_worlds, drone=airframes, dynamics=dynamics, control="state", controller=controller, device=device)
    path, states, params = figure_eight(2.0, 1.0, speed=speed, height=1.0), sim.data.states, sim.data.params
    start_setpoint, rng = path.evaluate(jnp.float32(0)), np.random.default_rng(0)

    pos, vel, quat, ang_vel = (np.array(x) for x in (states.pos, states.vel, states.quat, states.ang_vel))
    rotor_vel = np.array(np.broadcast_to(hover_rotor_states(params), states.rotor_vel.shape))
    pos[:], rotor_vel[TAKE_OFF_WORLD] = [0, 0, 1], 0
    pos[TAKE_OFF_WORLD, :, 2], pos[INVERTED_WORLD:, :, 2] = 0, START_HEIGHT
    pos[TRACKING_WORLD], vel[TRACKING_WORLD] = start_setpoint.pos, start_setpoint.vel
    quat[INVERTED_WORLD] = [np.sin(np.radians(89)), 0, 0, np.cos(np.radians(89))]
    quat[FIRST_TUMBLING_WORLD:], ang_vel[FIRST_TUMBLING_WORLD:] = (
        rng.normal(size=(n_attitudes, n_drones, 4)),
        rng.normal(size=(n_attitudes, n_drones, 3)),
    )
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    ang_vel[FIRST_TUMBLING_WORLD:] *= 5 / np.linalg.norm(ang_vel[FIRST_TUMBLING_WORLD:], axis=-1, keepdims=True)
    mass = np.array(np.broadcast_to(params.mass, (n_worlds, n_drones, 1)))
    force = np.zeros((n_worlds, n_drones, 3))
    force[PUSHED_WORLD, :, 0] = 0.1 * 9.81 * mass[PUSHED_WORLD, :, 0]
    mass[HEAVY_WORLD] *= 1.2

    as_data = lambda x: jnp.asarray(x, states.pos.dtype)  # noqa: E731
    states = states.replace(pos=as_data(pos), vel=as_data(vel), quat=as_data(quat), ang_vel=as_data(ang_vel))
    sim.data = sim.data.replace(
        states=states.replace(rotor_vel=as_data(rotor_vel)), params=params.replace(mass=as_data(mass))
    )
    target = np.array(np.broadcast_to([0, 0, 1.0], pos.shape))
    target[INVERTED_WORLD:, :, 2] = START_HEIGHT
    flown_pos, path_pos = fly_positions(sim, path, target, as_data(force))
    return {airframe.name: flight_metrics(flown_pos[:, :, k], path_pos, name) for k, airframe in enumerate(airframes)}


def step_response_metrics(
    name: str, airframes: list[Airframe], level: str, device: str = "cpu"
) -> dict[str, dict[str, float]]:
    """Return overshoot and error of a controller after steps of the command, by airframe."""
    normalized_responses = step_responses(name, airframes, level, device)
    overshoot = normalized_responses.max(axis=(0, 1)) - 1
    error = np.abs(normalized_responses[100:] - 1).max(axis=(0, 1))
    return {
        airframe.name: {f"overshoot_{level}": float(max(overshoot[k], 0)), f"error_{level}": float(error[k])}
        for k, airframe in enumerate(airframes)
    }


def step_responses(name: str, airframes: list[Airframe], level: str, device: str = "cpu") -> np.ndarray:
    """Return angles or body rates during the 3 s after a step of the command, divided by the size of the step.

    There is a sample every 0.02 s. (n_times, n_command_steps, n_airframes)
    """
    steps = COMMAND_STEPS[level]
    sim = Sim(len(steps), drone=airframes, control=level, controller=make_controller(name), device=device)
    states, params = sim.data.states, sim.data.params
    start_pos = jnp.broadcast_to(jnp.array([0, 0, START_HEIGHT], states.pos.dtype), states.pos.shape)
    sim.data = sim.data.replace(
        states=states.replace(
            pos=start_pos, rotor_vel=jnp.broadcast_to(hover_rotor_states(params), states.rotor_vel.shape)
        )
    )
    command = np.zeros((len(steps), len(airframes), 4), np.float32)
    command[..., 3] = [9.81 * airframe.value("rigid_body.mass") for airframe in airframes]
    for k, (axis, size) in enumerate(steps):
        command[k, :, axis] = size
    getattr(sim, f"{level}_control")(command)
    results = []
    for _ in range(150):
        sim.step(sim.freq // 50)
        states = sim.data.states
        quat = np.asarray(states.quat)
        angles = Rotation.from_quat(quat.reshape(-1, 4)).as_euler("xyz").reshape(*quat.shape[:2], 3)
        response = angles if level == "attitude" else np.asarray(states.ang_vel)
        results.append(np.stack([response[k, :, axis] / size for k, (axis, size) in enumerate(steps)]))
    return np.array(results)


def fly_positions(sim: Sim, path: Any, target: np.ndarray, force: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of all drones and the positions on the figure eight, m, after each step of 15 s of flight.

    (n_steps, n_worlds, n_drones, 3) and (n_steps, 3)
    """
    # A traced step leaves out terms of zero parameters only if it is told of them.
    step, takes_feedforward = (
        sim.build_step_fn().with_zeros_of(sim.data),
        sim.data.controls.state.staged_feedforward is not None,
    )
    command = np.zeros((*target.shape[:2], 16), np.float32)
    command[..., :3], command[..., 12] = target, 1

    def fly_step(data: Any, k: jax.Array) -> Any:
        setpoint = path.evaluate(k / sim.freq)
        feedforward = jnp.zeros((*target.shape[:2], 8)).at[TRACKING_WORLD].set(setpoint.feedforward())
        commands = jnp.asarray(command).at[TRACKING_WORLD].set(setpoint.command())
        data = F.state_control(data, commands, feedforward=feedforward if takes_feedforward else None)
        data = data.replace(states=data.states.replace(force=jnp.where(k < 2 * sim.freq, 0.0, force)))
        data = step(data, 1)
        return data, (data.states.pos, path.evaluate((k + 1) / sim.freq).pos)

    steps = jnp.arange(15 * sim.freq)
    _, (flown_pos, path_pos) = jax.jit(lambda data: jax.lax.scan(fly_step, data, steps))(sim.data)
    return np.asarray(flown_pos), np.asarray(path_pos)


def flight_metrics(pos: np.ndarray, path_pos: np.ndarray, name: str) -> dict[str, float]:
    """Return the metrics of one airframe from its positions. (n_steps, n_worlds, 3)"""
    freq, setpoint_pos = len(pos) // 15, np.array([0, 0, 1.0])
    distance = np.linalg.norm(pos - setpoint_pos, axis=-1)
    results = {
        "tracking": float(np.sqrt(np.mean(np.sum((pos[:, TRACKING_WORLD] - path_pos)[: 9 * freq] ** 2, axis=-1))))
    }
    if name == "tracking_lqr":
        return results
    return {
        "hover": float(distance[5 * freq, TAKE_OFF_WORLD]),
        **results,
        "pushed": float(distance[7 * freq, PUSHED_WORLD]),
        "pushed_largest": float(distance[:, PUSHED_WORLD].max()),
        "heavier": float(distance[5 * freq, HEAVY_WORLD]),
        "home": float(np.mean(np.linalg.norm(pos[-1, FIRST_TUMBLING_WORLD:] - [0, 0, START_HEIGHT], axis=-1) < 0.1)),
        "lost_178": float(START_HEIGHT - pos[:, INVERTED_WORLD, 2].min()),
    }


def report_cost(args: argparse.Namespace) -> None:
    """Print the step rates of many hovering worlds, measured alternately."""

    def compile_and_build_timer(sim: Sim) -> Any:
        def steps() -> Any:
            sim.step(100)
            return sim.data.states.pos

        seconds(steps)
        return lambda: seconds(steps)

    command = np.zeros((args.worlds, 1, 16), np.float32)
    command[..., 2], command[..., 12] = 1, 1
    sims = {}
    for name in args.controllers:
        sims[name] = Sim(args.worlds, control="state", controller=make_controller(name), device=args.device)
        sims[name].state_control(command)
    for name, duration in medians(
        {name: compile_and_build_timer(sim) for name, sim in sims.items()}, args.repeats
    ).items():
        rate, engine = args.worlds * 100 / duration, engine_name(sims[name])
        line = {"n_worlds": args.worlds, "engine": engine, "steps_per_s": round_digits(rate)}
        report(args.device, benchmark="controllers", controller=name, **line)


if __name__ == "__main__":
    main()
