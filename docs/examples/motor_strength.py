"""Randomise the strength of every motor, and measure the error of a hover with and without compensation.

There is one thrust curve for all rotors, (1, 3), or one per rotor, (n_rotors, 3), with the axes of worlds and drones in
front. Here each rotor of each drone has its own, while the controllers still use the curve of the airframe. The
default controller estimates what the motors lack; geometric control does not.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Sim, dynamics
from crazysim.core import drone_keys, select_worlds


def randomize_motors(data, default_data, mask=None, deviation=0.0):
    """Draw the strength of every rotor, with a standard deviation of ``deviation``."""
    p, default, n_rotors = data.params, default_data.params, data.states.rotor_vel.shape[-1]
    keys = drone_keys(data, "randomize_motors")
    strength = 1 + deviation * jax.vmap(jax.vmap(lambda key: jax.random.normal(key, (n_rotors, 1))))(keys)
    thrust = select_worlds(mask, strength * default.rpm2thrust, p.rpm2thrust)
    torque = select_worlds(mask, strength * default.rpm2torque, p.rpm2torque)
    return data.replace(params=p.replace(rpm2thrust=thrust, rpm2torque=torque))


def hover(controller: str) -> None:
    """Print the errors of 64 hovers after 5 s, for three spreads."""
    sim = Sim(n_worlds=64, control="state", controller=controller, rng_key=3)
    states, target = sim.data.states, np.array([0.0, 0.0, 1.0])
    rotor_vel = jnp.broadcast_to(dynamics.hover_rotor_vel(sim.data.params), states.rotor_vel.shape)
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(1.0), rotor_vel=rotor_vel))
    sim.build_default_data()

    for deviation in (0.0, 0.02, 0.05):
        sim.reset_pipeline["motors"] = partial(randomize_motors, deviation=deviation)
        sim.reset()
        sim.state_control(pos=target)
        sim.step(5 * sim.freq)
        error = np.asarray(sim.data.states.pos)[:, 0] - target
        sideways = np.linalg.norm(error[:, :2], axis=-1)
        print(f"{controller}, spread {deviation:.0%}: off by up to {sideways.max():.3f} m sideways,", end=" ")
        print(f"{error[:, 2].min():+.3f} to {error[:, 2].max():+.3f} m in height")


def main() -> None:
    for controller in ("auto", "geometric"):
        hover(controller)


if __name__ == "__main__":
    main()
