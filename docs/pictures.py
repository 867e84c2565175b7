"""Draw the pictures that the pages show: ``python docs/pictures.py [NAME ...]`` writes them to ``docs/pictures``.

``flight`` is the moving picture of the README, and ``mixed`` that of the page on features. The plots are those of
``crazysim demo`` (``tracks.png``), ``crazysim train`` (``training.png``) and ``benchmarks/scaling.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import crazysim.demos.mixed as demo
from crazysim import Follow, Sim
from crazysim.envs import flying
from crazysim.media import View
from crazysim.trajectories import figure_eight

FOLDER = Path(__file__).parent / "pictures"
COLOURS = np.array(
    [[0.1, 0.45, 0.95, 1], [0.95, 0.4, 0.1, 1], [0.15, 0.65, 0.3, 1], [0.75, 0.2, 0.6, 1], [0.9, 0.7, 0, 1]]
)
FPS = 20


def flight() -> None:
    """Five Crazyflies on one figure eight around two poles, for one period: the picture repeats without a jump."""
    path = figure_eight(width=1.8, depth=1.1, period=4.0, height=0.45)
    start = -float(path.duration) * np.arange(5) / 5
    sim = Sim(n_drones=5, control="state", controller="geometric")
    sim.scene.add("pole", count=2, pos=[[-0.5, 0, 0], [0.5, 0, 0]], height=0.9, radius=0.03)
    sim.add(Follow(path, start=start))
    at = jax.vmap(path.evaluate)(-start)
    sim.data = flying(sim.data, at.pos, vel=at.vel)
    camera = {"lookat": [0, 0, 0.36], "distance": 1.75, "azimuth": 105, "elevation": -24}
    view = View([0], 640, 360, cam_config=camera, trail=0.9, rgba=COLOURS)

    def frames() -> Iterator[Image.Image]:
        for frame in range(2 * 4 * FPS):
            sim.step(sim.freq // FPS)
            image = view.render(sim)
            if frame >= 4 * FPS:  # the first round fills the trails
                yield Image.fromarray(image)

    first, *rest = frames()
    first.save(
        FOLDER / "flight.webp", save_all=True, append_images=rest, duration=1000 // FPS, loop=0, quality=55, method=6
    )
    sim.close()


def mixed() -> None:
    """Two Crazyflies, a Bumblebee with a load, and two cars, one with a trailer, on hills."""
    sim = demo.build(1, "cpu")
    sim.step(round(7.5 * sim.freq))
    camera = {"lookat": [0, 0, 0.75], "distance": 3.4, "azimuth": 210, "elevation": -22}
    Image.fromarray(View([0], 960, 480, cam_config=camera).render(sim)).save(FOLDER / "mixed.jpg", quality=80)
    sim.close()


def main(names: list[str]) -> None:
    """Draw the named pictures, or all of them."""
    for draw in (flight, mixed):
        if not names or draw.__name__ in names:
            draw()
            print(f"drew {draw.__name__}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
