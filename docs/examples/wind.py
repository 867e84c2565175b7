"""Apply steady wind and gusts to hovering drones, with a stage that writes the external force.

``states.force`` keeps its value until it is changed, so the stage sets it at every step. The gusts are filtered noise
(an Ornstein-Uhlenbeck process) whose state is in a record of the stage, one value per drone.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import PyTree, Sim, leaf
from crazysim.core.pipeline import insert_fn_before
from crazysim.core.random import drone_keys

STEADY = np.array([20e-3, 0.0, 0.0])  # N; the drone weighs 426 mN
GUST, GUST_TIME = 10e-3, 0.5  # N, s


class Gusts(PyTree):
    """State of the wind stage."""

    force: Array = leaf("drone", 1)
    """Force of the current gust, world frame, N. (n_worlds, n_drones, 3)"""


def wind(data):
    """Advance the gusts, and apply them and the steady wind to every drone."""
    dt = 1 / data.core.freq
    noise = jax.vmap(jax.vmap(lambda key: jax.random.normal(key, (3,))))(drone_keys(data, "wind"))
    gust = data.plugins["gusts"].force
    gust = gust - dt / GUST_TIME * gust + GUST * jnp.sqrt(2 * dt / GUST_TIME) * noise
    states = data.states.replace(force=STEADY.astype(gust.dtype) + gust)
    return data.replace(states=states, plugins=data.plugins | {"gusts": Gusts(gust)})


def main() -> None:
    for windy in (False, True):
        sim = Sim(n_worlds=32, control="state", rng_key=5)
        if windy:
            sim.data = sim.data.replace(plugins={"gusts": Gusts(jnp.zeros_like(sim.data.states.force))})
            sim.build_default_data()
            insert_fn_before(sim.step_pipeline, "integration", wind)
            sim.build_step_fn()
        setpoint = np.zeros((sim.n_worlds, 1, 16))
        setpoint[..., 2] = 1.0
        sim.state_control(setpoint)
        sim.step(4 * sim.freq)
        off = np.asarray(sim.data.states.pos - setpoint[..., :3])[:, 0]
        name = "wind" if windy else "calm"
        print(f"{name}: x {off[:, 0].mean():+.3f} m (deviation {off[:, 0].std():.3f} m), y {off[:, 1].mean():+.3f} m")


if __name__ == "__main__":
    main()
