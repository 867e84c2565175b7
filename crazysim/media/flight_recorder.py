"""Recording of a simulation, and replay of a recorded flight in a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.arguments import check_arguments
from crazysim.core.functional import default_feedforward, stage_command, staged_leaves
from crazysim.eager import fetch_rows
from crazysim.errors import ConfigError, expect, require
from crazysim.media.flight import SAMPLE_CHUNK, SAMPLE_FIELDS, SCENE_CHUNK, Flight, pack_scene, sample_dtype
from crazysim.media.journal import Journal
from crazysim.media.worlds import world_indices
from crazysim.scene.visual_geoms import visual_geoms
from crazysim.sim.sim import Sim


class Clock:
    """Time since the start of a recording, which resets of the world do not set back."""

    def __init__(self) -> None:
        self.elapsed = 0.0
        self._last_time: float | None = None

    def elapsed_at(self, time: float) -> float:
        """Return the time since the first call, s, given the world's time since its last reset, s."""
        if self._last_time is not None:
            self.elapsed += time - self._last_time if time >= self._last_time else time
        self._last_time = time
        return self.elapsed


class Recorder:
    """Recorder of poses, in memory or in a file.

        recorder = Recorder(sim, worlds=[0, 1])
        for _ in range(100):
            sim.step(10)
            recorder.add()
        recorder.flight().save("flight.journal")

    With a path, each sample is appended to that file as it is added, and no sample stays in memory. If the process
    crashes, ``Flight.load`` returns the flight up to the last sample.
    """

    @check_arguments
    def __init__(self, sim: Sim, worlds: Sequence[int] | None = None, path: str | Path | None = None):
        self._sim = sim
        self._worlds = world_indices(sim, worlds)
        self._constants = _constant_fields(sim, self._worlds)
        n_worlds, n_bodies = len(self._worlds), len(self._constants["body_ids"])
        n_setpoints = 0 if sim.data.controls.state is None else sim.n_drones
        drones, bodies = (n_worlds, sim.n_drones), (n_worlds, n_bodies)
        self._dtype = sample_dtype(
            (), (*drones, 3), (*drones, 4), (*bodies, 3), (*bodies, 4), (n_worlds, n_setpoints, 3)
        )
        self._clock = Clock()
        self._samples: list[NDArray] = []
        self._n_samples, self._last_time = 0, -np.inf
        self._journal = None if path is None else Journal(path)
        if self._journal is not None:
            self._journal.append(SCENE_CHUNK, pack_scene(self._constants, np.zeros(0, self._dtype)))

    def __len__(self) -> int:
        return self._n_samples

    def add(self, time: float | None = None) -> None:
        """Record the present poses; a second sample at the same time is left out.

        Args:
            time: Time since the start of the recording, s; None for the time of the first recorded
                world, which resets of the world do not set back.

        Raises:
            OSError: If the file cannot be written.
        """
        sim, worlds = self._sim, self._worlds
        if time is None:
            time = self._clock.elapsed_at(float(sim.time[self._worlds[0], 0]))
        if self._last_time == time:
            return
        states, state = sim.data.states, sim.data.controls.state
        sample = np.zeros((), self._dtype)
        sample["time"] = time
        sample["pos"], sample["quat"] = (np.asarray(x, float)[worlds] for x in (states.pos, states.quat))
        sample["body_pos"], sample["body_quat"] = _body_poses(sim, worlds)
        if state is not None:
            sample["setpoint"] = np.asarray(state.staged_cmd, float)[worlds, :, :3]
        if self._journal is None:
            self._samples.append(sample)
        else:
            self._journal.append(SAMPLE_CHUNK, sample.tobytes())
        self._n_samples, self._last_time = self._n_samples + 1, time

    def flight(self) -> Flight:
        """Return the flight up to the last sample."""
        require(self._n_samples, "expected at least one sample, got none. Call recorder.add() between steps.")
        if self._journal is not None:
            return Flight.load(self._journal.path)
        samples = np.stack(self._samples)
        return Flight(**{name: samples[name] for name in SAMPLE_FIELDS}, **self._constants)

    def close(self) -> None:
        """Close the file, if there is one; samples in memory stay."""
        if self._journal is not None:
            self._journal.close()


@check_arguments
def flight_of(sim: Sim, states: Any, dt: float, worlds: Sequence[int] | None = None) -> Flight:
    """Make the flight of states that ``sim.rollout`` returned.

    Args:
        sim: Simulation of the rollout; other bodies are recorded at their present poses.
        states: Record with ``pos`` (n, n_worlds, n_drones, 3) and ``quat`` (n, n_worlds, n_drones, 4).
        dt: Time between two states, s.
        worlds: Indices of the worlds to record; None for all.
    """
    indices, sizes = world_indices(sim, worlds), (sim.n_worlds, sim.n_drones)
    expect(hasattr(states, "pos") and hasattr(states, "quat"), "states as sim.rollout returns them", states)
    require(
        np.shape(states.pos)[1:] == (*sizes, 3) and np.shape(states.quat) == (len(states.pos), *sizes, 4),
        f"expected positions of shape (n, *{(*sizes, 3)}) and quaternions of shape (n, *{(*sizes, 4)}), as "
        f"sim.rollout returns them, got {np.shape(states.pos)} and {np.shape(states.quat)}",
    )
    require(np.isfinite(dt) and dt > 0, f"expected a positive dt, s, got {dt!r}")
    n = len(states.pos)
    require(n, "expected at least one state, got none")
    body_pos, body_quat = _body_poses(sim, indices)
    return Flight(
        time=dt * np.arange(n),
        pos=np.asarray(fetch_rows(states.pos, (slice(None), indices)), float),
        quat=np.asarray(fetch_rows(states.quat, (slice(None), indices)), float),
        body_pos=np.broadcast_to(body_pos, (n, *body_pos.shape)),
        body_quat=np.broadcast_to(body_quat, (n, *body_quat.shape)),
        setpoint=np.zeros((n, len(indices), 0, 3)),
        **_constant_fields(sim, indices),
    )


def show_flight_at(sim: Sim, flight: Flight, time: float) -> None:
    """Set poses, setpoints and clock of a simulation to a moment of a flight, to draw it.

    Bodies are drawn as they were recorded, including those that plugins move, such as loads. Velocities, controllers
    and records of plugins are unchanged. To continue a simulation, keep ``data = sim.data`` and restore it.

    Args:
        sim: Simulation with the drones, worlds and bodies of the recorded simulation.
        time: Time of the flight, s.
    """
    worlds = flight.worlds
    world_indices(sim, worlds.tolist())
    counts, recorded_counts = (
        (sim.n_drones, sim.mj_model.nmocap - sim.n_drones),
        (flight.n_drones, len(flight.body_ids)),
    )
    if counts != recorded_counts:
        raise ConfigError(
            f"expected a simulation of {recorded_counts[0]} drones and {recorded_counts[1]} other mocap bodies, as the "
            f"flight has, got {counts[0]} and {counts[1]}"
        )
    poses, data = flight.at(time), sim.data
    controls, objects = data.controls, data.objects
    old_values = {"pos": data.states.pos, "quat": data.states.quat, "steps": data.core.steps}
    new_values = {
        "pos": poses["pos"],
        "quat": poses["quat"],
        "steps": np.full((len(worlds), 1), round(time * sim.freq), np.int32),
    }
    if controls.state is not None and poses["setpoint"].size:
        old_values["setpoint"], new_values["setpoint"] = staged_leaves(data)[0], poses["setpoint"]
    if objects is not None:
        columns = np.searchsorted(flight.body_ids, np.asarray(objects.mocap_ids))
        old_values |= {"body_pos": objects.pos, "body_quat": objects.quat}
        new_values |= {name: poses[name][:, None, columns] for name in ("body_pos", "body_quat")}
        if objects.map_index is not None:  # the others are far below
            heights = poses["body_pos"][:, np.searchsorted(flight.body_ids, np.asarray(objects.map_ids)), 2]
            old_values["map_index"], new_values["map_index"] = objects.map_index, np.argmax(heights, axis=1)[:, None]
    updated_values = _replace_in_worlds(old_values, worlds, new_values)
    states = data.states.replace(pos=updated_values["pos"], quat=updated_values["quat"])
    core = data.core.replace(steps=updated_values["steps"])
    if objects is not None:
        recorded = any(plugin.moves_objects for plugin in sim.plugins.values())
        objects = objects.replace(pos=updated_values["body_pos"], quat=updated_values["body_quat"], recorded=recorded)
        objects = objects.replace(map_index=updated_values.get("map_index"))
    data = data.replace(states=states, core=core, objects=objects)
    if "setpoint" in updated_values:
        command, (_, *feedforward_leaves) = updated_values["setpoint"], staged_leaves(data)
        # Other worlds keep their feedforward.
        feedforward = [x.at[worlds].set(default_feedforward(command)[worlds]) for x in feedforward_leaves]
        data = stage_command(data, command, *feedforward)
    sim.data = data
    body_pos, body_quat = _body_poses(sim, worlds)
    if not (
        np.allclose(body_pos, poses["body_pos"], atol=1e-6) and np.allclose(body_quat, poses["body_quat"], atol=1e-6)
    ):
        ids = np.ix_(worlds, _body_ids(sim))  # some bodies were moved through mjx_data
        sim.mjx_data = sim.mjx_data.replace(
            mocap_pos=sim.mjx_data.mocap_pos.at[ids].set(poses["body_pos"]),
            mocap_quat=sim.mjx_data.mocap_quat.at[ids].set(np.roll(poses["body_quat"], 1, axis=-1)),
        )


@jax.jit
def _replace_in_worlds(old: dict[str, Array], worlds: Array, new: dict[str, Array]) -> dict[str, Array]:
    return {name: x.at[worlds, ..., : new[name].shape[-1]].set(new[name]) for name, x in old.items()}


def _body_ids(sim: Sim) -> NDArray:
    return np.setdiff1d(np.arange(sim.mj_model.nmocap), np.asarray(sim.data.core.drone_mocap_ids))


def _constant_fields(sim: Sim, worlds: NDArray) -> dict[str, Any]:
    ids = _body_ids(sim)
    sim.scene.sync_one(sim.plugins.with_moved_objects(sim.data), worlds[0])
    return {
        "worlds": worlds,
        "drone_ids": np.asarray(sim.data.core.drone_mocap_ids),
        "body_ids": ids,
        "shapes": visual_geoms(sim.mj_model, sim.mj_data),
    }


def _body_poses(sim: Sim, worlds: NDArray) -> tuple[NDArray, NDArray]:
    ids = _body_ids(sim)
    pos, quat = sim.scene.host_poses(sim.plugins.with_moved_objects(sim.data), worlds)
    return pos[:, ids], quat[:, ids]
