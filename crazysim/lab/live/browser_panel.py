"""The panel of a live simulation in the browser: time, selection, layers, plots, buttons and sliders."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from crazysim.lab.live.loop import Live
from crazysim.lab.live.pace import Speed
from crazysim.lab.live.picture import list_quantities
from crazysim.lab.live.scene_bodies import DRONE, SceneBodies
from crazysim.lab.live.viewer import Slider, Widget
from crazysim.media.browser_scene import BrowserScene
from crazysim.media.picture import Picture

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10", "max")
"""Speeds that the panel offers."""
TEXT_PERIOD, PLOT_PERIOD = 0.2, 0.1
"""Time between updates of the text and of the plot, s."""
PLOT_SAMPLE_PERIOD = 0.02
"""Shortest simulated time between two samples of a plot, s."""
PLOT_LENGTH = 500
"""Number of samples of a plot."""
LINE_COLORS = ("#d6452f", "#2a7fd9", "#37a35a", "#d99a1c", "#8a4fbf", "#444444")
"""Colours of the lines of a plot, repeated in this order."""
MAX_LINES = 16
"""Largest number of lines of a plot."""
KEY_HOLD_TIME = 0.25
"""Time for which a hotkey of the browser holds a key of the loop, s; browsers report no releases."""
MOVEMENT_KEYS = {
    "forward": ("up", "arrowup"), "back": ("down", "arrowdown"), "left": ("left", "arrowleft"),
    "right": ("right", "arrowright"), "climb": ("w", "W"), "sink": ("s", "S"), "turn left": ("a", "A"),
    "turn right": ("d", "D"),
}  # fmt: skip
"""Key of the loop and hotkey of viser for each movement."""


class BrowserPanel:
    """Panel of a viser server; all browsers of the server share it."""

    follow: bool
    """True to keep the followed body in the middle."""
    plot: str
    """Quantity that is plotted; empty for none."""

    def __init__(self, server: Any, live: Live, scene: BrowserScene, bodies: SceneBodies, follow: bool, plot: str):
        self._gui = gui = server.gui
        self._scene, self._live = scene, live
        names = list(dict.fromkeys(["", *live.quantities, *list_quantities(live.sim)]))
        self.follow, self.plot = follow, plot if plot in names else ""
        gui.configure_theme(control_width="medium")
        self._text = gui.add_markdown("")
        self._text_time = self._plot_time = -np.inf
        self._samples: deque[tuple[float, np.ndarray]] = deque(maxlen=PLOT_LENGTH)
        self._chart: Any = None
        self._plot_key: tuple[Any, ...] = ()
        with gui.add_folder("Time"):
            self._add_time_controls(gui, live)
        with gui.add_folder("Drone"):
            self._add_drone_controls(gui, live, bodies)
        if live.widgets:
            with gui.add_folder("Controls"):
                for widget in live.widgets:
                    self._add_widget(gui, live, widget)
        with gui.add_folder("Layers", expand_by_default=False):
            for layer in scene.visible:
                self._add_layer(gui, layer)
        self._plot_folder = gui.add_folder("Plot")
        with self._plot_folder:
            choice = gui.add_dropdown("quantity", names, initial_value=self.plot)

            @choice.on_update
            def _(_: Any) -> None:
                if choice.value in names:  # a browser may send any text
                    self.plot = choice.value

    def update(self, picture: Picture, now: float) -> None:
        """Update the text and the plot, each at its own rate.

        Args:
            picture: Picture that is shown.
            now: Present time (``time.perf_counter``), s.
        """
        if now - self._text_time >= TEXT_PERIOD:
            self._text_time = now
            self._text.content = f"**{picture.status}**"
            if picture.selected is not None and self._drone_input.value != picture.selected[1]:
                self._drone_input.value = picture.selected[1]
            world, name = self._world_input.value, ""
            if picture.focus is not None:
                world, name = int(picture.worlds[picture.focus.shown_index]), picture.focus.name
            if self._world_input.value != world:
                self._world_input.value = world
            if self._body_input is not None and self._body_input.value != name:
                self._body_input.value = name
        plot_key = (self.plot, picture.selected, len(picture.plot))
        if plot_key != self._plot_key or (self._samples and picture.time < self._samples[-1][0]):
            self._plot_key = plot_key
            self._samples.clear()
            self._remove_chart()
        if not len(picture.plot):
            return
        if not self._samples or picture.time - self._samples[-1][0] >= PLOT_SAMPLE_PERIOD:
            self._samples.append((picture.time, picture.plot[:MAX_LINES]))
        if len(self._samples) > 1 and now - self._plot_time >= PLOT_PERIOD:
            self._plot_time = now
            self._draw_chart()

    def _draw_chart(self) -> None:
        times = np.array([time for time, _ in self._samples])
        values = np.stack([value for _, value in self._samples])
        data = (times, *np.where(np.isfinite(values), values, 0.0).T)
        if self._chart is not None:
            self._chart.data = data
            return
        lines = [
            {"label": str(k), "stroke": LINE_COLORS[k % len(LINE_COLORS)], "width": 1.5} for k in range(values.shape[1])
        ]
        with self._plot_folder:
            self._chart = self._gui.add_uplot(
                data, ({"label": "s"}, *lines), title=self.plot, scales={"x": {"time": False}}, aspect=1.3
            )

    def _remove_chart(self) -> None:
        if self._chart is not None:
            self._chart.remove()
            self._chart = None

    def _add_time_controls(self, gui: Any, live: Live) -> None:
        callbacks = {
            "pause": Live.toggle_pause, "step": Live.advance, "reset": Live.reset, "record": Live.toggle_recording,
        }  # fmt: skip
        buttons = gui.add_button_group("", tuple(callbacks))
        buttons.on_click(lambda _: live.post(callbacks[buttons.value]))
        speed = gui.add_dropdown("speed", SPEEDS, initial_value=_nearest_speed(live.speed))

        @speed.on_update
        def _(_: Any) -> None:
            value = speed.value
            live.post(lambda live: setattr(live, "speed", "max" if value == "max" else float(value)))

        target_time = gui.add_number("go to, s", 0.0, min=0.0, step=0.1)
        _post_on_click(gui.add_button("Go"), live, lambda live: live.go_to(float(target_time.value)))

    def _add_drone_controls(self, gui: Any, live: Live, bodies: SceneBodies) -> None:
        sim = live.sim
        world, drone = live.selected or (0, 0)
        self._world_input = world_input = gui.add_number(
            "world", world, min=0, max=sim.n_worlds - 1, step=1, visible=sim.n_worlds > 1
        )
        self._drone_input = gui.add_number("drone", drone, min=0, max=sim.n_drones - 1, step=1)
        for element in (world_input, self._drone_input):

            @element.on_update
            def _(event: Any) -> None:
                if event.client is not None:  # a change by a user
                    selection = int(world_input.value), int(self._drone_input.value)
                    live.post(lambda live: live.select(*selection))

        self._body_input = None
        if any(body.kind != DRONE for body in bodies.items):
            self._add_body_choice(gui, live, world_input, bodies)
        follow = gui.add_checkbox("follow", self.follow)

        @follow.on_update
        def _(_: Any) -> None:
            self.follow = follow.value

        for name, (key, hotkey) in MOVEMENT_KEYS.items():
            self._add_key(gui, live, name, key, hotkey)

    def _add_body_choice(self, gui: Any, live: Live, world_input: Any, bodies: SceneBodies) -> None:
        bodies_by_name = {body.name: body for body in bodies.items}
        self._body_input = choice = gui.add_dropdown("body", ("", *bodies_by_name))

        @choice.on_update
        def _(event: Any) -> None:
            body = bodies_by_name.get(choice.value)
            if event.client is not None and body is not None:  # a change by a user
                world = int(world_input.value)
                live.post(lambda live: live.follow(world, body.kind, body.index))

    def _add_key(self, gui: Any, live: Live, name: str, key: str, hotkey: str) -> None:
        command = gui.add_command(f"Fly: {name}", hotkey=hotkey)
        command.on_trigger(lambda _: live.keyboard.hold(key, KEY_HOLD_TIME))

    def _add_layer(self, gui: Any, layer: str) -> None:
        checkbox = gui.add_checkbox(layer, True)

        @checkbox.on_update
        def _(_: Any) -> None:
            self._scene.visible[layer] = checkbox.value

    @staticmethod
    def _add_widget(gui: Any, live: Live, widget: Widget) -> None:
        if not isinstance(widget, Slider):
            _post_on_click(gui.add_button(widget.name), live, lambda _: widget.callback())
            return
        step = (widget.high - widget.low) / 200
        slider = gui.add_slider(widget.name, widget.low, widget.high, step, widget.value)

        @slider.on_update
        def _(_: Any) -> None:
            value = float(slider.value)
            live.post(lambda live: live.set_value(widget.name, value))


def _post_on_click(button: Any, live: Live, callback: Callable[[Live], object]) -> None:
    button.on_click(lambda _: live.post(callback))


def _nearest_speed(speed: Speed) -> str:
    if speed == "max":
        return "max"
    return min(SPEEDS[:-1], key=lambda choice: abs(np.log(float(choice) / speed)))
