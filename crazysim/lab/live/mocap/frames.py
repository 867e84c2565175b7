"""Frames of motion capture, and the conventions in which systems send them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import ConfigError, require


@dataclass(frozen=True, eq=False)
class Frame:
    """Poses of all bodies that a motion capture system has measured at one time."""

    stamp: float
    """Time of the measurement, clock of the source, s."""
    names: tuple[str, ...]
    """Names of the bodies, as the source sends them."""
    pos: NDArray
    """Positions, world frame, m. (n, 3)"""
    quat: NDArray
    """Attitudes, body to world, xyzw. (n, 4)"""
    received: float = 0.0
    """Time of arrival, clock of this computer (``time.monotonic``), s."""

    @staticmethod
    def of(stamp: float, bodies: dict[str, tuple[ArrayLike, ArrayLike]], received: float | None = None) -> Frame:
        """Return a frame of bodies by name, each with its position, m, and attitude, xyzw.

        Args:
            stamp: Time of the measurement, s.
            bodies: Position and attitude of each body.
            received: Time of arrival, s; None for ``stamp``.
        """
        try:
            pos = np.array([p for p, _ in bodies.values()], float).reshape(len(bodies), 3)
            quat = np.array([q for _, q in bodies.values()], float).reshape(len(bodies), 4)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"expected a position of 3 and an attitude of 4 numbers for each body, got {error}. Use "
                f"{{'cf1': ((x, y, z), (qx, qy, qz, qw))}}."
            ) from None
        return Frame(float(stamp), tuple(bodies), pos, quat, float(stamp if received is None else received))


@dataclass(frozen=True)
class Convention:
    """Axes, order of quaternions and unit of length of a motion capture system.

    The world frame of crazysim has z up, its quaternions are xyzw and its lengths are in metres. With y up, the axes x,
    y, z of the source are the axes x, z, -y of the world, which turns positions and attitudes by 90 degrees about x.
    """

    up: str = "z"
    """Axis that points up: ``"y"`` or ``"z"``."""
    quat: str = "xyzw"
    """Order of the components of quaternions: ``"xyzw"`` or ``"wxyz"``."""
    unit: float = 1.0
    """Length of the unit of positions, m; 0.001 for millimetres."""

    def __post_init__(self) -> None:
        require(
            self.up in ("y", "z") and self.quat in ("xyzw", "wxyz") and 0 < self.unit < np.inf,
            f"expected up as 'y' or 'z', quat as 'xyzw' or 'wxyz' and a positive unit, got {self.up!r}, "
            f"{self.quat!r} and {self.unit!r}. Use Convention('y', 'xyzw', 0.001) for millimetres with y up, for "
            f"example.",
        )

    def to_world(self, pos: ArrayLike, quat: ArrayLike) -> tuple[NDArray, NDArray]:
        """Return poses of the source in the world frame: positions, m (..., 3), and attitudes, xyzw (..., 4)."""
        pos, quat = np.asarray(pos, float) * self.unit, np.asarray(quat, float)
        if self.quat == "wxyz":
            quat = quat[..., [1, 2, 3, 0]]
        if self.up == "y":
            pos = pos[..., [0, 2, 1]] * (1, -1, 1)
            quat = quat[..., [0, 2, 1, 3]] * (1, -1, 1, 1)
        return pos, quat

    def convert(self, frame: Frame) -> Frame:
        """Return a frame of the source in the world frame of crazysim."""
        if self == Convention():
            return frame
        pos, quat = self.to_world(frame.pos, frame.quat)
        return replace(frame, pos=pos, quat=quat)
