"""Depth cameras and range finders against formulas, C MuJoCo's rays and its depth images."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from crazysim import ConfigError, RangeFinder, Sim, SlungLoad
from crazysim.core.stage import vmap_worlds
from crazysim.errors import EngineWarning
from crazysim.scene.depth import pixel_directions

WIDTH, HEIGHT, FOVY = 24, 16, 70.0


def placed(sim, pos, quat=None):
    """Put drones at positions (n_worlds, n_drones, 3), level unless a quaternion is given."""
    states = sim.data.states.replace(pos=np.float32(pos))
    if quat is not None:
        states = states.replace(quat=np.float32(quat))
    sim.data = sim.data.replace(states=states)


def looks(width=WIDTH, height=HEIGHT, fovy=FOVY):
    """Return where the pixels of a level drone's camera look, world frame: ahead is x, right is -y."""
    d = pixel_directions(fovy, width, height)
    return np.stack([-d[..., 2], -d[..., 0], d[..., 1]], axis=-1)


@pytest.fixture(scope="module")
def room():
    """Two worlds of two drones before a wall, a ball and, hidden in one world, a box that moves."""
    sim = Sim(n_worlds=2, n_drones=2, control="attitude")
    sim.scene.add("wall", pos=[3, 0, 0], length=20, height=20, mocap=False)
    ball = sim.scene.add("sphere", pos=[1.5, 0.2, 1.1], radius=0.2)
    box = sim.scene.add("box", pos=[0, 0, -50], size=(0.2, 0.4, 0.3))
    placed(sim, [[[0, 0, 1], [0.5, -0.3, 1]]] * 2)
    return sim, ball, box


@pytest.fixture(scope="module")
def look_ahead(room):
    """Return a function from data to hits of the first drone's camera, other drones left out."""
    return jax.jit(room[0].scene.depth_fn("fpv_cam:0", WIDTH, HEIGHT, drones=False, along="ray"))


def test_a_wall_a_floor_and_a_ball_are_where_they_are(room, look_ahead):
    sim, _, _ = room
    eye = np.asarray(sim.airframe.value("shape.fpv_camera")) + [0, 0, 1]
    d = looks()
    with np.errstate(divide="ignore"):
        wall = (3 - 0.025 - eye[0]) / d[..., 0]
        floor = np.where(d[..., 2] < 0, -eye[2] / d[..., 2], np.inf)
    to = np.array([1.5, 0.2, 1.1]) - eye
    along = d @ to
    under = 0.2**2 - (to @ to - along**2)
    ball = np.where(under > 0, along - np.sqrt(np.maximum(under, 0)), np.inf)
    expected = np.minimum(np.minimum(wall, floor), ball)
    hits = jax.device_get(look_ahead(sim.data))
    np.testing.assert_allclose(hits.distance[0, 0], expected, rtol=1e-5)
    which = np.stack([floor, wall, ball]).argmin(axis=0)
    names = np.array(hits.names)[hits.body_index[0, 0]]
    np.testing.assert_array_equal(names, np.array(["floor", "wall:0", "sphere:0"])[which])
    assert set(which.ravel()) == {0, 1, 2}
    normal = hits.normal[0, 0]
    np.testing.assert_allclose(normal[which == 0], np.broadcast_to([0, 0, 1.0], normal[which == 0].shape), atol=1e-6)
    np.testing.assert_allclose(normal[which == 1], np.broadcast_to([-1.0, 0, 0], normal[which == 1].shape), atol=1e-6)
    at = eye + d * expected[..., None]
    np.testing.assert_allclose(normal[which == 2], ((at - [1.5, 0.2, 1.1]) / 0.2)[which == 2], atol=1e-4)


def test_depth_along_the_axis_of_a_wall_is_one_number(room):
    sim, _, _ = room
    depth = np.asarray(sim.depth("fpv_cam", WIDTH, HEIGHT, drones=False))
    assert depth.shape == (2, 2, HEIGHT, WIDTH)
    eye = np.asarray(sim.airframe.value("shape.fpv_camera"))[0]
    np.testing.assert_allclose(depth[:, 0, 0], 3 - 0.025 - eye, rtol=1e-5)  # the upper row sees only the wall
    np.testing.assert_allclose(depth[:, 1, 0], 3 - 0.025 - eye - 0.5, rtol=1e-5)


def test_depth_follows_the_objects_of_each_world(room, look_ahead):
    sim, _, box = room
    data = box.set_pose(sim.data, np.array([[[1.0, 0, 1.0]], [[0, 0, -50.0]]]))
    hits = look_ahead(data)
    seen = (np.asarray(hits.body_index) == hits.names.index("box:0")).reshape(2, -1).sum(axis=1)
    assert seen[0] > 20
    assert seen[1] == 0


@functools.cache
def look(sim, camera, hide_own):
    """Return a compiled function from data to hits of the rays of a camera, 96 by 64 pixels."""
    return jax.jit(sim.scene.depth_fn(camera, 96, 64, hide_own=hide_own))


def test_a_drone_sees_others_and_not_itself(room):
    """The second drone flies before the first, off to the right; it sees nobody."""
    sim, _, _ = room
    hits, own, hidden = (
        jax.device_get(look(sim, camera, hide_own)(sim.data))
        for camera, hide_own in (("fpv_cam", True), ("track_cam:1", False), ("track_cam:1", True))
    )
    first = hits.names.index("drone:0")
    assert not (hits.body_index[:, 1] >= first).any()
    others = hits.body_index[0, 0] == first + 1
    assert not (hits.body_index[:, 0] == first).any()
    assert 4 < others.sum() < 400
    assert np.argwhere(others)[:, 1].min() > 48, "what is at -y is in the right half"
    assert (own.body_index[0, 0] == first + 1).sum() > 8
    assert not (hidden.body_index[0, 0] == first + 1).any()


def test_an_image_in_one_world_is_that_of_the_world_among_all(room):
    """What a task of one world observes: the same rays in the loop over bodies as in the kernel, to rounding."""
    sim = room[0]
    depth = sim.scene.depth_fn("fpv_cam", 9, 6, drones=False)
    names = ("body_index", "distance", "normal", "point")
    together, each = (
        jax.jit(transform(lambda data: [getattr(depth(data), name) for name in names]))(sim.data)
        for transform in (lambda fn: fn, vmap_worlds)
    )
    for k, name in enumerate(names):
        np.testing.assert_allclose(together[k], each[k], rtol=2e-6, atol=2e-6, err_msg=name)
    assert together[-1].shape == (2, 2, 6, 9, 3)


def test_law_09_data_of_one_drone_has_no_image(room):
    sim = room[0]
    of_one = sim.data.replace(states=jax.tree.map(lambda x: x[0, 0], sim.data.states))
    with pytest.raises(ConfigError, match="expected data of all worlds or of one world for images, got data of one dr"):
        sim.scene.depth_fn()(of_one)


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("cameras, camera, hide_own", [
    ("fpv_cam", "fpv_cam:0", True), ("track_cam:1", "track_cam:1", False),
])  # fmt: skip
def test_depth_equals_that_of_the_renderer(room, cameras, camera, hide_own):
    """MuJoCo's renderer, at any attitude; but for edges, and for what is half transparent, they are the same."""
    sim, _, box = room
    before = sim.data
    rng = np.random.default_rng(2)
    quat = [0, 0, 0, 1] + 0.2 * rng.normal(size=(2, 2, 4))
    placed(sim, np.asarray(sim.data.states.pos), quat / np.linalg.norm(quat, axis=-1, keepdims=True))
    sim.data = box.set_pose(sim.data, [1.0, -0.4, 0.8], [0.1, 0.2, 0.3, 0.9])
    for world in range(2):
        picture = sim.render("depth_array", world, camera, width=96, height=64)
        depth = np.asarray(look(sim, cameras, hide_own)(sim.data).distance)[world, 0]
        both = np.isfinite(depth) & (picture < 50)
        assert both.mean() > 0.5
        wrong = np.abs(depth - picture)[both] > 0.01 * picture[both]
        assert wrong.mean() < 0.1
        assert np.median(np.abs(depth - picture)[both]) < 1e-3
    sim.data = before


def test_cameras_of_a_user_on_the_world_and_on_an_object(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text("""<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
      <camera name="down" pos="0 0 2" fovy="40"/></worldbody></mujoco>""")
    sim = Sim(n_worlds=2, xml_path=path)
    tower = sim.scene.add(
        "<mujoco><worldbody><geom type='sphere' size='.05'/><camera name='eye' fovy='40'/></worldbody></mujoco>",
        "tower", pos=np.array([[[5, 0, 1.0]], [[5, 0, 3.0]]]),
    )  # fmt: skip
    np.testing.assert_allclose(sim.depth("down", 4, 4, drones=False), 2.0, rtol=1e-5)
    seen = sim.depth("tower:0/eye", 4, 4)  # from within its ball, whose surface is where it leaves it
    np.testing.assert_allclose(seen, 0.05, rtol=0.1)
    sim.data = tower.set_pose(sim.data, [5, 0, 0.02])
    assert (np.asarray(sim.depth("tower:0/eye", 4, 4))[:, 0, 1:3, 1:3] < 0.03).all()


def test_the_slope_of_depth_is_the_way_to_the_wall(room):
    sim, _, _ = room
    look = sim.scene.depth_fn("fpv_cam:0", 4, 4, drones=False)

    def middle(x):
        pos = sim.data.states.pos + jnp.array([1.0, 0, 0]) * x
        return look(sim.data.replace(states=sim.data.states.replace(pos=pos))).distance[0, 0, 0, 3]

    assert float(jax.jit(jax.grad(middle))(0.0)) == pytest.approx(-1.0, abs=1e-5)


def test_a_range_finder_measures_in_the_step():
    sim = Sim(n_worlds=2, n_drones=2, control="attitude")
    sim.scene.add("wall", pos=[2, 0, 0], length=8, height=8)
    sim.scene.add("sphere", pos=[0, 1.2, 1.0], radius=0.2)
    sim.add(RangeFinder(max_range=3.0, drones=True))
    placed(sim, [[[0, 0, 1], [0, -1, 1]], [[1, 0, 2], [1, -0.5, 5]]], np.tile([0, 0, 0, 1.0], (2, 2, 1)))
    sim.step()
    found = np.asarray(sim.data.plugins["range_finder"].distance)
    names = list(RangeFinder.MULTI_RANGER)
    z = np.asarray(sim.data.states.pos)[..., 2]
    np.testing.assert_allclose(found[..., names.index("down")], np.minimum(z, 3.0), atol=1e-4)
    np.testing.assert_allclose(found[..., names.index("front")], [[1.975, 1.975], [0.975, 0.975]], atol=1e-4)
    np.testing.assert_allclose(found[..., names.index("back")], 3.0)
    np.testing.assert_allclose(found[0, 0, names.index("left")], 1.0, atol=1e-4)
    assert found[0, 0, names.index("right")] < 1.0  # the other drone
    assert found[1, 0, names.index("right")] == 3.0
    assert "not fused" not in sim.explain()


def test_rays_in_a_step_meet_loads_where_they_are_now():
    """No image was drawn since the load and its drone moved. The rod, which begins at the drone, is not measured."""
    sim = Sim(n_worlds=2, control="rotor_vel")
    load = sim.add(SlungLoad(mass=0.005, length=0.5, size=0.1))
    sim.add(RangeFinder([[0, 0, -1], [1, 0, 0]], max_range=3.0))
    sim.sync(0)
    placed(sim, [[[0, 0, 2]], [[5, 5, 2]]])
    sim.data = load.hang(sim.data)
    sim.step()
    found = np.asarray(sim.data.plugins["range_finder"].distance)
    np.testing.assert_allclose(found, [[[0.4, 3.0]]] * 2, atol=1e-3)
    assert "not fused" not in sim.explain()
    look = jax.jit(sim.scene.depth_fn(sim.mj_model.cam("fpv_cam:0").id, 3, 3, drones=False))
    beside = np.asarray(sim.data.states.pos) + np.float32([1.1, 0, 0])
    aside = load.write(sim.data, load.read(sim.data).replace(pos=beside))
    seen, placed_before = (
        np.asarray(look(d).distance)[:, 0, 1, 1] for d in (aside, sim.plugins.with_moved_objects(aside))
    )
    np.testing.assert_allclose(seen, placed_before)
    assert np.all(seen < 1.1)


def test_a_range_finder_finds_the_first_of_many_objects(x64, rng):
    """In a kernel, where C MuJoCo's rays end; with the gradient that central differences have, from one kernel too."""
    n = 16
    sim = Sim(n, control="rotor_vel", engine="fused", strict=True)
    pos, quat = rng.uniform([-3, -3, 0.2], [3, 3, 2], (40, 3)), rng.normal(size=(40, 4))
    sim.scene.add("pole", count=20, pos=pos[:20], quat=quat[:20], mocap=False)
    sim.scene.add("box", count=20, pos=pos[20:], quat=quat[20:], size=(0.8, 0.6, 1.0), mocap=False)
    look = np.array([[1.0, 0.2, -0.1], [-0.6, 0.8, 0.0]]) / np.sqrt([[1.05], [1.0]])
    sim.add(RangeFinder(look, max_range=2.5))
    sim.data = jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, sim.data)
    start = rng.uniform([-2, -2, 0.5], [2, 2, 1.5], (n, 1, 3))
    step, weight = sim.build_step_fn(), rng.uniform(size=(n, 1, 2))

    @jax.jit
    def measured(pos):
        data = step(sim.data.replace(states=sim.data.states.replace(pos=pos)), 2)
        found = data.plugins["range_finder"].distance
        return jnp.sum(weight * found), (found, data.states.pos)

    slope, (distance, at) = jax.jit(jax.grad(measured, has_aux=True))(start)
    assert "gradient: one kernel" in sim.explain()
    group, geom = np.array([1, 1, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    sim.scene.sync_one(sim.data, 0)
    rays = [(w, k) for w in range(n) for k in range(2)]
    far = [mujoco.mj_ray(sim.mj_model, sim.mj_data, at[w, 0], look[k], group, 1, -1, geom, None) for w, k in rays]
    far = np.array([x if 0 <= x < 2.5 else 2.5 for x in far])
    assert 8 < np.sum(far < 2.5) < 28
    # MuJoCo's compiler rounds sizes and poses of the scene to 1e-9 at most.
    np.testing.assert_allclose(np.asarray(distance).reshape(-1), far, atol=1e-7)
    h = 1e-6  # the third derivative of the distance to a pole costs some h^2 = 1e-12, rounding 1e-16 / h
    for k, way in enumerate(h * np.eye(3)):
        ends = [np.sum(weight * np.asarray(measured(start + sign * way)[1][0]), axis=-1) for sign in (1, -1)]
        np.testing.assert_allclose(slope[..., k], (ends[0] - ends[1]) / (2 * h), atol=1e-7)


def test_a_range_finder_measures_many_movable_objects_as_it_does_fixed_ones(rng):
    """A stage of all worlds measures them, at the same steps, and where they are in each world."""
    pos, quat = rng.uniform([-2, -2, 0.2], [2, 2, 2], (20, 3)), rng.normal(size=(20, 4))
    start = rng.uniform([-2, -2, 0.5], [2, 2, 1.5], (6, 2, 3))
    found = []
    for mocap in (False, True):
        sim = Sim(6, 2, control="attitude")
        boxes = sim.scene.add("box", count=20, pos=pos, quat=quat, size=(0.5, 0.5, 0.5), mocap=mocap)
        sim.add(RangeFinder(freq=250, drones=True, max_range=2.0))
        placed(sim, start)
        sim.step(5)
        found.append(np.asarray(sim.data.plugins["range_finder"].distance))
        assert ("'range_finder' is not fused: rays among 22 movable" in sim.explain()) == mocap
    np.testing.assert_allclose(found[1], found[0], atol=1e-5)
    assert 0.1 < np.mean(found[0] < 2.0) < 0.9
    sim.data = boxes.set_pose(sim.data, pos - [0, 0, 50])
    sim.step(1)
    np.testing.assert_array_equal(sim.data.plugins["range_finder"].distance, found[1])  # not at odd steps
    sim.step(1)
    far = np.asarray(sim.data.plugins["range_finder"].distance)
    assert np.mean(far < 2.0) < np.mean(found[1] < 2.0)


def test_a_range_finder_measures_at_its_rate():
    sim = Sim(control="attitude")
    sim.add(RangeFinder([[0, 0, -2]], freq=50))
    placed(sim, [[[0, 0, 1]]])
    sim.step(10)
    first = np.asarray(sim.data.plugins["range_finder"].distance).item()
    sim.step(9)
    assert first == pytest.approx(1.0, abs=1e-2)
    last = np.asarray(sim.data.plugins["range_finder"].distance).item()
    assert last == pytest.approx(float(np.asarray(sim.data.states.pos)[0, 0, 2]), abs=0.05)


def test_law_09_wrong_cameras_and_resolutions_are_refused(room):
    sim, _, _ = room
    for act, words in (
        (lambda: sim.depth("nose"), "expected a camera of the scene, track_cam, fpv_cam, got 'nose'"),
        (lambda: sim.depth(99), "got 99"),
        (lambda: sim.depth("fpv_cam", 0, 4), "positive integer width, got 0 x 4 pixels"),
        (lambda: sim.depth("fpv_cam", 4, 4.5), "positive integer height, got 4 x 4.5 pixels"),
        (lambda: sim.depth("fpv_cam", 4, 4, along="z"), "along='ray'"),
        (lambda: sim.add(RangeFinder([[0, 0, 0]])), "none of them zero"),
        (lambda: sim.add(RangeFinder(max_range=0)), "max_range of RangeFinder to be positive"),
        (lambda: sim.add(RangeFinder(freq=333)), "Use the nearest rate below, 250 Hz"),
    ):
        with pytest.raises(ConfigError) as error:
            act()
        assert words in str(error.value)


def test_rays_are_those_of_c_mujoco(room, rng):
    """Many rays in all directions, at what moves, stands, and lies around."""
    from crazysim.scene.ray_casting import cast_rays

    sim, _, box = room
    data = box.set_pose(sim.data, [-1.0, 0.3, 1.2], [0.3, -0.1, 0.5, 0.7])
    n = 400
    origin, direction = rng.uniform([-2, -2, 0.2], [2, 2, 2], (n, 3)), rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    rays = (np.tile(np.float32(x), (2, 1, 1)) for x in (origin, direction))
    hits = jax.jit(lambda data, *rays: cast_rays(sim.scene.visual_model, data, *rays, drones=False))(data, *rays)
    distance = np.asarray(hits.distance)[0]
    sim.scene.sync_one(data, 0)
    group = np.array([1, 1, 0, 0, 0, 0], np.uint8)  # drones are in groups 2 and 3
    geom = np.zeros(1, np.int32)
    met = 0
    for k in range(n):
        far = mujoco.mj_ray(sim.mj_model, sim.mj_data, origin[k], direction[k], group, 1, -1, geom, None)
        if far < 0:
            assert not np.isfinite(distance[k])
        else:
            met += 1
            assert distance[k] == pytest.approx(far, rel=1e-4, abs=1e-4)
    assert 100 < met < n


ALL_KINDS = """<mujoco><asset>
<mesh name="wedge" vertex="0 0 0 .4 0 0 0 .5 0 0 0 .6"/>
<hfield name="hill" nrow="3" ncol="4" size=".5 .4 .3 .1" elevation="0 .2 .1 0 .5 1 .6 .3 0 .4 .2 .1"/></asset>
<worldbody><geom type="sphere" size=".15" pos="0 0 .6"/><geom type="box" size=".1 .2 .3" euler="20 0 40" pos=".6 0 0"/>
<geom type="capsule" size=".1 .3" pos="-.5 .1 .2"/><geom type="cylinder" size=".12 .2" euler="0 30 0" pos="0 .6 .1"/>
<geom type="ellipsoid" size=".1 .2 .3" pos="0 -.6 .1"/><geom type="mesh" mesh="wedge" pos="-.2 -.2 -.5"/>
<geom type="hfield" hfield="hill" pos=".2 .2 -.6"/></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def crowd():
    """Two worlds of two drones among geoms of all kinds, some fixed and some that move."""
    sim = Sim(n_worlds=2, n_drones=2)
    sim.scene.add("box", "fixed", pos=[2, 0, 1], quat=[0.1, 0.2, 0.3, 0.9], size=(0.5, 1.0, 1.5), mocap=False)
    quat = np.random.default_rng(1).normal(size=(2, 1, 4))
    sim.scene.add(ALL_KINDS, "moving", pos=[0, 2, 1], quat=quat)
    placed(sim, [[[0, 0, 1], [0.5, -0.3, 1]]] * 2)
    return sim


def one_by_one(sim, own):
    """Return functions from data and rays to hits: by a kernel, by XLA, and for each world as a stage of it does it."""
    from crazysim.core.stage import Axes
    from crazysim.scene.ray_casting import RayKernels, cast_rays

    model = sim.scene.collision_model
    # Every other geom: compiling the gradients of each world takes long.
    some = tuple(dataclasses.replace(body, geoms=body.geoms[::-1][::2]) for body in model.objects)
    model = dataclasses.replace(model, objects=some)

    def together(data, origin, direction):
        return cast_rays(model, data, origin, direction, own, kernels=RayKernels("cpu", strict=True))

    def by_xla(data, origin, direction):
        return cast_rays(model, data, origin, direction, own)

    def each(data, origin, direction):
        axes = Axes(data)
        over = {"drone": 0, "world": 0}
        one = [x[:, 0] if scope == "world" else x for x, scope in zip(jax.tree.leaves(data), axes.scopes, strict=True)]

        def of_world(leaves, start, along):
            return cast_rays(model, axes.treedef.unflatten(leaves), start, along, own)

        mapped = jax.vmap(of_world, ([over.get(scope) for scope in axes.scopes], 0, 0))
        return mapped(one, origin, direction)

    return together, by_xla, each


def some_rays(rng, n):
    """Return rays from among the geoms, some along axes, some with a negative zero. (2, n, 3) each"""
    origin, direction = rng.uniform([-3, -3, 0.2], [3, 3, 3.5], (2, n, 3)), rng.normal(size=(2, n, 3))
    direction[:, : n // 8] = rng.choice([-1.0, -0.0, 0.0, 1.0], (2, n // 8, 3))
    direction[~direction.any(axis=-1)] = [-0.0, 0, 1]
    at = slice(n // 4, n)
    direction[:, at] = [0, 2, 1] + rng.uniform(-0.7, 0.7, (2, n - n // 4, 3)) - origin[:, at]
    return origin, direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def test_rays_of_all_worlds_are_those_of_each_world(x64, crowd, rng):
    """The kernel of one ray, the same function in XLA, and the stage's loop over bodies: hits and gradients agree."""
    n = 300
    data = jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, crowd.data)
    quat = data.objects.quat / jnp.linalg.norm(data.objects.quat, axis=-1, keepdims=True)
    data = data.replace(objects=data.objects.replace(quat=quat))
    origin, direction = some_rays(rng, n)
    own = np.repeat([-1, 0, 1], n // 3)
    origin[:, own == 1] = data.states.pos[:, 1:2]
    to_drones = np.asarray(data.states.pos)[:, np.arange(40, 100) % 2] - origin[:, 40:100]
    direction[:, 40:100] = to_drones / np.linalg.norm(to_drones, axis=-1, keepdims=True)
    weight, slant = rng.uniform(size=(2, n)), rng.normal(size=(2, n, 3))

    def answer(cast_all):
        def weighed(pos, quat, moved, start, along):
            states = data.states.replace(pos=pos, quat=quat)
            hits = cast_all(data.replace(states=states, objects=data.objects.replace(pos=moved)), start, along)
            lengths = jnp.sum(jnp.where(jnp.isfinite(hits.distance), weight * hits.distance, 0.0))
            return lengths + jnp.sum(slant * hits.normal), hits

        args = data.states.pos, data.states.quat, data.objects.pos, origin, direction
        return jax.jit(jax.value_and_grad(weighed, (0, 1, 2, 3, 4), has_aux=True))(*args)

    by_kernel, by_xla, by_world = one_by_one(crowd, own)
    ((_, together), slopes), ((_, each), expected) = map(answer, (by_kernel, by_world))
    seen = {together.names[k].partition(":")[0] for k in np.unique(together.body_index) if k >= 0}
    assert seen == {"floor", "fixed", "moving", "drone"}
    np.testing.assert_array_equal(together.body_index, each.body_index)
    np.testing.assert_allclose(together.distance, each.distance, rtol=1e-9)
    np.testing.assert_allclose(together.normal, each.normal, atol=1e-9)
    unfused = jax.jit(by_xla)(data, origin, direction)
    for name in ("body_index", "distance", "normal", "point"):
        np.testing.assert_allclose(getattr(unfused, name), getattr(together, name), rtol=1e-9, atol=1e-9)
    far = np.where(np.isfinite(each.distance), each.distance, 0.0)[..., None]
    np.testing.assert_allclose(together.point, np.where(far > 0, origin + far * direction, 0.0), atol=1e-9)
    for slope, known in zip(slopes, expected, strict=True):
        assert np.abs(known).max() > 0.1
        np.testing.assert_allclose(slope, known, rtol=1e-6, atol=1e-8 * np.abs(known).max())


def test_rays_meet_geoms_of_every_kind_where_c_mujoco_has_them(crowd, rng):
    """10,000 rays: distance to 1e-5 of it, normal and body, but for rays that graze a surface or pass by an edge."""
    from crazysim.scene.ray_casting import RayKernels, cast_rays

    n = 10_000
    rays = [x.astype(np.float32) for x in some_rays(rng, n)]
    rays[1][0, :3] = np.nan * np.eye(3)
    model, kernels = crowd.scene.visual_model, RayKernels("cpu", strict=True)
    cast = jax.jit(lambda data, *rays: cast_rays(model, data, *rays, drones=False, kernels=kernels))
    hits = jax.device_get(cast(crowd.data, *rays))
    assert not np.isfinite(hits.distance[0, :3]).any()
    crowd.scene.sync_one(crowd.data, 1)
    mj_model, group = crowd.mj_model, np.array([1, 1, 0, 0, 0, 0], np.uint8)
    origin, direction = (x[1].astype(np.float64) for x in rays)
    far, normal, geoms = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 1), np.int32)
    for k in range(n):
        far[k] = mujoco.mj_ray(mj_model, crowd.mj_data, origin[k], direction[k], group, 1, -1, geoms[k], normal[k])
    far = np.where(far < 0, np.inf, far)
    bodies = [mj_model.body(mj_model.body_rootid[body]).name for body in mj_model.geom_bodyid]
    names = np.array([*("floor" if body == "world" else body for body in bodies), "nothing"])[geoms[:, 0]]
    found = np.array([*hits.names, "nothing"])[hits.body_index[1]]
    differs = (found != names) | ~np.isclose(hits.distance[1], far, rtol=1e-2, atol=0)
    assert differs.mean() < 1e-3, "rays that pass by an edge on the other side of it"
    clear = ~differs & np.isfinite(far) & (np.abs(np.sum(normal * direction, axis=-1)) > 0.05)
    assert clear.mean() > 0.7
    # Coordinates of 4 m have a spacing of 5e-7 m in float32.
    np.testing.assert_allclose(hits.distance[1][clear], far[clear], rtol=1e-5, atol=5e-7)
    # Rounding moves a ray across the edge between two faces, or between the triangles of a height field.
    turned = np.abs(hits.normal[1] - normal)[clear].max(axis=-1) > 1e-3
    assert turned.mean() < 2e-3
    assert len(np.unique(mj_model.geom_type[geoms[clear]])) == 8


@pytest.fixture(scope="module")
def forest():
    """A world of many equal geoms, some fixed and some that move, in front of a camera."""
    sim = Sim(n_drones=2)
    rng = np.random.default_rng(5)
    for what, name, count, options in (
        ("pole", "tree", 60, {"mocap": False}),
        ("sphere", "ball", 50, {"mocap": False, "radius": 0.3}),
        ("box", "crate", 30, {"size": (0.4, 0.3, 0.5)}),
    ):
        pos, quat = rng.uniform([-6, -6, 0.2], [6, 6, 3], (count, 3)), rng.normal(size=(count, 4))
        sim.scene.add(what, name, count=count, pos=pos, quat=quat, **options)
    placed(sim, [[[0, 0, 1.0], [1.5, 0.2, 1.2]]])
    return sim


@pytest.mark.parametrize("platform", [None, "cpu"])
def test_each_of_many_equal_geoms_is_known_by_name(forest, rng, platform):
    """The body that C MuJoCo's ray meets: one of 140, so that an index that is off by one shows."""
    from crazysim.scene.ray_casting import RayKernels, cast_rays

    n, sim = 500, forest
    origin, direction = rng.uniform([-6, -6, 0.2], [6, 6, 3], (n, 3)), rng.normal(size=(n, 3))
    direction[:30] = np.eye(3)[rng.integers(0, 3, 30)] * rng.choice([-1, 1], (30, 1))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    rays = [np.float32(x)[None] for x in (origin, direction)]
    kernels = RayKernels(platform, strict=True)
    hits = jax.jit(lambda data, *rays: cast_rays(sim.scene.visual_model, data, *rays, drones=False, kernels=kernels))(
        sim.data, *rays
    )
    sim.scene.sync_one(sim.data, 0)
    geom, group, met = np.zeros(1, np.int32), np.array([1, 1, 0, 0, 0, 0], np.uint8), set()
    for k in range(n):
        far = mujoco.mj_ray(sim.mj_model, sim.mj_data, origin[k], direction[k], group, 1, -1, geom, None)
        if far < 0:
            assert not np.isfinite(hits.distance[0, k])
            continue
        body = sim.mj_model.body(sim.mj_model.body_rootid[sim.mj_model.geom_bodyid[geom[0]]])
        assert hits.names[hits.body_index[0, k]] == (body.name if body.id else "floor")
        assert hits.distance[0, k] == pytest.approx(far, rel=1e-4, abs=1e-4)
        met.add(body.name)
    assert len(met) > 50
    assert kernels.last_used.startswith("one kernel" if platform else "XLA")


def test_explain_says_what_cast_the_rays_of_an_image(forest):
    forest.depth("fpv_cam", 8, 6)
    line = forest.explain().splitlines()[-1]
    assert line.startswith(
        "rays: one kernel with a lane for each ray; 111 fixed geoms in a hierarchy, 52 movable geoms"
    )


def test_rays_whose_kernel_is_refused_are_cast_by_xla_with_a_warning(monkeypatch):
    """The scene has a mesh for which no cache holds a kernel, because its planes are constants of the kernel."""
    top = 0.5 + np.random.default_rng().uniform() / 2
    wedge = f"""<mujoco><asset><mesh name="wedge" vertex="0 0 0 .4 0 0 0 .5 0 0 0 {top!r}"/></asset>
    <worldbody><geom type="mesh" mesh="wedge"/></worldbody></mujoco>"""
    found = []
    monkeypatch.setenv("CRAZYSIM_COMPILE_TIMEOUT", "1e-6")
    for engine in ("plain", "auto"):
        sim = Sim(engine=engine)
        sim.scene.add(wedge, "wedge", pos=[1, 0, 1])
        placed(sim, [[[0, 0, 1]]])
        if engine == "plain":
            found.append(sim.depth("fpv_cam", 13, 9))
        else:
            with pytest.warns(EngineWarning, match="rays have no kernel: a kernel of .* lines takes .* longer"):
                found.append(sim.depth("fpv_cam", 13, 9))
        assert sim.scene.ray_kernels.last_used.startswith("XLA, without a kernel")
    np.testing.assert_array_equal(*found)
    assert np.min(found) < 2
