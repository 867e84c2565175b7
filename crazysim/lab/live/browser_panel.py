"""The panel of a live simulation in the browser: time, selection, plots, buttons and sliders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from crazysim.lab.live.loop import Live
from crazysim.lab.live.pace import Speed
from crazysim.lab.live.picture import PlotSamples, list_quantities
from crazysim.lab.live.viewer import Slider, Widget
from crazysim.media.picture import Picture

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10", "max")
"""Speeds that the panel offers."""
TEXT_PERIOD, PLOT_PERIOD = 0.2, 0.1
"""Time between updates of the text and of the plot, s."""
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
    """Whether to keep the followed body in the middle."""
    plot: str
    """Quantity that is plotted; empty for none."""

    def __init__(self, server: Any, live: Live, follow: bool, plot: str):
        self._gui = gui = server.gui
        names = list(dict.fromkeys(["", *live.quantities, *list_quantities(live.sim)]))
        self.follow, self.plot = follow, plot if plot in names else ""
        gui.configure_theme(control_width="medium")
        self._text = gui.add_markdown("")
        self._text_time = self._plot_time = -np.inf
        self._samples = PlotSamples(PLOT_LENGTH)
        self._chart: Any = None
        with gui.add_folder("Time"):
            self._add_time_controls(gui, live)
        with gui.add_folder("Drone"):
            self._add_drone_controls(gui, live)
        if live.widgets:
            with gui.add_folder("Controls"):
                for widget in live.widgets:
                    self._add_widget(gui, live, widget)
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
            now: Present time (``time.perf_counter``), s.
        """
        if now - self._text_time >= TEXT_PERIOD:
            self._text_time = now
            self._text.content = f"**{picture.status}**"
            for element, value in zip((self._world_input, self._drone_input), picture.selected or (), strict=False):
                if element.value != value:
                    element.value = value
        if self._samples.add(picture, self.plot, MAX_LINES) and self._chart is not None:
            self._chart.remove()
            self._chart = None
        if len(self._samples) > 1 and now - self._plot_time >= PLOT_PERIOD:
            self._plot_time = now
            self._draw_chart()

    def _draw_chart(self) -> None:
        times, values = self._samples.arrays()
        data = (times, *values)
        if self._chart is not None:
            self._chart.data = data
            return
        lines = [
            {"label": str(k), "stroke": LINE_COLORS[k % len(LINE_COLORS)], "width": 1.5} for k in range(len(values))
        ]
        with self._plot_folder:
            self._chart = self._gui.add_uplot(
                data, ({"label": "s"}, *lines), title=self.plot, scales={"x": {"time": False}}, aspect=1.3
            )

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

    def _add_drone_controls(self, gui: Any, live: Live) -> None:
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

        follow = gui.add_checkbox("follow", self.follow)

        @follow.on_update
        def _(_: Any) -> None:
            self.follow = follow.value

        for name, (key, hotkey) in MOVEMENT_KEYS.items():
            self._add_key(gui, live, name, key, hotkey)

    def _add_key(self, gui: Any, live: Live, name: str, key: str, hotkey: str) -> None:
        command = gui.add_command(f"Fly: {name}", hotkey=hotkey)
        command.on_trigger(lambda _: live.keyboard.hold(key, KEY_HOLD_TIME))

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
