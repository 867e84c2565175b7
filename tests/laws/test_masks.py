"""Law 9 for masks: a mask that is not bool with one entry per world (or drone, or rotor) is an error."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, Hook, MotorFailure, Sim, SlungLoad, envs
from crazysim.core.stages import reset
from crazysim.utils import leaf_replace, pytree_replace, world_mask

N_WORLDS = 3
MASK = [True, False, True]

sim = Sim(N_WORLDS, n_drones=2)
gates = sim.scene.add("gate", pos=[0, 0, 1])
load = sim.add(SlungLoad(mass=0.005, length=0.3))
motors = sim.add(MotorFailure())
hook_sim = Sim(N_WORLDS)
hook = hook_sim.add(Hook(0.01))


WORLD_MASK_FUNCTIONS = {
    "Sim.reset": lambda mask: sim.reset(mask),
    "reset_fn": lambda mask: sim.reset_fn(sim.data, sim.default_data, mask),
    "reset_fn.plain": lambda mask: sim.reset_fn.plain(sim.data, sim.default_data, mask),
    "stages.reset": lambda mask: reset(sim.data, sim.default_data, mask),
    "Handle.set_pose": lambda mask: gates.set_pose(sim.data, [1, 0, 1], mask=mask),
    "SlungLoad.hang": lambda mask: load.hang(sim.data, mask),
    "SlungLoad.release": lambda mask: load.release(sim.data, mask),
    "Hook.hang": lambda mask: hook.hang(hook_sim.data, mask),
    "leaf_replace": lambda mask: leaf_replace(sim.data.states, mask, pos=np.ones((N_WORLDS, 2, 3), np.float32)),
    "pytree_replace": lambda mask: pytree_replace(sim.data, sim.default_data, world_mask(sim.data), mask),
}
WRONG_MASKS = {
    "ints": np.array([1, 0, 1]),
    "one bool": [True],
    "a bool": True,
    "floats": jnp.ones(N_WORLDS),
    "a column": np.ones((N_WORLDS, 1), bool),
    "of another number of worlds": np.ones(N_WORLDS + 1, bool),
    "words": ["yes", "no", "yes"],
}


@pytest.mark.parametrize("name", WORLD_MASK_FUNCTIONS)
def test_a_mask_over_worlds_is_bool_and_one_per_world(name):
    before = sim.data
    for mask in WRONG_MASKS.values():
        with pytest.raises(ConfigError, match=r"expected a mask of .*got"):
            WORLD_MASK_FUNCTIONS[name](mask)
    assert sim.data is before


@pytest.mark.parametrize("wrong", ["ints", "floats", "a column", "of another number of worlds"])
def test_traced_masks_are_checked_by_shape_and_type(wrong):
    for name, fn in WORLD_MASK_FUNCTIONS.items():
        if name != "Sim.reset":
            with pytest.raises(ConfigError, match=r"expected a mask of .*got"):
                jax.eval_shape(fn, WRONG_MASKS[wrong])


def test_masks_of_host_and_device_change_only_the_selected_worlds():
    x = np.asarray(gates.set_pose(sim.data, [1, 0, 1], mask=MASK).objects.pos)[:, 0, 0, 0]
    np.testing.assert_array_equal(x, [1, 0, 1])
    for mask in (MASK, np.array(MASK), jnp.array(MASK)):
        np.testing.assert_array_equal(load.release(sim.data, mask).plugins["load"].attached[:, 0], ~np.array(MASK))
    drone_mask = np.array([[True, False], [False, False], [False, True]])
    np.testing.assert_array_equal(load.release(sim.data, drone_mask).plugins["load"].attached, ~drone_mask)
    assert not np.any(load.release(sim.data).plugins["load"].attached)
    release_traced = jax.jit(lambda mask: load.release(sim.data, mask).plugins["load"].attached)
    np.testing.assert_array_equal(release_traced(drone_mask), ~drone_mask)


@pytest.mark.parametrize("mask", [np.ones((N_WORLDS, 2, 4)), np.ones((N_WORLDS, 1, 4), bool), [[1]], "all"])
def test_a_mask_over_rotors_is_bool_and_one_per_rotor(mask):
    with pytest.raises(ConfigError, match="expected a mask of shape"):
        motors.fail(sim.data, mask)


@pytest.mark.parametrize("mask", [np.array([1, 0, 1]), [True], "all"])
def test_an_environment_restarts_worlds_by_a_mask_only(mask):
    env = envs.make("hover", n_worlds=N_WORLDS)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    with pytest.raises(ConfigError, match="expected a mask of shape"):
        env.restart(state, mask)
