"""Land: the motion of pads, and conditions of landing and crashing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazysim import Sim
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import DroneEnv
from crazysim.envs.tasks.land import Land
from crazysim.train.evaluation import evaluate

N_SPAWNS, SPEED = 2048, 0.5
CONTACT_HEIGHT = 0.066
"""Height of the centre of mass over a level pad that the drone touches, m: radius 0.086 less 0.02."""
CASES = {
    # Position relative to the pad's middle, m, velocity relative to the pad, m/s, tilt, rad.
    "soft": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.3), 0.0),
    "edge": ((0.24, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.3), 0.0),
    "fast": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.7), 0.0),
    "sliding": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0.6, 0, -0.3), 0.0),
    "tilted": ((0.0, 0.0, CONTACT_HEIGHT - 0.001), (0, 0, -0.3), 0.45),
    "rim": ((0.27, 0.0, CONTACT_HEIGHT - 0.02), (0, 0, -0.3), 0.0),
    "below": ((0.0, 0.0, -0.1), (0, 0, 0.0), 0.0),
    "floor": ((0.6, 0.0, -0.135), (0, 0, -0.1), 0.0),
    "far": ((0.0, 1.5, 0.5), (0, 0, 0.0), 0.0),
    "high": ((0.0, 0.0, 2.31), (0, 0, 0.0), 0.0),
    "hover": ((0.0, 0.0, 0.3), (0, 0, 0.0), 0.0),
}
"""Cases, each in its own world."""


def make_env(n_worlds, n_drones=1, **options):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="attitude", engine="interpret")
    task = Land(**options)
    task.install(sim)
    return DroneEnv(sim, task)


@pytest.fixture(scope="module")
def touch_downs():
    """Return an environment of all cases, the world of each case, the states before and after a step, and the step."""
    env, step = make_env(len(CASES)), None
    state = jax.jit(env.reset)(jax.random.key(0))
    offset, vel, tilt = (np.array(x, np.float32) for x in zip(*CASES.values(), strict=True))
    quat = Rotation.from_euler("x", tilt[:, None]).as_quat().astype(np.float32)
    pad = np.array([0.0, 0.0, 0.2], np.float32)
    states = state.data.states.replace(pos=(pad + offset)[:, None], vel=vel[:, None], quat=quat[:, None])
    before = state.replace(data=state.data.replace(states=states))
    step = jax.jit(env.step)
    return env, {name: k for k, name in enumerate(CASES)}, before, step(before, before.action), step


def test_a_soft_upright_touch_within_the_pad_is_a_landing(touch_downs):
    env, world, _, after, _ = touch_downs
    landed = np.asarray(env.succeeded(after))[:, 0]
    assert {name for name, k in world.items() if landed[k]} == {"soft", "edge"}


def test_every_other_touch_and_flying_away_is_a_crash(touch_downs):
    _, world, _, after, _ = touch_downs
    crashed = np.asarray(after.info["crashed"])[:, 0]
    assert {name for name, k in world.items() if crashed[k]} == set(CASES) - {"soft", "edge", "hover"}
    np.testing.assert_array_equal(after.terminated, [name != "hover" for name in CASES])


def test_landing_is_rewarded_and_crashing_costs_once(touch_downs):
    _, world, _, after, step = touch_downs
    reward = np.asarray(after.reward)[:, 0]
    assert reward[world["soft"]] > 9
    assert -3 < reward[world["fast"]] < -1, "less than the reward of a landing, or policies would not try to land"
    assert abs(reward[world["hover"]]) < 0.1
    again = step(after, after.action)
    np.testing.assert_array_equal(np.asarray(again.reward)[:, 0] == 0, [name != "hover" for name in CASES])


@pytest.fixture(scope="module")
def moving_pads():
    """Return an environment with moving pads and two drones in each world, and data at the start of episodes."""
    env = make_env(N_SPAWNS, 2, speed=SPEED)
    return env, jax.jit(env.reset)(jax.random.key(5)).data


def test_starts_are_clear_of_contact_and_pads_on_their_circles(moving_pads):
    env, data = moving_pads
    env.sim.data = data
    report = env.sim.contact_report()
    assert not np.any(report.any)
    assert report.object_distance.min() > 0.3
    assert report.drone_distance.min() > 0.3
    radius = np.linalg.norm(np.asarray(data.objects.pos)[:, 0, :, :2], axis=-1)
    assert np.ptp(radius) > 0.3
    assert np.all(np.asarray(data.plugins["task"].ang_vel)[..., 0].min(axis=0) < 0)


def test_a_moving_pad_moves_in_the_data_at_its_speed(moving_pads):
    env, data = moving_pads
    env.sim.data = data
    steps = 5
    env.sim.step(steps)
    after, data = (x.replace(objects=jax.device_get(x.objects)) for x in (env.sim.data, data))
    moved = np.linalg.norm(after.objects.pos - data.objects.pos, axis=-1)
    np.testing.assert_allclose(moved, SPEED * steps / 500, rtol=1e-2)
    np.testing.assert_allclose(np.linalg.norm(after.objects.vel, axis=-1), SPEED, rtol=1e-4)
    along = (after.objects.pos - data.objects.pos) * 500 / steps
    np.testing.assert_allclose(along, after.objects.vel, atol=0.01)
    observed_pos = jax.jit(vmap_worlds(env.task.observe))(after)["difference_to_pad"] + np.asarray(after.states.pos)
    np.testing.assert_allclose(observed_pos, after.objects.pos[:, 0], atol=1e-5)


def test_a_drone_that_follows_a_moving_pad_down_lands_and_one_that_falls_crashes():
    env = make_env(2, speed=SPEED, seconds=3.0)

    class Above(Land):
        """Start over the pad, with its velocity; the second world upside down."""

        def spawn(self, data, key):
            data = super().spawn(data, key)
            pos, vel = self.pad_motion(data, data.core.steps)
            quat = jnp.array([[[0.0, 0, 0, 1]], [[1.0, 0, 0, 0]]])[data.core.world_id]
            states = data.states.replace(pos=pos + jnp.array([0.0, 0.0, 0.35]), vel=vel, quat=quat)
            return data.replace(states=states)

    def follow(obs):
        """Hold the pad's velocity and sink with 0.3 m/s."""
        ahead = 6 * obs["difference_to_pad_vel"] + 4 * obs["difference_to_pad"] * jnp.array([1, 1, 0])
        down = 0.8 * (obs["difference_to_pad_vel"][..., 2:] - 0.3)
        roll, pitch = -ahead[..., 1:2] / 9.81, ahead[..., :1] / 9.81
        return jnp.concatenate([roll / (jnp.pi / 4), pitch / (jnp.pi / 4), 0 * roll, down], axis=-1)

    env = DroneEnv(env.sim, Above(speed=SPEED, seconds=3.0))
    metrics = evaluate(env, jax.tree_util.Partial(follow))
    assert metrics["success"] == metrics["crashed"] == 0.5
    assert metrics["error"] < 0.27
