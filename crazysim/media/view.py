"""Views: which worlds an image shows side by side, from which camera, with which overlays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import as_rgba, check_flags, positive
from crazysim.eager import to_host
from crazysim.errors import ConfigError
from crazysim.media.trail import Trail, colors_of
from crazysim.media.worlds import world_indices
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import draw_setpoints, draw_text

BORDER_COLOR = 40
"""Grey level between two worlds, 0 to 255."""

MAX_PIXELS = 16_384
"""Largest width and height of an image."""


@dataclass
class View:
    """A view of a simulation: one world, or several in a grid.

    Trails and the point that a following camera looks at carry over from image to image.
    """

    worlds: Sequence[int] = (0,)
    """Indices of the worlds, row by row."""
    width: int = 1280
    """Width of the whole image, pixels."""
    height: int = 720
    """Height of the whole image, pixels."""
    camera: int | str = -1
    """Name or id of a camera; -1 is the free camera."""
    cam_config: Mapping[str, Any] | Callable[[float], Mapping[str, Any]] | None = None
    """Settings of the free camera, or a function from time, s, to settings for a moving camera."""
    follow: int | None = None
    """Index of the drone that the free camera looks at; None for none."""
    lag: float = 0.3
    """Time constant with which the camera follows that drone, s."""
    trail: float = 0.0
    """Duration of the drones' trails, s; 0 for none."""
    setpoints: bool = False
    """True to draw the positions of state commands, as spheres."""
    rgba: ArrayLike | None = None
    """Colour of trails and setpoints, one or one per drone; None for default colours."""
    text: str | None = None
    """ASCII text at the top left of each world, with the fields ``{world}`` and ``{time}``; None for none."""
    draw: Callable[[Sim, int], None] | None = None
    """Function that draws further overlays of a world, ``draw(sim, world)``; None for none."""
    columns: int | None = None
    """Worlds per row; None for as many rows as columns."""
    border: int = 2
    """Width of the lines between worlds, pixels."""
    _trail: Trail | None = field(default=None, init=False, repr=False)
    _lookat: dict[int, tuple[float, NDArray]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the settings that do not depend on a simulation.

        Raises:
            ConfigError: If a setting is invalid.
        """
        check_flags(self)
        self.width, self.height = (positive(name, getattr(self, name), MAX_PIXELS) for name in ("width", "height"))
        if self.rgba is not None:
            as_rgba(np.atleast_2d(self.rgba)[0])
        self.worlds = [self.worlds] if isinstance(self.worlds, (int, np.integer)) else list(self.worlds)
        if not self.worlds:
            raise ConfigError("expected at least one world, got none")
        if self.columns is not None:
            positive("columns", self.columns)
        if isinstance(self.border, bool) or not isinstance(self.border, (int, np.integer)) or self.border < 0:
            raise ConfigError(f"expected a border of 0 or more whole pixels, got {self.border!r}")
        if min(self.tile_size) < 1:
            raise ConfigError(
                f"expected an image that {len(self.worlds)} worlds fit into, got {self.width} x {self.height} pixels. "
                f"Show fewer worlds or increase the size."
            )
        if self.follow is not None and self.camera != -1:
            raise ConfigError(
                f"expected camera=-1, the free camera, to follow a drone, got {self.camera!r}. Drones carry the "
                f"cameras track_cam:i and fpv_cam:i."
            )
        if not np.isfinite(self.lag) or self.lag < 0:
            raise ConfigError(f"expected a lag of 0 s or more, got {self.lag!r}")
        if self.trail != 0:
            self._trail = Trail(self.trail)
        _fill(self.text, 0, 0.0)

    @property
    def grid(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        n = len(self.worlds)
        columns = min(n, int(np.ceil(np.sqrt(n))) if self.columns is None else self.columns)
        return -(-n // columns), columns

    @property
    def tile_size(self) -> tuple[int, int]:
        """Width and height of one world, pixels."""
        rows, columns = self.grid
        return (
            (self.width - self.border * (columns - 1)) // columns,
            (self.height - self.border * (rows - 1)) // rows,
        )

    def tile(self, k: int) -> tuple[slice, slice]:
        """Return the rows and columns of pixels of the k-th world."""
        row, column = divmod(k, self.grid[1])
        width, height = self.tile_size
        left, top = column * (width + self.border), row * (height + self.border)
        return slice(top, top + height), slice(left, left + width)

    def render(self, sim: Sim) -> NDArray:
        """Return an image of a simulation. (height, width, 3), uint8

        Overlays that were drawn with ``crazysim.sim.visualize`` appear in each of the worlds.

        Raises:
            ValueError: If a world, the camera or the drone does not exist.
            RenderError: If this machine cannot draw.
        """
        time, pos = self._sample(sim)
        image = np.full((self.height, self.width, 3), BORDER_COLOR, np.uint8)
        width, height = self.tile_size
        before = sim.overlays.copy()
        try:
            for k, world in enumerate(self.worlds):
                sim.overlays.restore(before)
                self._draw(sim, k, time[k])
                config = self._cam_config(k, time[k], pos[k])
                image[self.tile(k)] = np.asarray(sim.render("rgb_array", world, self.camera, config, width, height))
        except Exception:
            sim.overlays.restore(before)  # they are kept for the next image
            raise
        return image

    def show(self, sim: Sim) -> None:
        """Show the first of the worlds in a window of the view's size.

        Raises:
            ValueError: If the world, the camera or the drone does not exist.
            RenderError: If there is no screen.
        """
        time, pos = self._sample(sim)
        self._draw(sim, 0, time[0])
        sim.render("human", self.worlds[0], self.camera, self._cam_config(0, time[0], pos[0]), self.width, self.height)

    def _sample(self, sim: Sim) -> tuple[NDArray, NDArray]:
        """Return times, s (n,), and drone positions, m (n, n_drones, 3), of the worlds, and extend the trails."""
        worlds = world_indices(sim, self.worlds)
        if self.follow is not None and self.follow not in range(sim.n_drones):
            raise ConfigError(f"expected a drone from 0 to {sim.n_drones - 1} to follow, got {self.follow!r}")
        time, pos = (
            np.asarray(to_host(sim.time, worlds)[:, 0], float),
            np.asarray(to_host(sim.data.states.pos, worlds), float),
        )
        if self._trail is not None:
            self._trail.add(time, pos)
        return time, pos

    def _draw(self, sim: Sim, k: int, time: float) -> None:
        """Draw the overlays of the k-th world."""
        if self._trail is not None:
            self._trail.draw(sim.overlays, k, self.rgba)
        if self.setpoints:
            draw_setpoints(sim, self.worlds[k], colors_of(sim.n_drones, self.rgba))
        if self.draw is not None:
            self.draw(sim, self.worlds[k])
        if self.text is not None:
            draw_text(sim, _fill(self.text, self.worlds[k], time))

    def _cam_config(self, k: int, time: float, pos: NDArray) -> dict[str, Any]:
        """Return the settings of the free camera for the k-th world, with drones at ``pos``."""
        config = dict((self.cam_config(time) if callable(self.cam_config) else self.cam_config) or {})
        if self.follow is not None:
            before, point = self._lookat.get(k, (np.inf, pos[self.follow]))
            # First-order lag; after a reset of the world the camera jumps to the drone.
            weight = 1.0 if time < before or self.lag == 0 else 1 - np.exp(-(time - before) / self.lag)
            if np.isfinite(pos[self.follow]).all():
                point = point + weight * (pos[self.follow] - point)
            self._lookat[k] = (time, point)
            config["lookat"] = point
        return config


def _fill(text: str | None, world: int, time: float) -> str:
    try:
        return "" if text is None else text.format(world=world, time=time)
    except (KeyError, IndexError, ValueError) as error:
        raise ConfigError(
            f"expected text with the fields {{world}} and {{time:.1f}} only, got {text!r}: {error}"
        ) from None
