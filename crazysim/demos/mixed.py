"""A mixed fleet: two Crazyflies, a Bumblebee with a load, and two cars, one with a trailer, on hilly ground."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import LoadLQR, Setpoint
from crazysim.core.data import SimData
from crazysim.demos.common import FPS, FilmedFlight, counted, frames_of
from crazysim.envs.spawn import flying
from crazysim.media import View
from crazysim.plugins.contacts.terrain import Terrain
from crazysim.plugins.follow import Follow
from crazysim.plugins.payloads import SlungLoad
from crazysim.plugins.vehicles import Cars, PathLQR
from crazysim.plugins.vehicles.car_data import CarData
from crazysim.pytree import PyTree
from crazysim.scene.software import film_size
from crazysim.sim.sim import Sim
from crazysim.trajectories import Trajectory, figure_eight, lissajous

DRONES = ("cf21B_500", "cf21B_500", "bumblebee")
"""Airframes of the drones."""
CARS = ("cars", "towing")
"""Names of the populations: a car, and a car with a trailer."""
LOAD, LENGTH = 0.2, 0.4
"""Mass of the Bumblebee's load, kg, and length of its rod, m."""
HILLS, SIZE, GRASS = 0.4, (9.0, 7.0), (0.45, 0.55, 0.35, 1.0)
"""Height of the hills, size of the terrain along x and y, m, and its colour."""
INNER, OUTER = (1.3, 1.1, 7.5), (2.8, 2.2, 13.0)
"""Half axes of the cars' paths, m, and their periods, s."""
ABOVE = 0.45
"""Height of the second Crazyflie above the path of the car that it escorts, m."""
CAMERA = {"lookat": [0, 0, 0.75], "distance": 5.6, "azimuth": 90, "elevation": -26}
"""Camera of the film, which has both ellipses and the figure eight in its picture."""
SETTLED = 2.0
"""Time after which tracking errors count: until then cars and drones gather speed, s."""


class Frame(PyTree):
    """Distances and errors at one time."""

    drones: Array
    """Smallest distance of two drones of a world. (n_worlds,)"""
    cars: Array
    """Smallest distance of a drone and a car or trailer. (n_worlds,)"""
    touches: Array
    """True where a drone touches another or a car. (n_worlds, n_drones)"""
    drone_errors: Array
    """Distances of the drones from their setpoints, of the Bumblebee's load from its own. (n_worlds, n_drones)"""
    car_errors: Array
    """Distances of the cars from their paths. (n_worlds, 2)"""


def run(
    n_worlds: int = 1,
    n_drones: int = len(DRONES),
    seconds: float = 14.0,
    device: str = "cpu",
    out: Path = Path("out"),
    film: bool = True,
) -> None:
    """Fly and drive, print distances, contacts and errors, and write ``mixed.mp4`` into a folder.

    Args:
        n_worlds: Number of worlds.
        n_drones: Number of drones per world, 3.
        seconds: Duration, s.
        device: Device of the simulation, such as ``"cpu"``.
        out: Folder of the film.
        film: True to write a film.

    Raises:
        ValueError: If the flight is shorter than one frame, or the number of drones is not 3.
    """
    n_frames = frames_of(seconds)
    if n_drones != len(DRONES):
        raise ValueError(f"expected --drones {len(DRONES)}, the mixed fleet of this demonstration, got {n_drones}")
    sim = build(n_worlds, device)
    engine = sim.explain().splitlines()[0]
    print(
        f"{counted(n_worlds, 'world')} of {', '.join(sim.names)}, {sim.freq} Hz, {seconds:g} s, on {device}, {engine}"
    )
    width, height = film_size(960, 544)
    view = View(width=width, height=height, trail=1.5, cam_config=CAMERA)
    out.mkdir(parents=True, exist_ok=True)
    flight = FilmedFlight(sim, out / "mixed.mp4", view, film)
    measure, frames = build_measure(sim), []
    for _ in range(n_frames):
        flight.fly_frame()
        flight.film_frame()
        frames.append(measure())
    report(sim, jax.tree.map(lambda *x: np.stack(x), *frames))
    flight.print_rate()
    flight.close_film()
    sim.close()


def build(n_worlds: int, device: str) -> Sim:
    """Return the fleet on its way; the worlds begin at other places of the paths."""
    controllers = ["lqr", LoadLQR(load_mass=LOAD, length=LENGTH)]
    is_loaded = np.broadcast_to([0, 0, 1], (n_worlds, len(DRONES)))
    sim = Sim(n_worlds, drone=DRONES, control="state", controller=controllers, switch=is_loaded, device=device)
    sim.add(Terrain(hills(), size=SIZE, rgba=GRASS))
    share = np.arange(n_worlds) / n_worlds
    for number, (name, path) in enumerate(zip(CARS, (ellipse(*INNER), ellipse(*OUTER)), strict=True)):
        time = share * float(path.duration)
        settings = {"path": path, "controller": PathLQR(), "start": -time[:, None], "trailer": name == "towing"}
        cars = sim.add(Cars([f"Fleet1Tenth_{number}"], name=name, **settings))
        car = cars.read(sim.data)
        body_vel = np.array(car.body_vel)
        body_vel[:, 0, 0] = np.linalg.norm(jax.device_get(_evaluate(path, time)).vel, axis=-1)
        sim.data = cars.write(sim.data, car.replace(body_vel=body_vel))
    paths = flown()
    times = [share * float(path.duration) for path in paths]
    at = [jax.device_get(_evaluate(path, time)) for path, time in zip(paths, times, strict=True)]
    pos, vel = (np.stack([getattr(x, name) for x in at], axis=1) for name in ("pos", "vel"))
    pos[:, 2, 2] += LENGTH
    sim.data = jax.jit(flying)(sim.data, pos, vel=vel)
    mass = np.broadcast_to([0.0, 0.0, LOAD], (n_worlds, len(DRONES)))
    load = sim.add(SlungLoad(mass=mass, length=LENGTH, size=(0.12, 0.12, 0.08)))
    sim.data = load.write(sim.data, load.read(sim.data).replace(vel=vel))
    sim.add(Follow(paths, start=-np.stack(times, axis=1), visible=False))
    sim.build_default_data()
    return sim


@jax.jit
def _evaluate(path: Trajectory, times: Array) -> Setpoint:
    """Return the setpoints of a path at some times, s. (n, ...)"""
    return jax.vmap(path.evaluate)(times)


def hills() -> np.ndarray:
    """Return the heights of the ground, m. (n_rows, n_columns)"""
    x, y = (np.linspace(-1, 1, n) * length / 2 for n, length in zip((46, 36), SIZE, strict=True))
    waves = 0.55 + 0.45 * np.sin(1.1 * x) * np.cos(1.3 * y[:, None])
    edge = np.cos(np.pi * x / SIZE[0]) * np.cos(np.pi * y[:, None] / SIZE[1])
    return HILLS * waves * np.sqrt(np.maximum(edge, 0))


def ellipse(x: float, y: float, period: float, height: float = 0.0) -> Trajectory:
    """Return an ellipse with half axes along x and y, m, around the z axis."""
    return lissajous((x, y, 0.0), (1, 1, 1), (np.pi / 2, 0.0, 0.0), period=period, center=(0.0, 0.0, height))


def flown() -> list[Trajectory]:
    """Return the trajectories of an eight above all, of the escort of a car, and of the Bumblebee's load."""
    return [figure_eight(4.0, 2.5, period=8.0, height=2.4), ellipse(*INNER, HILLS + ABOVE), ellipse(2.0, 1.0, 9.0, 1.4)]


def build_measure(sim: Sim) -> Callable[[], Frame]:
    """Return a function that measures the fleet at the present time."""
    parts = [name for name in sim.data.objects.names if name.startswith(CARS)]  # type: ignore[union-attr]

    @jax.jit
    def errors(data: SimData) -> tuple[Array, Array]:
        follow, time = data.plugins["follow"], data.core.steps[:, :1] / data.core.freq
        evaluate = jax.vmap(jax.vmap(follow.trajectories.evaluate_one))
        goal = evaluate(follow.index[..., 0], time - follow.start[..., 0]).pos
        body = data.states.pos.at[:, 2].set(data.plugins["load"].pos[:, 2])
        off = [off_path(data.plugins[name]) for name in CARS]
        return jnp.linalg.norm(body - goal, axis=-1), jnp.concatenate(off, axis=-1)

    def measure() -> Frame:
        seen = sim.contact_report(parts, floor=False)
        near = seen.drone_distance.min(-1), seen.object_distance.min((-2, -1))  # type: ignore[union-attr]
        return jax.device_get(Frame(*near, seen.any, *errors(sim.data)))

    return measure


def off_path(car: CarData) -> Array:
    """Return the distances of all cars from their paths, m. (n_worlds, n_members)"""

    def one(index: Array, arc: Array, pos: Array) -> Array:
        nearest = car.path.at(index, car.path.project(index, pos, arc)).pos  # type: ignore[union-attr]
        return jnp.linalg.norm(pos - nearest)

    return jax.vmap(jax.vmap(one))(car.index[..., 0], car.arc[..., 0], car.pos[..., :2])  # type: ignore[index]


def report(sim: Sim, frames: Frame) -> None:
    """Print closest distances, contacts, and the tracking error of each vehicle.

    Args:
        sim: The simulation.
        frames: All measurements. Leaves (n_frames, n_worlds, ...)
    """
    print(
        f"closest           {100 * frames.drones.min():.1f} cm between drones, {100 * frames.cars.min():.1f} cm to cars"
    )
    began = frames.touches[1:] & ~frames.touches[:-1]
    n_begun, n_worlds = int(began.sum() + frames.touches[0].sum()), int(frames.touches.any((0, 2)).sum())
    print(f"contacts          {n_begun:,} begun, in {n_worlds:,} of {counted(sim.n_worlds, 'world')}")
    names = [name + "'s load" * (name == "Bumblebee_0") for name in sim.names]
    first = min(round(SETTLED * FPS), len(frames.drones) - 1)
    errors = 100 * np.concatenate([frames.drone_errors, frames.car_errors], axis=-1)[first:]
    for k, name in enumerate(names):
        rms, most = np.sqrt(np.mean(errors[..., k] ** 2)), errors[..., k].max()
        print(f"tracking error    {name:18} {rms:5.2f} cm RMS, {most:.2f} cm at most")
