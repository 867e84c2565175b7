"""The main job, end to end: worlds of drones fly figure eights around poles, and are seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.core import functional as F
from crazysim.core.data import SimData
from crazysim.dynamics import first_principles
from crazysim.errors import RenderError
from crazysim.media import Film, Flight, Recorder, View
from crazysim.media.trail import COLORS
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import change_material

FPS = 25
"""Pictures, and checks for contacts, per second."""
PERIOD = 5.0
"""Time of one figure eight, s."""
SETTLED = 2.0
"""From here on the tracking error counts, s."""
WIDTH, DEPTH = 1.4, 0.7
"""Half sizes of the figure eight, m."""
POLE = """
<mujoco><worldbody><body name="pole">
  <geom type="capsule" fromto="0 0 0.035 0 0 2" size="0.03" rgba="0.85 0.35 0.25 1"/>
</body></worldbody></mujoco>
"""


def run(n_worlds: int, n_drones: int, seconds: float, device: str, out: Path, film: bool = True) -> None:
    """Fly, print figures, and write ``flight.npz``, ``tracks.png`` and ``flight.mp4`` into a folder.

    Raises:
        ValueError: If an argument cannot be.
    """
    if seconds < 1 / FPS:
        raise ValueError(f"--seconds is {seconds}; the flight must last at least {1 / FPS} s")
    sim = build(n_worlds, n_drones, device)
    chunk = chunk_of(sim)
    n_chunks = round(seconds * FPS)
    engine = sim.explain().splitlines()[0]
    print(f"{n_worlds:,} worlds of {n_drones} drones, {sim.freq} Hz, {seconds:g} s, on {device}, {engine}")

    begin = time.perf_counter()
    compiled = chunk.lower(sim.data).compile()
    compile_s = time.perf_counter() - begin
    begin = time.perf_counter()
    sim.contacts()
    contacts_compile_s = time.perf_counter() - begin

    recorder = Recorder(sim, worlds=[0])
    errors, touching = [], []
    step_s = contacts_s = 0.0
    for _ in progress(range(n_chunks), "flying"):
        begin = time.perf_counter()
        data, error = jax.block_until_ready(compiled(sim.data))
        step_s += time.perf_counter() - begin
        sim.data = data
        begin = time.perf_counter()
        touching.append(np.asarray(sim.contacts()))
        contacts_s += time.perf_counter() - begin
        recorder.add()
        errors.append(np.asarray(error))

    n_steps = n_chunks * (sim.freq // FPS)
    report(np.concatenate(errors), np.stack(touching), n_steps * n_worlds * n_drones, step_s, contacts_s / n_chunks)
    print(f"compile time      {compile_s:.2f} s for the flight, {contacts_compile_s:.2f} s for contacts")
    out.mkdir(parents=True, exist_ok=True)
    flight = recorder.flight()
    flight.save(out / "flight.npz")
    print(f"wrote {out / 'flight.npz'}")
    plot(sim, flight.pos[:, 0], np.concatenate(errors), out / "tracks.png")
    if film:
        record(sim, flight, out / "flight.mp4")


def build(n_worlds: int, n_drones: int, device: str) -> Sim:
    """Return worlds with a pole in each loop of the eight, a little elsewhere in each, and drones on their way."""
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, drone="cf2x_L250", control="state", device=device)
    pole = mujoco.MjSpec.from_string(POLE)
    frame = sim.spec.worldbody.add_frame()
    for i in range(2):
        frame.attach_body(pole.body("pole"), "pole_", f":{i}").mocap = True
    sim.build_mjx()

    poles = [sim.mj_model.body(f"pole_pole:{i}").mocapid.item() for i in range(2)]
    rng = np.random.default_rng(0)
    places = np.array([[-0.6 * WIDTH, 0, 0], [0.6 * WIDTH, 0, 0]]) + rng.uniform(-0.4, 0.4, (n_worlds, 2, 3)) * [
        1,
        1,
        0,
    ]
    sim.mjx_data = sim.mjx_data.replace(mocap_pos=sim.mjx_data.mocap_pos.at[:, poles].set(jnp.asarray(places)))

    start = reference(jnp.zeros((n_worlds, 1)), n_drones)
    rotor_vel = jnp.broadcast_to(first_principles.hover_rotor_vel(sim.data.params), (n_worlds, n_drones, 4))
    states = sim.data.states.replace(pos=start[..., :3], vel=start[..., 3:6], rotor_vel=rotor_vel)
    sim.data = sim.data.replace(states=states)
    sim.build_default_data()
    return sim


def reference(time: Array, n_drones: int) -> Array:
    """Return the setpoint of every drone: an eight for each, a quarter of a period and 0.25 m apart.

    Args:
        time: Time of every world, s. (n_worlds, 1)
        n_drones: Number of drones.

    Returns:
        Position, velocity, acceleration, level quaternion, no body rates. (n_worlds, n_drones, 16)
    """
    rate = 2 * jnp.pi / PERIOD
    drone = jnp.arange(n_drones)
    a = rate * time + 0.5 * jnp.pi * drone
    sin, cos, sin2, cos2 = jnp.sin(a), jnp.cos(a), jnp.sin(2 * a), jnp.cos(2 * a)
    zero = jnp.zeros_like(a)
    height = jnp.broadcast_to(0.7 + 0.25 * drone, a.shape)
    return jnp.stack(
        [
            *(WIDTH * sin, DEPTH * sin2, height),
            *(WIDTH * rate * cos, 2 * DEPTH * rate * cos2, zero),
            *(-WIDTH * rate**2 * sin, -4 * DEPTH * rate**2 * sin2, zero),
            *(zero, zero, zero, zero + 1.0),
            *(zero, zero, zero),
        ],
        axis=-1,
    )


def chunk_of(sim: Sim) -> Callable[[SimData], tuple[SimData, Array]]:
    """Return a jitted function that flies 1 / FPS seconds: one setpoint per tick of the state controller.

    It returns the data and the distance from the setpoint, m, at every tick. (n_ticks, n_worlds, n_drones)
    """
    step = sim.build_step_fn()
    per_tick = sim.freq // sim.control_freq

    def tick(data: SimData, _: None) -> tuple[SimData, Array]:
        setpoint = reference(data.core.steps / data.core.freq, data.core.n_drones)
        error = jnp.linalg.norm(data.states.pos - setpoint[..., :3], axis=-1)
        return step(F.state_control(data, setpoint), per_tick), error

    return jax.jit(lambda data: jax.lax.scan(tick, data, length=sim.control_freq // FPS))


def report(errors: np.ndarray, touching: np.ndarray, n_steps: int, step_s: float, contact_s: float) -> None:
    """Print what the flight gave."""
    first = round(SETTLED * FPS * len(errors) / len(touching))
    settled = 100 * (errors[first:] if first < len(errors) else errors)
    began = touching[1:] & ~touching[:-1]
    print(f"steps per second  {n_steps / step_s / 1e6:.1f} M ({n_steps / 1e6:.1f} M drone steps in {step_s:.1f} s)")
    print(f"tracking error    {settled.mean():.1f} cm mean, {np.percentile(settled, 95):.1f} cm 95th percentile")
    print(
        f"contacts          {int(began.sum() + touching[0].sum()):,} begun, in {int(touching.any((0, 2)).sum()):,} of "
        f"{touching.shape[1]:,} worlds; {1e3 * contact_s:.0f} ms a query"
    )


def plot(sim: Sim, tracks: np.ndarray, errors: np.ndarray, path: Path) -> None:
    """Write the tracks of world 0 and the error over time of all worlds as a picture."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot as plt
    except ImportError:
        print("no plot: matplotlib is not installed; pip install 'crazysim[demo]'")
        return
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    wanted = np.asarray(reference(jnp.linspace(0, PERIOD, 200)[:, None], 1))[:, 0]
    left.plot(wanted[:, 0], wanted[:, 1], "--", color="0.6", label="setpoint")
    for i in range(tracks.shape[1]):
        left.plot(tracks[:, i, 0], tracks[:, i, 1], color=COLORS[i % 4], label=f"drone {i}")
    for place in np.asarray(sim.mjx_data.mocap_pos[0, sim.n_drones :]):
        left.add_patch(plt.Circle(place[:2], 0.03, color="0.2"))
    left.set(title="Tracks in world 0, seen from above", xlabel="x, m", ylabel="y, m", aspect="equal")
    left.legend(loc="upper right", fontsize=8)
    flat = 100 * errors.reshape(len(errors), -1)
    seconds = np.arange(len(flat)) / sim.control_freq
    right.fill_between(seconds, *np.percentile(flat, [5, 95], axis=1), color="0.85", label="5th to 95th percentile")
    right.plot(seconds, np.median(flat, axis=1), color=COLORS[1], label="median")
    right.set(title=f"Tracking error of {flat.shape[1]:,} drones", xlabel="time, s", ylabel="error, cm", ylim=(0, None))
    right.legend(fontsize=8)
    fig.savefig(path, dpi=110)
    plt.close(fig)
    print(f"wrote {path}")


def record(sim: Sim, flight: Flight, path: Path) -> None:
    """Write world 0 as a film; say in one line if this machine cannot."""
    for i in range(sim.n_drones):
        change_material(sim, "led_top", [i], rgba=COLORS[i % 4], emission=1.0)
    view = View(width=960, height=544, trail=1.0, cam_config=turning)
    try:
        with Film(path, view, fps=FPS, progress=True) as film:
            film.play(sim, flight)
    except (ImportError, RenderError) as error:
        print(f"no film: {error}")
        return
    sim.close()
    print(f"wrote {path}")


def turning(time: float) -> dict[str, Any]:
    """Return a free camera that goes slowly around the scene."""
    return {"lookat": [0, 0, 0.9], "distance": 3.6, "azimuth": 110 + 3 * time, "elevation": -28}


def progress(items: Iterable[Any], label: str) -> Iterable[Any]:
    """Return the items with a progress bar, where tqdm is installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        print(f"{label} ...")
        return items
    return tqdm(items, desc=label, unit="frame", ncols=80)
