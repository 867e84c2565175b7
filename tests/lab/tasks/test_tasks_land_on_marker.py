"""Land on marker: images of the marker, observations, and conditions of landing and crashing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import rotation
from crazysim.envs import make

CONTACT_HEIGHT = 0.066
"""Height of the centre of mass over a level pad that the drone touches, m: radius 0.086 less 0.02."""
CASES = {
    # Position relative to the marker's middle, m, velocity, m/s, yaw, rad.
    "soft": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.3), 0.0),
    "edge": ((0.24, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.3), 0.0),
    "fast": ((0.0, 0.0, CONTACT_HEIGHT + 0.003), (0, 0, -0.7), 0.0),
    "floor": ((0.6, 0.0, CONTACT_HEIGHT - 0.02), (0, 0, -0.3), 0.0),
    "above": ((0.0, 0.0, 1.0), (0, 0, 0), 0.0),
    "ahead of it": ((0.8, 0.0, 1.0), (0, 0, 0), 0.0),
    "right of it": ((0.0, -0.8, 1.0), (0, 0, 0), 0.0),
    "turned": ((0.8, 0.0, 1.0), (0, 0, 0), np.pi / 2),
    "too far to see it": ((1.3, 0.0, 0.2), (0, 0, 0), 0.0),
}
"""Cases, each in its own world."""
LANDED, CRASHED = {"soft", "edge"}, {"fast", "floor"}
"""Cases that end by a landing and by a crash."""
SIDE, FOCAL = 16, 8 / np.tan(np.radians(60))
"""Side of the image and focal length, pixels."""


@pytest.fixture(scope="module")
def env():
    return make("land_on_marker", len(CASES), engine="interpret")


@pytest.fixture(scope="module")
def state_before(env):
    state = jax.jit(env.reset)(jax.random.key(0))
    offset, vel, yaw = (np.array(x, np.float32) for x in zip(*CASES.values(), strict=True))
    quat = rotation.from_rpy(jnp.stack([0 * yaw, 0 * yaw, yaw], axis=-1))
    pos = offset + np.float32([0, 0, env.task.height])
    states = state.data.states.replace(pos=jnp.asarray(pos)[:, None], vel=jnp.asarray(vel)[:, None], quat=quat[:, None])
    return state.replace(data=state.data.replace(states=states))


@pytest.fixture(scope="module")
def state_after(env, state_before):
    return jax.jit(env.step)(state_before, state_before.action)


def test_images_show_the_marker_where_it_is(state_after):
    images = np.asarray(state_after.obs["segmentation"]).reshape(len(CASES), SIDE, SIDE)
    assert set(np.unique(images)) == {0, 1}
    middle = (SIDE - 1) / 2
    shift = FOCAL * 0.8
    expected = {
        "above": (middle, middle),
        "ahead of it": (middle + shift, middle),
        "right of it": (middle, middle - shift),
        "turned": (middle, middle - shift),
    }
    for name, pixel in expected.items():
        image = images[list(CASES).index(name)]
        np.testing.assert_allclose(np.argwhere(image).mean(axis=0), pixel, atol=0.6, err_msg=name)
        # A disc of 0.25 m at a metre.
        assert abs(image.sum() - np.pi * (FOCAL * 0.25) ** 2) < 2.5, name
    assert not images[list(CASES).index("too far to see it")].any()
    assert images[list(CASES).index("soft")].all(), "the marker fills the image at touch-down"


def test_each_drone_sees_only_its_own_marker():
    env = make("land_on_marker", 1, n_drones=2)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert state.obs["segmentation"].shape == (1, 2, SIDE**2)
    data = jax.jit(env.reset)(jax.random.key(0)).data
    centres = env.task.path_centres(2)
    pos = np.stack([centres[0] + [0.4, 0, 1.0], centres[0] + [0, 0.4, 1.0]])[None].astype(np.float32)
    level = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1.0]), data.states.quat.shape)
    images = jax.jit(env.task.policy_camera().image_fn(env.sim))
    seen = images(data.replace(states=data.states.replace(pos=jnp.asarray(pos), quat=level)))["segmentation"]
    assert np.asarray(seen).any(axis=(2, 3)).tolist() == [[True, False]]
