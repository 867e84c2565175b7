"""Recorded flights: poses of drones and bodies over time, in one file."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.arguments import check_arguments
from crazysim.errors import ConfigError, require
from crazysim.media.journal import MAGIC, pack_chunk, read_journal
from crazysim.scene.visual_geoms import GEOM_KINDS, VisualGeom
from crazysim.storage import read_arrays, wrap_read_errors, write_file


@dataclass(frozen=True, eq=False)
class Flight:
    """Poses in some worlds over time, and the geoms to draw."""

    time: NDArray
    """Times, s; the first is 0, unless ``Recorder.add`` was called with other times. (n,)"""
    pos: NDArray
    """Positions of the drones, world frame, m. (n, n_worlds, n_drones, 3)"""
    quat: NDArray
    """Attitudes of the drones, body to world, xyzw. (n, n_worlds, n_drones, 4)"""
    body_pos: NDArray
    """Positions of the other mocap bodies, m. (n, n_worlds, n_bodies, 3)"""
    body_quat: NDArray
    """Attitudes of the other mocap bodies, xyzw. (n, n_worlds, n_bodies, 4)"""
    setpoint: NDArray
    """Positions of state commands, world frame, m; empty for other commands. (n, n_worlds, n_drones or 0, 3)"""
    worlds: NDArray
    """Indices of the worlds in the simulation. (n_worlds,)"""
    drone_ids: NDArray
    """Mocap id of each drone. (n_drones,)"""
    body_ids: NDArray
    """Mocap id of each other mocap body. (n_bodies,)"""
    shapes: Sequence[VisualGeom]
    """Visible geoms as they were when the recording began."""

    @property
    def n_drones(self) -> int:
        """Number of drones in each world."""
        return self.pos.shape[2]

    def index(self, world: int) -> int:
        """Return the index within ``worlds`` of a world of the simulation."""
        indices = np.flatnonzero(self.worlds == world)
        if not len(indices):
            raise ConfigError(f"expected a recorded world, one of {self.worlds.tolist()}, got {world!r}")
        return int(indices[0])

    def at(self, time: float) -> dict[str, NDArray]:
        """Interpolate pos, quat, body_pos, body_quat and setpoint at a time.

        Args:
            time: Time, s; clipped to the flight.
        """
        after = int(np.clip(np.searchsorted(self.time, time, side="right"), 1, max(len(self.time) - 1, 1)))
        before, after = after - 1, min(after, len(self.time) - 1)
        span = self.time[after] - self.time[before]
        weight = float(np.clip((time - self.time[before]) / span, 0, 1)) if span > 0 else 0.0

        def interpolate(values: NDArray) -> NDArray:
            return (1 - weight) * values[before] + weight * values[after]

        def interpolate_attitude(quat: NDArray) -> NDArray:
            # q and -q are the same attitude: interpolate along the shorter arc.
            sign = np.where((quat[before] * quat[after]).sum(-1, keepdims=True) < 0, -1, 1)
            blended_quat = (1 - weight) * quat[before] + weight * sign * quat[after]
            return blended_quat / np.linalg.norm(blended_quat, axis=-1, keepdims=True)

        return {
            "pos": interpolate(self.pos),
            "quat": interpolate_attitude(self.quat),
            "body_pos": interpolate(self.body_pos),
            "body_quat": interpolate_attitude(self.body_quat),
            "setpoint": interpolate(self.setpoint),
        }

    def save(self, path: str | Path) -> None:
        """Write the flight to a file, compressed.

        Raises:
            ConfigError: If the file cannot be written. No file is left then.
        """
        constants = {name: getattr(self, name) for name in ("worlds", "drone_ids", "body_ids", "shapes")}
        samples = np.zeros(len(self.time), sample_dtype(*(getattr(self, name).shape[1:] for name in SAMPLE_FIELDS)))
        for name in SAMPLE_FIELDS:
            samples[name] = getattr(self, name)
        write_file(path, MAGIC + pack_chunk(SCENE_CHUNK, pack_scene(constants, samples)))

    @classmethod
    @check_arguments
    def load(cls, path: str | Path) -> Flight:
        """Load a flight written by ``save`` or by a ``Recorder`` with a path, even if the recording program crashed.

        Raises:
            ConfigError: If the file does not exist, or is of another format.
            DamagedFileError: If the file is damaged or not a recorded flight.
        """
        with wrap_read_errors(path, "a recorded flight", "Save it again, or use another copy."):
            chunks = read_journal(path)
            kind, content = next(chunks, (b"", b""))
            require(kind == SCENE_CHUNK, "expected the scene of a flight first, got none", ValueError)
            scene = read_arrays(io.BytesIO(content), str(path))
            if int(scene["format"]) != FORMAT:
                raise ConfigError(f"expected a recording of format {FORMAT}, got format {scene['format']} in {path}")
            samples = scene["samples"]
            appended = [np.frombuffer(content, samples.dtype) for kind, content in chunks if kind == SAMPLE_CHUNK]
            samples = np.concatenate([samples, *appended])
            require(len(samples), "expected at least one sample, got none", ValueError)
            constants = {name: scene[name] for name in ("worlds", "drone_ids", "body_ids")}
            return cls(**{name: samples[name] for name in SAMPLE_FIELDS}, **constants, shapes=_read_shapes(scene))


FORMAT = 2
"""Version of the file format. A file is a journal (``crazysim.media.journal``): the scene, which may contain samples of
a finished flight, and samples that were appended one by one."""
SCENE_CHUNK, SAMPLE_CHUNK = b"SCEN", b"SAMP"
"""Kinds of chunks of a flight."""
SAMPLE_FIELDS = ("time", "pos", "quat", "body_pos", "body_quat", "setpoint")
"""Fields of a sample."""


def sample_dtype(*shapes: Sequence[int]) -> np.dtype:
    """Return the type of one sample, from the shapes of ``SAMPLE_FIELDS``."""
    return np.dtype([(name, "<f8", tuple(shape)) for name, shape in zip(SAMPLE_FIELDS, shapes, strict=True)])


def pack_scene(constants: dict[str, Any], samples: NDArray) -> bytes:
    """Return the fields of a flight that do not change with time, and its first samples, as the content of a chunk."""
    arrays = {name: x for name, x in constants.items() if name != "shapes"} | _shape_arrays(constants["shapes"])
    stream = io.BytesIO()
    np.savez_compressed(stream, format=FORMAT, samples=samples, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _shape_arrays(shapes: Sequence[VisualGeom]) -> dict[str, NDArray]:
    arrays = {"shape_kind": np.array([GEOM_KINDS.index(shape.kind) for shape in shapes], int)}
    for name in ("size", "rgba", "mocap", "pos", "quat"):
        arrays[f"shape_{name}"] = np.array([getattr(shape, name) for shape in shapes]).reshape(len(shapes), -1)
    for name in ("vertices", "faces"):  # of all meshes, concatenated
        arrays[f"shape_{name}"] = np.concatenate([np.zeros((0, 3)), *(getattr(shape, name) for shape in shapes)])
    arrays["shape_n"] = np.array([(len(shape.vertices), len(shape.faces)) for shape in shapes], int).reshape(-1, 2)
    return arrays


def _read_shapes(arrays: dict[str, NDArray]) -> list[VisualGeom]:
    counts = arrays["shape_n"]
    vertices = np.split(arrays["shape_vertices"], np.cumsum(counts[:, 0])[:-1]) if len(counts) else []
    faces = np.split(arrays["shape_faces"].astype(int), np.cumsum(counts[:, 1])[:-1]) if len(counts) else []
    return [
        VisualGeom(
            kind=GEOM_KINDS[kind],
            **{name: arrays[f"shape_{name}"][k] for name in ("size", "rgba", "pos", "quat")},
            mocap=int(arrays["shape_mocap"][k, 0]),
            vertices=vertices[k],
            faces=faces[k],
        )
        for k, kind in enumerate(arrays["shape_kind"])
    ]
