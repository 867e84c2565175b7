"""Send drones to a height with the state controller, and see where they hover.

The firmware's controller believes in a mass and a thrust that are not quite the drone's own. Its integral makes up a
part of that; the offset that remains is printed, not hidden.
"""

import numpy as np

from crazysim import Sim

HEIGHTS = (0.5, 1.0, 1.5, 2.0)
SECONDS = 5


def main() -> None:
    sim = Sim(n_worlds=len(HEIGHTS), control="state")
    setpoint = np.zeros((sim.n_worlds, sim.n_drones, 16))
    setpoint[:, 0, 2] = HEIGHTS

    for _ in range(SECONDS * sim.control_freq):
        sim.state_control(setpoint)
        sim.step(sim.freq // sim.control_freq)

    height = np.asarray(sim.data.states.pos[:, 0, 2])
    speed = np.linalg.norm(sim.data.states.vel[:, 0], axis=-1)
    for wanted, reached, v in zip(HEIGHTS, height, speed, strict=True):
        print(f"wanted {wanted:.1f} m, reached {reached:.3f} m, off by {reached - wanted:+.3f} m at {v:.3f} m/s")


if __name__ == "__main__":
    main()
