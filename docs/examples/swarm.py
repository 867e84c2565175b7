"""Fly sixteen drones of one world to the opposite side of a circle, straight through its centre and around it.

Contacts are queried ten times per second; the MuJoCo scene is updated only for these queries.
"""

import numpy as np

from crazysim import Sim

N_DRONES, SECONDS, RADIUS, HEIGHT = 16, 4, 1.5, 1.0


def places(along: float, around: bool) -> np.ndarray:
    """Return the target positions after a fraction of the way, 0 to 1, m. (n_drones, 3)"""
    angle = np.linspace(0, 2 * np.pi, N_DRONES, endpoint=False) + (np.pi * along if around else 0)
    radius = RADIUS if around else RADIUS * (1 - 2 * along)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(N_DRONES, HEIGHT)], axis=-1)


def closest_pair(pos: np.ndarray) -> float:
    """Return the smallest distance between two drones, m."""
    distance = np.linalg.norm(pos[:, None] - pos[None], axis=-1)
    return float(distance[np.triu_indices(len(pos), 1)].min())


def main() -> None:
    sim = Sim(n_drones=N_DRONES, control="state")
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=places(0.0, False)[None].astype(np.float32)))
    sim.build_default_data()

    for around in (False, True):
        sim.reset()
        closest, n_touching = np.inf, 0
        for tick in range(10 * (SECONDS + 1)):
            part = min(1.0, tick / (10 * SECONDS))
            targets = places(part**2 * (3 - 2 * part), around)
            sim.state_control(pos=targets)
            sim.step(sim.freq // 10)
            closest = min(closest, closest_pair(np.asarray(sim.data.states.pos[0])))
            n_touching = max(n_touching, int(sim.contacts().sum()))
        distance = np.linalg.norm(np.asarray(sim.data.states.pos[0]) - targets, axis=-1).max()
        way = "around" if around else "straight"
        print(
            f"{way:8s}: closest {closest:.3f} m, at most {n_touching} contacts at once, {distance:.3f} m off at the end"
        )


if __name__ == "__main__":
    main()
