"""Recorded flights: poses of drones and bodies over time, in one file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.arguments import check_arguments
from crazysim.errors import ConfigError, require
from crazysim.media.journal import is_journal, pack_arrays, read_journal, unpack_arrays
from crazysim.scene.visual_geoms import GEOM_KINDS, VisualGeom
from crazysim.storage import open_file, open_replacement, read_arrays, wrap_read_errors

FORMAT = 1
"""Version of the file format."""


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
        """Return pos, quat, body_pos, body_quat and setpoint at a time, interpolated.

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
        """Write the flight to a compressed ``.npz`` file.

        Raises:
            ConfigError: If the name has another suffix, or the file cannot be written. No file is left then.
        """
        path = Path(path)
        require(path.suffix == ".npz", f"expected the name of a recording to end with .npz, got {str(path)!r}")
        arrays: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "shapes"}
        arrays |= shape_arrays(self.shapes)
        with open_replacement(path) as file:
            np.savez_compressed(file, format=FORMAT, **arrays)

    @classmethod
    @check_arguments
    def load(cls, path: str | Path) -> Flight:
        """Load a flight written by ``save`` or by a ``Recorder`` with a path, even if the recording program crashed.

        Raises:
            ConfigError: If the file does not exist, or is of another format.
            DamagedFileError: If the file is damaged or not a recorded flight.
        """
        path = Path(path)
        with wrap_read_errors(path, "a recorded flight", "Save it again, or use another copy."):
            if is_journal(path):
                arrays = _read_samples(path)
            else:
                with open_file(path) as file:
                    arrays = read_arrays(file, str(path))
            if int(arrays["format"]) != FORMAT:
                raise ConfigError(f"expected a recording of format {FORMAT}, got format {arrays['format']} in {path}")
            return cls(
                **{f.name: arrays[f.name] for f in fields(cls) if f.name != "shapes"}, shapes=_read_shapes(arrays)
            )


def shape_arrays(shapes: Sequence[VisualGeom]) -> dict[str, NDArray]:
    """Return geoms as arrays, for a file."""
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


SCENE_CHUNK, SAMPLE_CHUNK = b"SCEN", b"SAMP"
"""Kinds of chunks of a flight: the constants, and one sample."""
SAMPLE_FIELDS = ("time", "pos", "quat", "body_pos", "body_quat", "setpoint")
"""Fields of a sample, in their order in a chunk."""


def pack_scene(scene: dict[str, Any]) -> bytes:
    """Return the fields of a flight that do not change with time as a chunk of a journal."""
    constant_fields = {name: x for name, x in scene.items() if name != "shapes"}
    return pack_arrays(format=np.array(FORMAT), **constant_fields, **shape_arrays(scene["shapes"]))


def pack_sample(sample: dict[str, Any]) -> bytes:
    """Return a sample as a chunk of a journal: the numbers of ``SAMPLE_FIELDS`` in order, float64."""
    return np.concatenate([np.ravel(sample[name]) for name in SAMPLE_FIELDS]).astype("<f8").tobytes()


def _read_samples(path: Path) -> dict[str, NDArray]:
    scene: dict[str, NDArray] = {}
    samples: list[NDArray] = []
    for kind, content in read_journal(path):
        if kind == SCENE_CHUNK:
            scene = unpack_arrays(content)
        elif kind == SAMPLE_CHUNK:
            samples.append(np.frombuffer(content, "<f8"))
    require(samples and scene, "expected at least one sample, got none", ValueError)
    n_worlds, n_drones, n_bodies = (len(scene[name]) for name in ("worlds", "drone_ids", "body_ids"))
    values = np.stack(samples)
    sizes = [(), (n_worlds, n_drones, 3), (n_worlds, n_drones, 4), (n_worlds, n_bodies, 3), (n_worlds, n_bodies, 4)]
    ends = np.cumsum([int(np.prod(size)) for size in sizes])
    parts = np.split(values, ends, axis=1)
    shapes = [*sizes, (n_worlds, parts[-1].shape[1] // (3 * n_worlds), 3)]
    return scene | {
        name: part.reshape(len(values), *shape) for name, part, shape in zip(SAMPLE_FIELDS, parts, shapes, strict=True)
    }
