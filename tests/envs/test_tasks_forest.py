"""Forest: positions of trees, observations, ends of flights, and rewards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import rotation
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import PrivilegedObservation, make
from crazysim.envs.tasks.forest import CEILING, EDGE_DISTANCE, HALF_WIDTH, HEIGHT, N_PRIVILEGED_TREES, VIEW_RANGE

N_WORLDS, N_OBSERVED_TREES = 64, 6


@pytest.fixture(scope="module")
def start_state():
    """Return an environment without images, its state at the start of episodes, and its step."""
    env = make("forest", N_WORLDS, camera=(), trees_seen=N_OBSERVED_TREES, engine="interpret")
    return env, jax.jit(env.reset)(jax.random.key(3)), jax.jit(env.step)


def place_drones(state, pos, vel=0.0, yaw=0.0, **changes):
    """Return the state with drones at other positions, level."""
    data, s = state.data, state.data.states
    pos = jnp.broadcast_to(jnp.asarray(pos, jnp.float32), s.pos.shape)
    quat = jnp.broadcast_to(rotation.from_rpy(jnp.asarray([0.0, 0.0, yaw], jnp.float32)), s.quat.shape)
    vel = jnp.broadcast_to(jnp.asarray(vel, jnp.float32), s.vel.shape)
    states = s.replace(pos=pos, vel=vel, ang_vel=jnp.zeros_like(pos), quat=quat)
    record = data.plugins["task"].replace(**changes)
    return state.replace(data=data.replace(states=states, plugins=data.plugins | {"task": record}))


def standing_trees(env, data):
    """Return positions, radii and presence of all trees. (n_worlds, n) each, and (n_worlds, n, 2) for positions"""
    forest = env.task.trees(env.sim.n_drones)
    pos = np.asarray(vmap_worlds(lambda data: forest.poses(data)[0])(data))
    cells = np.divmod(forest.cells_by_size, forest.n_cells[1])
    trees = vmap_worlds(lambda data: forest.obstacles_in_cells(data, *cells))(data)
    np.testing.assert_allclose(pos[..., 0], trees.x, atol=1e-5)
    radius = np.broadcast_to(np.asarray(trees.size), trees.is_standing.shape)
    return np.stack([trees.x, trees.y], axis=-1), radius, np.asarray(trees.is_standing)


def test_every_world_has_its_own_forest_with_clear_starts(start_state):
    env, state, _ = start_state
    xy, radius, stands = standing_trees(env, state.data)
    assert stands.mean() > 0.98
    assert np.ptp(xy, axis=0).min() > 2.0, "trees stand elsewhere in every world"
    assert xy[..., 0].min() > EDGE_DISTANCE - 0.1
    assert xy[..., 0].max() > 30
    assert np.abs(xy[..., 1]).max() > HALF_WIDTH, "there are trees at the sides of the corridor"
    assert 0.1 <= radius.min() < 0.15 < 0.25 < radius.max() <= 0.3
    area = (xy[..., 0] > 2) & (xy[..., 0] < 30) & (np.abs(xy[..., 1]) < 8)
    np.testing.assert_allclose(area.mean(axis=0).sum() / (28 * 16), 1 / 16, rtol=0.05)
    start, goal = (np.asarray(x)[:, 0] for x in (state.data.states.pos, state.data.plugins["task"].goal))
    assert np.abs(start[:, 0]).max() < 0.31
    assert (goal[:, 0] > env.task.length + 1).all()
    for x in (start, goal):
        assert np.abs(x[:, 1]).max() < 1.01
        assert np.ptp(x[:, 1]) > 1
        assert np.abs(x[:, 2] - HEIGHT).max() < 0.31
    other = jax.jit(env.reset)(jax.random.key(4))
    assert np.abs(standing_trees(env, other.data)[0] - xy).max(axis=(1, 2)).min() > 0.5


def test_nearest_trees_are_those_of_the_forest(start_state):
    env, state, _ = start_state
    rng = np.random.default_rng(0)
    data = place_drones(state, rng.uniform([0, -6, 0.5], [28, 6, 3], (N_WORLDS, 1, 3)), yaw=0.7).data
    xy, radius, _ = standing_trees(env, data)
    offset = xy - np.asarray(data.states.pos)[..., :2]
    gap = np.linalg.norm(offset, axis=-1) - radius
    obs = {k: np.asarray(x)[:, 0] for k, x in jax.jit(vmap_worlds(env.task.observe))(data).items()}
    near = obs["trees_near"].reshape(N_WORLDS, N_OBSERVED_TREES, 3)
    outside = gap.min(axis=-1) > 0.05
    assert outside.mean() > 0.8
    nearest = np.argmin(gap, axis=-1)
    worlds = np.arange(N_WORLDS)
    np.testing.assert_allclose(near[:, 0, 2], radius[worlds, nearest], atol=1e-6)
    ahead, left = np.array([np.cos(0.7), np.sin(0.7)]), np.array([-np.sin(0.7), np.cos(0.7)])
    to_tree = offset[worlds, nearest] / np.linalg.norm(offset[worlds, nearest], axis=-1, keepdims=True)
    to_tree = to_tree * gap[worlds, nearest][:, None]
    np.testing.assert_allclose(
        near[:, 0, :2][outside], np.stack([to_tree @ ahead, to_tree @ left], axis=-1)[outside], atol=1e-4
    )
    lengths = np.linalg.norm(near[outside][..., :2], axis=-1)
    assert (np.diff(lengths, axis=-1) > -1e-5).all(), "nearest first"
    assert lengths.max() <= VIEW_RANGE + 1e-4
    clearance = vmap_worlds(lambda data: env.task.trees(1).clearance(data, data.states.pos))(data)
    np.testing.assert_allclose(lengths[:, 0], np.minimum(clearance[:, 0], VIEW_RANGE)[outside], atol=1e-4)


def test_observed_vectors_turn_with_the_heading_and_the_critic_observes_trees(start_state):
    env, state, _ = start_state
    observe = jax.jit(vmap_worlds(env.task.observe))
    pos, goal = np.array([5.0, 1.0, 1.5]), np.array([32.0, 1.0, 1.5], np.float32)
    goals = jnp.broadcast_to(goal, state.data.states.pos.shape)
    seen = {
        k: np.asarray(x)[0, 0]
        for k, x in observe(place_drones(state, pos, (0, 2, 1), np.pi / 2, goal=goals).data).items()
    }
    np.testing.assert_allclose(seen["heading_vel"], [2, 0, 1], atol=1e-5)
    np.testing.assert_allclose(seen["goal_direction"], [0, -1, 0], atol=1e-5)
    np.testing.assert_allclose(seen["heading"], [0, 1], atol=1e-5)
    np.testing.assert_allclose(seen["up"], [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose([*seen["goal_distance"], *seen["height"], *seen["offset"]], [27, 1.5, 1], rtol=1e-5)
    privileged = jax.eval_shape(PrivilegedObservation(env).reset, jax.random.key(0)).obs["privileged"]
    hover = jax.eval_shape(PrivilegedObservation(make("hover", 2)).reset, jax.random.key(0)).obs["privileged"]
    assert privileged.shape[-1] - hover.shape[-1] == 3 * N_PRIVILEGED_TREES


def test_hits_disable_and_crossing_the_line_is_a_success(start_state):
    env, state, step = start_state
    xy, radius, _ = standing_trees(env, state.data)
    pos = np.tile([-0.5, 0.0, HEIGHT], (N_WORLDS, 1))
    side = radius[1, 7] + np.array([0.06, 0.10])  # the ball around a Crazyflie has 7 to 9 cm
    pos[0] = [*xy[0, 7], HEIGHT]
    pos[1] = [*xy[1, 7] + [side[0], 0], HEIGHT]
    pos[2] = [*xy[2, 7] + [0, radius[2, 7] + 0.10], HEIGHT]
    pos[3, 1] = HALF_WIDTH + 0.01
    pos[4, 2] = CEILING + 0.01
    pos[5, 2] = 0.01
    pos[6] = [env.task.length + 0.01, 0, HEIGHT]
    pos[7, 0] = -EDGE_DISTANCE - 0.01
    clear = np.asarray(vmap_worlds(lambda data: env.task.trees(1).clearance(data, data.states.pos))(
        place_drones(state, pos[:, None]).data))[:, 0]  # fmt: skip
    pos[6, 1] += 1.0 if clear[6] < 0.2 else 0.0
    after = step(place_drones(state, pos[:, None]), state.action)
    expected = np.zeros(N_WORLDS, bool)
    expected[[0, 1, 3, 4, 5, 7]] = True
    np.testing.assert_array_equal(after.info["disabled"][:, 0], expected)
    np.testing.assert_array_equal(np.flatnonzero(env.succeeded(after)), [6])
    np.testing.assert_array_equal(after.terminated, expected | (np.arange(N_WORLDS) == 6))
    reward = np.asarray(after.reward)[:, 0]
    assert reward[6] > 9
    assert (reward[expected] < -9).all()
    assert env.task.error(place_drones(state, [4.0, 0, 1]).data).max() == env.task.length - 4


def test_speed_is_rewarded_up_to_its_setting_and_trees_nearby_cost(start_state):
    env, state, _ = start_state
    goals = jnp.broadcast_to(jnp.asarray([32.0, 0.0, HEIGHT]), state.data.states.pos.shape)
    action = state.action

    def rewards(pos, vel):
        data = place_drones(state, pos, vel, goal=goals).data
        terms = vmap_worlds(env.task.rewards)(data, action, action)
        return {name: float(x[0, 0]) for name, x in terms.items()}

    start = [-1.0, 0.0, HEIGHT]
    totals = [sum(rewards(start, (speed, 0, 0)).values()) for speed in (-2, 0, 2, 5, 8)]
    assert np.diff(totals)[:3].min() > 0.03
    assert totals[4] < totals[3] - 0.1
    assert totals[1] < 0
    (x, y), radius = (values[0, 12] for values in standing_trees(env, state.data)[:2])
    near, far = (rewards([x - radius - gap, y, HEIGHT], (2, 0, 0))["closeness"] for gap in (0.2, 0.6))
    np.testing.assert_allclose([near, far], [-0.3 * np.exp(-1), -0.3 * np.exp(-3)], rtol=1e-3)
    over = place_drones(state, start, flight_over_before=jnp.ones((N_WORLDS, 1), bool)).data
    assert not any(np.any(x) for x in vmap_worlds(env.task.rewards)(over, action, action).values())
