"""Environments with their worlds on four devices have the results of one device, bit for bit."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim
from crazysim.engine.sharding import world_mesh
from crazysim.envs import ActionDelay, AutoReset, EpisodeStatistics, ObservationNoise, make
from crazysim.train.devices import exchanged_bytes

N_WORLDS = 8


@pytest.fixture(scope="module")
def mesh():
    return world_mesh(jax.devices()[:4])


def sequence(n, shape):
    """Yield random calls with their arguments: ``reset`` and a seed, ``restart`` and a mask, ``step`` and actions."""
    rng = np.random.default_rng(3)
    yield "reset", 7
    for kind in ["restart", *rng.choice(["step", "restart"], n, p=[0.8, 0.2]), "step"]:
        yield kind, rng.uniform(-1, 1, shape).astype(np.float32) if kind == "step" else rng.random(N_WORLDS) < 0.4


def assert_equal(unsharded, sharded, n_devices=4):
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(sharded), jax.tree.leaves(unsharded), strict=True):
        name = jax.tree_util.keystr(path)
        assert len(x.sharding.device_set) == n_devices, name
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y, err_msg=name)


@pytest.mark.long("compiles each environment for one device and for four")
def test_law_10_worlds_on_four_devices_are_those_of_one(mesh):
    """Episodes, steps, wrappers and statistics: random numbers depend on the world, not on the device."""

    def fly_on_mesh(mesh):
        env = make("hover", N_WORLDS, seconds=0.1, mesh=mesh, randomize="crazyflie")
        env = AutoReset(EpisodeStatistics(ActionDelay(ObservationNoise(env, {"pos": 0.01}), 1)))
        reset, step, restart = jax.jit(env.reset), jax.jit(env.step), jax.jit(env.restart)
        state = reset(jax.random.key(0))
        for kind, argument in sequence(10, state.action.shape):
            if kind == "reset":
                state = reset(jax.random.key(argument))
            else:
                state = step(state, argument) if kind == "step" else restart(state, argument)
            yield state
        assert jax.eval_shape(env.flatten, state).plan.rows  # arrays that a rollout updates in place

    n_ended = 0
    for unsharded, sharded in zip(fly_on_mesh(None), fly_on_mesh(mesh), strict=True):
        assert_equal(unsharded, sharded)
        assert sharded.obs["vel"].sharding.is_equivalent_to(sharded.reward.sharding, sharded.reward.ndim)
        assert sharded.reward.addressable_shards[0].data.shape[0] == N_WORLDS // 4
        n_ended += int(unsharded.done.sum())
    assert n_ended >= N_WORLDS


@pytest.mark.long("compiles an environment for one device and for four")
def test_gymnasium_worlds_on_four_devices_are_those_of_one(mesh):
    """Actions may be JAX arrays on the default device, and states may be read in between."""
    settings = {"num_envs": N_WORLDS, "seconds": 0.1}
    envs = [gymnasium.make_vec("crazysim/Hover-v0", **settings, **options) for options in ({}, {"mesh": mesh})]
    shape = envs[0].action_space.shape
    for i, (kind, argument) in enumerate(sequence(12, shape)):
        if kind == "step":
            action = jax.device_put(argument, jax.devices()[0]) if i % 2 else argument
            results = [env.step(action) for env in envs]
        else:
            reset_options = {"seed": argument} if kind == "reset" else {"options": {"reset_mask": argument}}
            results = [env.reset(**reset_options) for env in envs]
        assert_equal(*results)
    assert_equal(*(env.unwrapped.state for env in envs))
    assert envs[1].unwrapped.explain().startswith("engine: fused")
    assert jnp.asarray(results[1][1]).addressable_shards[0].data.shape[0] == N_WORLDS // 4


@pytest.mark.long("compiles images for one device and for four")
def test_depth_images_on_four_devices_are_those_of_one(mesh):
    """No device needs the worlds of another, and each runs the kernel."""

    def images(mesh):
        sim = Sim(N_WORLDS, control="attitude", mesh=mesh)
        sim.scene.add("pole", count=3, pos=[[1, 0, 0], [2, 0.5, 0], [3, -0.5, 0]])
        sim.data = sim.data.replace(
            states=sim.data.states.replace(pos=np.float32(np.random.default_rng(0).uniform(0, 1, (N_WORLDS, 1, 3))))
        )
        measure_depth = jax.jit(sim.scene.depth_fn("fpv_cam", 12, 8))
        program = measure_depth.lower(sim.data).compile()
        return program(sim.data), exchanged_bytes(program.as_text()), sim

    unsharded, exchanged_of_one, _ = images(None)
    sharded, exchanged_of_four, sim = images(mesh)
    assert (exchanged_of_one, exchanged_of_four) == ({}, {})
    assert_equal(unsharded, sharded)
    assert sharded.distance.addressable_shards[0].data.shape == (2, 1, 8, 12)
    assert "one kernel with a lane for each ray" in sim.explain()
    np.testing.assert_array_equal(sim.depth("fpv_cam", 12, 8), unsharded.distance)
