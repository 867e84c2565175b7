"""Bumblebees pick up loads with hooks, carry them along a figure eight and set them down on a pad.

The loads stand at random places of the first pad, in each world at another one. Run as a script it also films the first
world.
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Follow, Hook, Sim
from crazysim.control import LoadLQR
from crazysim.media import Film, Recorder, View
from crazysim.trajectories import Trajectory, figure_eight, hover, line, minimum_snap

FPS, SECONDS, GRIP_TIME, RELEASE_TIME = 25, 25, 6.0, 20.0  # the hook picks up and lets go at these times, s
MASS, HOOK_MASS, LENGTH, RING = 0.2, 0.0203, 0.4, 0.1675  # kg; length of the rod, height of a standing load's ring, m
START_POINT, PICK_UP_POINT, PLACE_POINT, END_POINT = (
    np.array([x, y, 0.0]) for x, y in ((-1.2, 1.2), (-1.2, -1.2), (1.2, 1.2), (1.2, -1.2))
)
FLIGHT, GRASP = np.array([0.0, 0.0, 0.7]), np.array([0.0, 0.0, RING])  # heights of the hook, m
WIDTH, DEPTH, PERIOD = 2.0, 1.0, 5.0  # of the figure eight, m and s


def is_loaded(_state, _setpoint, time):
    """Return the index of the controller: 1 while the hook has the load."""
    return jnp.where((time >= GRIP_TIME) & (time < RELEASE_TIME), 1, 0)


def pick_up(load):
    """Return the path of the hook to a load, and up with it to the middle of the first pad."""
    hover_point = load + FLIGHT - GRASP
    path = (
        line(START_POINT + FLIGHT, hover_point, duration=3).then(line(hover_point, load, duration=2)).then(hover(load))
    )
    return path.then(line(load, PICK_UP_POINT + FLIGHT, duration=2))


def carry():
    """Return the path along the figure eight, down to the second pad, and away without the load."""
    eight = figure_eight(WIDTH, DEPTH, period=PERIOD, height=FLIGHT[2]).replace(repeats=np.bool_(False))
    # The eight begins and ends in its middle, with the velocity and jerk of (sin wt, sin 2wt) and no acceleration.
    w, zero = 2 * np.pi / PERIOD, np.zeros(3)
    vel, jerk = (sign * np.array([WIDTH / 2 * w**n, DEPTH / 2 * (2 * w) ** n, 0]) for n, sign in ((1, 1), (3, -1)))
    path = minimum_snap([PICK_UP_POINT + FLIGHT, FLIGHT], [2.0], velocities=[zero, vel], jerks=[zero, jerk]).then(eight)
    path = path.then(minimum_snap([FLIGHT, PLACE_POINT + FLIGHT], [2.0], velocities=[vel, zero], jerks=[jerk, zero]))
    path = path.then(line(PLACE_POINT + FLIGHT, PLACE_POINT + GRASP, duration=2)).then(hover(PLACE_POINT + GRASP))
    return path.then(line(PLACE_POINT + GRASP, PLACE_POINT + FLIGHT, duration=2)).then(
        line(PLACE_POINT + FLIGHT, END_POINT + FLIGHT, duration=3)
    )


def build(n_worlds):
    """Return the simulation, the hook, and the paths of the hooks."""
    empty_controller, loaded_controller = (
        LoadLQR(load_mass=mass, length=LENGTH) for mass in (HOOK_MASS, HOOK_MASS + MASS)
    )
    sim = Sim(
        n_worlds, drone="bumblebee", control="state", controller=[empty_controller, loaded_controller], switch=is_loaded
    )
    pads = np.stack([PICK_UP_POINT, PLACE_POINT]) + [0, 0, 0.004]
    sim.scene.add("landing_pad", "pad", count=2, pos=pads, mocap=False, radius=0.22, thickness=0.01)
    states = sim.data.states
    start_pos = jnp.asarray(START_POINT + FLIGHT + [0, 0, LENGTH], states.pos.dtype)
    sim.data = sim.data.replace(states=states.replace(pos=jnp.broadcast_to(start_pos, states.pos.shape)))
    loads = PICK_UP_POINT + GRASP + np.random.default_rng(0).uniform(-0.12, 0.12, (n_worlds, 1, 3)) * [1, 1, 0]
    hook = sim.add(Hook.bumblebee(MASS, length=LENGTH, hook_mass=HOOK_MASS, reach=0.03, load_at=loads))
    path = carry()
    paths = Trajectory.stack([pick_up(load).then(path) for load in loads[:, 0]])
    sim.add(Follow(paths, index=np.arange(n_worlds)[:, None], visible=False))
    sim.build_default_data()
    return sim, hook, paths


def main(n_worlds=3, film=None):
    sim, hook, paths = build(n_worlds)
    setpoints = jax.jit(lambda time: jax.vmap(lambda path: path.evaluate(time).pos)(paths))
    recorder, errors, was_attached = Recorder(sim, worlds=[0]), [], np.zeros(n_worlds, bool)
    for k in range(SECONDS * FPS):
        if k in (GRIP_TIME * FPS, RELEASE_TIME * FPS):
            sim.data = hook.command(sim.data, k == GRIP_TIME * FPS)
        sim.step(sim.freq // FPS)
        recorder.add()
        load, time = hook.read(sim.data), (k + 1) / FPS
        was_attached |= np.asarray(load.attached[:, 0])
        if GRIP_TIME + 1 < time <= RELEASE_TIME - 1:
            errors.append(np.linalg.norm(load.pos[:, 0] - setpoints(time), axis=-1))
    distance = np.linalg.norm(np.asarray(load.pos[:, 0]) - PLACE_POINT - GRASP, axis=-1)
    is_placed = was_attached & ~np.asarray(load.attached[:, 0]) & (distance < 0.03)
    rms = np.sqrt(np.mean(np.square(errors)))
    print(f"{is_placed.sum()} of {n_worlds} loads placed, {100 * distance.max():.2f} cm from the middle at most")
    print(f"{100 * rms:.2f} cm RMS from the path while they were carried")
    if film is not None:
        view = View(width=960, height=544, trail=1.5, cam_config={"elevation": -20, "distance": 4.5})
        with Film(film, view, fps=FPS) as recording:
            recording.play(sim, recorder.flight())
    sim.close()
    return is_placed, distance, rms


if __name__ == "__main__":
    main(film="pick_and_place.mp4")
