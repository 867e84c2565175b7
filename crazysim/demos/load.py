"""A hooked Bumblebee carries a load: it hovers under an LQR with load, and is pushed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crazysim.control import LoadLQR
from crazysim.demos.common import FPS, FilmedFlight, counted, frames_of
from crazysim.media import View
from crazysim.plugins.payloads import Hook
from crazysim.scene.software import film_size
from crazysim.sim.sim import Sim

MASS, LENGTH, HEIGHT = 0.2, 0.4, 1.2
"""Mass of the load, kg, length of the rod, m, and height of the drone, m."""
PUSH = 1.0
"""Speed that the load has at the start, in a direction of its own in each world, m/s."""


def run(
    n_worlds: int = 1,
    n_drones: int = 1,
    seconds: float = 8.0,
    device: str = "cpu",
    out: Path = Path("out"),
    film: bool = True,
) -> None:
    """Fly, print how the load comes to rest, and write ``load.mp4`` into a folder.

    Args:
        n_worlds: Number of worlds.
        n_drones: Number of drones per world, each with a load.
        seconds: Duration of the flight, s.
        device: Device of the simulation, such as ``"cpu"``.
        out: Folder of the film.
        film: True to write a film.

    Raises:
        ValueError: If the flight is shorter than one frame.
    """
    n_frames = frames_of(seconds)
    sim = build(n_worlds, n_drones, device)
    goal = np.asarray(sim.data.plugins["load"].pos)
    print(f"{counted(n_worlds, 'world')} of {counted(n_drones, 'drone')}, {sim.freq} Hz, {seconds:g} s, on {device}")
    width, height = film_size(960, 544)
    view = View(
        width=width, height=height, trail=1.0, cam_config={"lookat": [0, 0, 0.9], "distance": 2.6, "elevation": -12}
    )
    out.mkdir(parents=True, exist_ok=True)
    flight = FilmedFlight(sim, out / "load.mp4", view, film)
    for k in range(n_frames):
        flight.fly_frame()
        flight.film_frame()
        if k % FPS == FPS - 1:
            error = np.linalg.norm(np.asarray(sim.data.plugins["load"].pos) - goal, axis=-1)
            mean, most = 100 * error.mean(), 100 * error.max()
            print(f"{(k + 1) / FPS:4.0f} s   load {mean:5.1f} cm from its goal, {most:.1f} cm at most")
    flight.close_film()
    sim.close()
    flight.print_rate()


def build(n_worlds: int, n_drones: int, device: str) -> Sim:
    """Return hooked Bumblebees in hover, whose loads swing in every direction."""
    controller = LoadLQR(load_mass=MASS + 0.0203, length=LENGTH)
    sim = Sim(n_worlds, n_drones, "bumblebee", control="state", controller=controller, device=device)
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(HEIGHT)))
    hook = sim.add(Hook.bumblebee(MASS, dof=2, ring=0.0))
    load = hook.read(sim.data)
    angle = 2 * np.pi * np.arange(n_worlds * n_drones).reshape(n_worlds, n_drones) / (n_worlds * n_drones)
    push = PUSH * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1).astype(np.float32)
    sim.data = hook.write(sim.data, load.replace(vel=load.vel + push, tip_vel=load.tip_vel + push))
    command = np.zeros((n_worlds, n_drones, 16))
    command[..., :3], command[..., 12] = np.asarray(load.pos), 1.0
    sim.state_control(command)
    sim.build_default_data()
    return sim
