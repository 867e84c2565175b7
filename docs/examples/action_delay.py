"""Delay the commands, and measure how a height controller degrades as the delay grows.

The pending commands are in a record that declares one queue per drone, so a masked reset resets only the queues of
its worlds.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import PyTree, Sim, leaf
from crazysim.core import replace_fn


class Delay(PyTree):
    """Commands that have not reached the drone yet."""

    queue: Array = leaf("drone", 2)
    """Pending commands, oldest first. (n_worlds, n_drones, delay in steps, 4)"""


def add_delay(sim: Sim, n_steps: int) -> None:
    """Pass the oldest pending command to the attitude controller."""
    controller = sim.step_pipeline["attitude_controller"]

    def staged(data, cmd):
        attitude = data.controls.attitude.replace(staged_cmd=cmd)
        return data.replace(controls=data.controls.replace(attitude=attitude))

    def late_controller(data):
        sent, queue = data.controls.attitude.staged_cmd, data.plugins["delay"].queue
        data = staged(controller(staged(data, queue[..., 0, :])), sent)
        queue = jnp.concatenate([queue[..., 1:, :], sent[..., None, :]], axis=-2)
        return data.replace(plugins=data.plugins | {"delay": Delay(queue)})

    queue = jnp.zeros((sim.n_worlds, sim.n_drones, n_steps, 4))
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"delay": Delay(queue)})
    sim.build_default_data()
    replace_fn(sim.step_pipeline, late_controller, "attitude_controller")


def main() -> None:
    for delay in (0, 50, 75, 100):
        sim = Sim(n_worlds=2, control="attitude")
        if delay:
            add_delay(sim, delay)
        weight, heights = 9.81 * float(sim.data.params.mass[0]), []
        for _ in range(300):  # spring and damper on the height, at 50 Hz
            z, vz = np.asarray(sim.data.states.pos[..., 2]), np.asarray(sim.data.states.vel[..., 2])
            sim.attitude_control(np.stack([0 * z, 0 * z, 0 * z, weight * (1 + 1.2 * (1 - z) - 0.5 * vz)], axis=-1))
            sim.step(10)
            heights.append(z[0, 0])
        print(f"{2 * delay:3d} ms: last second between {min(heights[-50:]):.3f} and {max(heights[-50:]):.3f} m")
    sim.reset(np.array([True, False]))
    print("pending commands after a reset of world 0:", np.abs(sim.data.plugins["delay"].queue).sum((1, 2, 3)))


if __name__ == "__main__":
    main()
