"""The race by camera: observations, headings at the start, and the cost of looking away."""

import colorsys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import rotation
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import PrivilegedObservation, make
from crazysim.envs.tasks.race_by_camera import AWAY_COST
from crazysim.envs.tracks import Track

N_WORLDS, TRACK = 16, Track()
SIZES = {"ang_vel": 3, "height": 1, "next_gate": 4, "rot": 9, "vel_body": 3}


@pytest.fixture(scope="module")
def start_state():
    """Return an environment whose episodes may begin behind any gate, and its state at the start of episodes."""
    env = make("race_by_camera", N_WORLDS, camera=(), practice=True, engine="interpret")
    return env, jax.jit(env.reset)(jax.random.key(0))


def test_policies_observe_an_image_and_no_positions_but_the_height():
    env = make("race_by_camera", 2, engine="interpret")
    obs = jax.eval_shape(env.reset, jax.random.key(0)).obs
    assert {name: x.shape[-1] for name, x in obs.items()} == SIZES | {"depth": 32 * 24}
    teacher = make("race_by_camera", 2, camera=(), gates_observed=True)
    obs = jax.eval_shape(teacher.reset, jax.random.key(0)).obs
    assert {name: x.shape[-1] for name, x in obs.items()} == SIZES | {"gate_corners": 24, "obstacles_near": 6}
    hover = jax.eval_shape(PrivilegedObservation(make("hover", 2)).reset, jax.random.key(0)).obs
    seen = jax.eval_shape(PrivilegedObservation(env).reset, jax.random.key(0)).obs
    assert seen["privileged"].shape[-1] - hover["privileged"].shape[-1] >= 24 + 6


def test_observations_do_not_change_where_the_course_and_the_drone_move_alike(start_state):
    """Neither the positions of gates nor the horizontal position of the drone are observed."""
    env, state = start_state
    observe = jax.jit(vmap_worlds(env.task.observe))
    data, shift = state.data, jnp.asarray([0.3, -0.2, 0.0], jnp.float32)
    seen, s = observe(data), data.states
    other = observe(data.replace(states=s.replace(pos=s.pos + shift)))
    moved_gates = observe(data.replace(objects=data.objects.replace(pos=data.objects.pos + shift)))
    for name, x in seen.items():
        np.testing.assert_array_equal(x, other[name], err_msg=name)
        np.testing.assert_array_equal(x, moved_gates[name], err_msg=name)


def test_the_critic_gets_the_true_corners_of_the_next_gates(start_state):
    env, state = start_state
    corners = np.asarray(jax.jit(vmap_worlds(env.task.privileged))(state.data)["gate_corners"]).reshape(-1, 2, 4, 3)
    passed, s = np.asarray(state.data.plugins["task"].passed)[:, 0], state.data.states
    quat = jnp.broadcast_to(s.quat, (N_WORLDS, 1, 4))
    middle = rotation.rotate(quat, jnp.asarray(corners[:, :1].mean(axis=2))) + s.pos
    np.testing.assert_allclose(middle[:, 0], np.asarray(TRACK.gates_pos)[passed], atol=1e-5)
    next_gate = np.asarray(state.obs["next_gate"])[:, 0]
    np.testing.assert_array_equal(next_gate, np.eye(4)[passed])


def test_drones_face_the_first_gate_or_along_the_gate_that_they_passed(start_state):
    _, state = start_state
    passed, s = np.asarray(state.data.plugins["task"].passed)[:, 0], state.data.states
    assert set(passed) == {0, 1, 2, 3}
    yaw = np.asarray(rotation.to_rpy(s.quat))[:, 0, 2]
    to_gate = np.asarray(TRACK.gates_pos[0]) - np.asarray(s.pos)[:, 0]
    gates_yaw = np.asarray(TRACK.gates_rpy)[np.maximum(passed - 1, 0), 2]
    expected = np.where(passed > 0, gates_yaw, np.arctan2(to_gate[:, 1], to_gate[:, 0]))
    assert np.abs((yaw - expected + np.pi) % (2 * np.pi) - np.pi).max() < 0.1 + 1e-5


def test_looking_away_from_the_next_gate_costs(start_state):
    env, state = start_state
    data, s = state.data, state.data.states
    record = data.plugins["task"].replace(passed=jnp.zeros((N_WORLDS, 1), jnp.int32))
    pos = jnp.broadcast_to(jnp.asarray(TRACK.gates_pos[0], jnp.float32) - jnp.asarray([1.0, 0, 0]), s.pos.shape)
    for yaw, cost in ((0.0, 0.0), (np.pi / 2, AWAY_COST), (np.pi, 2 * AWAY_COST)):
        quat = jnp.broadcast_to(rotation.from_rpy(jnp.asarray([0.0, 0.0, yaw], jnp.float32)), s.quat.shape)
        turned = data.replace(states=s.replace(pos=pos, quat=quat), plugins=data.plugins | {"task": record})
        away = vmap_worlds(env.task.rewards)(turned, state.action, state.action)["away"]
        np.testing.assert_allclose(away, -cost, atol=1e-6)
    over = record.replace(flight_over_before=jnp.ones((N_WORLDS, 1), bool))
    after = data.replace(plugins=data.plugins | {"task": over})
    assert not np.any(vmap_worlds(env.task.rewards)(after, state.action, state.action)["away"])


def test_the_frame_of_the_next_gate_is_in_the_image():
    env = make("race_by_camera", 1, engine="interpret")
    state = jax.jit(env.reset)(jax.random.key(0))
    depth = np.asarray(state.obs["depth"]).reshape(24, 32)
    distance = np.linalg.norm(np.asarray(TRACK.gates_pos[0]) - np.asarray(state.data.states.pos)[0, 0])
    middle = depth[4:12, 12:20]
    assert (np.abs(middle - distance) < 0.35).sum() >= 4, "frame"
    assert (middle > 2 * distance).any(), "opening"


def test_by_color_each_gate_has_its_own_in_images_and_films():
    env = make("race_by_camera", 1, by_color=True, engine="interpret")
    model = env.sim.mj_model
    colors = [model.geom_rgba[model.body_geomadr[model.body(f"gate:{k}").id], :3] for k in range(4)]
    hues = 360 * np.array([colorsys.rgb_to_hsv(*color)[0] for color in colors])
    np.testing.assert_allclose(np.diff(hues), 90, atol=1)
    state = jax.jit(env.reset)(jax.random.key(0))
    assert {name: x.shape[-1] for name, x in state.obs.items()} == SIZES | {"rgb": 32 * 24 * 3}
    # The camera looks at the first gate; the sky is blue, and the third gate is, too.
    pixels = np.array([colorsys.rgb_to_hsv(*x) for x in np.asarray(state.obs["rgb"]).reshape(-1, 3)])
    is_gate = pixels[:, 1] > 0.6
    nearest = np.abs((360 * pixels[:, 0] - hues[0] + 180) % 360 - 180)
    assert (is_gate & (nearest < 30)).sum() >= 10
