"""A hooked Bumblebee carries a load: it hovers under an LQR with load, and the load is pushed."""

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
PUSH, EVERY = 1.0, 2.0
"""Speed that a push gives the load, in a direction of its own in each world, m/s, and time between pushes, s."""


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
    sim, hook = build(n_worlds, n_drones, device)
    goal = np.asarray(hook.read(sim.data).pos)
    print(
        f"{counted(n_worlds, 'world')} of {counted(n_drones, 'drone')}, {sim.freq} Hz, {seconds:g} s, on {device}; "
        f"every {EVERY:g} s a push gives the load {PUSH:g} m/s"
    )
    width, height = film_size(960, 544)
    shown = np.concatenate(
        [goal - [0, 0, 0.2], goal + [0, 0, LENGTH + 0.2]], axis=1
    )  # from below loads to above rotors
    view = View(
        width=width, height=height, trail=1.0, cam_config={"elevation": -12}, hold=lambda _, world: shown[world]
    )
    out.mkdir(parents=True, exist_ok=True)
    flight = FilmedFlight(sim, out / "load.mp4", view, film)
    for k in range(n_frames):
        if k % round(EVERY * FPS) == 0:
            push(sim, hook, k // round(EVERY * FPS))
        flight.fly_frame()
        flight.film_frame()
        if k % FPS == FPS - 1:
            error = np.linalg.norm(np.asarray(hook.read(sim.data).pos) - goal, axis=-1)
            mean, most = 100 * error.mean(), 100 * error.max()
            print(f"{(k + 1) / FPS:4.0f} s   load {mean:5.1f} cm from its goal, {most:.1f} cm at most")
    flight.close_film()
    sim.close()
    flight.print_rate()


def build(n_worlds: int, n_drones: int, device: str) -> tuple[Sim, Hook]:
    """Return hooked Bumblebees in hover with their loads at rest, and the hook."""
    controller = LoadLQR(load_mass=MASS + 0.0203, length=LENGTH)
    sim = Sim(n_worlds, n_drones, "bumblebee", control="state", controller=controller, device=device)
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(HEIGHT)))
    hook = sim.add(Hook.bumblebee(MASS, dof=2, ring=0.0))
    command = np.zeros((n_worlds, n_drones, 16))
    command[..., :3], command[..., 12] = np.asarray(hook.read(sim.data).pos), 1.0
    sim.state_control(command)
    sim.build_default_data()
    return sim, hook


def push(sim: Sim, hook: Hook, number: int) -> None:
    """Push all loads, each push a quarter of a turn from the one before."""
    load, shape = hook.read(sim.data), (sim.n_worlds, sim.n_drones)
    angle = 2 * np.pi * np.arange(np.prod(shape)).reshape(shape) / np.prod(shape) + number * np.pi / 2
    gain = PUSH * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1).astype(np.float32)
    sim.data = hook.write(sim.data, load.replace(vel=load.vel + gain, tip_vel=load.tip_vel + gain))
