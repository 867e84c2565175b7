"""Record a simulation, and put one where a recorded flight was."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.media.flight import Flight
from crazysim.scene.visual_geoms import shapes_of
from crazysim.sim.sim import Sim


class Clock:
    """Time that has passed in a world; a reset does not turn it back."""

    def __init__(self) -> None:
        """Begin at 0."""
        self.elapsed = 0.0
        self._last: float | None = None

    def at(self, time: float) -> float:
        """Return the time that has passed since the first call, when the world's own time is ``time``, s."""
        if self._last is not None:
            self.elapsed += time - self._last if time >= self._last else time
        self._last = time
        return self.elapsed


class Recorder:
    """Takes down where everything is, moment by moment.

    recorder = Recorder(sim, worlds=[0, 1])
    for _ in range(100):
        sim.step(10)
        recorder.add()
    recorder.flight().save("flight.npz")
    """

    def __init__(self, sim: Sim, worlds: Sequence[int] | None = None):
        """Take down what is seen of a simulation; the first moment comes with ``add``.

        Args:
            sim: The simulation.
            worlds: Which worlds; None for all.

        Raises:
            ConfigError: If a world does not exist.
        """
        self._sim = sim
        self._worlds = _worlds(sim, worlds)
        self._scene = _scene(sim, self._worlds)
        self._clock = Clock()
        self._moments: list[dict[str, Any]] = []

    def __len__(self) -> int:
        """Return how many moments there are."""
        return len(self._moments)

    def add(self) -> None:
        """Take down this moment; one at the time of the last replaces it."""
        sim, worlds = self._sim, np.array(self._worlds)
        time = self._clock.at(float(sim.time[self._worlds[0], 0]))
        if self._moments and self._moments[-1]["time"] == time:
            self._moments.pop()
        states, state = sim.data.states, sim.data.controls.state
        body_pos, body_quat = _bodies(sim, self._worlds)
        self._moments.append(
            {
                "time": time,
                "pos": np.asarray(states.pos[worlds], float),
                "quat": np.asarray(states.quat[worlds], float),
                "body_pos": body_pos,
                "body_quat": body_quat,
                "setpoint": np.zeros((len(worlds), 0, 3))
                if state is None
                else np.asarray(state.staged_cmd[worlds, :, :3], float),
            }
        )

    def flight(self) -> Flight:
        """Return what was taken down so far.

        Raises:
            ConfigError: If that is nothing.
        """
        if not self._moments:
            raise ConfigError("nothing was recorded; call recorder.add() between steps")
        return Flight(**{name: np.stack([m[name] for m in self._moments]) for name in self._moments[0]}, **self._scene)


def flight_of(sim: Sim, states: Any, dt: float, worlds: Sequence[int] | None = None) -> Flight:
    """Return the flight of states that ``sim.rollout`` has kept.

    Args:
        sim: The simulation that was flown; other bodies are taken to stand where they stand now.
        states: With ``pos`` (n, n_worlds, n_drones, 3) and ``quat`` (n, n_worlds, n_drones, 4).
        dt: Time from one to the next, s.
        worlds: Which worlds are taken; None for all.

    Raises:
        ConfigError: If the states are not this simulation's, or a world does not exist.
    """
    chosen, needed = _worlds(sim, worlds), (sim.n_worlds, sim.n_drones)
    if np.shape(states.pos)[1:] != (*needed, 3) or np.shape(states.quat) != (len(states.pos), *needed, 4):
        raise ConfigError(
            f"states have positions {np.shape(states.pos)} and quaternions {np.shape(states.quat)}; needed is time in "
            f"front of {(*needed, 3)} and {(*needed, 4)}, as sim.rollout keeps them"
        )
    if not np.isfinite(dt) or dt <= 0:
        raise ConfigError(f"dt is {dt!r} s; it must be positive")
    n = len(states.pos)
    if not n:
        raise ConfigError("states have no moment")
    body_pos, body_quat = _bodies(sim, chosen)
    return Flight(
        time=dt * np.arange(n),
        pos=np.asarray(states.pos[:, np.array(chosen)], float),
        quat=np.asarray(states.quat[:, np.array(chosen)], float),
        body_pos=np.broadcast_to(body_pos, (n, *body_pos.shape)),
        body_quat=np.broadcast_to(body_quat, (n, *body_quat.shape)),
        setpoint=np.zeros((n, len(chosen), 0, 3)),
        **_scene(sim, chosen),
    )


def put(sim: Sim, flight: Flight, time: float) -> None:
    """Put a simulation where a flight was at a time: poses, setpoints and clock, to be drawn.

    Velocities and controllers stay as they are: who flies on keeps ``data = sim.data`` and puts it back.

    Args:
        sim: A simulation like the one that was recorded.
        flight: The flight.
        time: Time of the flight, s.

    Raises:
        ConfigError: If the simulation has other drones, worlds or bodies than the one that was recorded.
    """
    worlds = flight.worlds
    _worlds(sim, worlds.tolist())
    here, there = (sim.n_drones, sim.mj_model.nmocap - sim.n_drones), (flight.n_drones, len(flight.body_ids))
    if here != there:
        raise ConfigError(
            f"the flight has {there[0]} drones and {there[1]} other mocap bodies; the simulation has {here[0]} and "
            f"{here[1]}"
        )
    now, data = flight.at(time), sim.data
    states = data.states.replace(
        pos=data.states.pos.at[worlds].set(now["pos"]), quat=data.states.quat.at[worlds].set(now["quat"])
    )
    core = data.core.replace(steps=data.core.steps.at[worlds].set(round(time * sim.freq)))
    controls, objects = data.controls, data.objects
    if controls.state is not None and now["setpoint"].size:
        wanted = controls.state.staged_cmd.at[worlds, :, :3].set(now["setpoint"])
        controls = controls.replace(state=controls.state.replace(staged_cmd=wanted))
    if objects is not None:
        which = np.searchsorted(flight.body_ids, np.asarray(objects.mocap_ids))
        objects = objects.replace(
            pos=objects.pos.at[worlds, 0].set(now["body_pos"][:, which]),
            quat=objects.quat.at[worlds, 0].set(now["body_quat"][:, which]),
        )
    sim.data = data.replace(states=states, core=core, controls=controls, objects=objects)
    body_pos, body_quat = _bodies(sim, worlds.tolist())
    if not (np.allclose(body_pos, now["body_pos"], atol=1e-6) and np.allclose(body_quat, now["body_quat"], atol=1e-6)):
        ids = np.ix_(worlds, _body_ids(sim))  # bodies that were attached by hand, whose poses the scene has
        sim.mjx_data = sim.mjx_data.replace(
            mocap_pos=sim.mjx_data.mocap_pos.at[ids].set(now["body_pos"]),
            mocap_quat=sim.mjx_data.mocap_quat.at[ids].set(np.roll(now["body_quat"], 1, axis=-1)),
        )


def _worlds(sim: Sim, worlds: Sequence[int] | None) -> list[int]:
    chosen = list(range(sim.n_worlds) if worlds is None else worlds)
    if not chosen:
        raise ConfigError("a recording has at least one world; worlds is empty")
    for world in chosen:
        if world not in range(sim.n_worlds):
            raise ConfigError(f"world {world!r} does not exist; worlds go from 0 to {sim.n_worlds - 1}")
    return chosen


def _body_ids(sim: Sim) -> NDArray:
    """Return the mocap ids of the bodies that are no drones."""
    return np.setdiff1d(np.arange(sim.mj_model.nmocap), np.asarray(sim.data.core.drone_mocap_ids))


def _scene(sim: Sim, worlds: list[int]) -> dict[str, Any]:
    """Return what a flight has that does not change."""
    ids = _body_ids(sim)
    sim.sync(worlds[0])
    return {
        "worlds": np.array(worlds),
        "drone_ids": np.asarray(sim.data.core.drone_mocap_ids),
        "body_ids": ids,
        "shapes": shapes_of(sim.mj_model, sim.mj_data),
    }


def _bodies(sim: Sim, worlds: list[int]) -> tuple[NDArray, NDArray]:
    """Return where the bodies that are no drones are in each world. (n_worlds, n_bodies, 3) and (..., 4), xyzw"""
    ids = _body_ids(sim)
    pos, quat = np.zeros((len(worlds), len(ids), 3)), np.zeros((len(worlds), len(ids), 4))
    for k, world in enumerate(worlds if len(ids) else []):
        sim.sync(world)
        pos[k], quat[k] = sim.mj_data.mocap_pos[ids], np.roll(sim.mj_data.mocap_quat[ids], -1, axis=-1)
    return pos, quat
