"""Scale the inertia of every drone, and measure how fast each starts to roll.

Inertia and its inverse are separate parameters and must change together.
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Sim, dynamics
from crazysim.core import append_fn, drone_keys, select_worlds


def randomize_inertia(data, default_data, mask=None):
    """Draw the moment about every axis between half and twice the airframe's moment."""
    keys = drone_keys(data, "randomize_inertia")
    log_scale = jax.vmap(jax.vmap(lambda key: jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0)))(keys)
    root = jnp.exp2(0.5 * log_scale)
    J = root[..., :, None] * default_data.params.J * root[..., None, :]  # stays symmetric and positive
    p = data.params
    J, J_inv = select_worlds(mask, J, p.J), select_worlds(mask, jnp.linalg.inv(J), p.J_inv)
    return data.replace(params=p.replace(J=J, J_inv=J_inv))


def main() -> None:
    sim = Sim(n_worlds=200, control="attitude", rng_key=1)
    append_fn(sim.reset_pipeline, randomize_inertia)
    sim.reset()
    states = sim.data.states
    rotor_vel = jnp.broadcast_to(dynamics.hover_rotor_vel(sim.data.params), states.rotor_vel.shape)
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(2.0), rotor_vel=rotor_vel))

    cmd = np.zeros((sim.n_worlds, 1, 4))
    cmd[..., 0], cmd[..., 3] = (
        0.3,
        9.81 * float(sim.data.params.mass[0]),
    )  # roll by 0.3 rad, with the thrust of hovering
    sim.attitude_control(cmd)
    arrived = np.full(sim.n_worlds, np.nan)
    for k in range(60):
        sim.step()
        roll = 2 * np.asarray(sim.data.states.quat[:, 0, 0])  # valid for a small rotation about x only
        arrived[np.isnan(arrived) & (roll > 0.1)] = 1e3 * (k + 1) / sim.freq

    scale = np.asarray(sim.data.params.J[:, 0, 0, 0] / sim.default_data.params.J[0, 0])
    for low, high in ((0.5, 0.7), (0.7, 1.0), (1.0, 1.4), (1.4, 2.0)):
        times = arrived[(scale > low) & (scale <= high)]
        print(f"{low:.1f} to {high:.1f} times the inertia: a third of the roll after {times.mean():.0f} ms")


if __name__ == "__main__":
    main()
