"""Deliver: a load on a trailer, and conditions of taking and delivering it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine.stage import vmap_worlds
from crazysim.envs import make
from crazysim.lab.tasks.deliver import MIN_HEIGHT, ring_motion, ring_positions

N_WORLDS = 5


@pytest.fixture(scope="module")
def env():
    return make("deliver", N_WORLDS)


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


@pytest.fixture(scope="module")
def start_state(env):
    return jax.jit(env.reset)(jax.random.key(0))


def move_drone(state, pos, vel, load=None):
    data = state.data
    s = data.states
    level = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1]), s.quat.shape)
    states = s.replace(pos=pos, vel=vel, quat=level, ang_vel=jnp.zeros_like(pos))
    hook = data.plugins["load"].replace(tip_pos=pos - jnp.array([0.0, 0, 0.3]), tip_vel=vel, **load or {})
    return state.replace(data=data.replace(states=states, plugins=data.plugins | {"load": hook}))


def test_a_load_rides_on_its_trailer(start_state, step):
    state = start_state
    for _ in range(10):
        state = step(state, state.action)
    data = state.data
    load = data.plugins["load"]
    np.testing.assert_allclose(load.pos, vmap_worlds(ring_positions)(data.plugins["cars"]), atol=1e-6)
    assert np.linalg.norm(load.pos - start_state.data.plugins["load"].pos, axis=-1).min() > 0.02
    ahead = step(state, state.action).data.plugins["load"]
    np.testing.assert_allclose((ahead.pos - load.pos) * 50, load.vel, atol=0.02)
    with jax.enable_x64(True):  # a difference of positions in float32 would be off by 2e-4 m/s
        cars = jax.tree.map(lambda x: np.asarray(x, float) if x.dtype == np.float32 else x, data.plugins["cars"])
        _, exact = vmap_worlds(ring_motion)(cars)
    assert exact.dtype == np.float64
    np.testing.assert_allclose(load.vel, exact, atol=2e-6)


def test_a_hook_takes_a_load_only_near_its_ring_and_at_its_velocity(start_state, step):
    """At the ring with the trailer's velocity, at rest, 10 cm away, 5 cm away, and with a large upward velocity."""
    load = start_state.data.plugins["load"]
    offset = np.array([0.0, 0.0, 0.10, 0.05, 0.0], np.float32)[:, None, None] * np.array([0, 0, 1], np.float32)
    faster = np.array([0.0, 0.0, 0.0, 0.0, 0.7], np.float32)[:, None, None] * np.array([0, 0, 1], np.float32)
    vel = load.vel.at[1].multiply(0.0)
    state = move_drone(start_state, load.pos + offset + np.array([0, 0, 0.3], np.float32), vel + faster)
    after = step(state, state.action)
    assert float(jnp.linalg.norm(load.vel[1])) < 0.6
    np.testing.assert_array_equal(after.info["taken"][:, 0], [True, True, False, True, False])
    assert after.reward[0, 0] > after.reward[2, 0] + 0.3


def test_a_load_is_delivered_after_half_a_second_at_its_goal(env, start_state, step):
    goal = start_state.data.plugins["task"].goal
    pos = goal + jnp.array([0.0, 0, 0.3])
    attached = jnp.ones_like(start_state.data.plugins["load"].attached)
    state, load = start_state, {"pos": goal, "vel": jnp.zeros_like(pos), "attached": attached}
    for k in range(26):  # moved back before every step, as with zero action a drone sinks with its load
        state = step(move_drone(state, pos, jnp.zeros_like(pos), load), state.action)
        assert np.asarray(env.succeeded(state)).all() == (k >= 24), "half a second is 25 steps"
    assert state.info["taken"].all()
    assert float(state.info["error"].max()) < env.task.tolerance


def test_too_low_is_a_crash(start_state, step):
    pos = start_state.data.states.pos.at[0, 0, 2].set(MIN_HEIGHT - 0.01)
    state = step(move_drone(start_state, pos, jnp.zeros_like(pos)), start_state.action)
    np.testing.assert_array_equal(state.terminated, np.arange(N_WORLDS) == 0)
    assert float(state.reward[0, 0]) < -3
