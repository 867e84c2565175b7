"""Draw the mass of every drone at every reset, and measure its effect on the rate of climb.

A reset stage draws the masses. It writes only into the worlds that are reset, and its random numbers depend only on
seed, world, drone and episode: resetting a world alone or with others gives the same mass.
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Sim
from crazysim.core import append_fn, drone_keys, select_worlds


def randomize_mass(data, default_data, mask=None):
    """Draw masses between 90 % and 110 % of the airframe's mass."""
    keys = drone_keys(data, "randomize_mass")
    scale = jax.vmap(jax.vmap(lambda key: jax.random.uniform(key, (1,), minval=0.9, maxval=1.1)))(keys)
    mass = select_worlds(mask, scale * default_data.params.mass, data.params.mass)
    return data.replace(params=data.params.replace(mass=mass))


def main() -> None:
    sim = Sim(n_worlds=256, n_drones=2, control="attitude", rng_key=7)
    weight = 9.81 * float(sim.data.params.mass[0])
    append_fn(sim.reset_pipeline, randomize_mass)
    sim.reset()

    thrust = np.zeros((sim.n_worlds, sim.n_drones, 4))
    thrust[..., 3] = 1.3 * weight
    sim.attitude_control(thrust)
    sim.step(sim.freq)
    mass, climb = np.asarray(sim.data.params.mass[..., 0]), np.asarray(sim.data.states.vel[..., 2])
    print(f"masses from {1e3 * mass.min():.1f} g to {1e3 * mass.max():.1f} g")
    print(f"after 1 s they climb with {climb.min():.2f} to {climb.max():.2f} m/s")
    print(f"correlation of mass and climb: {np.corrcoef(mass.ravel(), climb.ravel())[0, 1]:.3f}")

    first_half = np.arange(sim.n_worlds) < sim.n_worlds // 2
    sim.reset(first_half)
    changed = np.asarray(sim.data.params.mass[..., 0]) != mass
    print(f"a reset of half the worlds drew {changed[first_half].mean():.0%} new masses there,", end=" ")
    print(f"{changed[~first_half].mean():.0%} elsewhere: {jnp.shape(sim.data.params.mass)}")


if __name__ == "__main__":
    main()
