"""Environments and training on an accelerator, and on the CPU of a machine whose JAX runs on the accelerator."""

from importlib.util import find_spec

import gymnasium
import jax
import numpy as np
import pytest
from env_cases import random_action
from on_devices import ACCELERATOR, DEVICES, NAMES, require_device
from sweep import assert_agree

import crazysim
from crazysim.envs import TASKS, AutoReset, make
from crazysim.train import TrainConfig
from crazysim.train.training import train

N_WORLDS, N_STEPS = 64, 20


def run_steps(env, state, device):
    """Return the state after each of ``N_STEPS`` steps, after checking that it is on a device."""
    step, states = jax.jit(env.step), []
    for seed in range(N_STEPS):
        state = step(state, random_action(state, seed))
        states.append(require_device(device, state))
    return states


@pytest.mark.parametrize("name", [x for x in TASKS if x != "time_trial" or find_spec("casadi")])  # its planner
def test_tasks_agree_with_the_cpu_and_stay_on_their_device(name):
    """Also, an environment on the CPU steps on the accelerator if its state is moved there."""
    envs = {device: AutoReset(make(name, N_WORLDS, device=device)) for device in NAMES}
    starts = {device: require_device(device, jax.jit(env.reset)(jax.random.key(0))) for device, env in envs.items()}
    assert_agree(starts[ACCELERATOR], starts["cpu"], 1e-5)
    expected = run_steps(envs["cpu"], starts["cpu"], "cpu")
    moved = jax.device_put(starts["cpu"], DEVICES[ACCELERATOR])
    for result in (
        run_steps(envs[ACCELERATOR], starts[ACCELERATOR], ACCELERATOR),
        run_steps(envs["cpu"], moved, ACCELERATOR),
    ):
        assert_agree(result, expected, 1e-4)


@pytest.mark.parametrize("compiled", [False, True])
def test_an_environment_on_the_cpu_steps_compiled_or_not(compiled):
    env = make("hover", 4)
    step = jax.jit(env.step) if compiled else env.step
    for reset in (jax.jit(env.reset), env.reset):
        state = reset(jax.random.key(0))
        after = step(state, random_action(state))
        require_device("cpu", (after.data.states, after.obs))
        assert int(after.data.core.steps[0, 0]) == env.n_substeps


@pytest.mark.parametrize("device", NAMES)
def test_gymnasium_stays_on_the_device(device):
    envs = gymnasium.make_vec("crazysim/Hover-v0", num_envs=64, device=device)
    require_device(device, envs.reset(seed=0))
    for _ in range(3):
        require_device(device, envs.step(np.zeros(envs.action_space.shape, np.float32)))
    require_device(device, envs.reset(options={"reset_mask": np.arange(64) % 2 == 0}))


@pytest.mark.parametrize(("task", "algorithm"), [("hover", "ppo"), ("track", "apg")])
def test_training_learns_the_same(task, algorithm, tmp_path):
    """Only two iterations are compared, because Adam's steps amplify rounding of small gradients."""

    def train_on(device):
        config = TrainConfig.create(
            task, algorithm, n_worlds=16, options={"seconds": 0.4, "device": device}, config={"iterations": 2}
        )
        return train(config, tmp_path / device.replace(":", ""), evaluation_worlds=64, log=list, progress=False)

    expected, result = (train_on(device) for device in NAMES)
    require_device(ACCELERATOR, result.policy)
    for name in ("success", "crashed", "error", "reward"):
        np.testing.assert_allclose(result.metrics[name], expected.metrics[name], rtol=0.02, atol=0.02, err_msg=name)


def test_the_default_device_is_the_accelerator():
    """Otherwise these tests would not show that simulations stay on the CPU."""
    if ACCELERATOR == "gpu":
        assert jax.default_backend() == "gpu"
    assert crazysim.Sim().device.platform == "cpu"
