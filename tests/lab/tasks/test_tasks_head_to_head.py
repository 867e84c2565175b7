"""Racing against other drones: places, collisions, the winner, and who is still in the race."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazysim import ConfigError
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import make
from crazysim.envs.tracks import Track, start_offsets
from crazysim.lab.tasks.head_to_head import NEAR

N_WORLDS, N_DRONES = 64, 4
LAST_GATE = np.array(Track().gates_pos[3])  # drones fly through it along x


@pytest.fixture(scope="module")
def start():
    env = make("head_to_head", N_WORLDS, engine="interpret")
    return env, jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)


def place_drones(state, pos, vel=(0.0, 0.0, 0.0), **changes):
    data = state.data
    pos, vel, quat = (
        jnp.asarray(np.broadcast_to(np.float32(x), (N_WORLDS, N_DRONES, n)))
        for x, n in ((pos, 3), (vel, 3), ([0, 0, 0, 1], 4))
    )
    changes = {name: jnp.broadcast_to(x, (N_WORLDS, N_DRONES)) for name, x in changes.items()}
    record = data.plugins["task"].replace(last_pos=pos, **changes)
    states = data.states.replace(pos=pos, vel=vel, quat=quat)
    return state.replace(data=data.replace(states=states, plugins=data.plugins | {"task": record}))


def terms_of_step(env, before, after):
    del before
    zeros = jnp.zeros_like(after.action)
    return jax.jit(vmap_worlds(env.task.rewards))(after.data, zeros, zeros)


def test_drones_draw_their_places(start):
    _, state, _ = start
    offsets = np.asarray(state.data.states.pos) - Track().start
    distance = np.linalg.norm(offsets[:, :, None] - start_offsets(N_DRONES), axis=-1)
    place = distance.argmin(axis=-1)
    np.testing.assert_array_equal(np.sort(place, axis=-1), np.broadcast_to(np.arange(4), (N_WORLDS, 4)))
    counts = np.bincount(place[:, 0], minlength=4)
    assert counts.min() > 5, "16 of 64 are expected, with a standard deviation of 3.5"


def test_drones_that_touch_are_out_fall_and_are_in_nobodys_way(start):
    _, state, step = start
    pos = np.array([[-2.0, 0.5, 1.0], [-1.95, 0.5, 1.0], [-2.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])
    state = step(place_drones(state, pos), state.action)
    np.testing.assert_array_equal(state.info["collided"][0], [True, True, False, False])
    np.testing.assert_array_equal(state.info["disabled"][0], [True, True, False, False])
    assert not np.any(np.asarray(state.obs["rivals"])[0, 2].reshape(3, 6)[1:]), "two of three rivals are out"
    mirrored = step(place_drones(state.replace(data=start[1].data), pos[[2, 3, 0, 1]]), state.action)
    np.testing.assert_allclose(mirrored.obs["rivals"][:, [2, 3, 0, 1]], state.obs["rivals"], atol=1e-5)
    for _ in range(10):
        state = step(state, state.action)
    fallen = 1.0 - np.asarray(state.data.states.pos)[0, :, 2]
    assert fallen[:2].min() > 0.15, "0.2 s of free fall, 0.2 m without drag"
    assert np.abs(fallen[2:]).max() < 0.05
    assert np.all(np.asarray(state.data.states.rotor_vel)[0, :2] == 0), "no thrust, and hence no downwash"
    # A third drone where one of them is.
    pos = np.asarray(state.data.states.pos).copy()
    pos[:, 2] = pos[:, 0]
    moved = state.replace(data=state.data.replace(states=state.data.states.replace(pos=jnp.asarray(pos))))
    assert not np.any(step(moved, state.action).info["collided"][0, 2:])


def test_the_first_behind_the_last_gate_has_won_and_earns_more(start):
    env, state, step = start
    pos = LAST_GATE + np.array([[-0.01, 0.1, 0.0], [-0.03, -0.1, 0.0], [-1.2, 0.0, 0.0], [-1.5, 0.0, 0.0]])
    before = place_drones(state, pos, (3.0, 0.0, 0.0), passed=np.int32(3))
    after = step(before, state.action)
    np.testing.assert_array_equal(after.info["finished"][0], [True, True, False, False])
    np.testing.assert_array_equal(after.info["won"][0], [True, False, False, False])
    terms = {name: np.asarray(x)[0] for name, x in terms_of_step(env, before, after).items()}
    np.testing.assert_allclose(terms["ahead"].sum(), 0, atol=1e-5)
    assert terms["ahead"][2] < 0 or terms["ahead"][3] < 0
    later = step(after, state.action)
    np.testing.assert_array_equal(later.info["won"][0], [True, False, False, False])
    assert not np.any(np.asarray(later.reward)[0, :2]), "their races are over"


def test_the_lead_is_over_the_best_rival_and_rivals_fade_with_distance(start):
    _, state, step = start
    pos = np.array([[-1.5, 0.75, 0.6], [-1.1, 0.75, 0.6], [-1.9, 0.75, 0.6], [-2.3, 0.75, 0.6]])
    after = step(place_drones(state, pos), state.action)
    lead, rivals = np.asarray(after.obs["lead"])[0, :, 0], np.asarray(after.obs["rivals"])[0].reshape(4, 3, 6)
    assert lead[1] > 0.2
    np.testing.assert_allclose(lead[1], -lead[0], atol=1e-5)
    assert lead[3] < lead[2] < lead[0] < 0
    nearest = rivals[3, 0, :3] @ Rotation.from_quat(after.data.states.quat[0, 3]).as_matrix().T
    np.testing.assert_allclose(nearest, [1 / (NEAR + 0.4), 0, 0], atol=0.02)  # the drones tilt and sink a little
    assert np.all(np.diff(np.linalg.norm(rivals[3, :, :3], axis=-1)) < 0), "nearest first"


def test_a_training_does_not_wait_for_opponents(start):
    env, state, step = start
    pos = np.array([[-2.0, 0.5, 1.0], [-1.95, 0.5, 1.0], [-2.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])
    after = step(place_drones(state, pos), state.action)
    assert not after.terminated.any()
    for ends_with, ends in ((1, True), (2, True), (3, False)):
        task = type(env.task)(ends_with=ends_with)
        np.testing.assert_array_equal(jax.jit(vmap_worlds(task.terminated))(after.data), ends)


def test_downwash_and_the_number_of_drones():
    assert "downwash" in make("head_to_head", 1, engine="interpret").sim.plugins
    assert "downwash" not in make("head_to_head", 1, engine="interpret", downwash=False).sim.plugins
    with pytest.raises(ConfigError, match="n_drones=2"):
        make("head_to_head", 1, n_drones=1)


def test_practice_begins_everywhere_with_as_many_drones_as_gates():
    env = make("head_to_head", 200, practice=True, engine="interpret")
    state = jax.jit(env.reset)(jax.random.key(0))
    passed = np.asarray(state.info["gates_passed"])
    together = (passed == 0).all(axis=1)
    assert np.all(together | (np.sort(passed, axis=1) == np.arange(4)).all(axis=1))
    assert 30 < together.sum() < 70, "a quarter of the episodes; 50 are expected, with a standard deviation of 6"
    assert np.bincount(passed[~together, 0], minlength=4).min() > 20
    env.sim.data = state.data
    assert not np.any(env.sim.contact_report().any)
