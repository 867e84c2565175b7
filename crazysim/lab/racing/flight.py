"""Flights over a race track: their times, films, pages and plots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from crazysim.envs.env import Env
from crazysim.envs.race_clock import RaceClock, time_flight
from crazysim.envs.state import EnvState
from crazysim.envs.tasks.race import FOOT_TO_TOP
from crazysim.envs.tasks.race_rules import POLE_HEIGHT, race_of
from crazysim.envs.tracks import Track, gate_body, gates_of_track
from crazysim.errors import optional_import
from crazysim.lab.racing.time_optimal import Plan
from crazysim.media import Film, Flight, View, flight_of, web
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import draw_text
from crazysim.storage import write_figure
from crazysim.train.policies import act, initial_memory

SAMPLE_TIME = 0.01
"""Time between samples of a flight, s."""
CAMERA_DISTANCE = 1.1
"""Distance of the camera of films, as a multiple of the size of the track."""


@dataclass(frozen=True, eq=False)
class RaceFlight:
    """A flight of one drone over a track."""

    track: Track
    """The track."""
    drone: Any
    """Airframe."""
    time: NDArray
    """Times of the samples, s. (n,)"""
    pos: NDArray
    """Positions, world frame, m. (n, 3)"""
    quat: NDArray
    """Attitudes, body to world, xyzw. (n, 4)"""
    clock: RaceClock
    """The clock at the end."""
    reason: str = "the flight was over"
    """Why the flight ended, if not by the last gate."""
    penalty: NDArray | None = None
    """Sum of the penalties at the samples, s; None without. (n,)"""
    battery: NDArray | None = None
    """Voltage, V, and state of charge of a ``Battery`` at the samples; None without. (n, 2)"""


def flight_of_plan(plan: Plan, track: Track, laps: int = 1) -> RaceFlight:
    """Sample a plan, and time it."""
    n = max(int(np.ceil(plan.duration / SAMPLE_TIME)), 2)
    # The times of the plan are among the samples, so that no gate is missed between two of them.
    times = np.union1d(np.linspace(0.0, plan.duration, n + 1), plan.time)
    k = np.searchsorted(plan.time, times, side="right").clip(1, len(plan.time) - 1) - 1
    h = np.diff(plan.time)[k][:, None]
    u = (times - plan.time[k])[:, None] / h
    # Cubic Hermite polynomials of positions, and straight lines between attitudes, which are near each other.
    a, b, v, w = plan.pos[k], plan.pos[k + 1], h * plan.vel[k], h * plan.vel[k + 1]
    pos = a + u * v + u**2 * (3 * (b - a) - 2 * v - w) + u**3 * (2 * (a - b) + v + w)
    quat = (1 - u) * plan.quat[k] + u * plan.quat[k + 1]
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    return RaceFlight(track, plan.airframe, times, pos, quat, time_flight(track, times, pos, laps))


def flight_of_policy(env: Env, policy: Any, seed: int = 1) -> RaceFlight:
    """Fly one episode of the task ``race`` with a policy, until all gates are passed or it ends, and time it."""
    step = jax.jit(lambda state, memory: _policy_step(env, policy, state, memory))
    state, memory = jax.jit(env.reset)(jax.random.key(seed)), initial_memory(policy, env)
    states, records, batteries = [state.data.states], [race_of(state.data)], [state.data.plugins.get("battery")]
    while len(states) <= env.max_steps and not state.done[0]:
        state, memory = step(state, memory)
        states.append(state.data.states)
        records.append(race_of(state.data))
        batteries.append(state.data.plugins.get("battery"))
    times = np.arange(len(states)) / env.base.freq
    pos, quat = (np.array([getattr(s, name)[0, 0] for s in states], float) for name in ("pos", "quat"))
    task: Any = env.task
    clock, penalty = time_flight(task.course, times, pos, task.laps, task.penalty), None
    if task.penalty is not None:  # the task counts contacts, too
        penalty = np.array([record.penalty_sum[0, 0] for record in records])
        clock = clock.replace(penalty=penalty[-1])
    battery = None
    if "battery" in env.sim.data.plugins:
        battery = np.array([[float(x.voltage[0, 0, 0]), float(x.charge[0, 0, 0])] for x in batteries])
    if not np.all((pos[-1] >= task.course.low) & (pos[-1] <= task.course.high)):
        reason = "the drone left the arena"
    elif records[-1].failure[0, 0]:
        things = "a gate, an obstacle" if task.penalty is None else "an obstacle"
        reason = f"the drone touched {things} or the floor{task.other_failures}"
    else:
        reason = "the time of the episode was over"
    return RaceFlight(task.course, env.sim.airframes[0], times, pos, quat, clock, reason, penalty, battery)


def _policy_step(env: Env, policy: Any, state: EnvState, memory: Any) -> tuple[EnvState, Any]:
    action, memory = act(policy, state.obs, memory)
    return env.step(state, action), memory


def summary(flight: RaceFlight) -> str:
    """Describe laps, splits and penalties in a few lines."""
    clock, n = flight.clock, flight.track.n_gates
    laps = np.asarray(clock.lap_times(flight.track))
    splits = np.reshape(_split_texts(np.asarray(clock.times)), (-1, n))
    lines = []
    for k, (lap, row) in enumerate(zip(laps, splits, strict=True)):
        passed = int(np.clip(int(clock.passed) - k * n, 0, n))
        if not passed:
            break
        time = f"{lap:.3f} s" if passed == n else f"{passed} of {n} gates"
        lines.append(f"lap {k + 1}: {time}; from gate to gate " + " ".join(row[:passed]))
    if float(clock.penalty):
        lines.append(f"penalties: {float(clock.penalty):g} s")
    if flight.battery is not None:
        voltage, charge = flight.battery.T
        lines.append(f"battery: {voltage[0]:.1f} V at the start, at least {voltage.min():.1f} V, {charge[-1]:.1%} left")
    missed = f"gate {int(clock.passed) + 1} of {len(clock.times)} was not passed: {flight.reason}"
    end = f"all gates after {float(clock.time):.3f} s" if bool(clock.finished) else missed
    return "\n".join([*lines, f"{end}; the flight ends after {flight.time[-1]:.3f} s"])


def media_flight(flight: RaceFlight, dt: float = SAMPLE_TIME) -> tuple[Sim, Flight]:
    """Return a simulation of the track, and the flight in it that ``crazysim.media`` can play."""
    sim = track_simulation(flight.track, flight.drone)
    times = np.arange(0.0, flight.time[-1] + dt, dt).clip(max=flight.time[-1])
    pos, quat = (
        np.stack([np.interp(times, flight.time, x) for x in values.T], axis=-1) for values in (flight.pos, flight.quat)
    )
    states = SimpleNamespace(pos=pos[:, None, None], quat=quat[:, None, None])
    return sim, flight_of(sim, states, dt)


def track_simulation(track: Track, drone: Any) -> Sim:
    """Make a simulation of one drone with the gates of a track, each once, and its obstacles."""
    sim = Sim(drone=drone, control="rotor_vel")
    bodies = {}
    for gate in gates_of_track(track):
        bodies.setdefault((*gate.pos.tolist(), *gate.rot.ravel().tolist()), gate)
    for k, gate in enumerate(bodies.values()):
        yaw = np.arctan2(gate.rot[1, 0], gate.rot[0, 0])
        quat = [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]
        sim.scene.add(gate_body(gate), f"gate{k}", pos=gate.pos, quat=quat, mocap=False)
    if track.n_obstacles:
        feet = np.asarray(track.obstacles_pos, float) - FOOT_TO_TOP
        sim.scene.add("pole", count=track.n_obstacles, pos=feet, height=POLE_HEIGHT, mocap=False)
    return sim


def film(flight: RaceFlight, path: str | Path, fps: float = 25, progress: bool = False) -> int:
    """Film a flight with the clock of the race, and return the number of frames.

    Raises:
        ImportError: If imageio-ffmpeg is not installed.
        RenderError: If this machine cannot draw, or the file cannot be written.
    """
    sim, recorded = media_flight(flight)
    points = np.concatenate([flight.pos, np.asarray(flight.track.gates_pos)])
    low, high = points.min(axis=0), points.max(axis=0)
    distance = CAMERA_DISTANCE * float(np.linalg.norm(high - low))
    camera = {"lookat": (low + high) / 2, "distance": distance, "azimuth": 90, "elevation": -40}

    def draw(sim: Sim, world: int) -> None:
        draw_text(sim, clock_text_at(flight, float(sim.time[world, 0])))

    view = View(width=1280, height=720, cam_config=camera, trail=1.5, ring_width=25, draw=draw)
    with Film(path, view, fps=fps, progress=progress) as recording:
        return recording.play(sim, recorded)


def clock_text_at(flight: RaceFlight, now: float) -> str:
    """Return ``clock_text`` at a time of the flight, s."""
    sample = np.searchsorted(flight.time, now, side="right") - 1
    penalty = 0.0 if flight.penalty is None else float(flight.penalty[sample])
    return clock_text(flight.clock, flight.track, now, penalty)


def clock_text(clock: RaceClock, track: Track, now: float, penalty: float = 0.0) -> str:
    """Describe the clock of a race at a time, s: time and penalties, lap, gates and the last split."""
    times, n = np.asarray(clock.times), track.n_gates
    passed, laps = int(np.sum(times <= now)), len(times) // n
    shown = f"{min(now, times[-1]):6.2f} s" + (f" + {penalty:.3g} s" if penalty else "")
    lines = [shown, f"lap {min(passed // n + 1, laps)} of {laps}, gate {passed} of {len(times)}"]
    if passed:
        lines.append(f"last gate {times[passed - 1]:.2f} s, split {_split_texts(times)[passed - 1]} s")
    return "\n".join(lines)


def _split_texts(times: NDArray) -> list[str]:
    # Times from gate to gate, s. A missed gate has the time of the gate after it.
    with np.errstate(invalid="ignore"):  # gates that were not reached
        splits = np.diff(times, prepend=0.0)
    missed = np.append(splits[1:] == 0, False)
    return [
        "missed" if skip else f"{x or before:.2f}"
        for skip, x, before in zip(missed, splits, np.roll(splits, 1), strict=True)
    ]


def page(flight: RaceFlight) -> str:
    """Make an HTML page that plays a flight in a browser.

    Raises:
        ImportError: If viser is not installed.
    """
    return web.page(media_flight(flight)[1], caption=lambda now: clock_text_at(flight, now))


def plot(flight: RaceFlight, path: str | Path) -> None:
    """Draw the flight from above, coloured by speed, and height and speed over time with the gates.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    with optional_import("plots need", "matplotlib", "demo"):
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    speed = np.linalg.norm(np.gradient(flight.pos, flight.time, axis=0), axis=-1)
    figure, (above, height, fast) = plt.subplots(
        3, 1, figsize=(8, 11), height_ratios=(3, 1, 1), constrained_layout=True
    )
    dots = above.scatter(flight.pos[:, 0], flight.pos[:, 1], c=speed, s=6)
    figure.colorbar(dots, ax=above, label="speed, m/s")
    for number, gate in enumerate(gates_of_track(flight.track), start=1):
        above.annotate(str(number), gate.pos[:2], xytext=(4, 4 if number % 2 else -12), textcoords="offset points")
        if gate.is_ball:
            above.add_patch(plt.Circle((gate.pos[0], gate.pos[1]), float(gate.opening), fill=False))
            continue
        ends = [np.insert(np.asarray(gate.frame), 0, x * gate.length, axis=-1) @ gate.rot.T for x in (-0.5, 0.5)]
        rings = gate.pos[:2] + np.array(ends)[:, [*range(len(ends[0])), 0], :2]
        for line in (*rings, *rings.swapaxes(0, 1)):
            above.plot(*line.T, color="black")
    for k, marker, label in ((0, "^", "start"), (-1, "s", "end")):
        above.plot(*flight.pos[k, :2], marker, color="red", label=label)
    above.legend()
    above.set(xlabel="x, m", ylabel="y, m")
    above.set_aspect("equal", adjustable="datalim")
    passes = np.asarray(flight.clock.times)
    for axis, values, label in ((height, flight.pos[:, 2], "z, m"), (fast, speed, "speed, m/s")):
        axis.plot(flight.time, values)
        axis.plot(passes, np.interp(passes, flight.time, values), "k.", label="gates")
        axis.set(xlabel="time, s", ylabel=label)
        axis.grid(alpha=0.3)
    height.legend()
    write_figure(figure, path, dpi=110)
    plt.close(figure)
