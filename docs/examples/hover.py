"""Command heights, with 20% more mass in every other world, and print the heights that are reached."""

import numpy as np

from crazysim import Sim

HEIGHTS = (0.5, 1.0, 1.5, 2.0)
SECONDS = 5


def main() -> None:
    sim = Sim(n_worlds=len(HEIGHTS), control="state")
    targets = np.zeros((sim.n_worlds, 1, 3))
    targets[:, 0, 2] = HEIGHTS
    heavier = np.array([1.0, 1.2, 1.0, 1.2])[:, None, None] * np.asarray(sim.data.params.mass)
    sim.data = sim.data.replace(params=sim.data.params.replace(mass=heavier))

    for _ in range(SECONDS * sim.control_freq):
        sim.state_control(pos=targets)
        sim.step(sim.freq // sim.control_freq)

    height = np.asarray(sim.data.states.pos[:, 0, 2])
    speed = np.linalg.norm(sim.data.states.vel[:, 0], axis=-1)
    for target, final, v in zip(HEIGHTS, height, speed, strict=True):
        print(f"target {target:.1f} m, reached {final:.3f} m, off by {final - target:+.3f} m at {v:.3f} m/s")


if __name__ == "__main__":
    main()
