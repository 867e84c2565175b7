"""Avoid: positions of obstacles, observations of them, hits and arrivals."""

import jax
import numpy as np
import pytest

from crazysim import Sim
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import DroneEnv
from crazysim.envs.tasks.avoid import CELL_JITTER, CELL_WIDTH, HEIGHT, Avoid

N_WORLDS = 2048


@pytest.fixture(scope="module")
def start_state():
    """Return an environment of two drones in every world, its state at the start of episodes, and its step."""
    sim = Sim(n_worlds=N_WORLDS, n_drones=2, control="attitude", engine="interpret")
    task = Avoid()
    task.install(sim)
    env = DroneEnv(sim, task)
    return env, jax.jit(env.reset)(jax.random.key(3)), jax.jit(env.step)


def place_drones(state, pos, **changes):
    """Return the state with drones at other positions, at rest and level, and changes in the record of the task."""
    data, s = state.data, state.data.states
    pos = np.broadcast_to(np.asarray(pos, np.float32), s.pos.shape)
    level = np.broadcast_to(np.float32([0, 0, 0, 1]), s.quat.shape)
    states = s.replace(pos=pos, vel=np.zeros_like(pos), ang_vel=np.zeros_like(pos), quat=level)
    record = data.plugins["task"].replace(**changes)
    return state.replace(data=data.replace(states=states, plugins=data.plugins | {"task": record}))


def test_starts_and_goals_are_clear_of_contact(start_state):
    env, state, _ = start_state
    data = state.data
    env.sim.data = data
    report = env.sim.contact_report()
    assert not np.any(report.any)
    assert report.object_distance.min() > 0.2
    assert report.drone_distance.min() > 0.05
    env.sim.data = place_drones(state, data.plugins["task"].goal).data
    report = env.sim.contact_report()
    assert not np.any(report.any)
    assert report.object_distance.min() > 0.2


def test_obstacles_have_other_positions_in_every_world_and_leave_gaps(start_state):
    _, state, _ = start_state
    pos = np.asarray(state.data.objects.pos)[:, 0]
    distances = np.linalg.norm(pos[:, :, None, :2] - pos[:, None, :, :2], axis=-1) + 9 * np.eye(12)
    assert distances.min() >= CELL_WIDTH - 2 * CELL_JITTER - 1e-5
    assert np.all(np.ptp(pos[..., :2], axis=0) > 2.5)
    quat = np.asarray(state.data.objects.quat)
    np.testing.assert_allclose(1 - 2 * np.sum(quat[..., :2] ** 2, axis=-1), 1, atol=1e-5)  # upright
    pole_heights, box_heights = pos[:, :8, 2], pos[:, 8:, 2]
    np.testing.assert_array_equal(pole_heights, 0)
    assert box_heights.min() > 0.15
    assert box_heights.max() < HEIGHT - 0.15
    assert np.ptp(box_heights) > 1


def test_observations_are_the_nearest_points_of_the_nearest_obstacles(start_state):
    env, state, _ = start_state
    rng = np.random.default_rng(0)
    inside = place_drones(state, rng.uniform([-1.6, -2, 0.2], [1.6, 2, 1.8], (N_WORLDS, 2, 3))).data
    env.sim.data = inside
    gaps = np.sort(np.asarray(env.sim.contact_report().object_distance), axis=-1)[..., :4]
    obs = jax.jit(vmap_worlds(env.task.observe))(inside)
    to_surface, surface_to_middle = (
        np.asarray(obs[f"obstacles_{x}"]).reshape(N_WORLDS, 2, 4, 3) for x in ("near", "middle")
    )
    # Contacts are measured from a ball of radius 8.6 cm, whose middle is 2 cm above the position of the drone.
    expected_gaps = np.linalg.norm(to_surface, axis=-1) - 0.086
    outside = gaps > 0.05
    assert outside.mean() > 0.5
    assert np.abs(expected_gaps - gaps)[outside].max() < 0.021
    is_box = np.any(surface_to_middle != 0, axis=-1)  # zero for poles
    assert 0.2 < is_box.mean() < 0.5, "a third of the obstacles"
    middle = np.asarray(inside.states.pos)[:, :, None] + to_surface + surface_to_middle
    middle_to_boxes = np.asarray(inside.objects.pos)[:, 0, None, None, 8:] - middle[..., None, :]
    outside_box = is_box & (np.linalg.norm(to_surface, axis=-1) > 0.01)
    np.testing.assert_allclose(np.linalg.norm(middle_to_boxes, axis=-1).min(axis=-1)[outside_box], 0, atol=1e-5)
    # A short step along such a vector reduces the distance by its length.
    length = np.maximum(np.linalg.norm(to_surface[:, :, 0], axis=-1, keepdims=True), 0.01)
    ahead = inside.states.pos + 0.1 * to_surface[:, :, 0] / length
    env.sim.data = inside.replace(states=inside.states.replace(pos=ahead))
    nearer = np.asarray(env.sim.contact_report().object_distance).min(axis=-1)
    assert np.abs(gaps[..., 0] - nearer - 0.1)[gaps[..., 0] > 0.15].max() < 0.022


def test_hits_disable_and_arriving_is_a_success(start_state):
    env, state, step = start_state
    goal, obstacles = np.asarray(state.data.plugins["task"].goal), np.asarray(state.data.objects.pos)[:, 0]
    free = np.array([-2.4, 0.0, 1.0])
    pos = np.broadcast_to([free, free + [0, 0.8, 0]], (N_WORLDS, 2, 3)).copy()
    pos[0] = goal[0]
    pos[1, 0] = goal[1, 0]
    pos[2, 0] = obstacles[2, 0] + [0.1, 0, 1.0]  # a pole
    pos[3, 0] = obstacles[3, 9]  # within a box
    pos[4, 0, 2] = 0.05  # the floor
    pos[5, 0, 2] = 2.01
    pos[6, 0, 0] = -3.0
    pos[7, 0] = pos[7, 1] + [0.1, 0, 0]  # another drone
    pos[8, 0] = pos[8, 1] + [0.1, 0, 0]  # a drone that is disabled
    disabled = np.zeros((N_WORLDS, 2), bool)
    disabled[8, 0] = True
    after = step(place_drones(state, pos, failure=disabled), state.action)
    expected = np.zeros((N_WORLDS, 2), bool)
    expected[2:9, 0] = True
    expected[7, 1] = True
    np.testing.assert_array_equal(after.info["disabled"], expected)
    arrived = np.asarray(env.succeeded(after))
    np.testing.assert_array_equal(np.argwhere(arrived), [[0, 0], [0, 1], [1, 0]])
    np.testing.assert_array_equal(np.flatnonzero(after.terminated), [0, 7])
    reward = np.asarray(after.reward)
    assert np.all(reward[0] > 9)
    assert np.all(reward[2:8, 0] < -9)
    assert reward[8, 0] == 0
    near = np.asarray(after.obs["drones_near"])
    np.testing.assert_array_equal(near[8, 1], 0)
    assert np.linalg.norm(near[9, 1]) > 0.7
