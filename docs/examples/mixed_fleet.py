"""Two Crazyflies and a Bumblebee with a load fly over two cars, one of them with a trailer, on hills.

Closest distances, contacts and tracking errors are measured in every world. Run as a script it also films the first
one.
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Cars, Follow, Sim, SlungLoad, Terrain
from crazysim.control import LoadLQR
from crazysim.envs import flying
from crazysim.media import Film, View
from crazysim.plugins import vehicles
from crazysim.trajectories import figure_eight, lissajous

FPS, DRONES, CARS = 25, ("cf21B_500", "cf21B_500", "bumblebee"), ("cars", "towing")
LOAD, LENGTH = 0.2, 0.4  # mass of the load, kg, and length of its rod, m
HILLS, SIZE = 0.4, (9.0, 7.0)  # height of the hills, and size of the terrain, m
INNER, OUTER = (1.3, 1.1, 7.5), (2.8, 2.2, 13.0)  # half axes of the cars' ellipses, m, and their periods, s
CAMERA = {"lookat": [0, 0, 0.75], "distance": 5.6, "azimuth": 90, "elevation": -26}


def hills():
    """Return the heights of the ground, m. (n_rows, n_columns)"""
    x, y = (np.linspace(-1, 1, n) * length / 2 for n, length in zip((46, 36), SIZE, strict=True))
    waves = 0.55 + 0.45 * np.sin(1.1 * x) * np.cos(1.3 * y[:, None])
    edge = np.cos(np.pi * x / SIZE[0]) * np.cos(np.pi * y[:, None] / SIZE[1])
    return HILLS * waves * np.sqrt(np.maximum(edge, 0))


def ellipse(x, y, period, height=0.0):
    """Return an ellipse with half axes along x and y, m, around the z axis."""
    return lissajous((x, y, 0.0), (1, 1, 1), (np.pi / 2, 0.0, 0.0), period=period, center=(0.0, 0.0, height))


@jax.jit
def evaluate(path, times):
    """Return the setpoints of a path at some times, s. (n, ...)"""
    return jax.vmap(path.evaluate)(times)


def build(n_worlds):
    """Return the fleet on its way; each world starts at another point of the paths."""
    controllers = ["lqr", LoadLQR(load_mass=LOAD, length=LENGTH)]
    is_loaded = np.broadcast_to([0, 0, 1], (n_worlds, len(DRONES)))
    sim = Sim(n_worlds, drone=DRONES, control="state", controller=controllers, switch=is_loaded)
    sim.add(Terrain(hills(), size=SIZE, rgba=(0.45, 0.55, 0.35, 1.0)))
    share = np.arange(n_worlds) / n_worlds
    for number, (name, path) in enumerate(zip(CARS, (ellipse(*INNER), ellipse(*OUTER)), strict=True)):
        time = share * float(path.duration)
        settings = {
            "path": path,
            "controller": vehicles.PathLQR(),
            "start": -time[:, None],
            "trailer": name == "towing",
        }
        cars = sim.add(Cars([f"Fleet1Tenth_{number}"], name=name, **settings))
        car = cars.read(sim.data)
        body_vel = np.array(car.body_vel)
        body_vel[:, 0, 0] = np.linalg.norm(evaluate(path, time).vel, axis=-1)
        sim.data = cars.write(sim.data, car.replace(body_vel=body_vel))
    # An eight above all, the escort of a car, and the Bumblebee's load.
    paths = [figure_eight(4.0, 2.5, period=8.0, height=2.4), ellipse(*INNER, HILLS + 0.45), ellipse(2.0, 1.0, 9.0, 1.4)]
    times = [share * float(path.duration) for path in paths]
    starts = [jax.device_get(evaluate(path, time)) for path, time in zip(paths, times, strict=True)]
    pos, vel = (np.stack([getattr(x, name) for x in starts], axis=1) for name in ("pos", "vel"))
    pos[:, 2, 2] += LENGTH
    sim.data = jax.jit(flying)(sim.data, pos, vel=vel)
    mass = np.broadcast_to([0.0, 0.0, LOAD], (n_worlds, len(DRONES)))
    load = sim.add(SlungLoad(mass=mass, length=LENGTH, size=(0.12, 0.12, 0.08)))
    sim.data = load.write(sim.data, load.read(sim.data).replace(vel=vel))
    sim.add(Follow(paths, start=-np.stack(times, axis=1), visible=False))
    sim.build_default_data()
    return sim


@jax.jit
def tracking_errors(data):
    """Return the distances of drones, or of their load, and of cars from their paths, m. (n_worlds, 5)"""
    follow, time = data.plugins["follow"], data.core.steps[:, :1] / data.core.freq
    goal = jax.vmap(jax.vmap(follow.slots.evaluate_one))(follow.index[..., 0], time - follow.start[..., 0]).pos
    body = data.states.pos.at[:, 2].set(data.plugins["load"].pos[:, 2])

    def off_path(car, index, arc, pos):
        return jnp.linalg.norm(pos - car.path.point_at(index, car.path.project(index, pos, arc)).pos)

    cars = [data.plugins[name] for name in CARS]
    errors = [
        jax.vmap(lambda *x, car=car: off_path(car, *x))(car.index[:, 0, 0], car.arc[:, 0, 0], car.pos[:, 0, :2])
        for car in cars
    ]
    return jnp.concatenate([jnp.linalg.norm(body - goal, axis=-1), jnp.stack(errors, axis=-1)], axis=-1)


def main(n_worlds=2, seconds=3, film=None):
    sim = build(n_worlds)
    parts = [name for name in sim.data.objects.names if name.startswith(CARS)]
    view, recording = View(width=960, height=544, trail=1.5, cam_config=CAMERA), None
    if film is not None:
        recording = Film(film, view, fps=FPS)
    closest, touches, errors = [], [], []
    for _ in range(seconds * FPS):
        sim.step(sim.freq // FPS)
        report = sim.contact_report(parts, floor=False)
        closest.append([report.drone_distance.min(), report.object_distance.min()])
        touches.append(report.any)
        errors.append(tracking_errors(sim.data))
        if recording is not None:
            recording.add(sim)
    closest, touches = np.min(closest, axis=0), np.any(touches, axis=(0, 2))
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    print(f"closest: {closest[0]:.2f} m between drones, {closest[1]:.2f} m to cars; contacts in {touches.sum()} worlds")
    for name, error in zip((*sim.names[:2], "the load", "the car", "the car with a trailer"), rms, strict=True):
        print(f"tracking error of {name}: {100 * error:.1f} cm RMS")
    if recording is not None:
        recording.close()
    sim.close()
    return closest, touches, rms


if __name__ == "__main__":
    main(seconds=14, film="mixed_fleet.mp4")
