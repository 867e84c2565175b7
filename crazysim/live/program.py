"""The command ``crazysim live``: drones that circle, and can be watched, piloted, commanded and recorded."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.live.browser import Browser
from crazysim.live.fleet import Fleet
from crazysim.live.gamepad import Gamepad
from crazysim.live.loop import Live
from crazysim.live.pace import LiveReport, Speed
from crazysim.live.piloting import Pilot, Sticks, keyboard_sticks
from crazysim.live.remote import RemoteCommands
from crazysim.live.server import CommandServer
from crazysim.live.window import Window
from crazysim.sim.sim import Sim

if TYPE_CHECKING:
    from argparse import Namespace

HEIGHT = 1.0
"""Height of the circles, m."""
RADIUS = 0.3
"""Radius of the circles, m."""
PERIOD = 4.0
"""Time of a circle, s."""
CLIMB = 2.0
"""Time in which the drones rise to their circles, s."""


class Circles:
    """Process that lets drones rise and fly circles around where they stood."""

    def __init__(self, live: Live, piloted: bool):
        """Take the places of the drones.

        Args:
            live: Loop.
            piloted: True to let the first drone of the first world hover, for a pilot.
        """
        self._places = np.asarray(live.sim.data.states.pos, float).copy()
        self._piloted = piloted

    def __call__(self, live: Live) -> None:
        """Write the setpoints of this control step."""
        command = circling(self._places, live.time)
        if self._piloted:
            if live.time > CLIMB:
                command[0, 0] = live.command[0, 0]
            else:
                command[0, 0, :2], command[0, 0, 3:9] = self._places[0, 0, :2], 0.0
        live.command[:] = command


def circling(places: NDArray, time: float) -> NDArray:
    """Return state commands of drones that rise above places, and circle. (n_worlds, n_drones, 16)

    Args:
        places: Positions, m. (n_worlds, n_drones, 3)
        time: Time since the start, s.
    """
    rise = np.clip(time / CLIMB, 0.0, 1.0)
    part = rise**2 * (3 - 2 * rise)
    omega = 2 * np.pi / PERIOD
    c, s = np.cos(omega * time), np.sin(omega * time)
    command = np.zeros((*places.shape[:2], 16))
    command[..., :3] = places + part * np.array([RADIUS * (c - 1), RADIUS * s, HEIGHT])
    command[..., 3:6] = part * RADIUS * omega * np.array([-s, c, 0.0])
    command[..., 6:9] = part * RADIUS * omega**2 * np.array([-c, -s, 0.0])
    command[..., 12] = 1.0
    return command


def fly(
    n_drones: int = 4,
    n_worlds: int = 1,
    seconds: float | None = None,
    speed: Speed = 1.0,
    viewers: Sequence[str] = (),
    control_freq: int = 100,
    freq: int = 500,
    fps: float = 50.0,
    port: int = 8080,
    host: str = "127.0.0.1",
    record: str | Path | None = None,
    pilot: bool = False,
    gamepad: bool = False,
    commands: bool = False,
    **settings: Any,
) -> LiveReport:
    """Fly drones live, and return the figures.

    Args:
        n_drones: Drones in each world.
        n_worlds: Number of worlds.
        seconds: Simulated time, s; None until all viewers are closed, or Ctrl-C.
        speed: Simulated seconds per second, or ``"max"``.
        viewers: ``"window"``, ``"browser"``, both or none.
        control_freq: Rate of control steps, Hz.
        freq: Rate of physics steps, Hz.
        fps: Pictures per second.
        port: Port of the browser's page; 0 for any free one.
        host: Address of that page.
        record: File to record to; None for none.
        pilot: True to pilot the first drone by keyboard, in a viewer.
        gamepad: True to pilot it by gamepad too.
        commands: True to listen for commands over TCP, as ``crazysim.live.CommandServer``; the drones wait for them.
        settings: Further settings of ``Sim``, such as ``drone``.

    Raises:
        ConfigError: If a setting is invalid, or there is no gamepad.
        RenderError: If this machine cannot show a viewer, or a port is in use.
    """
    if commands and (pilot or gamepad):
        raise ConfigError(
            "expected commands over TCP or a pilot, got both. Leave out --commands, or --pilot and --gamepad."
        )
    sim = Sim(n_worlds, n_drones, control="state", freq=freq, state_freq=control_freq, **settings)
    with contextlib.ExitStack() as stack:
        live = stack.enter_context(Live(sim, control_freq, speed, fps))
        if commands:
            fleet = Fleet(sim, teleport=False)
            server = stack.enter_context(CommandServer())
            live.add(RemoteCommands(fleet, server), name="commands")
        else:
            live.add(Circles(live, piloted=pilot or gamepad), name="circles")
        if pilot or gamepad:
            sticks: list[Sticks] = [keyboard_sticks]
            if gamepad:
                sticks.append(Gamepad())
            flown = Pilot(sticks)
            live.add(flown, name="pilot")
            live.on_click = flown.go_to
        for viewer in viewers:
            if viewer == "browser":
                print(
                    f"open {live.show(Browser(port, host, contacts=n_worlds == 1)).url}; stop with Ctrl-C", flush=True
                )
            else:
                live.show(Window(worlds=tuple(range(min(n_worlds, 9)))))
        if record is not None:
            print(f"recording to {live.record(record)}", flush=True)
        return live.run(seconds)


def run(options: Namespace) -> None:
    """Run the command with its options, and print the figures."""
    viewers = [name for name in ("window", "browser") if getattr(options, name)]
    if options.headless and viewers:
        raise ConfigError(f"expected --headless or --{viewers[0]}, got both. Leave one out.")
    if options.headless and options.seconds is None:
        raise ConfigError("expected --seconds with --headless, got none. Use --seconds 20, for example.")
    if not options.headless and not viewers:
        viewers = ["window" if _has_screen() else "browser"]
    given = {name: x for name in ("drone", "device", "controller") if (x := getattr(options, name)) is not None}
    report = fly(
        options.drones, options.worlds, options.seconds, parse_speed(options.speed), viewers, options.control_freq,
        options.freq, options.fps, options.port, options.host, options.record, options.pilot, options.gamepad,
        options.commands, **given,
    )  # fmt: skip
    print(report)


def parse_speed(text: str) -> Speed:
    """Return the speed of a command line.

    Raises:
        ConfigError: If it is neither a number nor ``max``.
    """
    if text == "max":
        return "max"
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"expected a positive speed or max, got {text!r}") from None


def _has_screen() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
