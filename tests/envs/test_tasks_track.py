"""Following a trajectory: what a policy observes of it."""

import jax
import numpy as np

from crazysim.envs import make


def test_samples_are_future_points_of_the_trajectory():
    env = make("track", 3, n_samples=4, spacing=0.2, engine="interpret")
    state = env.reset(jax.random.key(0))
    pos, start = np.asarray(state.data.states.pos)[:, 0], np.asarray(state.data.plugins["task"].start_time)[:, 0, 0]
    expected = [[env.task.trajectory.evaluate(t + 0.2 * k).pos for k in range(5)] for t in start]
    difference = np.asarray(expected) - pos[:, None]
    np.testing.assert_allclose(state.obs["difference_to_goal"][:, 0], difference[:, 0], atol=1e-5)
    np.testing.assert_allclose(state.obs["local_samples"][:, 0].reshape(3, 4, 3), difference[:, 1:], atol=1e-5)
