"""A recorded flight of a real drone is replayed as a twin, which a simulated drone avoids."""

import tempfile
from pathlib import Path

import numpy as np

from crazysim import Sim
from crazysim.lab.live import FunctionSource, ReplaySource, Twin, Twins

MIN_DISTANCE = 0.6
"""Distance that the simulated drone keeps, m."""


def real_flight(t):
    """Return the pose of the drone that is recorded: it flies to and fro through the origin at a height of 1 m."""
    return {"cf7": ((1.5 * np.cos(t), 0.1, 1.0), (0.0, 0.0, 0.0, 1.0))}


def fly(source, record=None, seconds=4.0):
    """Return the smallest distance from the simulated drone to the twin, m, and all positions of both."""
    sim = Sim(control="state")
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(1.0)))
    twins = Twins(sim, source, {"cf": Twin.drone()}, ["cf7"], record=record)
    home, closest, path = np.array([0.0, 0.0, 1.0]), np.inf, []
    with twins:
        for _ in range(round(100 * seconds)):
            twins.update(sim)
            offset = np.asarray(sim.data.states.pos[0, 0]) - twins.pose("cf7")[0]
            offset[2] = 0.0
            gap = np.linalg.norm(offset)
            target = home if gap > MIN_DISTANCE else twins.pose("cf7")[0] + 1.5 * MIN_DISTANCE * offset / gap
            sim.state_control(pos=target)
            sim.step(5)
            report = sim.contact_report(twins.handles["cf7"], floor=False, drones=False)
            closest = min(closest, float(report.object_distance[0, 0, 0]))
            path.append([sim.data.states.pos[0, 0], twins.pose("cf7")[0]])
    return closest, np.array(path)


def main():
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "flight.mocap"
        first = fly(FunctionSource(real_flight, freq=120), record=recording)
        replay = fly(ReplaySource(recording))
    print(f"closest {first[0]:.2f} m; the replay gives the same flight: {np.array_equal(first[1], replay[1])}")
    return first[0], np.array_equal(first[1], replay[1])


if __name__ == "__main__":
    main()
