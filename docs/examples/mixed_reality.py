"""Simulated and real vehicles together: three simulated drones carry a load over two simulated cars, past a real drone.

The real drone is the replay of a recording, as motion capture would send it. With ``--picture`` as argument the example
writes a picture.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from crazysim import Cars, SharedLoad, Sim
from crazysim.lab.live import FunctionSource, Live, ReplaySource, Twin, Twins
from crazysim.plugins import vehicles
from crazysim.trajectories import figure_eight

SECONDS = 5.0


def real_flight(t):
    """Return the pose of the real drone: it flies past the simulated ones, twice a minute, at a height of 1.4 m."""
    angle = 0.2 * np.pi * t
    return {"cf7": ((2.0 * np.cos(angle), 1.6 + 0.3 * np.sin(angle), 1.4), (0.0, 0.0, 0.0, 1.0))}


def record(path):
    """Record the real drone, as a laboratory would."""
    sim = Sim()
    with Twins(sim, FunctionSource(real_flight, 120), {"cf": Twin.drone()}, ["cf7"], record=path) as twins:
        for _ in range(round(100 * SECONDS)):
            twins.update(sim)
            sim.step(5)


def build():
    """Return the simulation with drones, load and cars, and their plugins."""
    sim = Sim(n_drones=3, drone="bumblebee", control="state", controller="geometric", integrator="symplectic_euler")
    angle = 2 * np.pi * np.arange(3) / 3
    ring = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.full(3, 2.0)], axis=-1)
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[0].set(ring)))
    sim.build_default_data()
    load = sim.add(SharedLoad(mass=0.15, length=1.0))
    cars = sim.add(Cars(2, path=figure_eight(6.0, 2.0, period=14.0), controller=vehicles.PathLQR()))
    return sim, ring, load, cars


def main(picture=None):
    sim, ring, load, cars = build()
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "real.mocap")
        twins = Twins(sim, ReplaySource(Path(folder) / "real.mocap", by="time"), {"cf": Twin.drone()}, ["cf7"])
        closest = [np.inf]

        def carry(live):
            """Move the three drones along y, to and fro, and note the distance to the real one."""
            live.command[0, :, :3] = ring + [0.0, 0.4 * np.sin(0.5 * live.time), 0.0]
            live.command[..., 12] = 1.0
            report = sim.contact_report(twins.handles["cf7"], floor=False)
            closest[0] = min(closest[0], float(report.object_distance.min()))

        with Live(sim, control_freq=100, speed="max") as live:
            live.add(twins, on_error="report")
            live.add(carry)
            live.run(seconds=SECONDS)
    if picture:
        import imageio.v3 as imageio

        view = {"lookat": (0, 0.5, 0.8), "distance": 6.5, "azimuth": 130, "elevation": -18}
        imageio.imwrite(picture, sim.render("rgb_array", width=960, height=540, cam_config=view))
    heights = np.asarray(sim.data.states.pos[0, :, 2])
    hanging = float(load.read(sim.data).pos[0, 0, 2])
    speeds = np.asarray(cars.read(sim.data).body_vel[0, :, 0])
    print(f"drones at {heights.round(2)} m, load at {hanging:.2f} m, cars at {speeds.round(2)} m/s")
    print(f"closest to the real drone: {closest[0]:.2f} m; reports: {[r.kind for r in twins.reports.latest]}")
    return heights, hanging, speeds, closest[0]


if __name__ == "__main__":
    main("mixed_reality.png" if "--picture" in sys.argv else None)
