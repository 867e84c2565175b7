"""Fly a drone with the keyboard, in a window or in a browser.

    python keyboard_flight.py            # a window
    python keyboard_flight.py browser    # a page, whose address is printed

Arrow keys fly forwards, backwards and sideways, W and S up and down, A and D turn; tab selects another drone, space
pauses, R records. Without an argument and without a screen, the example presses the keys itself, and prints where the
drone arrives.
"""

import os
import sys

import numpy as np

from crazysim import Sim
from crazysim.lab.live import Browser, Live, Pilot, Window

KEYS = (("up", 3.0, 4.0), ("left", 4.5, 5.5), ("w", 6.0, 6.5), ("a", 6.5, 7.5))
"""Keys that the example presses itself, with the times at which they are pressed and released, s."""


def build(speed):
    """Return a live simulation of three drones that hover at 1 m, with a pilot, a slalom of poles and some buttons."""
    sim = Sim(n_drones=3, control="state", freq=500)
    sim.scene.add("pole", count=4, pos=[[x, 1.0, 0.0] for x in (-1.5, -0.5, 0.5, 1.5)], height=1.5, mocap=False)
    live = Live(sim, control_freq=100, speed=speed)
    pilot = Pilot(speed=1.0, high=(5.0, 5.0, 3.0))
    live.add(pilot)
    live.on_click = pilot.go_to
    live.command[..., 2] = 1.0
    live.button("Land all", lambda live: live.command[..., 2].fill(0.05), key="l")
    live.quantities["distance from the origin"] = lambda live: np.linalg.norm(live.sim.data.states.pos[live.selected])
    return live


def main():
    """Fly until the window is closed; without a screen press the keys of ``KEYS``, and return where the drone is."""
    browser = len(sys.argv) > 1 and sys.argv[1] == "browser"
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform != "linux"
    watched = browser or (screen and __name__ == "__main__")
    with build(speed=1.0 if watched else "max") as live:
        if watched:
            viewer = live.show(Browser() if browser else Window(follow=True, contacts=True))
            print(f"open {viewer.url}" if browser else "close the window, or press escape, to end")
            print(live.run())
            return None
        for key, pressed, released in KEYS:
            live.call_at(pressed, lambda live, key=key: live.keyboard.press(key))
            live.call_at(released, lambda live, key=key: live.keyboard.release(key))
        report = live.run(9.0)
        pos = np.asarray(live.sim.data.states.pos[0, 0])
        print(f"flown to {np.round(pos, 1)}, {report.factor:.0f} times as fast as real time")
        return pos


if __name__ == "__main__":
    main()
