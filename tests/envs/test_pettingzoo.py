"""PettingZoo's own tests of a parallel environment, and further ones."""

import importlib
import sys

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.envs import AutoReset, make

pytest.importorskip("pettingzoo")
from pettingzoo.test import parallel_api_test, parallel_seed_test

from crazysim.envs.pettingzoo import DroneParallelEnv, make_parallel


@pytest.fixture(scope="module")
def drone_env():
    return make("hover", 1, n_drones=2, seconds=0.3)


@pytest.fixture(scope="module")
def env(drone_env):
    return DroneParallelEnv(drone_env)


def zeros(env):
    return {agent: np.zeros(4, np.float32) for agent in env.agents}


def test_pettingzoos_own_test(env, capsys):
    parallel_api_test(env, num_cycles=40)
    assert "Passed" in capsys.readouterr().out


def test_pettingzoos_own_test_of_seeds(drone_env):
    parallel_seed_test(lambda: DroneParallelEnv(drone_env), num_cycles=10)


def test_every_drone_has_its_own_observations_and_reward(env):
    obs, info = env.reset(seed=0)
    assert env.agents == env.possible_agents == ["drone_0", "drone_1"]
    assert all(obs[agent] in env.observation_space(agent) for agent in env.agents)
    assert all(x.flags.writeable for agent in env.agents for x in obs[agent].values())
    assert not np.allclose(obs["drone_0"]["pos"], obs["drone_1"]["pos"])
    state = env.env_state
    for i, agent in enumerate(env.agents):
        np.testing.assert_array_equal(obs[agent]["pos"], state.obs["pos"][0, i])
        np.testing.assert_array_equal(info[agent]["error"], state.info["error"][0, i])
        assert info[agent]["nonfinite"] == np.False_
    obs_of_zeros, *_ = env.step(zeros(env))
    env.reset(seed=0)
    obs, reward, terminated, truncated, _ = env.step(zeros(env) | {"drone_1": np.ones(4)})
    assert obs["drone_1"]["vel"][2] > obs_of_zeros["drone_1"]["vel"][2] + 1e-3
    np.testing.assert_allclose(obs["drone_0"]["vel"], obs_of_zeros["drone_0"]["vel"], atol=1e-6)
    assert reward == {f"drone_{i}": float(env.env_state.reward[0, i]) for i in range(2)}
    assert reward["drone_0"] != reward["drone_1"]
    assert terminated == truncated == {"drone_0": False, "drone_1": False}


def test_the_state_is_the_observations_of_all_drones(env):
    obs, _ = env.reset(seed=0)
    expected = [obs[agent][name] for agent in env.agents for name in sorted(obs[agent])]
    np.testing.assert_array_equal(env.state(), np.concatenate(expected))
    assert env.state() in env.state_space


def test_an_episode_ends_for_all(env):
    env.reset(seed=0)
    for _ in range(15):
        assert len(env.agents) == 2
        *_, truncated, _ = env.step(zeros(env))
    assert truncated == {"drone_0": True, "drone_1": True}
    assert env.agents == []
    with pytest.raises(ConfigError, match="running episode, got none: "):
        env.step({})


GOOD = np.zeros(4)


@pytest.mark.parametrize(
    ("actions", "error", "message"),
    [
        ({"drone_0": GOOD}, ConfigError, "none of drone_1"),
        ({"drone_0": GOOD, "drone_1": GOOD, "drone_7": GOOD}, KeyError, "drone_0, drone_1, got one of drone_7"),
        ({"drone_0": GOOD, "drone_1": np.zeros(3)}, ValueError, r"drone_1 of shape \(4,\), got \(3,\)"),
        ({"drone_0": GOOD * np.nan, "drone_1": GOOD}, ConfigError, "finite action of drone_0"),
        ({"drone_0": "up", "drone_1": GOOD}, ConfigError, "drone_0 .*got 'up'"),
        ({1: GOOD, "drone_2": GOOD}, KeyError, "got one of 1"),
        ([GOOD, GOOD], ConfigError, "a dict with an action of every drone"),
    ],
)
def test_wrong_actions_are_refused(env, actions, error, message):
    env.reset(seed=0)
    with pytest.raises(error, match=message):
        env.step(actions)


def test_wrong_settings_and_resets_are_refused(drone_env, env):
    fresh = make_parallel("hover", n_drones=2)
    for call, message in (
        (lambda: DroneParallelEnv(make("hover", 2)), r"2 worlds\. Make it with n_worlds=1"),
        (lambda: make_parallel("hover", n_worlds=2), r"2 worlds\. Make it with n_worlds=1"),
        (lambda: DroneParallelEnv(AutoReset(drone_env)), "without AutoReset"),
        (lambda: DroneParallelEnv(drone_env, "ascii"), "got 'ascii'"),
        *((call, "reset") for call in (fresh.state, fresh.render, lambda: fresh.step({}))),
        *((lambda seed=seed: env.reset(seed=seed), "as seed of all worlds") for seed in (-1, True, 1.5)),
        *((lambda x=x: env.reset(options=x), "options of reset") for x in ({"colour": 1}, {"reset_mask": [1]}, "all")),
    ):
        with pytest.raises(ConfigError, match=message):
            call()


@pytest.mark.usefixtures("opengl")
def test_rendering_returns_an_image(drone_env):
    env = DroneParallelEnv(drone_env, "rgb_array", (64, 48))
    env.reset(seed=0)
    picture = env.render()
    assert (picture.shape, picture.dtype) == ((48, 64, 3), np.uint8)
    assert picture.std() > 5
    env.close()


@pytest.mark.parametrize(
    ("module", "package", "message"),
    [
        (
            "crazysim.envs.pettingzoo",
            "pettingzoo",
            r"needs pettingzoo, which is not installed\. Run pip install 'crazysim\[pettingzoo\]'",
        ),
        ("crazysim.envs.sb3", "stable_baselines3", "needs stable-baselines3, which is not installed"),
    ],
)
def test_without_a_package_the_error_says_how_to_install_it(monkeypatch, module, package, message):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(ImportError, match=message):
        importlib.import_module(module)
