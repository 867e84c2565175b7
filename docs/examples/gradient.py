"""Optimise thrusts that lift a drone by 20 cm in half a second and leave it at rest, with ``jax.grad``.

The gradient goes through 250 physics steps: attitude controller, allocation, rotor lag and rigid body.
"""

import jax
import jax.numpy as jnp

from crazysim import Sim, dynamics
from crazysim import functional as F

N_THRUSTS, STEPS_PER_THRUST = 25, 10  # 25 thrusts, each held for 10 steps of 2 ms
RISE = 0.2  # m
ROUNDS = 60


def main() -> None:
    sim = Sim(control="attitude", engine="plain")  # the gradient of one drone: compiled in half the time
    step = sim.build_step_fn()
    weight = 9.81 * sim.data.params.mass[0]
    # The flight starts in hover and above the floor, because a drone whose rotors are at rest falls first.
    states = sim.data.states
    rotor_vel = jnp.broadcast_to(dynamics.hover_rotor_vel(sim.data.params), states.rotor_vel.shape)
    initial_data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(1.0), rotor_vel=rotor_vel))

    def cost(thrusts: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        def hold(data, thrust):
            cmd = jnp.zeros((1, 1, 4)).at[..., 3].set(thrust)
            return step(F.attitude_control(data, cmd), STEPS_PER_THRUST), None

        final_data, _ = jax.lax.scan(hold, initial_data, thrusts)
        rise, climb = final_data.states.pos[0, 0, 2] - 1.0, final_data.states.vel[0, 0, 2]
        effort = jnp.mean((thrusts / weight - 1) ** 2)
        return (rise - RISE) ** 2 + 0.1 * climb**2 + 1e-4 * effort, (rise, climb)

    value_and_grad = jax.jit(jax.value_and_grad(cost, has_aux=True))
    thrusts = jnp.full(N_THRUSTS, weight)
    velocity = jnp.zeros_like(thrusts)
    for i in range(ROUNDS + 1):
        (value, (rise, climb)), grad = value_and_grad(thrusts)
        if i % 15 == 0:
            print(f"iteration {i:2d}: cost {value:.5f}, norm of the gradient {jnp.linalg.norm(grad):.4f}")
        velocity = 0.9 * velocity - 6e-2 * grad
        thrusts = jnp.clip(thrusts + velocity, 0.1 * weight, 1.8 * weight)
    print(f"rises by {rise:.3f} m and leaves with {climb:+.3f} m/s")
    print("thrust over weight:", " ".join(f"{t:.2f}" for t in thrusts[::4] / weight))


if __name__ == "__main__":
    main()
