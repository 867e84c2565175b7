"""Stable-Baselines3 on our environments: contract, processes, PPO, which must learn, and SAC.

Run by .ci/sb3, not by pytest.
"""

import functools
import importlib.util
import time
from pathlib import Path

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecNormalize

from crazysim import ConfigError
from crazysim.envs import make
from crazysim.envs.sb3 import DroneVecEnv
from crazysim.envs.single import make_single

N_ENVS, N_STEPS = 64, 4
POS = slice(6, 9)
"""Slice of the position in the observations, after ``ang_vel`` and ``difference_to_goal``."""


def error_message(error, fn, *args):
    """Return the message of the error that a call must raise."""
    try:
        fn(*args)
    except error as refusal:
        return str(refusal)
    raise SystemExit(f"{fn} did not raise {error}")


def check_contract():
    """Check what DummyVecEnv promises: shapes, last observations, time limits, seeds, statistics of episodes."""
    env = DroneVecEnv(make("hover", 3, seconds=N_STEPS / 50))
    assert isinstance(env, VecEnv)
    assert env.observation_space.shape == (21,)
    assert env.action_space.shape == (4,)
    assert "reset" in error_message(ConfigError, env.step, np.zeros((3, 4)))
    env.seed(3)
    first = env.reset()
    assert (first.shape, first.dtype) == ((3, 21), np.float32)
    second = env.reset()
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(), second)
    assert not np.allclose(first, second)
    rewards, obs_before = np.zeros(3), None
    for step in range(N_STEPS):
        obs, reward, done, infos = env.step(np.zeros((3, 4), np.float32))
        assert [x.shape for x in (obs, reward, done)] == [(3, 21), (3,), (3,)]
        assert all(type(x) is np.ndarray and x.flags.writeable for x in (obs, reward, done))
        rewards += reward
        if step < N_STEPS - 1:
            assert not done.any()
            assert infos == [{}, {}, {}]
            obs_before = obs
    assert done.all()
    for world, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        assert info["episode"]["l"] == N_STEPS
        np.testing.assert_allclose(info["episode"]["r"], rewards[world], rtol=1e-5)
        last = info["terminal_observation"][POS]
        assert np.abs(last - obs_before[world][POS]).max() < 0.02, "it is the last observation of the old episode"
        assert np.abs(last - obs[world][POS]).max() > 0.1, "the returned observation is of the new episode"
    assert not env.step(np.zeros((3, 4)))[2].any()
    assert "of shape (3, 4), got (2, 4)" in error_message(ValueError, env.step, np.zeros((2, 4)))
    assert "world(s) [0, 1, 2]" in error_message(ConfigError, env.step, np.full((3, 4), np.nan))
    assert env.get_attr("max_steps") == [N_STEPS] * 3
    assert env.get_attr("max_steps", 1) == [N_STEPS]
    assert not env.has_attr("colour")
    assert "one compiled program" in error_message(ConfigError, env.set_attr, "max_steps", 7)
    crash = DroneVecEnv(make("hover", 2))
    crash.reset()
    done = np.zeros(2, bool)
    while not done.any():
        _, reward, done, infos = crash.step(np.tile([0.0, 0.0, 0.0, -1.0], (2, 1)))
    info = infos[int(np.argmax(done))]
    assert info["TimeLimit.truncated"] is False
    assert info["terminal_observation"][POS][2] < 0.03, "on the floor"


def check_named_observations():
    env = DroneVecEnv(make("hover", 2, n_drones=2), dict_obs=True, render_mode="rgb_array", render_size=(64, 48))
    assert env.observation_space["pos"].shape == (6,)
    assert env.action_space.shape == (8,)
    PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, device="cpu").learn(16)
    picture = env.render("rgb_array")
    assert picture.shape == (48, 64, 3)
    assert picture.std() > 5
    env.close()


def check_processes():
    make_env = functools.partial(make_single, "hover", seconds=N_STEPS / 50)
    env = SubprocVecEnv([make_env] * 2, start_method="spawn")
    PPO("MultiInputPolicy", env, n_steps=2 * N_STEPS, batch_size=8, device="cpu").learn(32)
    env.seed(3)
    first = env.reset()
    assert all(np.isfinite(x).all() for x in first.values())
    assert not np.allclose(first["pos"][0], first["pos"][1]), "each process has its own seed"
    env.seed(3)
    np.testing.assert_array_equal(env.reset()["pos"], first["pos"])
    env.close()


def check_training():
    """Check that PPO learns to hover: reward and distance from the goal, on starts that it has not seen."""
    env = VecNormalize(DroneVecEnv(make("hover", N_ENVS)), norm_reward=False)
    evaluation_env = VecNormalize(DroneVecEnv(make("hover", N_ENVS)), norm_reward=False, training=False)
    evaluation_env.obs_rms = env.obs_rms
    errors = []

    def keep_error(local_variables, _):
        if info := local_variables["info"]:
            errors.append(info["error"])

    def score(model):
        evaluation_env.seed(999)
        errors.clear()
        mean, _ = evaluate_policy(model, evaluation_env, N_ENVS, callback=keep_error)
        return mean, float(np.median(errors))

    kwargs = {"log_std_init": -0.7, "net_arch": [64, 64]}
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=4, learning_rate=1e-3, gamma=0.98,
                seed=0, device="cpu", policy_kwargs=kwargs)  # fmt: skip
    reward_before, error_before = score(model)
    start_time = time.perf_counter()
    model.learn(250_000)
    reward_after, error_after = score(model)
    print(
        f"PPO of Stable-Baselines3, hover, 250,000 steps in {time.perf_counter() - start_time:.0f} s: reward of an "
        f"episode {reward_before:.0f} -> {reward_after:.0f}, distance at its end "
        f"{error_before:.2f} m -> {error_after:.2f} m"
    )
    assert reward_after > reward_before + 50
    assert error_after < 0.3


def check_example():
    path = Path(__file__).parents[2] / "docs" / "examples" / "sac.py"
    spec = importlib.util.spec_from_file_location("example_sac", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    model, metrics = example.main(30 * example.WORLDS, starts=64)
    assert np.isfinite(metrics["reward"])
    obs = np.random.default_rng(0).normal(size=(5, 21)).astype(np.float32)
    expected, _ = model.predict(obs, deterministic=True)
    np.testing.assert_allclose(example.make_actor(model)({"all": obs}), expected, atol=1e-5)


if __name__ == "__main__":
    torch.set_num_threads(1)  # small networks: more threads only wait for each other
    check_contract()
    check_named_observations()
    check_processes()
    check_training()
    check_example()
    print("sb3: passed")
