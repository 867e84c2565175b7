"""Let a swarm change places: sixteen drones of one world fly across to the far side, at three heights.

After every tenth of a second the closest pair is looked up, and MuJoCo is asked once at the end of each leg whether
any drone touches anything. Flying straight through the middle, it does.
"""

import numpy as np

from crazysim import Sim

N_DRONES, SECONDS, RADIUS = 16, 5, 1.5


def closest_pair(pos: np.ndarray) -> float:
    """Return the smallest distance between two drones, m."""
    distance = np.linalg.norm(pos[:, None] - pos[None], axis=-1)
    return float(distance[np.triu_indices(len(pos), 1)].min())


def main() -> None:
    for n_layers in (1, 4):
        sim = Sim(n_drones=N_DRONES, control="state")
        angle = np.linspace(0, 2 * np.pi, N_DRONES, endpoint=False)
        height = 1.0 + 0.4 * (np.arange(N_DRONES) % n_layers)
        start = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), height], axis=-1)
        goal = start * [-1.0, -1.0, 1.0]
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.asarray(start[None], np.float32)))

        setpoint, closest, touched = np.zeros((1, N_DRONES, 16)), np.inf, False
        for tick in range(10 * SECONDS):
            along = min(1.0, tick / (8 * SECONDS))
            setpoint[0, :, :3] = start + along**2 * (3 - 2 * along) * (goal - start)
            sim.state_control(setpoint)
            sim.step(sim.freq // 10)
            closest = min(closest, closest_pair(np.asarray(sim.data.states.pos[0])))
            touched = touched or bool(sim.contacts().any())
        off = np.linalg.norm(np.asarray(sim.data.states.pos[0]) - goal, axis=-1).max()
        print(f"{n_layers} layer(s): closest pair {closest:.3f} m, touched: {touched}, {off:.3f} m off at the end")


if __name__ == "__main__":
    main()
