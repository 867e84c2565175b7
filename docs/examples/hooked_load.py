"""Bumblebees carry loads of 0.2 kg on hooks in hover, under an LQR of drone and load; then the loads are pushed."""

import numpy as np

from crazysim import Hook, Sim
from crazysim.control import LoadLQR

GOAL = np.array([0.5, 0.0, 0.8])  # of the load, m


def main(n_worlds=4):
    sim = Sim(n_worlds, drone="bumblebee", control="state", controller=LoadLQR(load_mass=0.22, length=0.4))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos.at[..., 2].set(1.2)))
    hook = sim.add(Hook.bumblebee(0.2, dof=2))
    sim.state_control(pos=GOAL)
    sim.step(2500)
    load = hook.read(sim.data)
    print("load", load.pos[0, 0], "drone", sim.data.states.pos[0, 0])

    angle = 2 * np.pi * np.arange(n_worlds) / n_worlds
    push = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)[:, None].astype(np.float32)  # 1 m/s
    sim.data = hook.write(sim.data, load.replace(vel=load.vel + push, tip_vel=load.tip_vel + push))
    errors = []
    for second in range(1, 4):
        sim.step(sim.freq)
        errors.append(np.linalg.norm(hook.read(sim.data).pos[:, 0] - GOAL, axis=-1).max())
        print(f"{second} s after a push of 1 m/s: {100 * errors[-1]:.1f} cm from the goal at most")
    return errors


if __name__ == "__main__":
    main()
