"""RSL-RL on our environments: contract, groups of observations, and PPO, which must learn.

Run by .ci/sb3, not by pytest.
"""

import importlib.util
from pathlib import Path

import jax
import numpy as np
import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner

from crazysim.envs import AutoReset, CameraImages, PrivilegedObservation, RewardTerms, flatten, make
from crazysim.envs.rsl_rl import RslRlEnv
from crazysim.plugins.sensors import Camera

N_STEPS = 4


def check_contract():
    """Compare with the functional environment, over ends of episodes, with actions out of range."""
    env = RslRlEnv(RewardTerms(make("hover", 3, seconds=N_STEPS / 50)))
    reference = AutoReset(make("hover", 3, seconds=N_STEPS / 50))
    assert isinstance(env, VecEnv)
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (3, 4, N_STEPS)
    obs, extras = env.reset(seed=3)
    assert env.get_observations() is obs
    assert extras == {}
    step, state = jax.jit(reference.step), reference.reset(jax.random.key(3))
    torch.manual_seed(0)
    for n in range(1, 2 * N_STEPS):
        actions = 2 * torch.randn(3, 4)
        obs, reward, done, extras = env.step(actions)
        state = step(state, np.clip(actions.numpy(), -1, 1)[:, None])
        np.testing.assert_allclose(obs["policy"], flatten(state.obs)[:, 0], atol=1e-5)
        np.testing.assert_allclose(reward, state.reward[:, 0], atol=1e-5)
        assert done.tolist() == extras["time_outs"].tolist() == [n == N_STEPS] * 3
        assert env.episode_length_buf.tolist() == [n % N_STEPS] * 3
        assert extras["log"].keys() > {"/error", "/reward proximity"}
        np.testing.assert_allclose(extras["log"]["/error"], state.info["error"].mean(), atol=1e-5)
    env.reset()
    env.episode_length_buf = torch.tensor([0, 1, 3])
    assert [env.step(torch.zeros(3, 4))[2].tolist() for _ in range(3)] == [
        [False, False, True], [False, False, False], [False, True, False]
    ]  # fmt: skip


def check_crash():
    env = RslRlEnv(make("hover", 2))
    done = torch.zeros(2)
    while not done.any():
        _, _, done, extras = env.step(torch.tensor([[0.0, 0.0, 0.0, -1.0]] * 2))
    assert not extras["time_outs"].any(), "a crash is no time limit"


def check_groups():
    """Check that networks get the groups that are theirs, of several drones, with images as channels."""
    sensor = Camera(8, 6)
    env = RslRlEnv(CameraImages(PrivilegedObservation(make("swarm", 2, n_drones=2, plugins=[sensor])), sensor))
    obs = env.get_observations()
    images = {name: x for name, x in obs.items() if x.ndim == 4}
    assert [x.shape for x in images.values()] == [(2, 2, 6, 8)]
    assert {*obs.keys()} == {"policy", "privileged", *images}
    base = env.env.observation_sizes
    assert obs["policy"].shape[1] + obs["privileged"].shape[1] + 2 * 6 * 8 == 2 * sum(base.values())
    assert env.num_actions == 8


def check_example():
    """Check that PPO learns in the example, and that its actor is the runner's."""
    path = Path(__file__).parents[2] / "docs" / "examples" / "rsl_rl_ppo.py"
    spec = importlib.util.spec_from_file_location("example_rsl_rl", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    runner, metrics = example.main(30, starts=64)
    assert isinstance(runner, OnPolicyRunner)
    assert metrics["error"] < 0.5, "hovering at the start is 1 m off"
    obs = runner.env.get_observations()
    with torch.inference_mode():
        expected = runner.get_inference_policy()(obs)
    actual = example.make_actor(runner)({"all": jax.numpy.asarray(obs["policy"].numpy())})
    np.testing.assert_allclose(actual, expected, atol=1e-4)


if __name__ == "__main__":
    torch.set_num_threads(1)
    check_contract()
    check_crash()
    check_groups()
    check_example()
    print("rsl_rl: passed")
