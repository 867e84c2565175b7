"""What a picture shows: which worlds side by side, from where, and what is drawn over them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import positive
from crazysim.errors import ConfigError
from crazysim.media.trail import Trail, colors_of
from crazysim.scene import batch_render
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import draw_setpoints, draw_text

BORDER_COLOR = 40
"""Grey between two worlds, 0 to 255."""
RENDERERS = ("auto", "warp", "plain")
"""What draws many worlds."""


@dataclass
class View:
    """A way of looking at a simulation: one world, or several in a grid.

    It remembers, from picture to picture, where drones were and where the camera looked.
    """

    worlds: Sequence[int] = (0,)
    """Which worlds, row by row."""
    width: int = 1280
    """Width of the whole picture, pixels."""
    height: int = 720
    """Height of the whole picture, pixels."""
    camera: int | str = -1
    """Name or id of a camera; -1 is the free one."""
    cam_config: Mapping[str, Any] | Callable[[float], Mapping[str, Any]] | None = None
    """Settings of the free camera, or a function from time, s, to settings, for one that moves."""
    follow: int | None = None
    """Drone that the free camera keeps in its middle."""
    lag: float = 0.3
    """Time by which the camera's middle lags behind the drone that it follows, s."""
    trail: float = 0.0
    """Time for which a drone's way is seen, s; 0 for none."""
    setpoints: bool = False
    """Whether the positions of state commands are seen, as spheres."""
    rgba: ArrayLike | None = None
    """Colour of trails and setpoints, one or one per drone; None for colours that tell drones apart."""
    text: str | None = None
    """Text at the top left of each world, in which ``{world}`` and ``{time}`` are filled in; ASCII."""
    draw: Callable[[Sim, int], None] | None = None
    """``draw(sim, world)`` draws more over a world, with what ``crazysim.sim.visualize`` has."""
    columns: int | None = None
    """Worlds in a row; None for a grid as wide as high."""
    border: int = 2
    """Width of the lines between worlds, pixels."""
    _trail: Trail | None = field(default=None, init=False, repr=False)
    _looks_at: dict[int, tuple[float, NDArray]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        """Check what can be checked without a simulation.

        Raises:
            ConfigError: If no picture can be made like this.
        """
        self.width, self.height = positive("width", self.width), positive("height", self.height)
        self.worlds = [self.worlds] if isinstance(self.worlds, (int, np.integer)) else list(self.worlds)
        if not self.worlds:
            raise ConfigError("a view shows at least one world; worlds is empty")
        if self.columns is not None:
            positive("columns", self.columns)
        if isinstance(self.border, bool) or not isinstance(self.border, (int, np.integer)) or self.border < 0:
            raise ConfigError(f"border is {self.border!r}; it must be a whole number of pixels, 0 or more")
        if min(self.tile_size) < 1:
            raise ConfigError(
                f"{len(self.worlds)} worlds do not fit into a picture of {self.width} x {self.height} pixels; show "
                f"fewer, or make it larger"
            )
        if self.follow is not None and self.camera != -1:
            raise ConfigError(
                f"only the free camera, -1, can follow a drone; camera is {self.camera!r}. Drones carry cameras of "
                f"their own, track_cam:i and fpv_cam:i"
            )
        if not np.isfinite(self.lag) or self.lag < 0:
            raise ConfigError(f"lag is {self.lag!r} s; it must be 0 or more")
        if self.trail != 0:
            self._trail = Trail(self.trail)
        _fill(self.text, 0, 0.0)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns."""
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
        """Return the rows and columns of pixels that show the k-th of the worlds."""
        row, column = divmod(k, self.grid[1])
        width, height = self.tile_size
        left, top = column * (width + self.border), row * (height + self.border)
        return slice(top, top + height), slice(left, left + width)

    def picture(self, sim: Sim) -> NDArray:
        """Return the picture of a simulation as it is now. (height, width, 3), uint8

        What was drawn with ``crazysim.sim.visualize`` is seen in each of the worlds.

        Raises:
            ValueError: If a world, the camera or the drone does not exist.
            RenderError: If this machine cannot draw.
        """
        time, pos = self._look(sim)
        picture = np.full((self.height, self.width, 3), BORDER_COLOR, np.uint8)
        width, height = self.tile_size
        drawn = sim.overlays.copy()
        try:
            for k, world in enumerate(self.worlds):
                sim.overlays.restore(drawn)
                self._draw(sim, k, time[k])
                config = self._cam_config(k, time[k], pos[k])
                picture[self.tile(k)] = np.asarray(sim.render("rgb_array", world, self.camera, config, width, height))
        except Exception:
            sim.overlays.restore(drawn)  # what the user drew waits for the next picture that comes to be
            raise
        return picture

    def show(self, sim: Sim) -> None:
        """Draw the first of the worlds into the window, in the view's whole size.

        Raises:
            ValueError: If the world, the camera or the drone does not exist.
            RenderError: If there is no screen.
        """
        time, pos = self._look(sim)
        self._draw(sim, 0, time[0])
        sim.render("human", self.worlds[0], self.camera, self._cam_config(0, time[0], pos[0]), self.width, self.height)

    def _look(self, sim: Sim) -> tuple[NDArray, NDArray]:
        """Return the time of every world shown and where its drones are, and remember them. (n,), (n, n_drones, 3)"""
        worlds = chosen(sim, self.worlds)
        if self.follow is not None and self.follow not in range(sim.n_drones):
            raise ConfigError(f"drone {self.follow!r} does not exist; drones go from 0 to {sim.n_drones - 1}")
        time, pos = np.asarray(sim.time[worlds, 0], float), np.asarray(sim.data.states.pos[worlds], float)
        if self._trail is not None:
            self._trail.add(time, pos)
        return time, pos

    def _draw(self, sim: Sim, k: int, time: float) -> None:
        """Draw over the k-th of the worlds what belongs to it."""
        if self._trail is not None:
            self._trail.draw(sim.overlays, k, self.rgba)
        if self.setpoints:
            draw_setpoints(sim, self.worlds[k], colors_of(sim.n_drones, self.rgba))
        if self.draw is not None:
            self.draw(sim, self.worlds[k])
        if self.text is not None:
            draw_text(sim, _fill(self.text, self.worlds[k], time))

    def _cam_config(self, k: int, time: float, pos: NDArray) -> dict[str, Any]:
        """Return the free camera's settings for the k-th of the worlds, in which drones are at ``pos``."""
        config = dict((self.cam_config(time) if callable(self.cam_config) else self.cam_config) or {})
        if self.follow is not None:
            before, point = self._looks_at.get(k, (np.inf, pos[self.follow]))
            # Weight of the new place in a first-order lag; a world that was reset is looked at afresh.
            new = 1.0 if time < before or self.lag == 0 else 1 - np.exp(-(time - before) / self.lag)
            if np.isfinite(pos[self.follow]).all():
                point = point + new * (pos[self.follow] - point)
            self._looks_at[k] = (time, point)
            config["lookat"] = point
        return config


def pictures_of(
    sim: Sim,
    worlds: Sequence[int] | None = None,
    camera: int | str = -1,
    cam_config: Mapping[str, Any] | None = None,
    width: int = 320,
    height: int = 240,
    renderer: str = "auto",
) -> NDArray:
    """Return a picture of each of several worlds, as a batch. (n, height, width, 3), uint8

    On a GPU, where ``warp-lang`` is installed, MuJoCo Warp traces what a camera of the scene sees in all worlds at
    once; else one is drawn after the other by MuJoCo's renderer. The same camera, size and number of worlds again
    cost no preparation.

    Args:
        sim: The simulation as it is now.
        worlds: Which worlds, in this order; None for all.
        camera: Name or id of a camera; -1 is the free one.
        cam_config: Settings of the free camera.
        width: Of each picture, pixels.
        height: Of each picture, pixels.
        renderer: ``"warp"``, which draws no marks and no free camera, ``"plain"``, or ``"auto"`` for the faster one
            that draws all that is to be seen.

    Raises:
        ValueError: If a world, the camera or the renderer does not exist, or the size cannot be.
        ImportError: If MuJoCo Warp is asked for and not installed.
        RenderError: If this machine cannot draw.
    """
    if renderer not in RENDERERS:
        raise ConfigError(f"renderer {renderer!r} does not exist; choose one of {', '.join(RENDERERS)}")
    shown = range(sim.n_worlds) if worlds is None else worlds
    plain = camera == -1 or len(sim.overlays) > 0 or sim.device.platform != "gpu" or not batch_render.installed()
    if renderer == "warp" or (renderer == "auto" and not plain):
        return np.asarray(sim.scene.render_worlds(sim.data, chosen(sim, shown), camera, width, height))
    whole = positive("height", height) * max(1, len(shown))
    column = View(shown, width, whole, camera, cam_config, columns=1, border=0)
    return column.picture(sim).reshape(-1, height, width, 3)


def chosen(sim: Sim, worlds: Sequence[int]) -> NDArray:
    """Return the numbers of worlds that are to be drawn, checked.

    Raises:
        ConfigError: If there are none, or one does not exist.
    """
    if not len(worlds):
        raise ConfigError("worlds is empty; name at least one world")
    for world in worlds:
        if world not in range(sim.n_worlds):
            raise ConfigError(f"world {world!r} does not exist; worlds go from 0 to {sim.n_worlds - 1}")
    return np.array(worlds)


def _fill(text: str | None, world: int, time: float) -> str:
    try:
        return "" if text is None else text.format(world=world, time=time)
    except (KeyError, IndexError, ValueError) as error:
        raise ConfigError(
            f"text {text!r} cannot be filled in: {error}; it may hold {{world}} and {{time:.1f}}"
        ) from None
