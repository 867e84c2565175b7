"""Environments and training on an accelerator, and on the CPU of a machine whose JAX runs on the accelerator."""

import gymnasium
import jax
import numpy as np
import pytest
from env_cases import random_action
from on_devices import ACCELERATOR, DEVICES, NAMES, on
from sweep import agree

import crazysim
from crazysim.envs import TASKS, AutoReset, make
from crazysim.train import TrainConfig
from crazysim.train.training import train

N_WORLDS, N_STEPS = 64, 20


def flight(env, state, device):
    """Return the states of some steps, all of which must be on a device."""
    step, states = jax.jit(env.step), []
    for seed in range(N_STEPS):
        state = step(state, random_action(state, seed))
        states.append(on(device, state))
    return states


@pytest.mark.parametrize("name", TASKS)
def test_tasks_are_those_of_the_cpu_and_stay_on_their_device(name):
    """Where the state is moved to, too: the steps of an environment on the CPU run on the accelerator."""
    envs = {device: AutoReset(make(name, N_WORLDS, device=device)) for device in NAMES}
    starts = {device: on(device, jax.jit(env.reset)(jax.random.key(0))) for device, env in envs.items()}
    agree(starts[ACCELERATOR], starts["cpu"], 1e-5)
    expected = flight(envs["cpu"], starts["cpu"], "cpu")
    moved = jax.device_put(starts["cpu"], DEVICES[ACCELERATOR])
    for found in (
        flight(envs[ACCELERATOR], starts[ACCELERATOR], ACCELERATOR),
        flight(envs["cpu"], moved, ACCELERATOR),
    ):
        agree(found, expected, 1e-4)


@pytest.mark.parametrize("compiled", [False, True])
def test_an_environment_on_the_cpu_steps_compiled_or_not(compiled):
    env = make("hover", 4)
    step = jax.jit(env.step) if compiled else env.step
    for reset in (jax.jit(env.reset), env.reset):
        state = reset(jax.random.key(0))
        after = step(state, random_action(state))
        on("cpu", (after.data.states, after.obs))
        assert int(after.data.core.steps[0, 0]) == env.n_substeps


@pytest.mark.parametrize("device", NAMES)
def test_gymnasium_stays_on_the_device(device):
    envs = gymnasium.make_vec("crazysim/Hover-v0", num_envs=64, device=device)
    on(device, envs.reset(seed=0))
    for _ in range(3):
        on(device, envs.step(np.zeros(envs.action_space.shape, np.float32)))
    on(device, envs.reset(options={"reset_mask": np.arange(64) % 2 == 0}))


@pytest.mark.parametrize(("task", "algorithm"), [("hover", "ppo"), ("track", "apg")])
def test_training_learns_the_same(task, algorithm, tmp_path):
    """For two iterations: Adam's first steps are as long where a gradient is rounding alone."""

    def trained(device):
        config = TrainConfig.create(
            task, algorithm, n_worlds=16, options={"seconds": 0.4, "device": device}, config={"iterations": 2}
        )
        return train(config, tmp_path / device.replace(":", ""), evaluation_worlds=64, log=list, progress=False)

    expected, found = (trained(device) for device in NAMES)
    on(ACCELERATOR, found.policy)
    for name in ("success", "crashed", "error", "reward"):
        np.testing.assert_allclose(found.metrics[name], expected.metrics[name], rtol=0.02, atol=0.02, err_msg=name)


def test_the_default_device_is_the_accelerator():
    """Otherwise these tests would not show that simulations stay on the CPU."""
    if ACCELERATOR == "gpu":
        assert jax.default_backend() == "gpu"
    assert crazysim.Sim().device.platform == "cpu"
