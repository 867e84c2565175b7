"""Transport: conditions of passing and missing the gate, of delivery, and rewards of progress."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim
from crazysim.engine.pytree import PyTree
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import DroneEnv
from crazysim.lab.tasks.transport import Transport, gate_axis, is_behind
from crazysim.train.evaluation import evaluate

N_SPAWNS, LENGTH = 512, 0.3
GATE, GOAL = np.array([0.0, 0.0, 1.3], np.float32), np.array([1.4, 0.0, 1.2], np.float32)
DOWN = (0.0, 0.0, -LENGTH)
CASES = {
    # Position of the drone relative to the gate, m, of the load relative to the drone, m, and velocity of both, m/s.
    "through": ((-0.005, 0.0, 0.15), DOWN, (1.0, 0.0, 0.0)),
    "backwards": ((0.005, 0.0, 0.15), DOWN, (-1.0, 0.0, 0.0)),
    "before": ((-0.5, 0.0, 0.15), DOWN, (0.0, 0.0, 0.0)),
    "behind": ((0.5, 0.0, 0.15), DOWN, (0.0, 0.0, 0.0)),
    "load just inside": ((0.0, 0.2, 0.15), (0.0, 0.16, -0.2538), (0.0, 0.0, 0.0)),
    "load outside": ((0.0, 0.2, 0.15), (0.0, 0.18, -0.24), (0.0, 0.0, 0.0)),
    "load below": ((0.0, 0.0, -0.15), DOWN, (0.0, 0.0, 0.0)),
    "frame": ((0.0, 0.0, 0.36), DOWN, (0.0, 0.0, 0.0)),
    "above": ((-0.005, 0.0, 0.8), DOWN, (1.0, 0.0, 0.0)),
    "beside": ((-0.005, 1.0, 0.15), DOWN, (1.0, 0.0, 0.0)),
    "beside, backwards": ((0.005, 1.0, 0.15), DOWN, (-1.0, 0.0, 0.0)),
    "floor": ((-1.0, 0.0, -0.98), DOWN, (0.0, 0.0, -0.1)),
    "far": ((2.61, 0.0, 0.0), DOWN, (0.0, 0.0, 0.0)),
    "aside": ((1.0, 1.41, 0.0), DOWN, (0.0, 0.0, 0.0)),
    "high": ((-1.0, 0.0, 1.21), DOWN, (0.0, 0.0, 0.0)),
}
"""Cases, each in its own world with an unturned gate."""
SAFE = {"through", "backwards", "before", "behind", "load just inside"}
"""Cases without a crash."""
AT_GOAL = {
    # Position of the load relative to its goal, m, velocity, m/s, and x of the goal, m.
    "there": ((0.0, 0.05, 0.0), (0.0, 0.0, 0.0), 1.4),
    "off": ((0.0, 0.12, 0.0), (0.0, 0.0, 0.0), 1.4),
    "fast": ((0.0, 0.0, 0.0), (0.0, 0.25, 0.0), 1.4),
    "before the gate": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), -0.6),
}
"""Cases, each in its own world."""


N_WORLDS = 64
"""Number of worlds of the environment that tests share; cases are repeated."""


def make_env(n_worlds, n_drones=1, **options):
    """Return an environment whose gate has an opening of 0.8 m."""
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="attitude")
    task = Transport(opening=0.8, **options)
    task.install(sim)
    return DroneEnv(sim, task)


@pytest.fixture(scope="module")
def env():
    return make_env(N_WORLDS, seconds=9.0)


@pytest.fixture(scope="module")
def start_state(env):
    return jax.jit(env.reset)(jax.random.key(0))


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


def in_all_worlds(cases):
    """Return the columns of cases, repeated for all worlds. (N_WORLDS, ...) each"""
    columns = (np.array(x, np.float32) for x in zip(*cases, strict=True))
    return [np.resize(x, (N_WORLDS, *x.shape[1:])) for x in columns]


def place_drones(state, drone, load, vel, goal=GOAL):
    data = state.data
    s, task, load_record = data.states, data.plugins["task"], data.plugins["load"]
    drone, load, vel, goal = (jnp.asarray(np.broadcast_to(np.float32(x), (len(s.pos), 3))[:, None])
                              for x in (drone, load, vel, goal))  # fmt: skip
    level = np.array([0.0, 0.0, 0.0, 1.0], np.float32)
    still = jnp.zeros(vel.shape)
    data = data.replace(states=s.replace(pos=drone, vel=vel, quat=jnp.full(s.quat.shape, level), ang_vel=still))
    plugins = data.plugins | {"task": task.replace(goal=goal), "load": load_record.replace(pos=load, vel=vel)}
    return state.replace(data=task.gates.set_pose(data.replace(plugins=plugins), GATE, level))


@pytest.fixture(scope="module")
def case_worlds_and_state(start_state, step):
    place, load_offset, vel = in_all_worlds(CASES.values())
    before = place_drones(start_state, GATE + place, GATE + place + load_offset, vel)
    return {name: k for k, name in enumerate(CASES)}, step(before, before.action)


def test_touching_and_missing_the_gate_or_leaving_the_corridor_is_a_crash(case_worlds_and_state):
    world, after = case_worlds_and_state
    crashed = np.asarray(after.info["crashed"])[:, 0]
    assert {name for name, k in world.items() if crashed[k]} == set(CASES) - SAFE
    np.testing.assert_array_equal(after.terminated, crashed)
    np.testing.assert_array_equal(np.asarray(after.reward)[:, 0] < -5, crashed)


def test_a_gate_is_passed_where_the_load_is_behind_it_without_a_crash(case_worlds_and_state):
    world, after = case_worlds_and_state
    passed = np.asarray(after.info["passed"])[:, 0]
    in_plane = {"load just inside"}  # its load is in the gate's plane, so rounding decides
    assert {name for name, k in world.items() if passed[k]} - in_plane == {"through", "behind"}


def test_a_load_is_delivered_after_it_has_stayed_at_its_goal_slowly_and_behind_the_gate(env, start_state, step):
    n, (offset, vel, x) = len(AT_GOAL), in_all_worlds(AT_GOAL.values())
    goal = np.broadcast_to(GOAL, offset.shape) * [0, 1, 1] + x[:, None] * [1, 0, 0]
    state = place_drones(start_state, goal + offset - DOWN, goal + offset, vel, goal)
    hold = round(env.task.hold * env.sim.freq)
    waiting = np.full((N_WORLDS, 1), hold - 15, np.int32)
    task_record = state.data.plugins["task"].replace(steps_at_goal=jnp.asarray(waiting))
    state = state.replace(data=state.data.replace(plugins=state.data.plugins | {"task": task_record}))
    first = step(state, state.action)
    assert not first.info["delivered"].any()
    np.testing.assert_array_equal(first.data.plugins["task"].steps_at_goal[:n, 0], [hold - 5, 0, 0, 0])
    second = step(first, state.action)
    np.testing.assert_array_equal(np.asarray(env.succeeded(second))[:n, 0], [True, False, False, False])
    away = place_drones(second, GOAL + np.array([0.0, 0.5, LENGTH]), GOAL + np.array([0.0, 0.5, 0.0]), 0.0)
    assert step(away, state.action).info["delivered"][0, 0], "it stays delivered"


def test_progress_is_rewarded_by_its_length_and_passing_the_gate_never_costs(env, start_state, rng):
    """The remaining way decreases, or does not change, where the gate is passed."""
    state, corner = start_state, np.array([0.0, 0.35, 0.35])
    crossing_points = GATE + rng.uniform(-corner, corner, (N_WORLDS, 3))
    aim = GATE - np.array([0.0, 0.0, LENGTH / 2], np.float32)
    crossing_points[0] = aim
    remaining_ways, remaining_way = [], jax.jit(vmap_worlds(env.task.remaining_way))
    for x in (-1.0, -1e-3, 1e-3, 1.0):
        load = (crossing_points + np.array([x, 0.0, 0.0])).astype(np.float32)
        remaining_ways.append(np.asarray(remaining_way(place_drones(state, load - DOWN, load, 0.0).data))[:, 0])
        way_through_gate = np.linalg.norm(load - aim, axis=-1) + np.linalg.norm(GOAL - aim)
        expected = way_through_gate if x < 0 else np.linalg.norm(load - GOAL, axis=-1)
        np.testing.assert_allclose(remaining_ways[-1], expected, atol=1e-5)
    assert np.all(remaining_ways[1] - remaining_ways[2] > -1e-3)
    np.testing.assert_allclose(remaining_ways[1][0], remaining_ways[2][0], atol=3e-3)
    data = place_drones(state, GOAL - DOWN, GOAL, 0.0).data
    task_record = data.plugins["task"].replace(remaining_way_before=jnp.asarray(remaining_ways[0])[:, None])
    data = data.replace(plugins=data.plugins | {"task": task_record})
    paid = jax.jit(vmap_worlds(env.task.rewards))(data, state.action, state.action)
    np.testing.assert_allclose(paid["progress"][:, 0], 5 * remaining_ways[0], rtol=1e-4)
    np.testing.assert_allclose(paid["proximity"], 1.5, rtol=1e-3)
    assert not np.any(paid["crash"])


def test_starts_are_clear_of_the_gates_and_links_are_taut():
    env = make_env(N_SPAWNS, 2, swing=0.6)
    data = jax.jit(env.reset)(jax.random.key(3)).data
    env.sim.data = data
    report = env.sim.contact_report()
    assert report.floor_distance.min() > 0.5
    task_record, load, s = data.plugins["task"], data.plugins["load"], data.states
    link, swing = np.asarray(load.pos) - s.pos, np.asarray(load.vel) - s.vel
    np.testing.assert_allclose(np.linalg.norm(link, axis=-1), LENGTH, rtol=1e-5)
    np.testing.assert_allclose(np.sum(link * swing, axis=-1), 0.0, atol=1e-5)
    assert 0.1 < np.linalg.norm(swing, axis=-1).mean() < 0.4
    tilt = np.arctan2(np.linalg.norm(link[..., :2], axis=-1), -link[..., 2])
    assert 0.5 < tilt.max() < 0.9
    rows = task_record.gates.rows
    pos, quat = (np.asarray(x)[:, 0, rows[0] :] for x in (data.objects.pos, data.objects.quat))
    assert np.ptp(pos[..., 1], axis=0).min() > 0.5
    np.testing.assert_allclose(pos[:, 1, 1].mean() - pos[:, 0, 1].mean(), 3.0, atol=0.1)
    assert np.asarray(jax.jit(gate_axis)(quat))[..., 0].min() > 0.95
    behind = jax.jit(is_behind)
    for place, expected in ((s.pos, False), (load.pos, False), (task_record.goal, True)):
        assert np.all(np.asarray(behind(place, pos, quat)) == expected)
    assert np.all(np.asarray(jax.jit(vmap_worlds(env.task.error))(data)) > 2.0)


class Pilot(PyTree):
    gain: jax.Array
    """Factor of all actions. ()"""

    def __call__(self, obs):
        gate, axis, load = obs["difference_to_gate"], obs["gate_axis"], obs["load_pos"]
        gate = gate + jnp.array([0.0, 0.0, LENGTH / 2])
        ahead = jnp.sum(gate * axis, axis=-1, keepdims=True)
        aside = gate - ahead * axis
        pace = jnp.clip(1 - 4 * jnp.linalg.norm(aside, axis=-1, keepdims=True), 0.0, 1.0)
        to_goal = obs["difference_to_goal"] + load + jnp.array([0.0, 0.0, LENGTH])
        vel = jnp.where(ahead > -0.2, 0.8 * pace * axis + 1.5 * aside, jnp.clip(1.2 * to_goal, -0.8, 0.8))
        level = jnp.array([1.0, 1.0, 0.0])
        acc = 3 * (vel - obs["vel"]) + 2 * level * obs["load_vel"]
        roll, pitch = -acc[..., 1:2] / 9.81, acc[..., :1] / 9.81
        actions = [roll / (jnp.pi / 4), pitch / (jnp.pi / 4), 0 * roll, 0.26 + 0.14 * acc[..., 2:]]
        return self.gain * jnp.clip(jnp.concatenate(actions, axis=-1), -1, 1)


def test_a_pilot_that_aims_at_the_opening_and_damps_the_swing_delivers_and_one_that_idles_does_not(env):
    metrics, idle = (evaluate(env, Pilot(jnp.float32(gain))) for gain in (1.0, 0.0))
    assert metrics["success"] > 0.95
    assert metrics["crashed"] < 0.05
    assert metrics["error"] < 0.1
    assert idle["success"] == 0
