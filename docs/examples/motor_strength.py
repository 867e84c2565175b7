"""Let every motor be a little weak or strong, and see what that does to a drone that knows nothing of it.

The thrust curve may be one for all rotors, (1, 3), or one per rotor, (n_rotors, 3), with the axes of worlds and drones
in front. Here each rotor of each drone gets its own; the controllers keep believing in the airframe's curve.
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Sim
from crazysim.pytree import select_worlds
from crazysim.sim.pipeline import append_fn
from crazysim.sim.random import drone_keys

SPREAD = 0.05


def randomize_motors(data, default_data, mask=None):
    """Draw the strength of every rotor, with a standard deviation of 5 %."""
    n_rotors = default_data.params.mixing_matrix.shape[-1]
    keys = drone_keys(data, "randomize_motors")
    strength = 1 + SPREAD * jax.vmap(jax.vmap(lambda key: jax.random.normal(key, (n_rotors, 1))))(keys)
    p, default = data.params, default_data.params
    thrust = select_worlds(mask, strength * default.rpm2thrust, p.rpm2thrust)
    torque = select_worlds(mask, strength * default.rpm2torque, p.rpm2torque)
    return data.replace(params=p.replace(rpm2thrust=thrust, rpm2torque=torque))


def main() -> None:
    for weak in (False, True):
        sim = Sim(n_worlds=64, control="state", rng_key=3)
        if weak:
            append_fn(sim.reset_pipeline, randomize_motors)
            sim.build_reset_fn()
            sim.reset()
        setpoint = np.zeros((sim.n_worlds, 1, 16))
        setpoint[..., 2] = 1.0
        sim.state_control(setpoint)
        sim.step(5 * sim.freq)
        error = np.asarray(sim.data.states.pos) - setpoint[..., :3]
        sideways, up = np.linalg.norm(error[..., :2], axis=-1), error[..., 2]
        shape = jnp.shape(sim.data.params.rpm2thrust)
        print(f"thrust curves {shape}: sideways off by up to {sideways.max():.3f} m,", end=" ")
        print(f"height off by {up.min():+.3f} to {up.max():+.3f} m")


if __name__ == "__main__":
    main()
