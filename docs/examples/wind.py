"""Gusts on hovering drones, as a plugin of one's own: a steady force and filtered noise.

The noise (an Ornstein-Uhlenbeck process) has a state in the plugin's record, advanced by a stage. The force is an
influence: the dynamics see it, and ``states.force`` stays the user's.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import Plugin, PyTree, Sim, StagePlacement, leaf, stage
from crazysim.core import drone_key

STEADY = np.array([20e-3, 0.0, 0.0])  # N; the drone weighs 426 mN
GUST, GUST_TIME = 10e-3, 0.5  # N, s


class GustData(PyTree):
    """State of the gusts."""

    force: Array = leaf("drone", 1)
    """Force, world frame, N. (n_worlds, n_drones, 3)"""


class Gusts(Plugin):
    """A steady force with gusts."""

    name: str = "gusts"

    def record(self, sim):
        return GustData(jnp.zeros_like(sim.data.states.force))

    def stages(self, sim):
        return [StagePlacement(stage("drone")(self.vary))]

    def vary(self, data):
        """Advance the gust at one drone by a step."""
        dt, gust = 1 / data.core.freq, self.read(data).force
        noise = jax.random.normal(drone_key(data, self.name), (3,))
        return self.write(data, GustData(gust - dt / GUST_TIME * gust + GUST * (2 * dt / GUST_TIME) ** 0.5 * noise))

    def influence(self, data):
        force = data.states.force + STEADY.astype(data.states.force.dtype) + self.read(data).force
        return data.replace(states=data.states.replace(force=force))


def main() -> None:
    for windy in (False, True):
        sim = Sim(n_worlds=32, control="state", rng_key=5)
        if windy:
            sim.add(Gusts())
        target = np.array([0.0, 0.0, 1.0])
        sim.state_control(pos=target)
        sim.step(4 * sim.freq)
        offset = np.asarray(sim.data.states.pos)[:, 0] - target
        name = "wind" if windy else "calm"
        print(
            f"{name}: x {offset[:, 0].mean():+.3f} m (deviation {offset[:, 0].std():.3f} m), "
            f"y {offset[:, 1].mean():+.3f} m"
        )


if __name__ == "__main__":
    main()
