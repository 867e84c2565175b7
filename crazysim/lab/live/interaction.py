"""Interaction with a live simulation: keys, buttons, sliders, clicks, the selected drone and the followed body."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import require
from crazysim.lab.live.keyboard import Keyboard
from crazysim.lab.live.scene_bodies import DRONE, SceneBodies
from crazysim.lab.live.viewer import Button, Slider, Widget
from crazysim.media.picture import Picture
from crazysim.sim.sim import Sim


class Interaction:
    """The part of ``Live`` that viewers and users interact with."""

    sim: Sim
    """The simulation."""
    keyboard: Keyboard[Self]
    """Keys that are held in a viewer, and functions that keys call."""
    widgets: list[Widget]
    """Buttons and sliders that viewers show."""
    slider_values: dict[str, float]
    """Present values of the sliders, by name."""
    selected: tuple[int, int] | None
    """World and index of the drone that is plotted and piloted, and followed unless ``follow`` chose another body; None
    for none."""
    lights: NDArray
    """Colours of the drones' LEDs, red, green and blue from 0 to 1, which viewers draw; zero for off.
    (n_worlds, n_drones, 3)"""
    goals: NDArray | None
    """Positions that viewers mark, m; None to mark the positions in state commands. (n_worlds, n_drones, 3)"""
    quantities: dict[str, Callable[[Self], ArrayLike]]
    """Further quantities that viewers can plot, by name: functions of the loop that return numbers. (k,)"""
    on_click: Callable[[Self, int, NDArray], object] | None
    """Function that is called with the loop, the world and the point, m, when the ground is clicked in a viewer; None
    for none."""
    note: Callable[[Self], str] | None
    """Function from the loop to a text that viewers show after the status; None for none."""

    def __init__(self, sim: Sim):
        self.sim = sim
        self.keyboard, self.widgets, self.slider_values, self.quantities = Keyboard(), [], {}, {}
        self.selected, self.on_click, self.goals, self.note = (0, 0), None, None, None
        self.lights = np.zeros((sim.n_worlds, sim.n_drones, 3))
        self._followed_body: tuple[int, str, int] | None = None
        self._slider_index = 0
        self._posted_callbacks: deque[Callable[[Self], object]] = deque()

    def button(self, name: str, callback: Callable[[Self], object], key: str | None = None) -> None:
        """Add a button to viewers that are shown from now on, and optionally a key that calls the same function."""
        self.widgets.append(Button(name, partial(callback, self), key))
        if key is not None:
            self.keyboard.bind(key, callback)

    def slider(
        self, name: str, low: float, high: float, value: float, callback: Callable[[Self, float], object]
    ) -> None:
        """Add a slider to viewers that are shown from now on; the function is called with the loop and the value."""
        require(
            np.isfinite([low, high]).all() and low < high and low <= value <= high,
            f"expected low < high, and a value between them, of slider {name!r}, got low {low!r}, value {value!r} "
            f"and high {high!r}",
        )
        require(
            name not in self.slider_values, f"expected a new name of a slider, got {name!r} twice. Use another name."
        )
        self.widgets.append(Slider(name, low, high, value, partial(callback, self)))
        self.slider_values[name] = float(value)

    def set_value(self, name: str, value: float) -> None:
        """Move a slider, clipped to its limits, and call its function."""
        slider = next((slider for slider in self._sliders if slider.name == name), None)
        require(
            slider is not None and np.isfinite(value),
            f"expected a slider of {list(self.slider_values)} and a finite value, got {name!r}, {value!r}",
        )
        self.slider_values[name] = float(np.clip(value, slider.low, slider.high))
        slider.callback(self.slider_values[name])

    @property
    def widget_lines(self) -> tuple[str, ...]:
        """Buttons with their keys, and sliders with their values, for viewers without a panel."""
        selected_name = self._sliders[self._slider_index].name if self._sliders else None
        return tuple(
            f"{w.name}: {self.slider_values[w.name]:.3g}" + ("  [ ]" if w.name == selected_name else "")
            if isinstance(w, Slider)
            else f"{w.name}  {w.key or ''}".rstrip()
            for w in self.widgets
        )

    @property
    def _sliders(self) -> list[Slider]:
        return [widget for widget in self.widgets if isinstance(widget, Slider)]

    def move_slider(self, fraction: float) -> None:
        if self._sliders:
            slider = self._sliders[self._slider_index]
            self.set_value(slider.name, self.slider_values[slider.name] + fraction * (slider.high - slider.low))

    def choose_next_slider(self) -> None:
        self._slider_index = (self._slider_index + 1) % max(len(self._sliders), 1)

    def select(self, world: int, drone: int) -> None:
        """Select a drone to follow, plot and pilot."""
        require(
            world in range(self.sim.n_worlds) and drone in range(self.sim.n_drones),
            f"expected a world below {self.sim.n_worlds} and a drone below {self.sim.n_drones}, got "
            f"{world!r} and {drone!r}",
        )
        self.selected, self._followed_body = (int(world), int(drone)), None

    def select_next(self) -> None:
        world, drone = self.selected or (0, -1)
        self.select(world, (drone + 1) % self.sim.n_drones)

    @property
    def followed(self) -> tuple[int, str, int] | None:
        """World, kind and index of the body that viewers follow: the selected drone, or the choice of ``follow``."""
        if self._followed_body is not None or self.selected is None:
            return self._followed_body
        return self.selected[0], DRONE, self.selected[1]

    def follow(self, world: int, kind: str, index: int) -> None:
        """Make viewers mark and follow a body, as a click on it does. A drone becomes the selected drone as well.

        Args:
            kind: ``"drone"``, or the name of the objects in the scene: ``"cars"``, ``"load"`` or a handle's name.
            index: Index of the body among the bodies of its kind.
        """
        if kind == DRONE:
            self.select(world, index)
            return
        require(world in range(self.sim.n_worlds), f"expected a world below {self.sim.n_worlds}, got {world!r}")
        self.sim.scene.compile_if_edited()
        SceneBodies(self.sim).find(kind, index)
        self._followed_body = int(world), kind, int(index)

    def click(self, world: int, point: NDArray) -> None:
        """Call ``on_click``, if it is set, as viewers do for a click on the ground.

        Args:
            point: Point, world frame, m. (3,)
        """
        if self.on_click is not None:
            self.on_click(self, world, point)

    def click_along(self, bodies: SceneBodies, picture: Picture, origins: NDArray, direction: NDArray) -> None:
        """Follow the body, or click on the ground, that a ray from a viewer's camera hits; from any thread.

        Args:
            picture: Picture that the user has seen.
            origins: Origin of the ray in the frame of each world, m; NaN for worlds elsewhere. (n, 3)
            direction: Direction of the ray. (3,)
        """
        k, body, point = bodies.pick(picture, origins, direction)
        world = int(picture.worlds[k])
        if body is not None:
            self.post(lambda live: live.follow(world, body.kind, body.index))
        elif point is not None:
            self.post(lambda live: live.click(world, point))

    def post(self, callback: Callable[[Self], object]) -> None:
        """Make the loop call a function between two steps; may be called from any thread."""
        self._posted_callbacks.append(callback)
