"""The flight of ``crazysim demo``: figure eights around poles in many worlds, with figures, a plot and a film."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core import functional as F
from crazysim.core.data import SimData
from crazysim.dynamics import first_principles
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import device_array
from crazysim.errors import RenderError, not_installed, require
from crazysim.media import Film, Flight, Recorder, View
from crazysim.media.trail import COLORS
from crazysim.progress import progress_bar
from crazysim.scene.software import film_size
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import change_material
from crazysim.storage import make_folder, write_figure

FPS = 25
"""Rate of frames, Hz."""
PERIOD = 5.0
"""Period of the figure eight, s."""
SETTLING_TIME = 2.0
"""Start of the interval in which the tracking error is measured, s."""
X_AMPLITUDE, Y_AMPLITUDE = 1.4, 0.7
"""Amplitudes of the figure eight along x and y, m."""
POLE_RADIUS = 0.03
"""Radius of a pole, m."""


def run_demo_flight(
    n_worlds: int = 1024,
    n_drones: int = 4,
    seconds: float = 10.0,
    device: str = "cpu",
    out: Path = Path("out"),
    film: bool = True,
) -> None:
    """Fly, print figures, and write ``flight.journal``, ``tracks.png`` and ``flight.mp4`` into a folder."""
    require(
        1 / FPS <= seconds < math.inf,
        f"expected --seconds of at least {1 / FPS}, and finite, got {seconds}. Use 10, for example.",
    )
    make_folder(out)
    n_frames = round(seconds * FPS)
    sim = build_sim(n_worlds, n_drones, device)
    step_frame = build_frame_step(sim)
    engine = sim.explain().splitlines()[0]
    fleet = f"{count_text(n_worlds, 'world')} of {count_text(n_drones, 'drone')}"
    print(f"{fleet}, {sim.freq} Hz, {seconds:g} s, on {device}, {engine}")

    # Compile before the clock starts.
    start_time = perf_counter()
    compiled_frame = step_frame.lower(sim.data).compile()
    compile_s = perf_counter() - start_time
    start_time = perf_counter()
    find_pole_contacts(sim)
    contacts_compile_s = perf_counter() - start_time

    # Fly, and time steps and contacts separately.
    recorder = Recorder(sim, worlds=[0])
    errors, pole_contacts = [], []
    step_s = contacts_s = 0.0
    for _ in progress_bar(range(n_frames), "flying"):
        start_time = perf_counter()
        data, error = jax.block_until_ready(compiled_frame(sim.data))
        step_s += perf_counter() - start_time
        sim.data = data
        start_time = perf_counter()
        pole_contacts.append(find_pole_contacts(sim))
        contacts_s += perf_counter() - start_time
        recorder.add()
        errors.append(np.asarray(error))

    # Report, log, picture and film.
    n_steps = n_frames * (sim.freq // FPS)
    print_report(
        np.concatenate(errors), np.stack(pole_contacts), n_steps * n_worlds * n_drones, step_s, contacts_s / n_frames
    )
    print(f"compile time      {compile_s:.2f} s for the flight, {contacts_compile_s:.2f} s for contacts")
    flight = recorder.flight()
    flight.save(out / "flight.journal")
    print(f"wrote {out / 'flight.journal'}")
    plot_tracks(sim, flight.pos[:, 0], np.concatenate(errors), out / "tracks.png")
    if film:
        film_flight(sim, flight, out / "flight.mp4")


def count_text(n: int, noun: str) -> str:
    """Return a number with a noun in singular or plural, such as "1 world" or "1,024 worlds"."""
    return f"{n:,} {noun}{'s' * (n != 1)}"


def build_sim(n_worlds: int, n_drones: int, device: str) -> Sim:
    """Return a simulation with two randomly placed poles per world and drones already on the figure eight."""
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, drone="cf2x_L250", control="state", device=device)
    offset = np.random.default_rng(0).uniform(-0.4, 0.4, (n_worlds, 2, 3)) * [1, 1, 0]
    pole_pos = offset + [[-0.6 * X_AMPLITUDE, 0, 0], [0.6 * X_AMPLITUDE, 0, 0]]
    sim.scene.add("pole", count=2, pos=pole_pos, height=1.7, radius=POLE_RADIUS)

    start = figure_eight_setpoints(device_array(np.zeros((n_worlds, 1))), n_drones)
    rotor_vel = jnp.broadcast_to(first_principles.hover_rotor_vel(sim.data.params), (n_worlds, n_drones, 4))
    states = sim.data.states.replace(pos=start[..., :3], vel=start[..., 3:6], rotor_vel=rotor_vel)
    sim.data = sim.data.replace(states=states)
    sim.build_default_data()
    return sim


def find_pole_contacts(sim: Sim) -> np.ndarray:
    """Whether a drone touches a pole. (n_worlds, n_drones, n_poles)"""
    return np.asarray(sim.contact_report(floor=False, drones=False).objects)


@jit_eager_calls("n_drones")
def figure_eight_setpoints(time: Array, n_drones: int) -> Array:
    """Return the setpoint of every drone: figure eights offset by a quarter of a period and by 0.25 m in height.

    Args:
        time: Time of every world, s. (n_worlds, 1)

    Returns:
        Position, velocity, acceleration, identity quaternion, zero body rates. (n_worlds, n_drones, 16)
    """
    rate = 2 * jnp.pi / PERIOD
    drone = jnp.arange(n_drones)
    angle = rate * time + 0.5 * jnp.pi * drone
    sin, cos, sin2, cos2 = jnp.sin(angle), jnp.cos(angle), jnp.sin(2 * angle), jnp.cos(2 * angle)
    zero = jnp.zeros_like(angle)
    height = jnp.broadcast_to(0.7 + 0.25 * drone, angle.shape)
    return jnp.stack(
        [
            *(X_AMPLITUDE * sin, Y_AMPLITUDE * sin2, height),
            *(X_AMPLITUDE * rate * cos, 2 * Y_AMPLITUDE * rate * cos2, zero),
            *(-X_AMPLITUDE * rate**2 * sin, -4 * Y_AMPLITUDE * rate**2 * sin2, zero),
            *(zero, zero, zero, zero + 1.0),
            *(zero, zero, zero),
        ],
        axis=-1,
    )


@jit_eager_calls("n_drones")
def jerk_feedforward(time: Array, n_drones: int) -> Array:
    """Return the feedforward of every drone's setpoint: its jerk, and zeros for snap and yaw rates.

    Without the jerk, drones lag behind their setpoints in curves.

    Args:
        time: Time of every world, s. (n_worlds, 1)

    Returns:
        Jerk, m/s^3, and zeros. (n_worlds, n_drones, 8)
    """
    rate = 2 * jnp.pi / PERIOD
    angle = rate * time + 0.5 * jnp.pi * jnp.arange(n_drones)
    jerk = [-X_AMPLITUDE * rate**3 * jnp.cos(angle), -8 * Y_AMPLITUDE * rate**3 * jnp.cos(2 * angle)]
    return jnp.stack([*jerk, *[jnp.zeros_like(angle)] * 6], axis=-1)


def build_frame_step(sim: Sim) -> Callable[[SimData], tuple[SimData, Array]]:
    """Return a jitted function of data that flies for 1 / FPS seconds, with one setpoint per tick of the controller.

    The function returns the new data, and the distance from the setpoint at every tick, m, of shape
    (n_ticks, n_worlds, n_drones).
    """
    step = sim.build_step_fn()
    steps_per_tick = sim.freq // sim.control_freq

    def tick(data: SimData, _: None) -> tuple[SimData, Array]:
        time, n_drones = data.core.steps / data.core.freq, data.core.n_drones
        setpoint = figure_eight_setpoints(time, n_drones)
        error = jnp.linalg.norm(data.states.pos - setpoint[..., :3], axis=-1)
        data = F.state_control(data, setpoint, feedforward=jerk_feedforward(time, n_drones))
        return step(data, steps_per_tick), error

    return jax.jit(lambda data: jax.lax.scan(tick, data, length=sim.control_freq // FPS))


def print_report(errors: np.ndarray, pole_contacts: np.ndarray, n_steps: int, step_s: float, contact_s: float) -> None:
    """Print step rate, tracking error and contacts of the flight.

    Args:
        errors: Distances from the setpoint, m. (n_ticks, n_worlds, n_drones)
        pole_contacts: True where a drone touches a pole. (n_frames, n_worlds, n_drones, n_poles)
        n_steps: Number of physics steps of all drones.
        step_s: Time of all steps, s.
        contact_s: Time of one contact query, s.
    """
    start = round(SETTLING_TIME * FPS * len(errors) / len(pole_contacts))
    settled_errors = 100 * (errors[start:] if start < len(errors) else errors)
    contact_starts = pole_contacts[1:] & ~pole_contacts[:-1]
    print(f"steps per second  {n_steps / step_s / 1e6:.1f} M ({n_steps / 1e6:.1f} M drone steps in {step_s:.1f} s)")
    mean, percentile = settled_errors.mean(), np.percentile(settled_errors, 95)
    print(f"tracking error    {mean:.1f} cm mean, {percentile:.1f} cm 95th percentile")
    n_contacts_begun = int(contact_starts.sum() + pole_contacts[0].sum())
    n_worlds = int(pole_contacts.any((0, 2, 3)).sum())
    print(
        f"contacts          {n_contacts_begun:,} begun, in {n_worlds:,} of "
        f"{count_text(pole_contacts.shape[1], 'world')}; {1e3 * contact_s:.1f} ms a query"
    )


def plot_tracks(sim: Sim, tracks: np.ndarray, errors: np.ndarray, path: Path) -> None:
    """Plot the tracks of world 0, and the tracking error of all worlds over time."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot as plt
    except ImportError:
        print(f"no plot: {not_installed('plots need', 'matplotlib', 'demo')}")
        return
    fig, (tracks_axis, error_axis) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    setpoint = np.asarray(figure_eight_setpoints(jnp.linspace(0, PERIOD, 200)[:, None], 1))[:, 0]
    tracks_axis.plot(setpoint[:, 0], setpoint[:, 1], "--", color="0.6", label="setpoint")
    for i in range(tracks.shape[1]):
        tracks_axis.plot(tracks[:, i, 0], tracks[:, i, 1], color=COLORS[i % 4], label=f"drone {i}")
    for pole_pos in np.asarray(sim.data.objects.pos[0, 0]):
        tracks_axis.add_patch(plt.Circle(pole_pos[:2], POLE_RADIUS, color="0.2"))
    tracks_axis.set(title="Tracks in world 0, seen from above", xlabel="x, m", ylabel="y, m", aspect="equal")
    tracks_axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    errors_cm = 100 * errors.reshape(len(errors), -1)
    seconds = np.arange(len(errors_cm)) / sim.control_freq
    error_axis.fill_between(
        seconds, *np.percentile(errors_cm, [5, 95], axis=1), color="0.85", label="5th to 95th percentile"
    )
    error_axis.plot(seconds, np.median(errors_cm, axis=1), color=COLORS[1], label="median")
    error_axis.set(
        title=f"Tracking error of {errors_cm.shape[1]:,} drones", xlabel="time, s", ylabel="error, cm", ylim=(0, None)
    )
    error_axis.legend(fontsize=8)
    write_figure(fig, path, dpi=110)
    plt.close(fig)
    print(f"wrote {path}")


def film_flight(sim: Sim, flight: Flight, path: Path) -> None:
    """Film world 0; print one line and return if this machine cannot render."""
    for i in range(sim.n_drones):
        change_material(sim, "led_top", [i], rgba=COLORS[i % 4], emission=1.0)
    width, height = film_size(960, 544)
    view = View(width=width, height=height, trail=1.0, cam_config=orbiting_camera)
    try:
        with Film(path, view, fps=FPS, progress=True) as film:
            film.play(sim, flight)
    except (ImportError, RenderError) as error:
        print(f"no film: {error}")
        return
    sim.close()
    print(f"wrote {path}")


def orbiting_camera(time: float) -> dict[str, Any]:
    """Return the settings of a free camera that orbits the scene slowly."""
    return {"lookat": [0, 0, 0.8], "distance": 2.7, "azimuth": 100 + 3 * time, "elevation": -28}
