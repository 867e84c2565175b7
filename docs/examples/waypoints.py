"""Send a trained hover policy along a path of points, in eight worlds at once.

Each world begins elsewhere, and gets its next goal when its drone is near the last one. Without the folder of a trained
policy, such as ``out/hover``, one is trained with analytic gradients first, which takes some seconds.
"""

import sys
import tempfile
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import crazysim.envs as envs
from crazysim import train

POINTS = np.array([[0.7, 0.7, 1.0], [-0.7, 0.7, 1.4], [-0.7, -0.7, 1.0], [0.7, -0.7, 1.4], [0.0, 0.0, 1.2]])  # m
SWITCH_DISTANCE = 0.15  # distance at which the next point becomes the goal, m
SECONDS = 10.0


@partial(jax.jit, static_argnums=0)
def fly(env: envs.DroneEnv, policy: Any, key: Array) -> tuple[Array, Array]:
    """Return the positions and the numbers of points passed after each step. (n_steps, n_worlds, ...)"""
    points = jnp.asarray(POINTS)

    def step(carry, _):
        state, passed = carry
        goal = points[jnp.minimum(passed, len(points) - 1)]  # one for each world
        state = env.set_goal(state, goal)
        state = env.step(state, policy(state.obs))
        pos = state.data.states.pos[:, 0]
        passed += jnp.linalg.norm(goal - pos, axis=-1) < SWITCH_DISTANCE
        return (state, passed), (pos, jnp.minimum(passed, len(points)))

    initial_state = env.reset(key)
    return jax.lax.scan(step, (initial_state, jnp.zeros(env.sim.n_worlds, int)), length=env.max_steps)[1]


def main(folder: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Fly, print when each point was passed, and return the numbers of points passed and the last distances, m."""
    if folder is not None:
        policy = train.load_policy(folder)[0]
    else:
        with tempfile.TemporaryDirectory() as folder:
            policy = train.run(
                "hover", folder, algorithm="apg", config={"iterations": 100}, film=False, progress=False
            ).policy
    env = envs.make("hover", n_worlds=8, seconds=SECONDS)
    pos, passed = fly(env, policy, jax.random.key(1))
    for world in range(env.sim.n_worlds):
        times = [int(np.argmax(passed[:, world] > n)) / env.freq for n in range(int(passed[-1, world]))]
        print(f"world {world}: passed the points after {', '.join(f'{t:.1f}' for t in times)} s")
    return np.asarray(passed[-1]), np.linalg.norm(pos[-1] - POINTS[-1], axis=-1)


if __name__ == "__main__":
    main(*sys.argv[1:2])
