"""Following a car: its motion, images of it, rewards for being at a point behind and above it, and ends of episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine.stage import vmap_worlds
from crazysim.envs import DroneEnv, PrivilegedObservation, make
from crazysim.lab.tasks.follow_car import FOLLOW_DISTANCE, FOLLOW_HEIGHT, MAX_DISTANCE, MIN_HEIGHT, FollowCar
from crazysim.train.evaluation import evaluate

N_WORLDS, N_STEPS = 64, 100


@pytest.fixture(scope="module")
def env():
    return make("follow_car", N_WORLDS, engine="interpret")


@pytest.fixture(scope="module")
def start_state(env):
    return jax.jit(env.reset)(jax.random.key(0))


@pytest.fixture(scope="module")
def target_motion(env):
    return jax.jit(vmap_worlds(env.task.target_motion))


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


def with_drones(state, **states):
    return state.replace(data=state.data.replace(states=state.data.states.replace(**states)))


def test_every_car_drives_in_its_own_way(env, start_state):
    """Cars are stepped without episodes, since the falling drones do not matter here."""
    speeds, yaws = [], []
    simulate = jax.jit(lambda data: env.sim.step_fn(vmap_worlds(env.task.before_step)(data), env.n_substeps))
    data = start_state.data
    for _ in range(N_STEPS):
        data = simulate(data)
        car = data.plugins["cars"]
        speeds.append(np.asarray(car.body_vel)[:, 0, 0])
        yaws.append(np.asarray(car.yaw)[:, 0, 0])
    speeds, yaws = np.array(speeds), np.array(yaws)
    expected = vmap_worlds(lambda d: env.task.command(d, d.core.steps / d.core.freq))(data)
    np.testing.assert_allclose(speeds[-1], np.asarray(expected)[:, 0, 0], atol=0.1)
    assert speeds.min() > -0.05
    assert speeds.max() < 1.25
    assert np.ptp(speeds, axis=0).mean() > 0.2, "it speeds up and slows down"
    assert np.ptp(yaws, axis=0).mean() > 0.2, "it turns"
    assert np.abs(yaws).mean() < 0.5, "on average it drives along the x axis"
    assert np.std(yaws[-1]) > 0.1


def test_the_point_is_behind_and_above_the_car(start_state, step, target_motion):
    before, after = start_state.data, step(start_state, start_state.action).data
    (pos, vel), (later, _) = (jax.device_get(target_motion(data)) for data in (before, after))
    car = before.plugins["cars"]
    heading = np.concatenate([np.cos(car.yaw), np.sin(car.yaw), 0 * car.yaw], axis=-1)
    offset = pos - np.asarray(car.pos)
    np.testing.assert_allclose(np.sum(offset * heading, axis=-1), -FOLLOW_DISTANCE, atol=1e-5)
    np.testing.assert_allclose(offset[..., 2], FOLLOW_HEIGHT, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(offset[..., :2], axis=-1), FOLLOW_DISTANCE, atol=1e-5)
    np.testing.assert_allclose((later - pos) * 50, vel, atol=0.05)


def test_images_show_the_car(env, start_state):
    """Almost every episode begins with the car in view; pixels of the car have its distance."""
    format = env.image_formats()["segmentation"]
    shape = (N_WORLDS, format["height"], format["width"])
    mask, depth = (np.asarray(start_state.obs[name]).reshape(shape) for name in ("segmentation", "depth"))
    assert set(np.unique(mask)) == {0, 1}
    assert mask.any(axis=(1, 2)).mean() > 0.95
    distance = np.linalg.norm(
        np.asarray(start_state.data.plugins["cars"].pos - start_state.data.states.pos)[:, 0], axis=-1
    )
    for image, depths, car_distance in zip(mask, depth, distance, strict=True):
        assert not image.any() or depths[image > 0].min() < car_distance + 0.3
        assert not image.any() or depths[image > 0].max() < car_distance + 0.3


def test_an_episode_ends_where_the_drone_is_too_low_or_too_far_away(env, start_state, step, target_motion):
    pos, vel = (np.array(x) for x in target_motion(start_state.data))
    pos[0, 0, 1] += MAX_DISTANCE + 0.05
    pos[1, 0, 2] = MIN_HEIGHT - 0.05
    pos[2, 0, 0] += MAX_DISTANCE - 0.1
    level = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1.0]), start_state.data.states.quat.shape)
    state = with_drones(start_state, pos=jnp.asarray(pos), vel=jnp.asarray(vel), quat=level)
    after = step(state, state.action)
    np.testing.assert_array_equal(np.flatnonzero(after.terminated), [0, 1])
    reward = np.asarray(after.reward)[:, 0]
    assert reward[:2].max() < -8
    assert 0 < reward[2] < 0.1
    assert reward[3:].min() > 1, "being at the point pays most"


@pytest.mark.long("flies whole episodes, step by step")
def test_a_controller_with_privileged_observations_follows_the_car():
    class Informed(FollowCar):
        def observe(self, data):
            return super().observe(data) | self.privileged(data)

    def fly(obs):
        acc = 4 * obs["difference_to_point_vel"] + 5 * obs["difference_to_point"]
        roll, pitch = -acc[..., 1:2] / 9.81, acc[..., :1] / 9.81
        return jnp.concatenate([roll / (jnp.pi / 4), pitch / (jnp.pi / 4), 0 * roll, 0.1 * acc[..., 2:]], axis=-1)

    base = make("follow_car", 16, camera=(), engine="interpret")
    outcome = evaluate(DroneEnv(base.sim, Informed()), jax.tree_util.Partial(fly))
    assert outcome["success"] == 1
    assert outcome["crashed"] == 0


def test_only_the_critic_observes_the_position_of_the_car(env, start_state):
    assert set(start_state.obs) == {"ang_vel", "depth", "heading", "heading_vel", "height", "segmentation", "up"}
    privileged = jax.eval_shape(PrivilegedObservation(env).reset, jax.random.key(0)).obs["privileged"]
    hover = jax.eval_shape(PrivilegedObservation(make("hover", 2)).reset, jax.random.key(0)).obs["privileged"]
    assert privileged.shape[-1] - hover.shape[-1] == 12
