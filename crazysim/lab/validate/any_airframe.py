"""Flights of policies for any airframe, RAPTOR and that of the task ``any``, with delayed commands.

RAPTOR (Eschmann, Albani and Loianno, arXiv 2509.11481; package ``foundation-policy``) commands rotor speeds from
position, rotation matrix, velocity, body rates and its previous action. A policy of the task ``any`` has the same
inputs and outputs.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.envs.spawn import random_attitude
from crazysim.errors import expect
from crazysim.lab.export import rl_tools
from crazysim.lab.export.rl_tools import MAX_DIFFERENCE, MAX_VELOCITY
from crazysim.lab.validate.rotor_simulators import (
    CRAZYFLOW_AIRFRAMES,
    N_STARTS,
    SIMULATORS,
    Drones,
    Quadrotors,
    built_in_airframes,
    drawn_airframes,
)
from crazysim.lab.validate.rows import Row
from crazysim.lab.validate.simulators import States
from crazysim.trajectories import figure_eight

ADVANCE_PERIOD = 1000 // rl_tools.RAPTOR_RATE
"""Time between two advances of the memory, ms."""
PERIODS = (ADVANCE_PERIOD, 2)
"""Times between two calls of the policy, ms: the first as in training, the second about as on flight controllers.

RAPTOR's authors' firmware calls it every 2.5 ms on PX4, 1 ms on the Crazyflie and 0.5 ms on Betaflight.
"""
FLIGHT_SECONDS = 10
"""Duration of a flight, s."""
DELAYS = (0, 3, 6, 10)
"""Delays of the commands, ms."""
HEIGHT = 10.0
"""Height of the goal above the floor, m."""
HELD_DISTANCE = 0.3
"""Distance from the goal below which a drone is held, m."""

PEERS = {"l2f": "l2f==2.0.18", "torchdiffeq": "rotorpy[batched]==3.0.0", "crazyflow": "crazyflow==0.4.0"}
"""Modules of simulators that may be missing, with the requirement for pip of each."""
SECTION_TEXT = f"""
RAPTOR (`foundation-policy`, unchanged) and the policy of `crazysim train any` command rotors, called every
{PERIODS[0]} ms, as in their training, or every {PERIODS[1]} ms, with a memory that advances every {PERIODS[0]} ms; the
firmware of RAPTOR's authors calls it every 0.5 to 2.5 ms. Position and velocity are limited to {MAX_DIFFERENCE} m and
{MAX_VELOCITY:g} m/s along each axis, as by PX4's `mc_raptor`, and actions to 1 before they are observed; without the
latter limit, as on PX4, RAPTOR's shares change by at most 5 points. Commands arrive 0 to {DELAYS[-1]} ms late, which is
added to the lag of the motors; RAPTOR was trained without this delay. The figure of *hold* and *recover* is the share
of drones that stay within {HELD_DISTANCE} m of their goal from {FLIGHT_SECONDS - 1} to {FLIGHT_SECONDS} s and never
touch the floor, {HEIGHT:g} m below the goal. Drones start at rest within 0.5 m along each axis, or at the goal with any
attitude and up to 3 m/s. The figure of the figure eights, 2 m by 1 m with this largest speed, is the median over all
drones of their mean distance from the goal.

The 256 quadrotors are drawn from the ranges of RAPTOR's training: 20 g to 5 kg, thrusts of 1.5 to 5 weights, time
constants of rising rotor speeds of 30 to 100 ms. Of the built-in airframes `cf2x_L250` and `cf2x_P250` (over 110 ms),
`crazyflie` (20 ms), `uzh_cpc` (2 ms) and `bumblebee` (10.1 weights) are outside of these ranges. The thousand are those
of `RandomAirframe`. Steps last 1 ms. The simulators differ:

- crazysim and l2f: methods of Runge-Kutta of order 4. The shares of drones held agree within 2 points.
- C MuJoCo: no drag; thrusts, in place of speeds, lag by the mean of the time constants of rising and falling speeds.
- RotorPy: speeds lag by this mean; the drag, and the lift of forward flight, of its brushless Crazyflie.
- Crazyflow: its own four airframes, as they are.
""".strip()
"""Paragraphs of the section: method and differences of the simulators."""


class Network(NamedTuple):
    """Recurrent network of RAPTOR's inputs and outputs, for a batch of drones."""

    step: Callable[[Any, Any], tuple[Array, Any]]
    """Function from observations, (n, 22), and memory to actions, (n, 4), and the memory after the step."""
    initial_memory: Callable[[int], Any]
    """Function from the number of drones to the memory at the start."""


@functools.cache
def load_network(source: Path | None) -> Network:
    """Load the network of a policy.

    Args:
        source: Checkpoint of rl-tools, ``.tar``, weights of the package, or folder of a run of the task ``any``; None
            for RAPTOR.
    """
    weights = foundation_weights() if source is None else rl_tools.find_weights(source)
    if weights is not None:
        memory = weights["1/initial_hidden_state"]
        return Network(
            jax.jit(partial(rl_tools.evaluate_step, weights)), lambda n: np.broadcast_to(memory, (n, *memory.shape))
        )
    from crazysim.train import load_policy  # only here: it needs packages of the extra train

    policy, _, meta = load_policy(str(source))
    expect(meta["freq"] == rl_tools.RAPTOR_RATE, f"a policy at {rl_tools.RAPTOR_RATE} Hz", meta["freq"])

    def step(observation: Array, memory: Any) -> tuple[Array, Any]:
        sizes = rl_tools.OBSERVATION_SIZES
        parts = jnp.split(observation, np.cumsum(list(sizes.values()))[:-1], axis=-1)
        return policy.act(dict(zip(sizes, parts, strict=True)), memory)

    return Network(jax.jit(step), policy.initial_memory)


def foundation_weights() -> dict[str, NDArray]:
    """Read RAPTOR's weights from its package, named as in ``rl_tools.SHAPES``."""
    layers = importlib.import_module("foundation_policy").Raptor().layers
    keys = {name: name.split("/") for name in rl_tools.SHAPES}
    return {name: getattr(layers[int(layer)], array) for name, (layer, array) in keys.items()}


class RecurrentPolicy:
    """A policy for a batch of drones, called in the same way as by the firmware of RAPTOR's authors.

    Its memory advances every 10 ms, as in training; calls in between leave the memory unchanged. The previous action
    that the policy observes is the mean since the last advance (rl-tools, ``inference/executor`` and
    ``inference/applications/l2f``). Position and velocity are limited as by PX4's ``mc_raptor``.

    Args:
        network: Its network.
        period: Time between two calls, ms.
        action: Action before the first call, from -1 to 1. (n, 4)
    """

    def __init__(self, network: Network, period: int, action: NDArray) -> None:
        self._step, self._memory = network.step, network.initial_memory(len(action))
        self._calls_per_advance, self._n_calls = ADVANCE_PERIOD // period, 0
        self._mean_action = self._action = action

    def action(self, state: NDArray) -> NDArray:
        """Return the commanded speeds from -1, the least, to 1, the largest. (n, 4)

        Args:
            state: Position from the goal, m, rotation matrix, row by row, velocity from that of the goal, m/s, and
                angular velocity, body frame, rad/s. (n, 18)
        """
        weight = (self._n_calls - 1) % self._calls_per_advance
        self._mean_action = (weight * self._mean_action + self._action) / (weight + 1)
        limits = np.repeat([MAX_DIFFERENCE, np.inf, MAX_VELOCITY, np.inf], [3, 9, 3, 3])
        observation = np.concatenate([np.clip(state, -limits, limits), self._mean_action], axis=-1)
        action, memory = self._step(observation.astype(np.float32), self._memory)
        self._action = np.clip(np.asarray(action, np.float64), -1, 1)
        if self._n_calls % self._calls_per_advance == 0:
            self._memory = memory
        self._n_calls += 1
        return self._action


class Manoeuvre(NamedTuple):
    """A flight to a goal."""

    start: Callable[[int], States]
    """Function from the number of drones to their states at the start."""
    goal: Callable[[float], tuple[NDArray, NDArray]]
    """Function from the time, s, to position, m, and velocity, m/s, of the goal."""


GOAL = np.array([0, 0, HEIGHT]), np.zeros(3)
"""Position and velocity of a goal at rest."""


def _start_near(n: int) -> States:
    pos = GOAL[0] + np.random.default_rng(0).uniform(-0.5, 0.5, (n, 3))
    return {"pos": pos, "quat": np.tile([0.0, 0, 0, 1], (n, 1)), "vel": np.zeros((n, 3)), "ang_vel": np.zeros((n, 3))}


def _start_thrown(n: int) -> States:
    draw = np.random.default_rng(1)
    direction = draw.normal(size=(n, 3))
    vel = draw.uniform(0, 3, (n, 1)) * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    quat = np.asarray(random_attitude(jnp.asarray(draw.uniform(size=(n, 3)))), np.float64)
    return _start_near(n) | {"pos": np.tile(GOAL[0], (n, 1)), "quat": quat, "vel": vel}


def _figure_eight(speed: float) -> Manoeuvre:
    trajectory = figure_eight(2.0, 1.0, speed=speed, height=HEIGHT)

    def goal(time: float) -> tuple[NDArray, NDArray]:
        setpoint = trajectory.evaluate(time)
        return np.asarray(setpoint.pos, np.float64), np.asarray(setpoint.vel, np.float64)

    def start(n: int) -> States:
        pos, vel = (np.tile(x, (n, 1)) for x in goal(0.0))
        return _start_near(n) | {"pos": pos, "vel": vel}

    return Manoeuvre(start, goal)


MANOEUVRES = {
    "hold": Manoeuvre(_start_near, lambda _: GOAL),
    "recover": Manoeuvre(_start_thrown, lambda _: GOAL),
    "figure eight, 1 m/s": _figure_eight(1.0),
    "figure eight, 2 m/s": _figure_eight(2.0),
}
"""Manoeuvres by name."""


class Flight(NamedTuple):
    """Outcome of the flight of each drone."""

    held: NDArray
    """Whether it stays near its goal in the last second, and never touches the floor. (n,)"""
    error: NDArray
    """Mean distance from its goal, m. (n,)"""


def fly(network: Network, drones: Drones, goal: Any, delay: NDArray, period: int) -> Flight:
    """Fly drones by a policy whose commands are late.

    Args:
        goal: See ``Manoeuvre``.
        delay: Delays of the commands, ms. (n,)
        period: Time between two calls of the policy, ms.
    """
    policy = RecurrentPolicy(network, period, drones.hover_action)
    n, n_calls = len(delay), 1000 * FLIGHT_SECONDS // period
    commands = np.repeat(drones.hover_action[None], max(DELAYS) + 1, axis=0)  # of the last milliseconds, newest first
    sum_of_distances, last_distance, lowest = np.zeros(n), np.zeros(n), np.full(n, np.inf)
    for call in range(n_calls):
        state, (pos, vel) = drones.observe(), goal(call * period / 1000)
        lowest = np.minimum(lowest, state[:, 2])
        state[:, :3] -= pos
        state[:, 12:15] -= vel
        distance = np.linalg.norm(state[:, :3], axis=-1)
        sum_of_distances += distance
        if call >= n_calls * (1 - 1 / FLIGHT_SECONDS):
            last_distance = np.maximum(last_distance, distance)
        # Speeds that decay to zero would become subnormal numbers, which take processors a hundred times longer.
        action = np.maximum(policy.action(state), -0.9999)
        for _ in range(period):
            commands = np.concatenate([action[None], commands[:-1]])
            drones.step(commands[delay, np.arange(n)])
    return Flight((last_distance < HELD_DISTANCE) & (lowest > 0), sum_of_distances / n_calls)  # false for NaN


FLEETS: dict[str, Callable[[], Any]] = {
    "256 quadrotors of RAPTOR's training": Quadrotors.sample,
    f"built-in airframes, {N_STARTS} starts each": built_in_airframes,
    "1,000 drawn airframes": drawn_airframes,
    f"airframes of Crazyflow, {N_STARTS} starts each": lambda: np.repeat(CRAZYFLOW_AIRFRAMES, N_STARTS),
}
"""Functions that return airframes, by what they are called."""
TRAINING, BUILT_IN, DRAWN, CRAZYFLOWS = FLEETS
FLIGHTS = (
    ("crazysim", TRAINING), ("l2f", TRAINING), ("C MuJoCo", TRAINING), ("crazysim", BUILT_IN),
    ("Crazyflow", CRAZYFLOWS),
    ("RotorPy", TRAINING),  # after Crazyflow, which refuses to be imported after SciPy
    ("crazysim", DRAWN),
)  # fmt: skip
"""Simulators and the airframes that they fly."""


@functools.cache
def fly_fleet(
    source: Path | None, simulator: str, fleet: str, manoeuvre: str, period: int, delays: Sequence[int]
) -> Flight:
    """Fly airframes at several delays. (n_delays, n) each

    Args:
        source: See ``load_network``.
        delays: Delays of the commands, ms.
    """
    airframes, flight = FLEETS[fleet](), MANOEUVRES[manoeuvre]
    n, n_delays = len(jax.tree.leaves(airframes)[0]), len(delays)
    airframes, start = (
        jax.tree.map(lambda x: np.tile(x, (n_delays, *[1] * (np.ndim(x) - 1))), tree)
        for tree in (airframes, flight.start(n))
    )
    drones = SIMULATORS[simulator](airframes, start)
    result = fly(load_network(source), drones, flight.goal, np.repeat(delays, n), period)
    return Flight(*(x.reshape(n_delays, n) for x in result))


def compare(policy: str, source: Path | None, simulator: str, fleet: str, period: int) -> Iterable[Row]:
    """Yield how a policy flies airframes in one simulator, or nothing if the simulator is not installed.

    Args:
        policy: Name of the policy.
        source: See ``load_network``.
    """
    module, where = SIMULATORS[simulator].module, f"{fleet}, in {simulator}; every {period} ms"
    if module and importlib.util.find_spec(module) is None:
        return
    for manoeuvre in ("hold", "recover"):
        shares = 100 * fly_fleet(source, simulator, fleet, manoeuvre, period, DELAYS).held.mean(axis=1)
        bounds = [None] * len(DELAYS)
        if simulator == "l2f" and manoeuvre == "hold":
            own = 100 * fly_fleet(source, "crazysim", fleet, manoeuvre, period, DELAYS).held.mean(axis=1)
            bounds = [
                (float(share) - 2, float(share) + 2) for share in own
            ]  # rounding decides at the edge of stability: 5 of 256
        for delay, share, bound in zip(DELAYS, shares, bounds, strict=True):
            yield Row(f"{manoeuvre}; {where}; {delay} ms late", policy, float(share), "%", bound)
    for manoeuvre in list(MANOEUVRES)[2:] if simulator == "crazysim" else ():
        error = fly_fleet(source, simulator, fleet, manoeuvre, period, (0,)).error
        remark = f"below 1 m for {100 * np.mean(error < 1):.3g} %"
        yield Row(f"{manoeuvre}; {where}; 0 ms late", policy, float(np.median(error)), "m", None, remark)


def checks(policy: Path | None) -> Sequence[Callable[[], Iterable[Row]]]:
    """Return the comparisons of RAPTOR and of another policy in all simulators.

    Args:
        policy: See ``load_network``; None for the policy of the package.
    """
    policies = {"RAPTOR": None, "any": policy or rl_tools.SHIPPED_FILE}
    return [
        partial(compare, name, source, simulator, fleet, period)
        for simulator, fleet in FLIGHTS
        for period in PERIODS[: 2 if simulator in ("crazysim", "l2f") else 1]
        for name, source in policies.items()
    ]
