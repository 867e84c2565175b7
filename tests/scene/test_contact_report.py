"""The contact report against C MuJoCo's distances, and inside the step."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from crazysim import ConfigError, ContactLog, Sim
from crazysim.engine import Step
from crazysim.engine.stage import stage
from crazysim.sim.sim import use_box_collision

N_WORLDS, N_DRONES = 40, 3
SPHERE_TOLERANCE = 1e-5
"""Tolerance of distances between a sphere and shapes with a closed form: float32 at a few metres, m."""


def build_course():
    sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES, control="attitude")
    handles = {
        "gate": sim.scene.add("gate", count=2, pos=[[1, 0, 1], [2, 0, 1]], stand=1.0),
        "pole": sim.scene.add("pole", count=2, pos=[[0, 1, 0], [1, 1, 0]], mocap=False),
        "box": sim.scene.add("box", count=2),
        "pad": sim.scene.add("landing_pad", "pad", pos=[-1, 0, 0.3]),
        "ball": sim.scene.add("sphere", "ball", pos=[-1, -1, 1]),
        "egg": sim.scene.add(
            "<mujoco><worldbody><geom type='ellipsoid' size='.3 .2 .1'/></worldbody></mujoco>", "egg", pos=[0, 0, 1]
        ),
    }
    return sim, handles


@pytest.fixture(scope="module")
def scattered_course(request):
    sim, handles = build_course()
    rng = np.random.default_rng(5)
    pos = rng.uniform([-1.5, -1.5, 0], [2.5, 1.5, 1.8], (N_WORLDS, N_DRONES, 3))
    pos[:8, 1] = pos[:8, 0] + rng.normal(scale=0.08, size=(8, 3))  # drones that overlap
    quat = rng.normal(size=(N_WORLDS, N_DRONES, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    states = sim.data.states.replace(pos=np.float32(pos), quat=np.float32(quat))
    sim.data = sim.data.replace(states=states)
    near = pos[:, :2] + rng.normal(scale=0.2, size=(N_WORLDS, 2, 3))
    sim.data = handles["box"].set_pose(sim.data, near, rng.normal(size=(N_WORLDS, 2, 4)))
    return sim, handles


def mujoco_distances(sim, world, names, geom):
    sim.scene.sync_one(sim.data, world)
    model, data = sim.mj_model, sim.mj_data
    root = model.body_rootid[model.geom_bodyid]

    def distance(a, b):
        return mujoco.mj_geomDistance(model, data, a, b, 100.0, None)

    drone_geoms = [model.geom(f"{geom}:{i}").id for i in range(sim.n_drones)]
    floor = [distance(model.geom("floor").id, g) for g in drone_geoms]
    objects = [
        [min(distance(g, o) for o in np.flatnonzero(root == model.body(n).id)) for n in names] for g in drone_geoms
    ]
    drones = [[distance(a, b) if a != b else np.inf for b in drone_geoms] for a in drone_geoms]
    return np.array(floor), np.array(objects), np.array(drones)


def test_every_distance_equals_that_of_c_mujoco(scattered_course):
    sim, _ = scattered_course
    report = jax.device_get(sim.contact_report())
    for world in range(N_WORLDS):
        floor, objects, drones = mujoco_distances(sim, world, report.object_names, "col_sphere")
        np.testing.assert_allclose(report.floor_distance[world], floor, atol=SPHERE_TOLERANCE)
        np.testing.assert_allclose(report.object_distance[world], objects, atol=SPHERE_TOLERANCE)
        np.testing.assert_allclose(report.drone_distance[world], drones.min(axis=-1), atol=SPHERE_TOLERANCE)
        np.testing.assert_array_equal(report.nearest_drone[world], drones.argmin(axis=-1))
        np.testing.assert_array_equal(report.nearest_object[world], objects.argmin(axis=-1))
    for touches, distance in (
        (report.floor, report.floor_distance),
        (report.objects, report.object_distance),
        (report.drones, report.drone_distance),
    ):
        np.testing.assert_array_equal(touches, distance < 0)
        assert 2 < int(touches.sum()) < touches.size - 2, "both outcomes must occur"
    np.testing.assert_array_equal(report.any, report.floor | report.drones | report.objects.any(axis=-1))


def test_box_collision_changes_the_distances():
    sim = Sim(n_worlds=2, control="attitude")
    sim.scene.add("box", pos=[0, 0, 1.0], size=(1, 1, 1))
    half_height = np.asarray(sim.airframe.value("shape.collision_box"))[5]
    pos = np.float32([[[0, 0, 1.5 + half_height + 0.01]], [[0, 0, 1.5 + half_height - 0.01]]])
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    touches = np.asarray(sim.contact_report(drones=False).objects)[:, 0, 0]
    np.testing.assert_array_equal(touches, [True, True])  # the sphere is taller
    use_box_collision(sim)
    offset = float(np.asarray(sim.airframe.value("shape.collision_box"))[2])
    distance = np.asarray(sim.contact_report(drones=False).object_distance)[:, 0, 0]
    np.testing.assert_allclose(distance, [0.01 + offset, offset - 0.01], atol=1e-5)


def test_fields_that_were_not_requested_are_none(scattered_course):
    sim, handles = scattered_course
    full_report, box_report = sim.contact_report(), sim.contact_report(handles["box"], floor=False, drones=False)
    assert box_report.object_names == ("box:0", "box:1")
    assert box_report.floor is None
    assert box_report.drone_distance is None
    columns = [full_report.object_names.index(n) for n in box_report.object_names]
    expected = np.asarray(full_report.object_distance)[..., columns]
    np.testing.assert_allclose(box_report.object_distance, expected, atol=1e-6)
    mixed_report = sim.contact_report(("box:1", handles["pad"]), drones=False)
    assert mixed_report.object_names == ("box:1", "pad:0")
    assert sim.contact_report((), drones=False).objects is None


def test_reports_of_one_drone_one_world_and_all_worlds_agree(scattered_course):
    sim, _ = scattered_course
    full_report = jax.device_get(sim.contact_report())
    contacts_in_world = sim.scene.contact_fn()
    contacts_of_drone = sim.scene.contact_fn(drones=False)

    @stage("world")
    def world(data):
        report = contacts_in_world(data)
        return data.replace(states=data.states.replace(force=jnp.stack(
            [report.drone_distance, report.floor_distance, report.object_distance[:, 1]], axis=-1)))  # fmt: skip

    @stage("drone")
    def drone(data):
        report = contacts_of_drone(data)
        return data.replace(states=data.states.replace(torque=report.object_distance[:3]))

    states = Step({"world": world, "drone": drone})(sim.data, 1).states
    expected = np.stack(
        [full_report.drone_distance, full_report.floor_distance, full_report.object_distance[..., 1]], axis=-1
    )
    np.testing.assert_allclose(states.force, expected, atol=1e-5)
    np.testing.assert_allclose(states.torque, full_report.object_distance[..., :3], atol=1e-5)


@pytest.mark.long("builds a scene of 4,096 drones")
def test_a_swarm_of_4096_finds_the_two_that_touch_without_quadratic_memory():
    """Built one by one, this scene would take minutes, since MuJoCo traverses the whole spec for every added geom."""
    n, rows = 4096, 64
    sim = Sim(n_drones=n, control="attitude")
    assert sim.mj_model.nmocap == n
    k = np.arange(n)
    pos = np.stack([0.5 * (k % rows), 0.5 * (k // rows), np.ones(n)], axis=-1)
    pos[4000] = pos[7] + [0.1, 0.0, 0.05]
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.float32(pos[None])))
    contacts = jax.jit(sim.scene.contact_fn(())).lower(sim.data).compile()
    assert contacts.memory_analysis().temp_size_in_bytes < n * n, "less than a byte for each pair"
    report = jax.device_get(contacts(sim.data))
    np.testing.assert_array_equal(np.flatnonzero(report.drones[0]), [7, 4000])
    np.testing.assert_array_equal(report.nearest_drone[0, [7, 4000]], [4000, 7])
    radius = np.asarray(sim.airframe.value("shape.collision_sphere"))[3]
    gap = np.hypot(0.1, 0.05) - 2 * radius
    np.testing.assert_allclose(report.drone_distance[0, [7, 4000]], gap, atol=SPHERE_TOLERANCE)
    others = np.delete(report.drone_distance[0], [4000, 7, 8])
    np.testing.assert_allclose(others, 0.5 - 2 * radius, atol=SPHERE_TOLERANCE)
    assert not report.floor.any()


def test_a_replaced_log_checks_what_its_new_settings_select():
    sim = Sim(n_drones=2, plugins=[ContactLog(drones=False)])
    sim.step()
    log = sim.replace(ContactLog(floor=False))
    sim.reset()
    sim.step()
    assert not log.read(sim.data).any.any()
    assert log.read(sim.data).floor is None


def test_contacts_are_logged_at_the_step_at_which_they_begin():
    """In the first world a drone flies past a pole, in the second into it; in the third two drones rest in contact."""
    sim = Sim(n_worlds=3, n_drones=2, control="rotor_vel")
    pole = sim.scene.add("pole", pos=[0.5, 0, 0], height=3.0, radius=0.02)
    sim.add(ContactLog(pole, floor=False))
    pos = np.float32([[[0, 0.5, 1], [5, 0, 1]], [[0, 0, 1], [5, 0, 1]], [[0, 5, 1], [0, 5.1, 1]]])
    vel = np.float32([[[1, 0, 0], [0, 0, 0]], [[1, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]]])
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos, vel=vel))
    initial_data, touches = sim.data, []
    for _ in range(250):
        sim.step()
        touches.append(jax.device_get(sim.contact_report(pole, floor=False)))
    touches = np.array([report.objects.any(axis=-1) | report.drones for report in touches])
    sim.data = initial_data
    sim.step(250)
    log = jax.device_get(sim.data.plugins["contacts"])
    np.testing.assert_array_equal(log.first_step, np.where(touches.any(axis=0), touches.argmax(axis=0) + 1, -1))
    np.testing.assert_array_equal(log.objects[..., 0], [[False, False], [True, False], [False, False]])
    np.testing.assert_array_equal(log.drones, [[False, False], [False, False], [True, True]])
    assert log.first_step[2].tolist() == [1, 1]
    assert log.any.tolist() == [[False, False], [True, False], [True, True]]
    sim.reset(np.array([False, True, False]))
    assert sim.data.plugins["contacts"].any.tolist() == [[False, False], [False, False], [True, True]]


@pytest.fixture(scope="module")
def attached_bodies():
    """Return two worlds with three kinds of bodies: with a handle, attached and moved through mjx_data, and fixed."""
    sim = Sim(n_worlds=2, n_drones=2)
    ball = sim.scene.add("sphere", "ball", pos=[0, 2, 1], radius=0.1)
    rock = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='rock'><geom type='box' size='.1 .2 .3'/><camera name='eye' pos='0 0 1'/>"
        "</body></worldbody></mujoco>"
    ).body("rock")
    frame = sim.spec.worldbody.add_frame()
    for k in range(3):
        frame.attach_body(rock, "", f":{k}").pos = [k, 0, 1]
        sim.spec.body(f"rock:{k}").mocap = k != 1
    sim.build_mjx()
    pos = np.tile(np.float32([[0.1, 0, 0.8], [1.6, 0.4, 1]]), (2, 1, 1))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    return sim, ball


def move_rocks(sim, shift):
    ids = np.array([sim.mj_model.body(f"rock:{k}").mocapid[0] for k in (0, 2)])
    pos = np.float32([[[0, 0, 1], [2, 0, 1]], [[0.2, 0, 1], [2, 0.3, 1]]]) + np.float32(shift)
    turned = np.float32([np.cos(0.3), 0, 0, np.sin(0.3)])  # wxyz, by 0.6 rad about z
    data = sim.mjx_data
    mocap_pos, mocap_quat = np.array(data.mocap_pos), np.array(data.mocap_quat)
    mocap_pos[:, ids], mocap_quat[:, ids] = pos, turned
    sim.mjx_data = data.replace(mocap_pos=mocap_pos, mocap_quat=mocap_quat)


def test_bodies_moved_through_mjx_data_are_reported_at_their_poses(attached_bodies):
    """After every move, distances in every world equal those of C MuJoCo; a move compiles nothing."""
    sim, ball = attached_bodies
    n_touches = []
    for shift in ([0, 0, 0], [0.3, -0.2, 0.1], [0, 1.0, 0]):
        move_rocks(sim, shift)
        report = jax.device_get(sim.contact_report())
        assert set(report.object_names) == {"ball:0", "rock:0", "rock:1", "rock:2"}
        for world in range(2):
            _, objects, _ = mujoco_distances(sim, world, report.object_names, "col_sphere")
            np.testing.assert_allclose(report.object_distance[world], objects, atol=SPHERE_TOLERANCE)
        n_touches.append(int(report.objects.sum()))
    assert n_touches[0] > 0
    assert n_touches[2] == 0
    report_of_two = sim.contact_report(["rock:2", ball], floor=False, drones=False)
    columns = [report.object_names.index(name) for name in ("rock:2", "ball:0")]
    np.testing.assert_allclose(report_of_two.object_distance, report.object_distance[..., columns], atol=1e-6)
    cache_sizes = [fn._cache_size() for fn in sim._queries._compiled[1].values()]
    assert cache_sizes == [1] * len(cache_sizes), "a move compiles nothing"


def test_before_mjx_data_is_read_bodies_are_at_their_poses_in_the_spec():
    sim = Sim(n_worlds=2)
    body = sim.spec.worldbody.add_body(name="rock", pos=[0, 0, 2], mocap=True)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    sim.build_mjx()
    centre = np.asarray(sim.airframe.value("shape.collision_sphere"))
    np.testing.assert_allclose(
        sim.contact_report("rock").object_distance, 2 - centre[2] - centre[3] - 0.1, atol=SPHERE_TOLERANCE
    )
    assert not sim.scene.is_allocated


def test_a_pure_function_takes_poses_of_bodies_moved_through_mjx_data(attached_bodies):
    """Poses are passed as mjx_data or as a pair, for all worlds or for one."""
    sim, _ = attached_bodies
    move_rocks(sim, [0.1, 0.1, 0])
    expected = np.asarray(sim.contact_report().object_distance)
    contacts, mjx_data = jax.jit(sim.scene.contact_fn()), sim.mjx_data
    pair = jax.device_get((mjx_data.mocap_pos, mjx_data.mocap_quat))
    for mocap in (mjx_data, pair):
        np.testing.assert_allclose(contacts(sim.data, mocap).object_distance, expected, atol=1e-6)
    raised_report = contacts(sim.data, (pair[0] + np.float32([0, 0, 5]), pair[1]))
    column = raised_report.object_names.index("rock:0")
    assert (np.asarray(raised_report.object_distance)[..., column] > expected[..., column] + 1).all()
    contacts_of_rock = sim.scene.contact_fn(["rock:0"], floor=False, drones=False)

    def distance(pos):
        return contacts_of_rock(sim.data, (jnp.broadcast_to(pos, pair[0].shape), pair[1])).object_distance[0, 0, 0]

    gradient = np.asarray(jax.jit(jax.grad(distance))(pair[0][0, 0]))
    assert np.abs(gradient).sum() > 0.5, "the distance has a slope by the body's position"
    forces = Step({"one": stage("world")(
        lambda d: d.replace(states=d.states.replace(force=d.states.force.at[:, 0].set(
            contacts_of_rock(d, (pair[0][0], pair[1][0])).object_distance[:, 0])))
    )}, "lanes")(sim.data, 1).states.force  # fmt: skip
    np.testing.assert_allclose(np.asarray(forces)[0, :, 0], expected[0, :, column], atol=1e-5)


def test_cameras_see_bodies_moved_through_mjx_data_and_move_with_them(attached_bodies):
    sim, _ = attached_bodies
    move_rocks(sim, [0, 0, 0])
    view = {"camera": "eye:0", "width": 4, "height": 4, "drones": False}
    first = np.asarray(sim.depth(**view))
    hits = jax.device_get(jax.jit(sim.scene.depth_fn(**view))(sim.data, sim.mjx_data))
    np.testing.assert_allclose(hits.distance, first, atol=1e-6)
    assert "rock:0" in {hits.names[k] for k in np.unique(hits.body_index)}
    np.testing.assert_allclose(first.min(), 1 - 0.3, atol=1e-5)  # from 1 m over its middle to its upper side
    move_rocks(sim, [0, 0, 3])
    depth = np.asarray(sim.depth(**view))
    np.testing.assert_allclose(depth.min(), 0.7, atol=1e-5)
    assert depth.max() > 3.9, "beside it, the floor is 3 m further away"


def test_law_09_wrong_queries_are_refused(attached_bodies):
    sim, _ = attached_bodies
    for query in (lambda: sim.scene.contact_fn()(sim.data), lambda: sim.scene.depth_fn("fpv_cam", 2, 2)(sim.data)):
        with pytest.raises(
            ConfigError, match=r"'rock:0', which is moved through sim.mjx_data.*Pass mocap=sim.mjx_data"
        ):
            query()
    with pytest.raises(ConfigError, match=r"expected mocap_pos of shape \(2, n_mocap, 3\), got \(5, 3\)"):
        sim.scene.contact_fn()(sim.data, (np.zeros((5, 3)), np.zeros((5, 4))))
    with pytest.raises(ConfigError, match="objects whose poses are in the data, got body 'rock:0'"):
        sim.add(ContactLog())


@pytest.mark.long("compiles contacts in the step and in a report")
@pytest.mark.parametrize(("n_drones", "has_boxes"), [(1, False), (3, True), (9, False)])
def test_the_log_and_a_report_have_the_same_contacts_between_drones(n_drones, has_boxes, rng):
    """In the step one drone loops over the others, of which up to eight are unrolled; a report has all pairs of a
    world."""
    sim = Sim(n_worlds=4, n_drones=n_drones, control="rotor_vel", engine="interpret")
    if has_boxes:
        use_box_collision(sim)
    pos = rng.uniform(-0.2, 0.2, (4, n_drones, 3)) * [1, 1, 0.2] + [0, 0, 1]
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.float32(pos)))
    log = sim.add(ContactLog((), floor=False))
    sim.step()
    assert not sim.build_step_fn().plan(sim.data).program.unfused_stages
    expected = np.asarray(sim.contact_report((), floor=False).drones)
    assert n_drones == 1 or (expected.any() and not expected.all())
    np.testing.assert_array_equal(log.read(sim.data).drones, expected)


@pytest.mark.parametrize("n_drones", [3, 9])
def test_one_kernel_reports_the_same_as_xla(n_drones, rng):
    """Distances between more than eight drones have no kernel; fields that are not requested are None in both."""
    sims = [Sim(n_worlds=5, n_drones=n_drones, engine=engine) for engine in ("auto", "lanes")]
    pos = np.float32(rng.uniform(-0.5, 1, (5, n_drones, 3)))
    for sim in sims:
        sim.scene.add("box", count=2, pos=[[1, 0, 0.5], [0, 1, 0.5]])
        sim.scene.add("pole", pos=[0.2, 0.2, 0])
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    for options in ({}, {"objects": "pole:0", "floor": False}):
        report, expected = (sim.contact_report(**options) for sim in sims)
        assert jax.tree.structure(report) == jax.tree.structure(expected)
        for x, y in zip(jax.tree.leaves(report), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-5)


BALL = "<geom type='sphere' size='.1' pos='{} {} {}' conaffinity='2'/>"


@pytest.mark.long("builds a scene of 3,031 objects, and another program to compare")
@pytest.mark.parametrize("has_boxes", [False, True])
def test_thousands_of_objects_are_reported_by_a_small_program(has_boxes, rng):
    """Movable and fixed balls, boxes in any attitude, and a body of forty balls.

    The distances of few objects are computed one by one, and compared with those of C MuJoCo above.
    """
    sim = Sim(n_worlds=1, n_drones=1)
    if has_boxes:
        use_box_collision(sim)
    n, positions, positions_in_body = 1500, rng.uniform(-3, 3, (2, 1500, 3)), rng.uniform(-3, 3, (40, 3))
    sim.scene.add("sphere", "moves", count=n, pos=positions[0])
    sim.scene.add("sphere", "stays", count=n, pos=positions[1], mocap=False)
    sim.scene.add("box", "turned", count=30, pos=positions[0, :30], quat=rng.normal(size=(30, 4)), mocap=False)
    balls = "".join(BALL.format(*pos) for pos in positions_in_body)
    sim.scene.add(f"<mujoco><worldbody>{balls}</worldbody></mujoco>", "many", mocap=False)
    program = str(jax.make_jaxpr(sim.scene.contact_fn())(sim.data))
    assert program.count("\n") < 20_000, "the program grows with the number of objects, and takes minutes to compile"
    report = sim.contact_report()
    distances = np.asarray(report.object_distance)[0, 0]
    assert distances.shape == (2 * n + 31,)
    assert report.nearest_object[0, 0] == np.argmin(distances)
    chosen_names = [f"{name}:{k}" for name in ("moves", "stays", "turned") for k in (7, 29)]
    chosen_distances = np.asarray(sim.contact_report(chosen_names).object_distance)[0, 0]
    np.testing.assert_allclose(
        distances[[report.object_names.index(name) for name in chosen_names]], chosen_distances, atol=1e-5
    )
    if not has_boxes:
        centre, reach = np.array([0, 0, 0.02]), 0.086 + 0.1
        expected = np.linalg.norm(np.concatenate(positions) - centre, axis=-1) - reach
        np.testing.assert_allclose(distances[: 2 * n], expected, atol=1e-5)
        nearest = np.linalg.norm(positions_in_body - centre, axis=-1).min() - reach
        np.testing.assert_allclose(distances[report.object_names.index("many:0")], nearest, atol=1e-5)
