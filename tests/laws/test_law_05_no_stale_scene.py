"""Law 5: the scene is synced when, and only when, something has changed since the last sync.

One world more than asked is never computed, one question more than needed is never answered from the past. Fault 7 of
the peer, contacts that stay as they were after a teleport or a rebuild, is tested here.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

import crazysim.scene.mjx_scene as place
from crazysim.core import functional as F
from crazysim.sim import Sim
from crazysim.sim.sim import sync_sim2mjx, use_box_collision

UP = 1.0
"""Height, m, at which a drone touches nothing."""
SMALL = {"mode": "rgb_array", "width": 32, "height": 24}


class Unreadable:
    """A flag that nobody may look at."""

    def __bool__(self):
        raise AssertionError("the device's flag was read")

    __array__ = __jax_array__ = __bool__


@pytest.fixture(scope="module")
def one():
    """One world of one drone."""
    return Sim()


@pytest.fixture(scope="module")
def two():
    """Two worlds of one drone, and a ball that a user moves."""
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

    monkeypatch.setattr(place, "sync_sim2mjx", counted)
    return done


def add_ball(sim):
    xml = (
        '<mujoco><worldbody><body name="ball"><geom name="ball" type="sphere" size="0.1"/></body></worldbody></mujoco>'
    )
    body = mujoco.MjSpec.from_string(xml).body("ball")
    ball = sim.spec.worldbody.add_frame().attach_body(body, "", "")
    ball.mocap, ball.pos = True, [0, 0, 5]
    sim.build_mjx()


def at_height(data, *heights):
    """Return the data with every world's drones at a height of its own."""
    pos = np.array(data.states.pos)
    pos[..., 2] = np.reshape(heights, (-1, 1))
    return data.replace(states=data.states.replace(pos=pos))


def ball_at(sim, *heights):
    """Return the scene with the ball at another height in every world."""
    ids = sim.mj_model.body("ball").mocapid.item()
    mocap_pos = np.array(sim.mjx_data.mocap_pos)
    mocap_pos[:, ids] = [[0, 0, z] for z in heights]
    return sim.mjx_data.replace(mocap_pos=mocap_pos)


def drone_touches(sim):
    """Return in which worlds the drone touches anything."""
    return np.asarray(sim.contacts("drone:0")).any(-1).tolist()


def fresh(sim, *heights):
    """Put the drones of all worlds somewhere, the ball away, and have the scene synced."""
    sim.reset()
    sim.data = at_height(sim.data, *heights)
    if sim.n_worlds == 2:
        sim.mjx_data = ball_at(sim, 5, 5)
    sim.contacts()


# What clears the flag -------------------------------------------------------------------------------------------


def test_contacts_after_a_teleport_are_those_of_the_new_place(two, syncs):
    """Fault 7: assigning sim.data makes the scene stale, whatever flag the assigned data carries."""
    fresh(two, 0.0, UP)
    assert drone_touches(two) == [True, False]
    assert bool(two.data.core.mjx_synced), "the data that is assigned next claims to be synced"
    two.data = at_height(two.data, UP, 0.0)
    assert drone_touches(two) == [False, True]


def test_contacts_after_a_rebuild_are_those_of_the_new_scene(syncs):
    """Fault 7: floor contact stays floor contact through build_mjx, and what was added touches at once."""
    sim = Sim(n_worlds=2)
    sim.data = at_height(sim.data, 0.0, UP)
    assert drone_touches(sim) == [True, False]
    sim.build_mjx()
    assert not bool(sim.data.core.mjx_synced)
    assert drone_touches(sim) == [True, False]
    add_ball(sim)
    assert drone_touches(sim) == [True, False]
    sim.mjx_data = ball_at(sim, 5, UP)
    assert drone_touches(sim) == [True, True]
    assert len(syncs) == 4


def test_contacts_after_box_collision_are_those_of_boxes(one):
    """The sphere of 8.6 cm reaches the floor from 5 cm up, the box of 2 cm half height does not."""
    fresh(one, 0.05)
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
    fresh(two, UP, UP)
    assert drone_touches(two) == [False, False]
    syncs.clear()
    two.mjx_data = ball_at(two, 5, UP)
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
    fresh(two, UP, UP)
    syncs.clear()
    change(two)
    assert not syncs, "a change alone syncs nothing"
    two.contacts()
    assert len(syncs) == 1
    two.contacts()
    assert len(syncs) == 1


def test_the_flag_of_the_data_follows(two):
    """``data.core.mjx_synced`` is set by a question, and cleared by whatever makes the scene stale."""
    fresh(two, UP, UP)
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
    """Whatever the flag is, it is exchanged; one that is known to be clear stays, so that edits cost no transfer."""
    fresh(two, UP, UP)
    two.step()
    compiled = two.step_fn._cache_size()
    for flag in (Unreadable(), False, True, jnp.asarray(True), np.asarray(True)):
        two.data = two.data.replace(core=two.data.core.replace(mjx_synced=flag))
        two.step()
    assert two.step_fn._cache_size() == compiled
    clear = two.data.core.mjx_synced
    two.data = at_height(two.data, UP, UP)
    assert two.data.core.mjx_synced is clear


def test_a_cleared_flag_is_an_array_of_its_own(two):
    """Who donates what was read from ``sim.data`` takes no array from data that is kept, such as the default."""
    fresh(two, UP, UP)
    flags = [two.default_data.core.mjx_synced]
    for _ in range(3):
        two.contacts()
        two.data = two.data
        flags.append(two.data.core.mjx_synced)
    assert len(set(map(id, flags))) == len(flags)


def test_what_sync_returns_may_be_assigned(two, syncs):
    """After the pair of sync_sim2mjx is assigned one sync too many is allowed, a stale answer never."""
    fresh(two, UP, UP)
    syncs.clear()
    two.data, two.mjx_data = sync_sim2mjx(at_height(two.data, 0.0, UP), two.mjx_data, two.mjx_model)
    assert drone_touches(two) == [True, False]
    assert len(syncs) <= 1


# What does not --------------------------------------------------------------------------------------------------


def test_questions_share_one_sync_and_a_step_between_forces_two(one, syncs):
    """Grouped after a step, all contacts and those of a body need one sync; with a step between them, two."""
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
        one.data = at_height(one.data, height)
        one.render(**SMALL)
        np.testing.assert_allclose(one.mj_data.body("drone:0").xpos[2], height, atol=1e-6)
        assert not one.data.core.mjx_synced
    assert one.mjx_data is before
    assert not syncs


def test_commands_leave_the_scene_fresh(two, syncs):
    """A command moves nothing: neither flag is cleared."""
    fresh(two, UP, UP)
    syncs.clear()
    two.attitude_control(np.zeros((2, 1, 4)))
    assert bool(two.data.core.mjx_synced)
    two.contacts()
    assert not syncs


def test_wrong_questions_change_nothing(two, syncs):
    fresh(two, UP, UP)
    data, mjx_data = two.data, two.mjx_data
    for wrong in (lambda: two.contacts("gate"), lambda: two.render("film"), lambda: two.render("rgb_array", world=2)):
        with pytest.raises(ValueError):
            wrong()
    assert two.data is data
    assert two.mjx_data is mjx_data


def test_asking_reads_no_device(two, syncs):
    """Whether a sync is due is known on the host: a flag that cannot be read does no harm."""

    fresh(two, UP, UP)
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
    """Flying, resetting and rebuilding hold no MuJoCo state of any world; contacts do."""
    n_worlds = 977  # as no other test has, so that an array of so many rows is this simulation's
    sim = Sim(n_worlds=n_worlds)

    def foreign_bytes():
        own = {id(x) for x in jax.tree.leaves((sim.data, sim.default_data))}
        return sum(x.nbytes for x in jax.live_arrays() if x.ndim and x.shape[0] == n_worlds and id(x) not in own)

    assert not sim.scene.is_allocated
    assert foreign_bytes() == 0
    sim.step(2)
    sim.reset()
    sim.build_mjx()
    assert not sim.scene.is_allocated
    assert foreign_bytes() == 0
    assert sim.mjx_data.mocap_pos.shape == (n_worlds, 1, 3)
    assert foreign_bytes() > 1000 * n_worlds


def test_data_has_what_was_added_before_the_scene_is_compiled(monkeypatch, syncs):
    """Reading data, stepping, commands and resets compile no MuJoCo model; a question does, once for all edits.

    The data has the objects and mocap ids that the model will have, between hand-made bodies too.
    """
    compiled = []
    sim = Sim(n_worlds=2, n_drones=2)

    def count(spec, real=place.build.compile_spec):
        compiled.append(1)
        return real(spec)

    monkeypatch.setattr(place.build, "compile_spec", count)
    assert sim.data.objects is None
    first = sim.scene.add("gate", count=2, pos=(0, 3, 1))
    sim.spec.worldbody.add_body(name="by_hand", mocap=True, pos=[0, 0, 9]).add_geom(size=[0.1, 0, 0])
    sim.step()
    second = sim.scene.add("box", pos=(0.0, 0.0, UP), size=(4.0, 4.0, 0.2))
    objects, default = sim.data.objects, sim.default_data.objects
    assert objects.names == default.names == ("gate:0", "gate:1", "box:0")
    sim.data = second.set_pose(sim.data, pos=(0.0, 0.0, 2 * UP))
    sim.attitude_control(np.zeros((2, 2, 4)))
    sim.step(2)
    sim.seed(1)
    moved = at_height(sim.data, UP, 2 * UP)
    sim.reset(np.array([True, False]))
    assert sim.data.objects.pos.shape == (2, 1, 3, 3)
    np.testing.assert_allclose(second.pose(sim.data)[0][:, 0, 2], [UP, 2 * UP])
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
    assert sim.render(**SMALL, world=1).shape == (24, 32, 3)
    assert not sim.scene.is_allocated
    assert sim.scene._mjx._model is None
    assert not syncs


def test_the_scene_is_returned_as_it_is(two, syncs):
    """Reading sim.mjx_data syncs nothing: it is as the last question left it, and the same object every time."""
    fresh(two, UP, UP)
    syncs.clear()
    before = two.mjx_data
    two.data = at_height(two.data, 0.25, 0.5)
    assert two.mjx_data is before
    np.testing.assert_allclose(two.mjx_data.mocap_pos[:, two.data.core.drone_mocap_ids[0], 2], UP)
    assert not syncs
    two.contacts()
    np.testing.assert_allclose(two.mjx_data.mocap_pos[:, two.data.core.drone_mocap_ids[0], 2], [0.25, 0.5])


# Any order ------------------------------------------------------------------------------------------------------

heights = st.tuples(st.sampled_from([0.0, 0.5, UP]), st.sampled_from([0.0, 0.5, UP]))


class AnyOrder(RuleBasedStateMachine):
    """Whatever is done in whatever order, contacts are those of the poses as they are, with no sync too many."""

    sim = None
    """Built once: a simulation of two worlds with a ball."""

    @initialize()
    def begin(self):
        if AnyOrder.sim is None:
            AnyOrder.sim = Sim(n_worlds=2)
            add_ball(AnyOrder.sim)
        self.ball = (5.0, 5.0)
        fresh(self.sim, UP, UP)
        self.changed = False

    @rule(heights=heights)
    def teleport(self, heights):
        self.sim.data = at_height(self.sim.data, *heights)
        self.changed = True

    @rule(heights=heights)
    def move_ball(self, heights):
        self.sim.mjx_data = ball_at(self.sim, *heights)
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
            patch.setattr(place, "sync_sim2mjx", lambda *args: done.append(1) or sync_sim2mjx(*args))
            assert drone_touches(self.sim) == expected.tolist()
        assert len(done) == self.changed
        self.changed = False


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=15, stateful_step_count=15, deadline=None)
