"""Pick and place: a hooked Bumblebee picks up a load, carries it along a figure eight and sets it down on a pad."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control.load_lqr import LoadLQR
from crazysim.control.setpoint import Setpoint
from crazysim.core.data import SimState
from crazysim.demos.common import FPS, FilmedFlight, counted, frames_of
from crazysim.media import Recorder, View
from crazysim.plugins.follow import Follow
from crazysim.plugins.payloads import Hook
from crazysim.scene.software import film_size
from crazysim.sim.sim import Sim
from crazysim.trajectories import Trajectory, figure_eight, hover, line, minimum_snap

MASS, HOOK_MASS, LENGTH, RING = 0.2, 0.0203, 0.4, 0.1675
"""Masses of load and hook, kg, length of the rod, m, and height of a standing load's ring, m."""
START, FROM, TO, END = (np.array([x, y, 0.0]) for x, y in ((-1.2, 1.2), (-1.2, -1.2), (1.2, 1.2), (1.2, -1.2)))
"""First position of the hook on the ground plane, middles of the two pads, and last position of the hook, m."""
HEIGHT, ABOVE = np.array([0.0, 0.0, 0.7]), np.array([0.0, 0.0, RING])
"""Height of the hook in flight, and on a standing load, m."""
WIDTH, DEPTH, PERIOD = 2.0, 1.0, 5.0
"""Size of the figure eight, m, and its period, s."""
SPREAD, PAD_RADIUS = 0.12, 0.22
"""Largest distance of a load from the middle of its pad along x and y, and radius of the pads, m."""
GRIP, RELEASE, SECONDS = 6.0, 20.0, 25.0
"""Times at which the hook is commanded to pick up and to let go, and duration of the flight, s."""
PLACED = 0.03
"""Largest distance of a load that is set down from the middle of the pad, m."""
SHOWN = np.array([[0.0, 0.0, -LENGTH - 0.45], [0.0, 0.0, 0.25]])
"""Lowest and highest place that a film shows, from the drone, m. (2, 3)"""
AISLE = 4.0
"""Distance between the drones of a world along y, m."""


def run(
    n_worlds: int = 1,
    n_drones: int = 1,
    seconds: float = SECONDS,
    device: str = "cpu",
    out: Path = Path("out"),
    film: bool = True,
) -> None:
    """Fly, print how many loads arrive, and write ``flight.npz`` and ``pick.mp4`` into a folder.

    Args:
        n_worlds: Number of worlds.
        n_drones: Number of drones per world, each with a load and two pads.
        seconds: Duration of the flight, s.
        device: Device of the simulation, such as ``"cpu"``.
        out: Folder of the files.
        film: True to write a film.

    Raises:
        ValueError: If the flight is shorter than one frame.
    """
    n_frames = frames_of(seconds)
    sim, hook, plans = build(n_worlds, n_drones, device)
    engine = sim.explain().splitlines()[0]
    fleet = f"{counted(n_worlds, 'world')} of {counted(n_drones, 'drone')}"
    print(f"{fleet}, {sim.freq} Hz, {seconds:g} s, on {device}, {engine}")
    width, height = film_size(960, 544)
    view = View(
        width=width,
        height=height,
        trail=1.5,
        cam_config={"elevation": -20},
        hold=lambda sim, world: np.asarray(sim.data.states.pos[world, 0]) + SHOWN,
    )
    out.mkdir(parents=True, exist_ok=True)
    recorder, flight = Recorder(sim, worlds=[0]), FilmedFlight(sim, out / "pick.mp4", view, film)
    setpoints = jax.jit(lambda t: jax.vmap(lambda plan: plan.evaluate(t).pos)(plans).reshape(n_worlds, n_drones, 3))
    errors, held = [], np.zeros((n_worlds, n_drones), bool)
    for k in range(n_frames):
        if k in (GRIP * FPS, RELEASE * FPS):
            sim.data = hook.command(sim.data, k == GRIP * FPS)
        flight.fly_frame()
        recorder.add()
        flight.film_frame()
        load, now = hook.read(sim.data), (k + 1) / FPS
        held |= np.asarray(load.attached)
        if GRIP + 1 < now <= RELEASE - 1:
            errors.append(np.linalg.norm(np.asarray(load.pos - setpoints(now)), axis=-1))
    report(sim, hook, held, np.array(errors))
    flight.print_rate()
    recorder.flight().save(out / "flight.npz")
    print(f"wrote {out / 'flight.npz'}")
    flight.close_film()
    sim.close()


def build(n_worlds: int, n_drones: int, device: str) -> tuple[Sim, Hook, Trajectory]:
    """Return hooked Bumblebees with loads at random places on their pads, the hook, and the hooks' paths.

    The leading axis of the paths goes over all drones of all worlds.
    """
    shape = (n_worlds, n_drones)
    empty, loaded = (LoadLQR(load_mass=mass, length=LENGTH) for mass in (HOOK_MASS, HOOK_MASS + MASS))
    sim = Sim(*shape, "bumblebee", control="state", controller=[empty, loaded], switch=is_loaded, device=device)
    aisles = AISLE * np.arange(n_drones)[:, None] * [0, 1, 0]
    pads = np.concatenate([aisles + FROM, aisles + TO]) + [0, 0, 0.004]
    sim.scene.add("landing_pad", "pad", count=2 * n_drones, pos=pads, mocap=False, radius=PAD_RADIUS, thickness=0.01)
    states = sim.data.states
    pos = jnp.asarray(aisles + START + HEIGHT + [0, 0, LENGTH], states.pos.dtype)
    sim.data = sim.data.replace(states=states.replace(pos=jnp.broadcast_to(pos, states.pos.shape)))
    loads = aisles + FROM + ABOVE + np.random.default_rng(0).uniform(-SPREAD, SPREAD, (*shape, 3)) * [1, 1, 0]
    hook = sim.add(Hook.bumblebee(MASS, length=LENGTH, hook_mass=HOOK_MASS, reach=0.03, load_at=loads))
    carry = carrying()
    plans = Trajectory.stack(
        [plan(loads[w, k] - aisles[k], carry).moved(aisles[k]) for w in range(n_worlds) for k in range(n_drones)]
    )
    sim.add(Follow(plans, index=np.arange(n_worlds * n_drones).reshape(shape), visible=False))
    sim.build_default_data()
    return sim, hook, plans


def is_loaded(state: SimState, setpoint: Setpoint, time: Array) -> Array:  # noqa: ARG001
    """Return the index of the controller: 1 between the commands to pick up and to let go. ()"""
    return jnp.where((time >= GRIP) & (time < RELEASE), 1, 0)


def plan(load: np.ndarray, carry: Trajectory) -> Trajectory:
    """Return the path of the hook: to a load, up with it, and on.

    Args:
        load: Position of the load's ring, m. (3,)
        carry: The rest of the path, from the height of flight above the first pad.
    """
    lifted = load + HEIGHT - ABOVE
    path = line(START + HEIGHT, lifted, duration=3).then(line(lifted, load, duration=2)).then(hover(load))
    return path.then(line(load, FROM + HEIGHT, duration=2)).then(carry)


def carrying() -> Trajectory:
    """Return the path along the figure eight, down to the second pad, and away without the load."""
    eight = figure_eight(WIDTH, DEPTH, period=PERIOD, height=float(HEIGHT[2])).replace(repeats=np.bool_(False))
    # The eight begins and ends in its middle, with the velocity and jerk of (sin wt, sin 2wt) and no acceleration.
    w, rest = 2 * np.pi / PERIOD, np.zeros(3)
    vel, jerk = (sign * np.array([WIDTH / 2 * w**n, DEPTH / 2 * (2 * w) ** n, 0]) for n, sign in ((1, 1), (3, -1)))
    path = minimum_snap([FROM + HEIGHT, HEIGHT], [2.0], velocities=[rest, vel], jerks=[rest, jerk]).then(eight)
    path = path.then(minimum_snap([HEIGHT, TO + HEIGHT], [2.0], velocities=[vel, rest], jerks=[jerk, rest]))
    path = path.then(line(TO + HEIGHT, TO + ABOVE, duration=2)).then(hover(TO + ABOVE))
    return path.then(line(TO + ABOVE, TO + HEIGHT, duration=2)).then(line(TO + HEIGHT, END + HEIGHT, duration=3))


def report(sim: Sim, hook: Hook, held: np.ndarray, errors: np.ndarray) -> None:
    """Print how many loads were picked up and placed, and how well they followed their paths.

    Args:
        sim: Simulation at the end of the flight.
        hook: The hook.
        held: True where a load was on its hook. (n_worlds, n_drones)
        errors: Distances of the loads from their setpoints while they were carried, m. (n, n_worlds, n_drones)
    """
    load = hook.read(sim.data)
    aisles = AISLE * np.arange(sim.n_drones)[:, None] * [0, 1, 0]
    away = np.linalg.norm((np.asarray(load.pos) - aisles - TO - ABOVE), axis=-1)
    placed = held & ~np.asarray(load.attached) & (away < PLACED)
    print(f"picked up         {held.sum():,} of {held.size:,}")
    print(f"placed            {placed.sum():,} of {held.size:,} within {100 * PLACED:.0f} cm of the pad's middle")
    if held.any():
        print(f"distance          {100 * away[held].mean():.2f} cm mean, {100 * away[held].max():.2f} cm at most")
    if len(errors) and held.any():
        carried = 100 * errors[:, held]
        print(
            f"tracking error    {np.sqrt(np.mean(carried**2)):.2f} cm RMS at the load, {carried.max():.2f} cm at most"
        )
