"""Law 5: the scene is synced when, and only when, something has changed since the last sync.

No sync is computed without need, and no question is answered from an old scene. Fault 7 of Crazyflow, contacts that do
not change after a teleport or a rebuild, is tested here.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from crazysim.core import functional as F
from crazysim.scene import mjx_scene
from crazysim.sim import Sim
from crazysim.sim.sim import sync_sim2mjx, use_box_collision

FREE_HEIGHT = 1.0
"""Height, m, at which a drone touches nothing."""
SMALL_IMAGE = {"mode": "rgb_array", "width": 32, "height": 24}


class Unreadable:
    """A flag that must not be read."""

    def __bool__(self):
        raise AssertionError("the device's flag was read")

    __array__ = __jax_array__ = __bool__


@pytest.fixture(scope="module")
def one():
    """Return a simulation of one world with one drone."""
    return Sim()


@pytest.fixture(scope="module")
def two():
    """Return a simulation of two worlds with one drone, and a ball that the tests move."""
    sim = Sim(n_worlds=2)
    add_ball(sim)
    return sim


@pytest.fixture
def syncs(monkeypatch):
    """Return a list that grows by one with every sync of all worlds."""
    done = []

    def counted(*args):
        done.append(1)
        return sync_sim2mjx(*args)

    monkeypatch.setattr(mjx_scene, "sync_sim2mjx", counted)
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
    """Return the data with the drones of each world at a given height."""
    pos = np.array(data.states.pos)
    pos[..., 2] = np.reshape(heights, (-1, 1))
    return data.replace(states=data.states.replace(pos=pos))


def scene_with_ball(sim, *heights):
    """Return the scene with the ball at another height in every world."""
    ids = sim.mj_model.body("ball").mocapid.item()
    mocap_pos = np.array(sim.mjx_data.mocap_pos)
    mocap_pos[:, ids] = [[0, 0, z] for z in heights]
    return sim.mjx_data.replace(mocap_pos=mocap_pos)


def drone_touches(sim):
    """Return in which worlds the drone touches anything."""
    return np.asarray(sim.contacts("drone:0")).any(-1).tolist()


def sync_scene(sim, *heights):
    """Reset, set the heights of drones, move the ball away, and sync the scene."""
    sim.reset()
    sim.data = with_heights(sim.data, *heights)
    if sim.n_worlds == 2:
        sim.mjx_data = scene_with_ball(sim, 5, 5)
    sim.contacts()


# What clears the flag -------------------------------------------------------------------------------------------


def test_contacts_after_a_teleport_are_those_of_the_new_place(two, syncs):
    """Fault 7: assigning sim.data makes the scene stale, whatever flag the assigned data carries."""
    sync_scene(two, 0.0, FREE_HEIGHT)
    assert drone_touches(two) == [True, False]
    assert bool(two.data.core.mjx_synced), "the data that is assigned next claims to be synced"
    two.data = with_heights(two.data, FREE_HEIGHT, 0.0)
    assert drone_touches(two) == [False, True]


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


def test_contacts_after_box_collision_are_those_of_boxes(one):
    """At a height of 5 cm, the sphere of 8.6 cm touches the floor, and the box of 2 cm half height does not."""
    sync_scene(one, 0.05)
    assert drone_touches(one) == [True]
    slots = one.contacts().shape
    use_box_collision(one)
    try:
        assert one.contacts().shape != slots
        assert drone_touches(one) == [False]
    finally:
        use_box_collision(one, False)
    assert drone_touches(one) == [True]


def test_contacts_after_a_body_was_moved_are_those_of_its_new_place(two, syncs):
    """Assigning sim.mjx_data makes the scene stale: a ball put on the drone of world 1 touches it."""
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    assert drone_touches(two) == [False, False]
    syncs.clear()
    two.mjx_data = scene_with_ball(two, 5, FREE_HEIGHT)
    assert drone_touches(two) == [False, True]
    assert drone_touches(two) == [False, True]
    assert len(syncs) == 1


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda sim: sim.step(), id="step"),
        pytest.param(lambda sim: sim.step(3), id="three steps"),
        pytest.param(lambda sim: sim.reset(), id="reset"),
        pytest.param(lambda sim: sim.reset(np.array([True, False])), id="masked reset"),
        pytest.param(lambda sim: setattr(sim, "data", sim.data), id="sim.data"),
        pytest.param(lambda sim: setattr(sim, "mjx_data", sim.mjx_data), id="sim.mjx_data"),
        pytest.param(
            lambda sim: setattr(sim, "data", F.attitude_control(sim.data, np.zeros((2, 1, 4)))), id="F command"
        ),
        pytest.param(lambda sim: sim.seed(3), id="seed"),
        pytest.param(lambda sim: sim.build_data(), id="build_data"),
        pytest.param(lambda sim: sim.build_mjx(), id="build_mjx"),
    ],
)
def test_a_change_has_the_next_question_sync_once(two, syncs, change):
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    syncs.clear()
    change(two)
    assert not syncs, "a change alone syncs nothing"
    two.contacts()
    assert len(syncs) == 1
    two.contacts()
    assert len(syncs) == 1


def test_the_flag_of_the_data_follows(two):
    """``data.core.mjx_synced`` is set by a question, and cleared by whatever makes the scene stale."""
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    synced = two.data
    changes = {
        "step": two.step,
        "reset": two.reset,
        "build_mjx": two.build_mjx,
        "the same data": lambda: setattr(two, "data", two.data),
        "data that was synced": lambda: setattr(two, "data", synced),
        "data that claims to be": lambda: setattr(
            two, "data", two.data.replace(core=two.data.core.replace(mjx_synced=np.True_))
        ),
        "mjx_data": lambda: setattr(two, "mjx_data", two.mjx_data),
        "what a sync returns": lambda: setattr(two, "data", sync_sim2mjx(two.data, two.mjx_data, two.mjx_model)[0]),
    }
    for name, change in changes.items():
        two.contacts()
        assert bool(two.data.core.mjx_synced), name
        for _ in range(2):
            change()
            assert not bool(two.data.core.mjx_synced), name


def test_an_edit_of_the_scene_has_the_next_question_sync_once(syncs):
    """An edit compiles the scene at the next question, and clears the one flag."""
    sim = Sim(n_worlds=2)
    edits = {
        "add": lambda: sim.scene.add("sphere", pos=(0.0, 0.0, 9.0)),
        "build_mjx": sim.build_mjx,
    }
    for name, edit in edits.items():
        sim.contacts()
        assert sim.data.core.mjx_synced, name
        syncs.clear()
        edit()
        assert not sim.data.core.mjx_synced, name
        for _ in range(2):
            sim.contacts()
            assert sim.data.core.mjx_synced, name
        assert len(syncs) == 1, name


def test_clearing_the_flag_reads_nothing_and_compiles_nothing(two):
    """Any flag is replaced by a cleared one; a flag that is known to be clear stays, so edits need no transfer."""
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    two.step()
    compiled = two.step_fn._cache_size()
    for flag in (Unreadable(), False, True, jnp.asarray(True), np.asarray(True)):
        two.data = two.data.replace(core=two.data.core.replace(mjx_synced=flag))
        two.step()
    assert two.step_fn._cache_size() == compiled
    clear = two.data.core.mjx_synced
    two.data = with_heights(two.data, FREE_HEIGHT, FREE_HEIGHT)
    assert two.data.core.mjx_synced is clear


def test_a_cleared_flag_is_an_array_of_its_own(two):
    """A user who donates data read from ``sim.data`` must not invalidate other data, such as the default data."""
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    flags = [two.default_data.core.mjx_synced]
    for _ in range(3):
        two.contacts()
        two.data = two.data
        flags.append(two.data.core.mjx_synced)
    assert len(set(map(id, flags))) == len(flags)


def test_what_sync_returns_may_be_assigned(two, syncs):
    """After the results of sync_sim2mjx are assigned, one redundant sync is allowed, but no stale answer."""
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    syncs.clear()
    two.data, two.mjx_data = sync_sim2mjx(with_heights(two.data, 0.0, FREE_HEIGHT), two.mjx_data, two.mjx_model)
    assert drone_touches(two) == [True, False]
    assert len(syncs) <= 1


# What does not --------------------------------------------------------------------------------------------------


def test_queries_share_a_sync_until_the_next_step(one, syncs):
    """Two questions after a step need one sync, and two syncs if there is a step between them."""
    one.step(5)
    syncs.clear()
    one.contacts()
    one.contacts("drone:0")
    assert len(syncs) == 1

    one.step(5)
    syncs.clear()
    one.contacts()
    one.step(5)
    one.contacts()
    assert len(syncs) == 2


def test_pictures_show_the_world_as_it_is_and_leave_mjx_alone(one, syncs, opengl):
    """An image after a step shows that step, whether the contacts were up to date or not."""
    one.reset()
    one.contacts()
    syncs.clear()
    before = one.mjx_data
    for height in (0.5, 1.0):
        one.data = with_heights(one.data, height)
        one.render(**SMALL_IMAGE)
        np.testing.assert_allclose(one.mj_data.body("drone:0").xpos[2], height, atol=1e-6)
        assert not one.data.core.mjx_synced
    assert one.mjx_data is before
    assert not syncs


def test_commands_leave_the_scene_fresh(two, syncs):
    """A command moves nothing, so no flag is cleared."""
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    syncs.clear()
    two.attitude_control(np.zeros((2, 1, 4)))
    assert bool(two.data.core.mjx_synced)
    two.contacts()
    assert not syncs


def test_wrong_questions_change_nothing(two, syncs):
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    data, mjx_data = two.data, two.mjx_data
    for wrong in (lambda: two.contacts("gate"), lambda: two.render("film"), lambda: two.render("rgb_array", world=2)):
        with pytest.raises(ValueError):
            wrong()
    assert two.data is data
    assert two.mjx_data is mjx_data


def test_queries_read_no_flag_from_the_device(two, syncs):
    """The host knows whether a sync is due, so the flag on the device is never read."""

    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    fine = two._stepper.data
    try:
        two._stepper.data = fine.replace(core=fine.core.replace(mjx_synced=Unreadable()))
        syncs.clear()
        two.contacts()
        two.contacts("drone:0")
        assert not syncs
    finally:
        two._stepper.data = fine


# What is allocated ----------------------------------------------------------------------------------------------


def test_nothing_of_the_scene_is_held_per_world_before_it_is_asked_for():
    """Steps, resets and rebuilds allocate no MuJoCo state of any world; contacts do."""
    n_worlds = 977  # a number that no other test uses, so arrays with this number of rows belong to this simulation
    sim = Sim(n_worlds=n_worlds)

    def scene_bytes():
        own = {id(x) for x in jax.tree.leaves((sim.data, sim.default_data))}
        return sum(x.nbytes for x in jax.live_arrays() if x.ndim and x.shape[0] == n_worlds and id(x) not in own)

    assert not sim.scene.is_allocated
    assert scene_bytes() == 0
    sim.step(2)
    sim.reset()
    sim.build_mjx()
    assert not sim.scene.is_allocated
    assert scene_bytes() == 0
    assert sim.mjx_data.mocap_pos.shape == (n_worlds, 1, 3)
    assert scene_bytes() > 1000 * n_worlds


def test_data_has_what_was_added_before_the_scene_is_compiled(monkeypatch, syncs):
    """Reading data, stepping, commands and resets compile no MuJoCo model; a question does, once for all edits.

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


def test_drawing_one_world_of_several_holds_none_of_the_others(opengl, syncs):
    """A picture needs one world's poses: no MJX, no scene state, no sync of all worlds."""
    sim = Sim(n_worlds=2)
    sim.step()
    assert sim.render(**SMALL_IMAGE, world=1).shape == (24, 32, 3)
    assert not sim.scene.is_allocated
    assert sim.scene._mjx._model is None
    assert not syncs


def test_the_scene_is_returned_as_it_is(two, syncs):
    """Reading sim.mjx_data syncs nothing: it returns the same object, as of the last sync."""
    sync_scene(two, FREE_HEIGHT, FREE_HEIGHT)
    syncs.clear()
    before = two.mjx_data
    two.data = with_heights(two.data, 0.25, 0.5)
    assert two.mjx_data is before
    np.testing.assert_allclose(two.mjx_data.mocap_pos[:, two.data.core.drone_mocap_ids[0], 2], FREE_HEIGHT)
    assert not syncs
    two.contacts()
    np.testing.assert_allclose(two.mjx_data.mocap_pos[:, two.data.core.drone_mocap_ids[0], 2], [0.25, 0.5])


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
    def read(self):
        assert self.sim.mjx_data is self.sim.mjx_data

    @precondition(lambda self: hasattr(self, "ball"))
    @rule()
    def ask(self):
        assert bool(self.sim.data.core.mjx_synced) != self.changed, "the flag says whether a question syncs"
        z = np.asarray(self.sim.data.states.pos[:, 0, 2]) + 0.02
        expected = (z < 0.086) | (np.abs(z - self.ball) < 0.186)
        done = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mjx_scene, "sync_sim2mjx", lambda *args: done.append(1) or sync_sim2mjx(*args))
            assert drone_touches(self.sim) == expected.tolist()
        assert len(done) == self.changed
        self.changed = False


TestAnyOrder = SceneMachine.TestCase
TestAnyOrder.settings = settings(max_examples=15, stateful_step_count=15, deadline=None)
