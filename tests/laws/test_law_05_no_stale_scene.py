"""Law 5: the scene is synced when, and only when, something has changed since the last sync.

No sync is computed without need, and no query (contacts, an image) is answered from an old scene. Fault 7 of Crazyflow
(see ``test_faults.py``), contacts that do not change after a teleport or a rebuild, is tested here.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from crazysim import ConfigError
from crazysim.core import functional as F
from crazysim.scene import mjx_scene
from crazysim.scene.sync import poses_of, sync_poses
from crazysim.sim import Sim
from crazysim.sim.sim import sync_sim2mjx

FREE_HEIGHT = 1.0
"""Height, m, at which a drone touches nothing."""
SMALL_IMAGE = {"mode": "rgb_array", "width": 32, "height": 24}


@pytest.fixture(scope="module")
def one_world_sim():
    return Sim()


@pytest.fixture(scope="module")
def two_world_sim():
    sim = Sim(n_worlds=2)
    add_ball(sim)
    return sim


@pytest.fixture
def syncs(monkeypatch):
    done = []

    def counted(*args):
        done.append(1)
        return sync_poses(*args)

    monkeypatch.setattr(mjx_scene, "sync_poses", counted)
    return done


def add_ball(sim):
    xml = (
        '<mujoco><worldbody><body name="ball"><geom name="ball" type="sphere" size="0.1"/></body></worldbody></mujoco>'
    )
    body = mujoco.MjSpec.from_string(xml).body("ball")
    ball = sim.spec.worldbody.add_frame().attach_body(body, "", "")
    ball.mocap, ball.pos = True, [0, 0, 5]
    sim.build_mjx()


def with_heights(data, *heights):
    pos = np.array(data.states.pos)
    pos[..., 2] = np.reshape(heights, (-1, 1))
    return data.replace(states=data.states.replace(pos=pos))


def scene_with_ball(sim, *heights):
    ids = sim.mj_model.body("ball").mocapid.item()
    mocap_pos = np.array(sim.mjx_data.mocap_pos)
    mocap_pos[:, ids] = [[0, 0, z] for z in heights]
    return sim.mjx_data.replace(mocap_pos=mocap_pos)


def drone_touches(sim):
    return np.asarray(sim.contacts("drone:0")).any(-1).tolist()


def sync_scene(sim, *heights):
    sim.reset()
    sim.data = with_heights(sim.data, *heights)
    if sim.n_worlds == 2:
        sim.mjx_data = scene_with_ball(sim, 5, 5)
    sim.contacts()


# What clears the flag -------------------------------------------------------------------------------------------


def test_contacts_after_a_rebuild_are_those_of_the_new_scene(syncs):
    """Fault 7: contact with the floor remains after build_mjx, and an added body has contacts at once."""
    sim = Sim(n_worlds=2)
    sim.data = with_heights(sim.data, 0.0, FREE_HEIGHT)
    assert drone_touches(sim) == [True, False]
    sim.build_mjx()
    assert not bool(sim.data.core.mjx_synced)
    assert drone_touches(sim) == [True, False]
    add_ball(sim)
    assert drone_touches(sim) == [True, False]
    sim.mjx_data = scene_with_ball(sim, 5, FREE_HEIGHT)
    assert drone_touches(sim) == [True, True]
    assert len(syncs) == 4


def assign_synced(sim):
    sim.data, sim.mjx_data = sync_sim2mjx(sim.data, sim.mjx_data, sim.mjx_model)


def claim_to_be_synced(sim, flag):
    sim.data = sim.data.replace(core=sim.data.core.replace(mjx_synced=flag))


CHANGES = {
    "step": lambda sim: sim.step(),
    "three steps": lambda sim: sim.step(3),
    "reset": lambda sim: sim.reset(),
    "masked reset": lambda sim: sim.reset(np.array([True, False])),
    "sim.data": lambda sim: setattr(sim, "data", sim.data),
    "sim.mjx_data": lambda sim: setattr(sim, "mjx_data", sim.mjx_data),
    "a flag": lambda sim: claim_to_be_synced(sim, np.True_),
    "a flag of False": lambda sim: claim_to_be_synced(sim, jnp.asarray(False)),
    "results of a sync": assign_synced,
    "F command": lambda sim: setattr(sim, "data", F.attitude_control(sim.data, np.zeros((2, 1, 4)))),
    "seed": lambda sim: sim.seed(3),
    "build_data": lambda sim: sim.build_data(),
    "build_mjx": lambda sim: sim.build_mjx(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_the_next_query_after_a_change_syncs_once(syncs, two_world_sim, change):
    """A change clears ``data.core.mjx_synced`` and computes nothing; a query sets the flag."""
    sync_scene(two_world_sim, FREE_HEIGHT, FREE_HEIGHT)
    for _ in range(2):
        assert bool(two_world_sim.data.core.mjx_synced)
        syncs.clear()
        CHANGES[change](two_world_sim)
        assert not syncs
        assert not bool(two_world_sim.data.core.mjx_synced)
        for _ in range(2):
            two_world_sim.contacts()
        assert len(syncs) == 1


def test_a_cleared_flag_is_an_array_of_its_own(two_world_sim):
    """A user who donates data read from ``sim.data`` must not invalidate other data, such as the default data."""
    sync_scene(two_world_sim, FREE_HEIGHT, FREE_HEIGHT)
    flags = [two_world_sim.default_data.core.mjx_synced]
    for _ in range(3):
        two_world_sim.contacts()
        two_world_sim.data = two_world_sim.data
        flags.append(two_world_sim.data.core.mjx_synced)
    assert len(set(map(id, flags))) == len(flags)


# What keeps the flag --------------------------------------------------------------------------------------------------


def test_pictures_show_the_world_as_it_is_and_do_not_use_mjx(one_world_sim, syncs, opengl):
    one_world_sim.reset()
    one_world_sim.contacts()
    syncs.clear()
    before = one_world_sim.mjx_data
    for height in (0.5, 1.0):
        one_world_sim.data = with_heights(one_world_sim.data, height)
        one_world_sim.render(**SMALL_IMAGE)
        np.testing.assert_allclose(one_world_sim.mj_data.body("drone:0").xpos[2], height, atol=1e-6)
        assert not one_world_sim.data.core.mjx_synced
    assert one_world_sim.mjx_data is before
    assert not syncs


# Whose poses the scene has --------------------------------------------------------------------------------------


def test_a_step_that_moves_nothing_leaves_the_scene_fresh(syncs):
    """The scene compares the arrays of poses, so it needs no flag of the step."""
    sim = Sim(n_worlds=2)
    sim.step_pipeline = {"increment_steps": sim.step_pipeline["increment_steps"]}
    sim.contacts()
    sim.step()
    sim.contacts()
    assert len(syncs) == 1


def test_numpy_arrays_are_copied_at_every_sync(two_world_sim, syncs):
    """Their owner may change them, so that identity proves nothing."""
    scene, ((ids, pos, quat), *others) = two_world_sim.scene._mjx, poses_of(two_world_sim.data)
    pos = np.array(pos)
    for height in (FREE_HEIGHT, 0.0):
        pos[..., 2] = height
        scene.sync(((ids, pos, quat), *others))
        np.testing.assert_allclose(two_world_sim.mjx_data.mocap_pos[:, np.asarray(ids)[0], 2], height)
    assert len(syncs) == 2


def test_a_traced_query_is_right_and_leaves_no_tracer(two_world_sim, syncs):
    sync_scene(two_world_sim, FREE_HEIGHT, FREE_HEIGHT)
    scene = two_world_sim.scene

    @jax.jit
    def touches(data):
        return scene.contacts(data, "drone:0").any(-1)

    assert touches(with_heights(two_world_sim.data, 0.0, FREE_HEIGHT)).tolist() == [True, False]
    assert not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(two_world_sim.mjx_data))
    assert drone_touches(two_world_sim) == [False, False]


def test_donated_poses_count_by_identity(one_world_sim, syncs):
    """A user may donate data read from the simulation; the scene still knows whether it has seen new arrays."""
    one_world_sim.step()
    one_world_sim.contacts()
    raised = jax.jit(lambda data: with_traced_height(data, FREE_HEIGHT), donate_argnums=0)(one_world_sim.data)
    one_world_sim.data = raised
    assert drone_touches(one_world_sim) == [False]
    one_world_sim.data = with_heights(one_world_sim.data, 0.0)
    assert drone_touches(one_world_sim) == [True]


def with_traced_height(data, height):
    return data.replace(states=data.states.replace(pos=data.states.pos.at[..., 2].set(height)))


def test_a_pure_step_clears_the_flag(two_world_sim):
    """Functional code asks the flag of its data, which is False after every step, also inside jit."""
    data, _ = sync_sim2mjx(two_world_sim.data, two_world_sim.mjx_data, two_world_sim.mjx_model)
    step = two_world_sim.build_step_fn()
    for fn in (step, jax.jit(step)):
        assert not fn(data).core.mjx_synced


# What is allocated ----------------------------------------------------------------------------------------------


def test_data_have_added_objects_before_the_scene_is_compiled(monkeypatch, syncs):
    """Reading data, stepping, commands and resets compile no MuJoCo model; a query does, once for all edits.

    The data has the objects and mocap ids that the model will have, between hand-made bodies too.
    """
    compiled = []
    sim = Sim(n_worlds=2, n_drones=2)

    def count(spec, real=mjx_scene.build.compile_spec):
        compiled.append(1)
        return real(spec)

    monkeypatch.setattr(mjx_scene.build, "compile_spec", count)
    assert sim.data.objects is None
    first = sim.scene.add("gate", count=2, pos=(0, 3, 1))
    sim.spec.worldbody.add_body(name="by_hand", mocap=True, pos=[0, 0, 9]).add_geom(size=[0.1, 0, 0])
    sim.step()
    second = sim.scene.add("box", pos=(0.0, 0.0, FREE_HEIGHT), size=(4.0, 4.0, 0.2))
    objects, default = sim.data.objects, sim.default_data.objects
    assert objects.names == default.names == ("gate:0", "gate:1", "box:0")
    sim.data = second.set_pose(sim.data, pos=(0.0, 0.0, 2 * FREE_HEIGHT))
    sim.attitude_control(np.zeros((2, 2, 4)))
    sim.step(2)
    sim.seed(1)
    moved = with_heights(sim.data, FREE_HEIGHT, 2 * FREE_HEIGHT)
    sim.reset(np.array([True, False]))
    assert sim.data.objects.pos.shape == (2, 1, 3, 3)
    np.testing.assert_allclose(second.pose(sim.data)[0][:, 0, 2], [FREE_HEIGHT, 2 * FREE_HEIGHT])
    sim.data = moved
    assert not compiled
    touching = drone_touches(sim)
    assert len(compiled) == 1
    assert touching == [False, True], "the box is where the data has it"
    ids = [sim.mj_model.body(name).mocapid.item() for name in objects.names]
    np.testing.assert_array_equal(sim.data.objects.mocap_ids, ids)
    np.testing.assert_array_equal(objects.mocap_ids, ids)
    np.testing.assert_array_equal(sim.data.core.drone_mocap_ids, [0, 1])
    assert len(syncs) == 1
    assert first.pose(sim.data)[0].shape == (2, 2, 3)
    assert len(compiled) == 1


def test_a_spec_that_lost_a_drone_is_refused_by_name():
    sim = Sim(n_drones=2)
    sim.spec.delete(sim.spec.body("drone:1"))
    sim.scene.add("box")
    with pytest.raises(ValueError, match="expected mocap body 'drone:1' in the spec, got none"):
        _ = sim.data


def test_a_spec_that_lost_an_object_with_poses_is_refused_and_keeps_its_name():
    sim = Sim()
    ball = sim.scene.add("sphere", "ball", pos=[1, 0, 0])
    sim.step()
    sim.spec.delete(sim.spec.body("ball:0"))
    with pytest.raises(ConfigError, match=r"'ball:0'.* Use set_pose of its handle .* mocap=False"):
        sim.build_mjx()
    with pytest.raises(ConfigError, match="expected a new name, got 'ball:0'"):
        sim.scene.add("sphere", "ball", pos=[-1, 0, 0])
    np.testing.assert_array_equal(ball.pose(sim.data)[0], [[[1, 0, 0]]])


# Any order ------------------------------------------------------------------------------------------------------

heights = st.tuples(st.sampled_from([0.0, 0.5, FREE_HEIGHT]), st.sampled_from([0.0, 0.5, FREE_HEIGHT]))


class SceneMachine(RuleBasedStateMachine):
    """Contacts always belong to the current poses, after any sequence of changes, without a redundant sync."""

    sim = None
    """Simulation of two worlds with a ball, which is built once."""

    @initialize()
    def set_up_scene(self):
        if SceneMachine.sim is None:
            SceneMachine.sim = Sim(n_worlds=2)
            add_ball(SceneMachine.sim)
        self.ball = (5.0, 5.0)
        sync_scene(self.sim, FREE_HEIGHT, FREE_HEIGHT)
        self.changed = False

    @rule(heights=heights)
    def teleport(self, heights):
        self.sim.data = with_heights(self.sim.data, *heights)
        self.changed = True

    @rule(heights=heights)
    def move_ball(self, heights):
        self.sim.mjx_data = scene_with_ball(self.sim, *heights)
        self.ball, self.changed = heights, True

    @rule(n=st.integers(1, 3))
    def step(self, n):
        self.sim.step(n)
        self.changed = True

    @rule(mask=st.lists(st.booleans(), min_size=2, max_size=2))
    def reset(self, mask):
        self.sim.reset(np.array(mask))
        self.changed = True

    @rule()
    def command(self):
        self.sim.attitude_control(np.zeros((2, 1, 4)))

    @rule()
    def read_scene(self):
        assert self.sim.mjx_data is self.sim.mjx_data

    @precondition(lambda self: hasattr(self, "ball"))
    @rule()
    def query_contacts(self):
        assert bool(self.sim.data.core.mjx_synced) != self.changed, "the flag says whether a query syncs"
        z = np.asarray(self.sim.data.states.pos[:, 0, 2]) + 0.02
        expected = (z < 0.086) | (np.abs(z - self.ball) < 0.186)
        done = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mjx_scene, "sync_poses", lambda *args: done.append(1) or sync_poses(*args))
            assert drone_touches(self.sim) == expected.tolist()
        assert len(done) == self.changed
        self.changed = False


TestAnyOrder = SceneMachine.TestCase
TestAnyOrder.settings = settings(max_examples=15, stateful_step_count=15, deadline=None)
