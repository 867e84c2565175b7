"""Chase: the motion of the roof, and conditions of landing and crashing."""

import jax
import numpy as np
import pytest

from crazysim.engine.stage import vmap_worlds
from crazysim.envs import make

CONTACT_HEIGHT = 0.066
"""Height of the centre of mass over a level roof that the drone touches, m. The collision sphere has the
radius 0.086, and its centre is 0.02 above the centre of mass."""
CASES = {
    # Position relative to the roof's middle, m, and velocity relative to it, m/s.
    "soft": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.3)),
    "to the side": ((0.0, 0.07, CONTACT_HEIGHT + 0.003), (0, 0, -0.3)),
    "fast": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.7)),
    "sliding": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0.6, 0, -0.3)),
    "hood": ((0.2, 0.0, CONTACT_HEIGHT - 0.057), (0, 0, -0.3)),
    "floor": ((-0.7, 0.0, -0.085), (0, 0, -0.1)),
    "far": ((0.0, 3.05, 0.5), (0, 0, 0)),
    "high": ((0.0, 0.0, 2.45), (0, 0, 0)),
    "hover": ((0.0, 0.0, 0.3), (0, 0, 0)),
}
"""Cases, each in its own world, over cars that drive ahead."""
LANDED, IN_FLIGHT = {"soft", "to the side"}, {"hover"}


@pytest.fixture(scope="module")
def env():
    """Return the environment of all cases; its two steps are interpreted, as compiling them would take longer."""
    return make("chase", len(CASES), engine="interpret")


@pytest.fixture(scope="module")
def start_state(env):
    return jax.jit(env.reset)(jax.random.key(0))


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


@pytest.fixture(scope="module")
def roof_motion(env):
    return jax.jit(vmap_worlds(env.task.target_motion))


@pytest.fixture(scope="module")
def state_after_step(start_state, step, roof_motion):
    data = start_state.data
    car = data.plugins["cars"]
    straight = {name: np.zeros_like(getattr(car, name)) for name in ("yaw", "yaw_rate", "steer", "command", "body_vel")}
    for name in ("command", "body_vel"):
        straight[name][..., 0] = 0.8
    car = car.replace(**straight)
    data = data.replace(plugins=data.plugins | {"cars": car})
    offset, vel = (np.array(x, np.float32)[:, None] for x in zip(*CASES.values(), strict=True))
    roof, roof_vel = map(np.asarray, roof_motion(data))
    np.testing.assert_allclose(roof_vel, np.broadcast_to([0.8, 0, 0], roof_vel.shape), atol=1e-6)
    level = np.broadcast_to(np.float32([0, 0, 0, 1]), data.states.quat.shape)
    states = data.states.replace(pos=roof + offset, vel=roof_vel + vel, quat=level, ang_vel=np.zeros_like(roof))
    state = start_state.replace(data=data.replace(states=states))
    return step(state, state.action)


def names(mask):
    return {name for name, x in zip(CASES, np.asarray(mask)[:, 0], strict=True) if x}


def test_a_soft_touch_of_the_roof_from_above_is_a_landing(state_after_step):
    assert names(state_after_step.info["landed"]) == LANDED


def test_every_other_touch_and_flying_away_is_a_crash(state_after_step):
    assert names(state_after_step.info["crashed"]) == set(CASES) - LANDED - IN_FLIGHT
    np.testing.assert_array_equal(state_after_step.terminated, [name not in IN_FLIGHT for name in CASES])


def test_the_reward_is_for_landing(state_after_step):
    rewards = dict(zip(CASES, np.asarray(state_after_step.reward)[:, 0], strict=True))
    assert min(rewards[name] for name in LANDED) > 9 > 0 > -3 > max(rewards[name] for name in ("fast", "hood", "far"))


def test_the_roof_moves_with_the_car(env, start_state, step, roof_motion):
    """Its velocity is the derivative of its position, also in a turn, and the drone observes both."""
    before, after = start_state.data, step(start_state, start_state.action).data
    (pos, vel), (later, _) = (jax.device_get(roof_motion(data)) for data in (before, after))
    dt = env.n_substeps / env.sim.freq
    np.testing.assert_allclose((later - pos) / dt, vel, atol=0.05)
    np.testing.assert_allclose(start_state.obs["difference_to_roof"] + np.asarray(before.states.pos), pos, atol=1e-5)
    np.testing.assert_allclose(
        start_state.obs["difference_to_roof_vel"] + np.asarray(before.states.vel), vel, atol=1e-5
    )
    assert np.ptp(np.linalg.norm(vel, axis=-1)) > 0.2, "the speeds of the cars differ"


def test_the_roof_is_the_top_of_the_car(env, start_state, roof_motion):
    body = next(b for b in env.sim.scene.collision_model.objects if b.name == "cars:0")
    top = max(body.geoms, key=lambda geom: geom.pos[2] + geom.shape.size[2])
    data = start_state.data
    height = (np.asarray(roof_motion(data)[0]) - data.plugins["cars"].pos)[..., 2]
    np.testing.assert_allclose(height, top.pos[2] + top.shape.size[2], atol=1e-6)
