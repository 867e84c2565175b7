"""A Bumblebee with a hook carries a load of 0.2 kg in hover, under an LQR of drone and load."""

from crazysim import Hook, Sim
from crazysim.control import LoadLQR


def main(n_worlds=1):
    sim = Sim(n_worlds, drone="bumblebee", control="state", controller=LoadLQR(load_mass=0.22, length=0.4))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos.at[..., 2].set(1.2)))
    hook = sim.add(Hook.bumblebee(0.2, dof=2))
    sim.state_control(pos=[0.5, 0.0, 0.8])  # of the load
    sim.step(2500)
    print("load", hook.read(sim.data).pos[0, 0], "drone", sim.data.states.pos[0, 0])


if __name__ == "__main__":
    main()
