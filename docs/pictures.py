"""Draw the pictures that the pages show: ``python docs/pictures.py [NAME ...]`` writes them to ``docs/pictures``.

``flight`` is the moving picture of the README. ``mixed`` is for the page on features, ``scenery`` for the page on
scenery, ``allan`` and ``measured`` are for the page on sensors, ``cameras`` and ``lidar`` for the page on cameras. The
other plots are written by ``crazysim demo`` (``tracks.png``), ``crazysim train`` (``training.png``) and
``benchmarks/scaling.py``. The first command of the page on your own task writes ``two_hoops_curve.png`` and
``two_hoops_episode.png`` as ``curve.png`` and ``episode.png``, and ``two_hoops.jpg`` shows its policy after 0.9 s.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import matplotlib as mpl
import numpy as np
from examples import mixed_fleet
from PIL import Image

from crazysim import IMU, Camera, Clutter, Follow, Forest, Gates, Lidar, MotionCapture, Pillars, Rooms, Sim
from crazysim.envs import flying
from crazysim.media import View
from crazysim.plugins import sensors
from crazysim.plugins.sensors.imu import RAD_PER_DEGREE, STANDARD_GRAVITY
from crazysim.scene.depth import extrapolate
from crazysim.trajectories import figure_eight

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.colors import hsv_to_rgb

FOLDER = Path(__file__).parent / "pictures"
COLOURS = np.array(
    [[0.1, 0.45, 0.95, 1], [0.95, 0.4, 0.1, 1], [0.15, 0.65, 0.3, 1], [0.75, 0.2, 0.6, 1], [0.9, 0.7, 0, 1]]
)
FPS = 20
MESH = [[0.0, 0.0, 0.4], [0.4, 0.0, -0.15], [-0.2, 0.35, -0.15], [-0.2, -0.35, -0.15]]
"""Corners of a tetrahedron, m."""


def flight() -> None:
    """Five Crazyflies on one figure eight around two poles, for one period: the picture repeats without a jump."""
    path = figure_eight(width=1.8, depth=1.1, period=4.0, height=0.45)
    start_times = -float(path.duration) * np.arange(5) / 5
    sim = Sim(n_drones=5, control="state", controller="geometric")
    sim.scene.add("pole", count=2, pos=[[-0.5, 0, 0], [0.5, 0, 0]], height=0.9, radius=0.03)
    sim.add(Follow(path, start=start_times))
    positions = jax.vmap(path.evaluate)(-start_times)
    sim.data = flying(sim.data, positions.pos, vel=positions.vel)
    camera = {"lookat": [0, 0, 0.36], "distance": 1.75, "azimuth": 105, "elevation": -24}
    view = View([0], 640, 360, cam_config=camera, trail=0.9, rgba=COLOURS)

    def frames() -> Iterator[Image.Image]:
        for frame in range(2 * 4 * FPS):
            sim.step(sim.freq // FPS)
            image = view.render(sim)
            if frame >= 4 * FPS:  # the first round fills the trails
                yield Image.fromarray(image)

    first_frame, *other_frames = frames()
    first_frame.save(
        FOLDER / "flight.webp",
        save_all=True,
        append_images=other_frames,
        duration=1000 // FPS,
        loop=0,
        quality=55,
        method=6,
    )
    sim.close()


def mixed() -> None:
    """Two Crazyflies, a Bumblebee with a load, and two cars, one with a trailer, on hills."""
    sim = mixed_fleet.build(1)
    sim.step(round(7.5 * sim.freq))
    camera = {"lookat": [0, 0, 0.75], "distance": 3.4, "azimuth": 210, "elevation": -22}
    Image.fromarray(View([0], 960, 480, cam_config=camera).render(sim)).save(FOLDER / "mixed.jpg", quality=80)
    sim.close()


def scenery() -> None:
    """One forest in two worlds, pillars, clutter, gates and rooms."""
    above = {"lookat": [0, 0, 1], "distance": 17, "azimuth": 120, "elevation": -35}
    layouts = [
        (Forest(size=(20.0, 16.0)), 0, above | {"distance": 23}),
        (Forest(size=(20.0, 16.0)), 1, above | {"distance": 23}),
        (Pillars(size=(16.0, 12.0), density=0.25), 0, above | {"distance": 14}),
        (Clutter(meshes=[MESH]), 0, above | {"distance": 12, "elevation": -25}),
        (Gates(spacing=3.0), 0, {"lookat": [9.5, 0, 0.8], "distance": 12, "azimuth": 115, "elevation": -22}),
        (Rooms(), 0, above | {"distance": 13, "elevation": -50}),
    ]
    canvas = Image.new("RGB", (3 * 320, 2 * 220))
    for k, (layout, world, camera) in enumerate(layouts):
        sim = Sim(n_worlds=2, rng_key=3)
        sim.add(layout)
        sim.reset()
        image = sim.render("rgb_array", world, cam_config=camera, width=640, height=440)
        canvas.paste(Image.fromarray(np.asarray(image)).resize((320, 220)), (k % 3 * 320, k // 3 * 220))
        sim.close()
    canvas.save(FOLDER / "scenery.jpg", quality=80)


def allan() -> None:
    """Allan deviation of gyroscope and accelerometer of simulated BMI088 at rest, and as their numbers determine it."""
    n, freq = 32, 100
    sim = Sim(n, control="rotor_vel", freq=freq, rng_key=2)
    gyro = sensors.Triad(noise=0.014 * RAD_PER_DEGREE, instability=5.1e-5, correlation_time=20.0, random_walk=5e-6)
    accel = sensors.Triad(noise=160e-6 * STANDARD_GRAVITY, instability=3e-4, correlation_time=20.0, random_walk=3e-5)
    sim.add(IMU(gyro=gyro, accel=accel))
    records = sim.rollout(
        lambda _, data: data.controls.rotor_vel, None, 400 * freq, keep=lambda data: data.plugins["imu"].samples.value
    )
    samples = np.asarray(records, np.float64)[freq:, :, 0]  # in the first second the drones come to rest on the floor
    m = np.unique(np.logspace(0, 4.1, 24).astype(int))
    t, fine = m / freq, np.logspace(-2, 2.1, 200)
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.2), layout="constrained")
    for axis, triad, column, unit in ((axes[0], gyro, 0, "rad/s"), (axes[1], accel, 3, "m/s²")):
        total = np.cumsum(samples[..., column : column + 3], axis=0) / freq
        steps = [total[2 * k :] - 2 * total[k:-k] + total[: -2 * k] for k in m]
        deviations = [np.sqrt(np.mean(x**2) / 2) / (k / freq) for x, k in zip(steps, m, strict=True)]
        ratio = fine / triad.correlation_time
        wander = triad.instability**2 * (2 * ratio - 3 + 4 * np.exp(-ratio) - np.exp(-2 * ratio)) / ratio**2
        white, walk = triad.noise**2 / (2 * fine), triad.random_walk**2 * fine / 3
        axis.loglog(fine, np.sqrt(white + wander + walk), "k-", lw=1, label="of the parameters")
        for part, name in ((white, "white noise"), (wander, "wandering bias"), (walk, "random walk")):
            axis.loglog(fine, np.sqrt(part), "--", lw=0.8, label=name)
        axis.loglog(t, deviations, "o", ms=4, mfc="none", label=f"simulated, {n} units")
        axis.set(xlabel="averaging time, s", ylabel=f"Allan deviation, {unit}")
        axis.set_ylim(min(deviations) / 4, max(deviations) * 2)
        axis.grid(alpha=0.3)
    axes[0].set_title("gyroscope")
    axes[1].set_title("accelerometer")
    axes[0].legend(fontsize=7)
    figure.savefig(FOLDER / "allan.png", dpi=100)
    plt.close(figure)


def measured() -> None:
    """A Crazyflie on a figure eight: its motion, and the measurements of its sensors."""
    path = figure_eight(width=1.8, depth=1.1, period=4.0, height=0.6)
    sim = Sim(control="state", rng_key=3)
    sim.add(Follow(path))
    start_setpoint = path.evaluate(0.0)
    sim.data = flying(sim.data, start_setpoint.pos[None], vel=start_setpoint.vel[None])
    sim.add(MotionCapture(5e-3, delay=0.02, dropout=0.1, bandwidth=10.0))
    sim.add(IMU.bmi088())
    sim.add(sensors.TimeOfFlight())
    true_values, measured_values = [], []
    for _ in range(4 * 100):
        sim.step(sim.freq // 100)
        s, observations = sim.data.states, sim.plugins.observations(sim.data)
        true_values.append([s.vel[0, 0, 0], s.ang_vel[0, 0, 1], s.pos[0, 0, 2]])
        names = ("motion_capture.vel", "imu.gyro", "time_of_flight.distance")
        measured_values.append([observations[name][0, 0, k] for name, k in zip(names, (0, 1, 0), strict=True)])
    t, true_values, measured_values = np.arange(1, 401) / 100, np.array(true_values), np.array(measured_values)
    figure, axes = plt.subplots(3, 1, figsize=(8.4, 5.4), sharex=True, layout="constrained")
    labels = ("velocity x, m/s\nMotionCapture", "pitch rate, rad/s\nIMU.bmi088()", "height, m\nTimeOfFlight (slanted)")
    for k, (axis, label) in enumerate(zip(axes, labels, strict=True)):
        axis.step(t, measured_values[:, k], where="post", lw=0.9, color="tab:orange", label="measured")
        axis.plot(t, true_values[:, k], lw=1.2, color="tab:blue", label="true")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0].legend(loc="upper center", fontsize=8)
    axes[-1].set_xlabel("time, s")
    figure.savefig(FOLDER / "measured.png", dpi=100)
    plt.close(figure)


def camera_scene(n_drones: int = 1) -> Sim:
    """Return a simulation of a drone before a gate, poles, a ball, boxes and a wall."""
    sim = Sim(n_drones=n_drones, control="state", rng_key=4)
    sim.scene.add("gate", pos=[2.0, 0.35, 1.0], width=0.7, height=0.7, stand=1.0, mocap=False)
    sim.scene.add(
        "pole", count=3, pos=[[1.3, -0.5, 0], [2.6, -0.9, 0], [3.0, 1.4, 0]], height=2.0, radius=0.06, mocap=False
    )
    sim.scene.add("sphere", pos=[1.6, -0.1, 0.55], radius=0.2)
    sim.scene.add("box", count=2, pos=[[2.2, -0.45, 0.2], [-1.5, 1.5, 0.4]], size=(0.4, 0.4, 0.8), mocap=False)
    sim.scene.add("wall", count=2, pos=[[4.5, 0, 0], [-3.0, 0, 0]], length=7.0, height=2.6, mocap=False)
    sim.data = flying(sim.data, np.array([[0.0, 0.0, 0.9]]))
    return sim


def cameras() -> None:
    """What a camera in one scene sees: each output, noise, a lens, and the motion of the drone and of the ball."""
    sim, size = camera_scene(), (160, 120)
    clean = Camera(*size, outputs=("rgb", "gray", "depth", "normal", "segmentation"), max_depth=6.0)
    images = jax.jit(clean.image_fn(sim))(sim.data)
    stereo = Camera(*size, max_depth=6.0, noise=sensors.StereoNoise())
    lens = Camera(*size, max_depth=6.0, distortion=sensors.Distortion(k1=-0.25, k2=0.05))
    noisy, bent = (jax.jit(camera.image_fn(sim))(sim.data)["depth"][0, 0] for camera in (stereo, lens))
    # The drone flies ahead and turns to the left; the ball moves to the right.
    moving = sim.data.replace(
        states=sim.data.states.replace(
            vel=np.full((1, 1, 3), np.float32([3, 0, 0])), ang_vel=np.full((1, 1, 3), np.float32([0, 0, 1.2]))
        ),
        objects=sim.data.objects.replace(vel=np.full((1, 1, 1, 3), np.float32([0, -4, 0]))),
    )
    flow_camera = Camera(*size, outputs=("flow", "flow_valid"))
    motion = jax.jit(flow_camera.image_fn(sim))(moving, extrapolate(moving, -0.05))
    u, v = np.moveaxis(np.asarray(motion["flow"][0, 0]), -1, 0)
    speed = np.hypot(u, v)
    hue = np.stack([np.arctan2(v, u) / (2 * np.pi) % 1, np.clip(speed / 8, 0, 1), np.ones_like(u)], axis=-1)
    blurred, rolling = (
        jax.jit(camera.image_fn(sim))(moving)["rgb"][0, 0]
        for camera in (
            Camera(*size, outputs=("rgb",), exposure=0.05, blur_samples=32),
            Camera(*size, outputs=("rgb",), readout=0.1),
        )
    )
    figure, axes = plt.subplots(3, 4, figsize=(11.2, 6.6), layout="constrained")
    depths = {"vmin": 0, "vmax": 6, "cmap": "viridis_r"}
    segments = np.asarray(images["segmentation"][0, 0])
    panels = [
        ("sim.render, by MuJoCo", sim.render("rgb_array", camera="fpv_cam:0", width=size[0], height=size[1]), {}),
        ('"rgb"', images["rgb"][0, 0], {}),
        ('"gray"', images["gray"][0, 0], {"cmap": "gray", "vmin": 0, "vmax": 255}),
        ('"depth", m', images["depth"][0, 0], depths),
        ('"normal", as red, green and blue', 0.5 + 0.5 * np.asarray(images["normal"][0, 0]), {}),
        ('"segmentation"', np.ma.masked_less(segments, 0), {"cmap": "tab10", "interpolation": "nearest"}),
        ("depth with StereoNoise(), holes white", np.ma.masked_equal(noisy, 0), depths),
        ("depth through a lens, k1=-0.25", bent, depths),
        ('"flow": hue by direction, paler if slow', hsv_to_rgb(hue), {}),
        ('"flow_valid", in white', motion["flow_valid"][0, 0], {"cmap": "gray"}),
        ('"rgb" with exposure=0.05', blurred, {}),
        ('"rgb" with readout=0.1', rolling, {}),
    ]
    for axis, (title, image, options) in zip(axes.ravel(), panels, strict=True):
        shown = axis.imshow(image, **options)
        axis.set_title(title, fontsize=9)
        axis.axis("off")
        if options is depths:
            figure.colorbar(shown, ax=axis, shrink=0.7)
    figure.savefig(FOLDER / "cameras.png", dpi=100)
    plt.close(figure)
    sim.close()


def lidar() -> None:
    """The returns of a rotating lidar from above and as an image, and the 64 zones of a solid-state one."""
    sim = camera_scene()
    rotating, zones = Lidar.vlp16(360, max_range=6.0), Lidar.vl53l5cx()
    distance, grid = (
        np.asarray(jax.jit(sensor.image_fn(sim))(sim.data)["distance"])[0, 0] for sensor in (rotating, zones)
    )
    points = (rotating.rays * distance[..., None])[distance < rotating.far]
    figure = plt.figure(figsize=(8.4, 3.6), layout="constrained")
    above, image, square = figure.subplot_mosaic([["above", "image"], ["above", "zones"]]).values()
    shown = above.scatter(points[:, 0], points[:, 1], s=1, c=points[:, 2] + 0.9, cmap="viridis")
    above.set(xlabel="x, m", ylabel="y, m", aspect="equal", title="returns from above, by height, m")
    figure.colorbar(shown, ax=above, shrink=0.7)
    for axis, values, title in (
        (image, np.ma.masked_equal(distance, rotating.far), "Lidar.vlp16(360): 16 rows, from behind over ahead"),
        (square, grid, "Lidar.vl53l5cx(): 8 x 8 zones"),
    ):
        shown = axis.imshow(values, cmap="viridis_r", aspect="equal" if axis is square else "auto")
        axis.set_title(title, fontsize=9)
        axis.axis("off")
        figure.colorbar(shown, ax=axis, label="m")
    figure.savefig(FOLDER / "lidar.png", dpi=100)
    plt.close(figure)


def main(names: list[str]) -> None:
    """Draw the named pictures, or all of them."""
    for draw in (flight, mixed, scenery, allan, measured, cameras, lidar):
        if not names or draw.__name__ in names:
            draw()
            print(f"drew {draw.__name__}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
