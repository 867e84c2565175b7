"""Recorded flights: where everything was over time, in one file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.scene.visual_geoms import KINDS, VisualGeom

FORMAT = 1
"""Number of the file's format."""


@dataclass(frozen=True, eq=False)
class Flight:
    """Poses of some worlds over time, and the shapes that stand in them."""

    time: NDArray
    """Time, s, from 0 on. (n,)"""
    pos: NDArray
    """Positions of the drones, world frame, m. (n, n_worlds, n_drones, 3)"""
    quat: NDArray
    """Attitudes of the drones, body to world, xyzw. (n, n_worlds, n_drones, 4)"""
    body_pos: NDArray
    """Positions of the other mocap bodies, m. (n, n_worlds, n_bodies, 3)"""
    body_quat: NDArray
    """Attitudes of the other mocap bodies, xyzw. (n, n_worlds, n_bodies, 4)"""
    setpoint: NDArray
    """Positions of state commands, m; no drones with other commands. (n, n_worlds, n_drones or 0, 3)"""
    worlds: NDArray
    """Which worlds of the simulation they are. (n_worlds,)"""
    drone_ids: NDArray
    """Mocap id of each drone. (n_drones,)"""
    body_ids: NDArray
    """Mocap id of each other mocap body. (n_bodies,)"""
    shapes: Sequence[VisualGeom]
    """What is seen, as it was when the recording began."""

    @property
    def n_drones(self) -> int:
        """Number of drones in each world."""
        return self.pos.shape[2]

    def index(self, world: int) -> int:
        """Return where a world of the simulation is in the recording.

        Raises:
            ConfigError: If it was not recorded.
        """
        found = np.flatnonzero(self.worlds == world)
        if not len(found):
            raise ConfigError(f"world {world!r} was not recorded; recorded are {self.worlds.tolist()}")
        return int(found[0])

    def at(self, time: float) -> dict[str, NDArray]:
        """Return pos, quat, body_pos, body_quat and setpoint at a time, between two moments interpolated.

        Args:
            time: Time, s; before the first and after the last moment that moment's.
        """
        after = int(np.clip(np.searchsorted(self.time, time, side="right"), 1, max(len(self.time) - 1, 1)))
        before, after = after - 1, min(after, len(self.time) - 1)
        span = self.time[after] - self.time[before]
        part = float(np.clip((time - self.time[before]) / span, 0, 1)) if span > 0 else 0.0

        def between(values: NDArray) -> NDArray:
            return (1 - part) * values[before] + part * values[after]

        def turned(quat: NDArray) -> NDArray:
            # The shorter way round: q and -q are one attitude.
            sign = np.where((quat[before] * quat[after]).sum(-1, keepdims=True) < 0, -1, 1)
            mixed = (1 - part) * quat[before] + part * sign * quat[after]
            return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)

        return {
            "pos": between(self.pos),
            "quat": turned(self.quat),
            "body_pos": between(self.body_pos),
            "body_quat": turned(self.body_quat),
            "setpoint": between(self.setpoint),
        }

    def save(self, path: str | Path) -> None:
        """Write everything into one ``.npz`` file.

        Raises:
            ConfigError: If there is no such folder, or the name ends otherwise.
        """
        path = Path(path)
        if path.suffix != ".npz":
            raise ConfigError(f"{path} is no recording; its name must end with .npz")
        if not path.parent.is_dir():
            raise ConfigError(f"{path} cannot be written: there is no folder {path.parent}")
        shapes = self.shapes
        arrays: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "shapes"}
        arrays["shape_kind"] = np.array([KINDS.index(shape.kind) for shape in shapes], int)
        for name in ("size", "rgba", "mocap", "pos", "quat"):
            arrays[f"shape_{name}"] = np.array([getattr(shape, name) for shape in shapes]).reshape(len(shapes), -1)
        for name in ("vertices", "faces"):  # of all meshes one after the other
            arrays[f"shape_{name}"] = np.concatenate([np.zeros((0, 3)), *(getattr(shape, name) for shape in shapes)])
        arrays["shape_n"] = np.array([(len(shape.vertices), len(shape.faces)) for shape in shapes], int).reshape(-1, 2)
        np.savez_compressed(path, format=FORMAT, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Flight:
        """Read what ``save`` has written.

        Raises:
            ConfigError: If there is no such file, or it is no recorded flight.
        """
        path = Path(path)
        if not path.is_file():
            raise ConfigError(f"there is no file {path}")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            if int(arrays["format"]) != FORMAT:
                raise ConfigError(f"{path} has format {arrays['format']}; this version reads format {FORMAT}")
            n = arrays["shape_n"]
            vertices = np.split(arrays["shape_vertices"], np.cumsum(n[:, 0])[:-1]) if len(n) else []
            faces = np.split(arrays["shape_faces"].astype(int), np.cumsum(n[:, 1])[:-1]) if len(n) else []
            shapes = [
                VisualGeom(
                    kind=KINDS[kind],
                    **{name: arrays[f"shape_{name}"][k] for name in ("size", "rgba", "pos", "quat")},
                    mocap=int(arrays["shape_mocap"][k, 0]),
                    vertices=vertices[k],
                    faces=faces[k],
                )
                for k, kind in enumerate(arrays["shape_kind"])
            ]
            return cls(**{f.name: arrays[f.name] for f in fields(cls) if f.name != "shapes"}, shapes=shapes)
        except ConfigError:
            raise
        except (KeyError, ValueError, OSError, EOFError) as error:
            raise ConfigError(f"{path} is no recorded flight: {error}") from error
