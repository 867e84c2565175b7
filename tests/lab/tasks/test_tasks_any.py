"""One policy for any quadrotor: what it observes, what its actions mean, and how goals move."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import rotation
from crazysim.core.plugin import drawn_data
from crazysim.dynamics import first_principles
from crazysim.envs import make
from crazysim.lab.tasks.any_airframe import MIDDLE

N = 64


@pytest.fixture(scope="module")
def env():
    return make("any", N, noise=0.0, speed=1.0, engine="interpret")


@pytest.fixture(scope="module")
def start(env):
    return env.reset(jax.random.key(2))


def test_an_action_is_the_speed_of_each_rotor_from_zero_to_the_largest(env):
    largest = float(np.max(env.sim.data.params.rotor_vel_max))
    assert env.base.freq == 100
    commands = [env.actions.command(jnp.full(4, x)) for x in (-1.0, 0.0, 1.0)]
    np.testing.assert_allclose(commands, np.multiply([[0.0], [0.5], [1.0]], largest) * np.ones(4), rtol=1e-6)


def test_observations_are_relative_to_the_goal_its_yaw_and_its_velocity(env, start):
    data, obs = start.data, {name: np.asarray(x)[:, 0] for name, x in start.obs.items()}
    record, s = data.plugins["task"], data.states
    yaw = np.asarray(record.goal_yaw)[:, 0, 0]
    turn = np.array([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in yaw])
    to_frame = lambda x: np.einsum("wji,wj->wi", turn, np.asarray(x)[:, 0])  # noqa: E731
    np.testing.assert_allclose(obs["pos_from_goal"], np.clip(to_frame(s.pos - record.goal), -0.5, 0.5), atol=2e-5)
    np.testing.assert_allclose(obs["vel_from_goal"], np.clip(to_frame(s.vel - record.goal_vel), -1.0, 1.0), atol=2e-5)
    assert (np.abs(to_frame(s.vel)) > 1).any(), "some start faster"
    rot = np.einsum("wji,wjk->wik", turn, np.asarray(rotation.matrix(s.quat))[:, 0])
    np.testing.assert_allclose(obs["attitude_from_goal"].reshape(N, 3, 3), rot, atol=2e-5)
    moving = np.abs(np.asarray(record.goal_vel)).max(axis=(1, 2)) > 0
    assert 0.25 < moving.mean() < 0.75
    assert sum(x.shape[-1] for x in obs.values()) == 22


def test_drones_start_with_the_rotor_speeds_that_carry_their_own_weight(start):
    p = drawn_data(start.data).params
    np.testing.assert_allclose(start.data.states.rotor_vel, first_principles.hover_rotor_vel(p), rtol=1e-5)
    assert np.ptp(np.asarray(start.data.states.rotor_vel)[:, 0, 0]) > 1000


def test_goals_move_with_their_velocity_and_the_last_action_is_observed(env, start):
    action = jnp.broadcast_to(jnp.array([0.1, -0.2, 0.3, -0.4]), (N, 1, 4))
    state = env.step(start, action)
    before, after = (x.data.plugins["task"] for x in (start, state))
    flies = ~np.asarray(state.terminated)
    moved = np.asarray(after.goal - before.goal)[flies]
    mean_vel = (np.asarray(before.goal_vel) + np.asarray(after.goal_vel))[flies] / 2
    # Steps of the physics use the velocity at their end: half of a step's change, at 2 rad/s and 1 m from the middle.
    np.testing.assert_allclose(moved, mean_vel / 100, atol=2.0**2 / 500 / 2 / 100 + 2e-5)
    change, rate = (np.asarray(x)[flies] for x in (after.goal_vel - before.goal_vel, before.goal_rate))
    way = (np.asarray(before.goal + after.goal) / 2 - MIDDLE)[flies]
    np.testing.assert_allclose(change, -(rate**2) * way / 100, atol=3e-4)  # curvature of the ellipse within the step
    np.testing.assert_allclose(np.asarray(state.obs["last_action"])[flies], np.asarray(action)[flies], atol=1e-5)


def test_delays_are_drawn_up_to_ten_milliseconds_and_an_airframe_of_ones_own_can_be_kept(start):
    delays = np.asarray(start.data.plugins["latency"].delay).ravel()
    assert set(delays) == {0, 1, 2, 3, 4, 5}
    own = make("any", 2, drawn=False, delay=0.0, drone="crazyflie", engine="interpret")
    assert "airframe" not in own.sim.plugins
    own.step(own.reset(jax.random.key(0)), jnp.zeros((2, 1, 4)))
