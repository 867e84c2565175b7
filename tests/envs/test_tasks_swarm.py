"""A swarm: starts, goals, separation, and ends of episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import DroneEnv
from crazysim.envs.tasks.swarm import Swarm, separation

N_WORLDS, N_DRONES = 2048, 4


@pytest.fixture(scope="module")
def start_state():
    """Return an environment, its state at the start of episodes, and its step."""
    sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES, control="attitude", engine="interpret")
    task = Swarm()
    task.install(sim)
    env = DroneEnv(sim, task)
    return env, jax.jit(env.reset)(jax.random.key(3)), jax.jit(env.step)


def place_drones(state, pos):
    """Return the state with drones at other positions, at rest and level."""
    data, s = state.data, state.data.states
    level = np.broadcast_to(np.float32([0, 0, 0, 1]), s.quat.shape)
    still = np.zeros_like(s.vel)
    states = s.replace(pos=np.asarray(pos, np.float32), vel=still, ang_vel=still, quat=level)
    return state.replace(data=data.replace(states=states))


separations = jax.jit(separation)


def test_separation_is_that_of_an_ellipsoid_longer_in_z():
    pos = np.float32([[0.0, 0, 1], [0.24, 0, 1], [0, -0.48, 1], [0, 0, 2.2]])
    np.testing.assert_allclose(separations(pos), [1, 1, 2, 2], rtol=1e-6)
    np.testing.assert_allclose(separations(pos[[0, 3]]), [2, 2], rtol=1e-6)
    gradient = jax.jit(jax.grad(lambda p: separation(p).sum()))(jnp.zeros((2, 3)))
    assert np.all(np.isfinite(gradient))


def test_starts_are_clear_and_drones_exchange_their_positions(start_state):
    env, state, _ = start_state
    data = state.data
    env.sim.data = data
    report = env.sim.contact_report()
    assert not np.any(report.any)
    assert np.asarray(separations(data.states.pos)).min() > 1.5
    goal = np.asarray(data.plugins["task"].goal)
    # A goal is the position of another drone, and no two drones have the same goal.
    distance = np.linalg.norm(goal[:, :, None] - np.asarray(data.states.pos)[:, None], axis=-1)
    target_drone = distance.argmin(axis=-1)
    assert distance.min(axis=-1).max() < 0.1 * np.sqrt(3) + 1e-5
    assert not np.any(target_drone == np.arange(N_DRONES))
    np.testing.assert_array_equal(
        np.sort(target_drone, axis=-1), np.broadcast_to(np.arange(N_DRONES), target_drone.shape)
    )
    assert set((target_drone[:, 0]).tolist()) == {1, 2, 3}
    np.testing.assert_allclose(state.info["error"], np.linalg.norm(goal - data.states.pos, axis=-1), rtol=1e-5)


def test_coming_too_near_ends_and_costs(start_state):
    _, state, step = start_state
    goal = np.asarray(state.data.plugins["task"].goal)
    pos = goal.copy()
    pos[1, 1] = pos[1, 0] + [0.2, 0, 0]  # beside each other
    pos[2, 1] = pos[2, 0] + [0, 0, 0.5]  # above: too near in the downwash
    pos[3, 1] = pos[3, 0] + [0.5, 0, 0]  # beside, far enough
    pos[4, 2, 2] = 0.01
    pos[5, 3, 0] = 2.5
    pos[6, 0] = pos[6, 1] + [0.2, 0, 0]
    after = step(place_drones(state, pos), state.action)
    np.testing.assert_array_equal(np.flatnonzero(after.terminated), [1, 2, 4, 5, 6])
    assert np.all(np.asarray(after.info["separation"])[1:3, :2] < 1)
    reward = np.asarray(after.reward)
    assert np.all(reward[0] > 1.3)
    assert np.all(reward[1:3, :2] < -9)
    assert reward[1, 2] > 1  # a drone that no other one comes near is not punished
    assert np.all(np.asarray(after.info["error"])[0] < 0.03)
    offsets = np.asarray(after.obs["drones_near"]).reshape(N_WORLDS, N_DRONES, 3, 3)
    np.testing.assert_allclose(offsets[1, 0, 0], [0.2, 0, 0], atol=0.01)
    assert np.all(np.diff(np.linalg.norm(offsets, axis=-1), axis=-1) > -1e-6)


def test_separation_is_kept_at_every_physics_step(start_state):
    _, state, step = start_state
    # One drone flies past another at 40 m/s within one environment step, so both are near only between steps.
    pos = np.asarray(state.data.plugins["task"].goal).copy()
    pos[0, 0], pos[0, 1] = [-0.4, 0, 1.2], [0.0, 0.05, 1.2]
    pos[0, 2:] = [[0, 1.5, 1.2], [0, -1.5, 1.2]]
    fast = place_drones(state, pos)
    vel = fast.data.states.vel.copy()
    vel[0, 0, 0] = 40.0
    after = step(fast.replace(data=fast.data.replace(states=fast.data.states.replace(vel=vel))), state.action)
    assert np.asarray(separations(after.data.states.pos))[0].min() > 1
    assert after.terminated[0]


def test_goals_can_be_a_formation():
    formation = [(0, 0, 1), (0.5, 0, 1), (0, 0.5, 1), (0, 0, 2)]
    sim = Sim(n_worlds=64, n_drones=N_DRONES, control="attitude", engine="interpret")
    task = Swarm(formation=formation, strict=False)
    task.install(sim)
    data = jax.jit(DroneEnv(sim, task).reset)(jax.random.key(0)).data
    np.testing.assert_allclose(data.plugins["task"].goal, np.broadcast_to(formation, (64, 4, 3)))
    close = np.array(data.states.pos)
    close[:, 1] = close[:, 0] + 0.1
    near = data.replace(states=data.states.replace(pos=close))
    near = near.replace(plugins={"task": near.plugins["task"].replace(closest=np.zeros((64, 4), np.float32))})
    assert not np.any(jax.jit(vmap_worlds(task.terminated))(near))
    zeros, rewards = np.zeros((64, 4, 4), np.float32), jax.jit(vmap_worlds(task.rewards))
    rewards_apart, rewards_near = rewards(data, zeros, zeros), rewards(near, zeros, zeros)
    assert np.all((np.asarray(rewards_near["crowding"]) - rewards_apart["crowding"])[:, 0] < -2)
