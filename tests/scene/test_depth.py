"""Depth cameras and range finders against formulas, C MuJoCo's rays and its depth images."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import with_states

from crazysim import ConfigError, RangeFinder, Sim, SlungLoad
from crazysim.engine.backends import native
from crazysim.errors import EngineWarning
from crazysim.scene.ray_casting import FLOOR_CLEARANCE, MIN_COSINE, raise_to_floor

WIDTH, HEIGHT, FOVY = 24, 16, 70.0
HIT_FIELDS = ("body_index", "distance", "normal", "point")


@pytest.fixture(scope="module")
def room():
    sim = Sim(n_worlds=2, n_drones=2, control="attitude")
    sim.scene.add("wall", pos=[3, 0, 0], length=20, height=20, mocap=False)
    ball = sim.scene.add("sphere", pos=[1.5, 0.2, 1.1], radius=0.2)
    box = sim.scene.add("box", pos=[0, 0, -50], size=(0.2, 0.4, 0.3))
    sim.data = with_states(sim.data, pos=[[[0, 0, 1], [0.5, -0.3, 1]]] * 2)
    return sim, ball, box


@pytest.fixture(scope="module")
def front_depth(room):
    """Return a function from data to hits of the first drone's camera, other drones left out."""
    return jax.jit(room[0].scene.depth_fn("fpv_cam:0", WIDTH, HEIGHT, drones=False, along="ray"))


def test_depth_follows_the_objects_of_each_world(room, front_depth):
    sim, _, box = room
    data = box.set_pose(sim.data, np.array([[[1.0, 0, 1.0]], [[0, 0, -50.0]]]))
    hits = front_depth(data)
    n_pixels = (np.asarray(hits.body_index) == hits.names.index("box:0")).reshape(2, -1).sum(axis=1)
    assert n_pixels[0] > 20
    assert n_pixels[1] == 0


@functools.cache
def compiled_depth(sim, camera, hide_own):
    """Return a compiled function from data to hits of the rays of a camera, 96 by 64 pixels."""
    return jax.jit(sim.scene.depth_fn(camera, 96, 64, hide_own=hide_own))


def test_a_drone_sees_other_drones_but_not_itself(room):
    """The second drone flies in front of the first, to the right, and sees no other drone."""
    sim, _, _ = room
    hits, hits_with_own, hits_without_own = (
        jax.device_get(compiled_depth(sim, camera, hide_own)(sim.data))
        for camera, hide_own in (("fpv_cam", True), ("track_cam:1", False), ("track_cam:1", True))
    )
    first = hits.names.index("drone:0")
    assert not (hits.body_index[:, 1] >= first).any()
    others = hits.body_index[0, 0] == first + 1
    assert not (hits.body_index[:, 0] == first).any()
    assert 4 < others.sum() < 400
    assert np.argwhere(others)[:, 1].min() > 48, "a drone at -y is in the right half"
    assert (hits_with_own.body_index[0, 0] == first + 1).sum() > 8
    assert not (hits_without_own.body_index[0, 0] == first + 1).any()


def test_law_09_data_of_one_drone_has_no_image(room):
    sim = room[0]
    data_of_one_drone = sim.data.replace(states=jax.tree.map(lambda x: x[0, 0], sim.data.states))
    with pytest.raises(ConfigError, match="expected data of all worlds or of one world for images, got data of one dr"):
        sim.scene.depth_fn()(data_of_one_drone)


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("cameras, camera, hide_own", [
    ("fpv_cam", "fpv_cam:0", True), ("track_cam:1", "track_cam:1", False),
])  # fmt: skip
def test_depth_equals_the_depth_of_mujocos_renderer(room, cameras, camera, hide_own):
    """Images equal those of MuJoCo's renderer at any attitude, except at edges and on half-transparent geoms."""
    sim, _, box = room
    original_data = sim.data
    rng = np.random.default_rng(2)
    quat = [0, 0, 0, 1] + 0.2 * rng.normal(size=(2, 2, 4))
    sim.data = with_states(sim.data, quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True))
    sim.data = box.set_pose(sim.data, [1.0, -0.4, 0.8], [0.1, 0.2, 0.3, 0.9])
    for world in range(2):
        picture = sim.render("depth_array", world, camera, width=96, height=64)
        depth = np.asarray(compiled_depth(sim, cameras, hide_own)(sim.data).distance)[world, 0]
        is_hit_in_both = np.isfinite(depth) & (picture < 50)
        assert is_hit_in_both.mean() > 0.5
        is_wrong = np.abs(depth - picture)[is_hit_in_both] > 0.01 * picture[is_hit_in_both]
        assert is_wrong.mean() < 0.1
        assert np.median(np.abs(depth - picture)[is_hit_in_both]) < 1e-3
    sim.data = original_data


def test_cameras_of_an_mjcf_on_the_world_and_on_an_object(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text("""<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
      <camera name="down" pos="0 0 2" fovy="40"/></worldbody></mujoco>""")
    sim = Sim(n_worlds=2, xml_path=path)
    tower = sim.scene.add(
        "<mujoco><worldbody><geom type='sphere' size='.05'/><camera name='eye' fovy='40'/></worldbody></mujoco>",
        "tower", pos=np.array([[[5, 0, 1.0]], [[5, 0, 3.0]]]),
    )  # fmt: skip
    np.testing.assert_allclose(sim.depth("down", 4, 4, drones=False), 2.0, rtol=1e-5)
    depth = sim.depth("tower:0/eye", 4, 4)  # from inside the ball, whose surface rays meet as they leave it
    np.testing.assert_allclose(depth, 0.05, rtol=0.1)
    sim.data = tower.set_pose(sim.data, [5, 0, 0.02])
    assert (np.asarray(sim.depth("tower:0/eye", 4, 4))[:, 0, 1:3, 1:3] < 0.03).all()


def test_the_gradient_of_depth_points_away_from_the_wall(room):
    sim, _, _ = room
    depth = sim.scene.depth_fn("fpv_cam:0", 4, 4, drones=False)

    def depth_of_pixel(x):
        pos = sim.data.states.pos + jnp.array([1.0, 0, 0]) * x
        return depth(sim.data.replace(states=sim.data.states.replace(pos=pos))).distance[0, 0, 0, 3]

    assert float(jax.jit(jax.grad(depth_of_pixel))(0.0)) == pytest.approx(-1.0, abs=1e-5)


def test_a_range_finder_measures_in_a_step():
    sim = Sim(n_worlds=2, n_drones=2, control="attitude")
    sim.scene.add("wall", pos=[2, 0, 0], length=8, height=8)
    sim.scene.add("sphere", pos=[0, 1.2, 1.0], radius=0.2)
    sim.add(RangeFinder(max_range=3.0, drones=True))
    sim.data = with_states(sim.data, pos=[[[0, 0, 1], [0, -1, 1]], [[1, 0, 2], [1, -0.5, 5]]], quat=[0, 0, 0, 1.0])
    sim.step()
    distance = np.asarray(sim.data.plugins["range_finder"].distance)
    names = list(RangeFinder.MULTI_RANGER)
    z = np.asarray(sim.data.states.pos)[..., 2]
    np.testing.assert_allclose(distance[..., names.index("down")], np.minimum(z, 3.0), atol=1e-4)
    np.testing.assert_allclose(distance[..., names.index("front")], [[1.975, 1.975], [0.975, 0.975]], atol=1e-4)
    np.testing.assert_allclose(distance[..., names.index("back")], 3.0)
    np.testing.assert_allclose(distance[0, 0, names.index("left")], 1.0, atol=1e-4)
    assert distance[0, 0, names.index("right")] < 1.0  # the other drone
    assert distance[1, 0, names.index("right")] == 3.0
    assert "not fused" not in sim.explain()


def test_rays_in_a_step_meet_loads_at_their_present_poses():
    """No image is drawn after the load and its drone move. The rod, which begins at the drone, is not measured."""
    sim = Sim(n_worlds=2, control="rotor_vel")
    load = sim.add(SlungLoad(mass=0.005, length=0.5, size=0.1))
    sim.add(RangeFinder([[0, 0, -1], [1, 0, 0]], max_range=3.0))
    sim.sync(0)
    sim.data = with_states(sim.data, pos=[[[0, 0, 2]], [[5, 5, 2]]])
    sim.data = load.hang(sim.data)
    sim.step()
    distance = np.asarray(sim.data.plugins["range_finder"].distance)
    np.testing.assert_allclose(distance, [[[0.4, 3.0]]] * 2, atol=1e-3)
    assert "not fused" not in sim.explain()
    depth = jax.jit(sim.scene.depth_fn(sim.mj_model.cam("fpv_cam:0").id, 3, 3, drones=False))
    new_load_pos = np.asarray(sim.data.states.pos) + np.float32([1.1, 0, 0])
    moved_data = load.write(sim.data, load.read(sim.data).replace(pos=new_load_pos))
    depth_of_record, depth_of_moved_objects = (
        np.asarray(depth(d).distance)[:, 0, 1, 1] for d in (moved_data, sim.plugins.with_moved_objects(moved_data))
    )
    np.testing.assert_allclose(depth_of_record, depth_of_moved_objects)
    assert np.all(depth_of_record < 1.1)


def test_a_range_finder_finds_the_first_of_many_objects(x64, rng):
    """One kernel computes the distances of C MuJoCo's rays, and another the gradients of central differences."""
    n = 16
    sim = Sim(n, control="rotor_vel", engine="fused", strict=True)
    pos, quat = rng.uniform([-3, -3, 0.2], [3, 3, 2], (40, 3)), rng.normal(size=(40, 4))
    sim.scene.add("pole", count=20, pos=pos[:20], quat=quat[:20], mocap=False)
    sim.scene.add("box", count=20, pos=pos[20:], quat=quat[20:], size=(0.8, 0.6, 1.0), mocap=False)
    directions = np.array([[1.0, 0.2, -0.1], [-0.6, 0.8, 0.0]]) / np.sqrt([[1.05], [1.0]])
    sim.add(RangeFinder(directions, max_range=2.5))
    sim.data = jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, sim.data)
    start = rng.uniform([-2, -2, 0.5], [2, 2, 1.5], (n, 1, 3))
    step, weight = sim.build_step_fn(), rng.uniform(size=(n, 1, 2))

    @jax.jit
    def weighted_distance(pos):
        data = step(sim.data.replace(states=sim.data.states.replace(pos=pos)), 2)
        distances = data.plugins["range_finder"].distance
        return jnp.sum(weight * distances), (distances, data.states.pos)

    gradient, (distance, pos_in_step) = jax.jit(jax.grad(weighted_distance, has_aux=True))(start)
    assert "gradient: one kernel" in sim.explain()
    group, geom = np.array([1, 1, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    sim.scene.sync_one(sim.data, 0)
    rays = [(w, k) for w in range(n) for k in range(2)]
    expected = [
        mujoco.mj_ray(sim.mj_model, sim.mj_data, pos_in_step[w, 0], directions[k], group, 1, -1, geom, None)
        for w, k in rays
    ]
    expected = np.array([x if 0 <= x < 2.5 else 2.5 for x in expected])
    assert 8 < np.sum(expected < 2.5) < 28
    # MuJoCo's compiler rounds sizes and poses of the scene to 1e-9 at most.
    np.testing.assert_allclose(np.asarray(distance).reshape(-1), expected, atol=1e-7)
    h = 1e-6  # the third derivative of the distance to a pole costs some h^2 = 1e-12, rounding 1e-16 / h
    for k, shift in enumerate(h * np.eye(3)):
        sums = [np.sum(weight * np.asarray(weighted_distance(start + sign * shift)[1][0]), axis=-1) for sign in (1, -1)]
        np.testing.assert_allclose(gradient[..., k], (sums[0] - sums[1]) / (2 * h), atol=1e-7)


def test_a_range_finder_measures_at_its_rate():
    sim = Sim(control="attitude")
    sim.add(RangeFinder([[0, 0, -2]], freq=50))
    sim.data = with_states(sim.data, pos=[[[0, 0, 1]]])
    sim.step(10)
    first = np.asarray(sim.data.plugins["range_finder"].distance).item()
    sim.step(9)
    assert first == pytest.approx(1.0, abs=1e-2)
    last = np.asarray(sim.data.plugins["range_finder"].distance).item()
    assert last == pytest.approx(float(np.asarray(sim.data.states.pos)[0, 0, 2]), abs=0.05)


ALL_KINDS = """<mujoco><asset>
<mesh name="wedge" vertex="0 0 0 .4 0 0 0 .5 0 0 0 .6"/>
<hfield name="hill" nrow="3" ncol="4" size=".5 .4 .3 .1" elevation="0 .2 .1 0 .5 1 .6 .3 0 .4 .2 .1"/></asset>
<worldbody><geom type="sphere" size=".15" pos="0 0 .6"/><geom type="box" size=".1 .2 .3" euler="20 0 40" pos=".6 0 0"/>
<geom type="capsule" size=".1 .3" pos="-.5 .1 .2"/><geom type="cylinder" size=".12 .2" euler="0 30 0" pos="0 .6 .1"/>
<geom type="ellipsoid" size=".1 .2 .3" pos="0 -.6 .1"/><geom type="mesh" mesh="wedge" pos="-.2 -.2 -.5"/>
<geom type="hfield" hfield="hill" pos=".2 .2 -.6"/>
<geom type="plane" size=".4 .3 .1" pos=".5 .3 .9" euler="160 10 0" contype="0" conaffinity="0"/></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def mixed_scene():
    sim = Sim(n_worlds=2, n_drones=2)
    sim.scene.add("box", "fixed", pos=[2, 0, 1], quat=[0.1, 0.2, 0.3, 0.9], size=(0.5, 1.0, 1.5), mocap=False)
    quat = np.random.default_rng(1).normal(size=(2, 1, 4))
    sim.scene.add(ALL_KINDS, "moving", pos=[0, 2, 1], quat=quat)
    sim.data = with_states(sim.data, pos=[[[0, 0, 1], [0.5, -0.3, 1]]] * 2)
    return sim


def cast_functions(sim, own):
    """Return functions from data and rays to hits: by a kernel, and by XLA for each world as in a stage."""
    from crazysim.engine.stage import Axes
    from crazysim.scene.ray_casting import RayKernels, cast_rays

    model = sim.scene.collision_model
    # Every other geom: compiling the loop over those of each world takes long.
    objects = tuple(dataclasses.replace(body, geoms=body.geoms[::-1][::2]) for body in model.objects)
    model = dataclasses.replace(model, objects=objects)

    def cast_by_kernel(data, origin, direction):
        return cast_rays(model, data, origin, direction, own, kernels=RayKernels("cpu", strict=True))

    def cast_in_each_world(data, origin, direction):
        axes = Axes(data)
        batch_axes = {"drone": 0, "world": 0}
        leaves_of_drone = [
            x[:, 0] if scope == "world" else x for x, scope in zip(jax.tree.leaves(data), axes.scopes, strict=True)
        ]

        def cast_in_world(leaves, origin_in_world, direction_in_world):
            return cast_rays(model, axes.treedef.unflatten(leaves), origin_in_world, direction_in_world, own)

        mapped = jax.vmap(cast_in_world, ([batch_axes.get(scope) for scope in axes.scopes], 0, 0))
        return mapped(leaves_of_drone, origin, direction)

    return cast_by_kernel, cast_in_each_world


def draw_rays(rng, n):
    """Return rays that start among the geoms, some along axes, some with a negative zero. (2, n, 3) each"""
    origin, direction = rng.uniform([-3, -3, 0.2], [3, 3, 3.5], (2, n, 3)), rng.normal(size=(2, n, 3))
    direction[:, : n // 8] = rng.choice([-1.0, -0.0, 0.0, 1.0], (2, n // 8, 3))
    direction[~direction.any(axis=-1)] = [-0.0, 0, 1]
    targeted = slice(n // 4, n)
    direction[:, targeted] = [0, 2, 1] + rng.uniform(-0.7, 0.7, (2, n - n // 4, 3)) - origin[:, targeted]
    return origin, direction / np.linalg.norm(direction, axis=-1, keepdims=True)


@pytest.mark.long("compiles rays in a stage, and a kernel with its gradient")
def test_rays_of_all_worlds_equal_those_of_each_world(x64, mixed_scene, rng):
    """Hits agree in the kernel and in the loop over bodies of a stage. Gradients of the kernel are slopes of its
    results."""
    n = 300
    data = jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, mixed_scene.data)
    quat = data.objects.quat / jnp.linalg.norm(data.objects.quat, axis=-1, keepdims=True)
    data = data.replace(objects=data.objects.replace(quat=quat))
    origin, direction = draw_rays(rng, n)
    own = np.repeat([-1, 0, 1], n // 3)
    origin[:, own == 1] = data.states.pos[:, 1:2]
    to_drones = np.asarray(data.states.pos)[:, np.arange(40, 100) % 2] - origin[:, 40:100]
    direction[:, 40:100] = to_drones / np.linalg.norm(to_drones, axis=-1, keepdims=True)
    weight, slant = rng.uniform(size=(2, n)), rng.normal(size=(2, n, 3))

    by_kernel, by_world = cast_functions(mixed_scene, own)

    def weighted_sum(pos, quat, object_pos, object_quat, ray_origin, ray_direction):
        states = data.states.replace(pos=pos, quat=quat)
        moved_data = data.replace(states=states, objects=data.objects.replace(pos=object_pos, quat=object_quat))
        hits = by_kernel(moved_data, ray_origin, ray_direction)
        is_steep = jnp.abs(jnp.sum(hits.normal * ray_direction, axis=-1)) > MIN_COSINE
        lengths = jnp.sum(jnp.where(is_steep, weight * hits.distance, 0.0))
        return lengths + jnp.sum(slant * hits.normal), hits

    args = data.states.pos, data.states.quat, data.objects.pos, data.objects.quat, origin, direction
    value_and_gradients = jax.jit(jax.value_and_grad(weighted_sum, range(len(args)), has_aux=True))
    (_, kernel_hits), gradients = value_and_gradients(*args)
    hit_kinds = {kernel_hits.names[k].partition(":")[0] for k in np.unique(kernel_hits.body_index) if k >= 0}
    assert hit_kinds == {"floor", "fixed", "moving", "drone"}
    hits = jax.jit(lambda *args: [getattr(by_world(*args), name) for name in HIT_FIELDS])(data, origin, direction)
    for name, x in zip(HIT_FIELDS, hits, strict=True):
        np.testing.assert_allclose(getattr(kernel_hits, name), x, rtol=1e-9, atol=1e-9, err_msg=name)
    h = 1e-6
    for k, gradient in enumerate(gradients):
        assert np.abs(gradient).max() > 0.1
        shift = rng.normal(size=gradient.shape)
        if k == 5:
            shift[:, : n // 8] = 0  # along axes, parallel to the floor
        shifted = ((*args[:k], args[k] + sign * h * shift, *args[k + 1 :]) for sign in (1, -1))
        sums = [value_and_gradients(*x)[0][0] for x in shifted]
        np.testing.assert_allclose(np.sum(gradient * shift), (sums[0] - sums[1]) / (2 * h), rtol=1e-6, err_msg=k)


def test_rays_hit_geoms_of_every_kind_where_rays_of_c_mujoco_do(mixed_scene, rng):
    """Distance to 1e-5, normal and body of 10,000 rays, except rays that graze a surface or pass an edge."""
    from crazysim.scene.ray_casting import RayKernels, cast_rays

    n = 10_000
    rays = [x.astype(np.float32) for x in draw_rays(rng, n)]
    rays[1][0, :3] = np.nan * np.eye(3)
    model, kernels = mixed_scene.scene.visual_model, RayKernels("cpu", strict=True)
    cast = jax.jit(lambda data, *rays: cast_rays(model, data, *rays, drones=False, kernels=kernels))
    hits = jax.device_get(cast(mixed_scene.data, *rays))
    assert not np.isfinite(hits.distance[0, :3]).any()
    mixed_scene.scene.sync_one(mixed_scene.data, 1)
    mj_model, group = mixed_scene.mj_model, np.array([1, 1, 0, 0, 0, 0], np.uint8)
    origin, direction = (x[1].astype(np.float64) for x in rays)
    expected_distance, normal, geoms = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 1), np.int32)
    for k in range(n):
        expected_distance[k] = mujoco.mj_ray(
            mj_model, mixed_scene.mj_data, origin[k], direction[k], group, 1, -1, geoms[k], normal[k]
        )
    expected_distance = np.where(expected_distance < 0, np.inf, expected_distance)
    bodies = [mj_model.body(mj_model.body_rootid[body]).name for body in mj_model.geom_bodyid]
    names = np.array([*("floor" if body == "world" else body for body in bodies), "nothing"])[geoms[:, 0]]
    hit_names = np.array([*hits.names, "nothing"])[hits.body_index[1]]
    differs = (hit_names != names) | ~np.isclose(hits.distance[1], expected_distance, rtol=1e-2, atol=0)
    assert differs.mean() < 1e-3, "rays that pass an edge on its other side"
    is_comparable = ~differs & np.isfinite(expected_distance) & (np.abs(np.sum(normal * direction, axis=-1)) > 0.05)
    assert is_comparable.mean() > 0.7
    # Coordinates of 4 m have a spacing of 5e-7 m in float32.
    np.testing.assert_allclose(hits.distance[1][is_comparable], expected_distance[is_comparable], rtol=1e-5, atol=5e-7)
    # Rounding moves a ray across the edge between two faces, or between the triangles of a height field.
    has_other_normal = np.abs(hits.normal[1] - normal)[is_comparable].max(axis=-1) > 1e-3
    assert has_other_normal.mean() < 2e-3
    assert len(np.unique(mj_model.geom_type[geoms[is_comparable]])) == 8


def test_sensors_are_raised_to_a_finite_floor_where_it_is(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text('<mujoco><worldbody><geom type="plane" size="1 0 .1"/></worldbody></mujoco>')
    model = Sim(xml_path=path).scene.visual_model
    pos = jnp.array([[0.9, 50, -0.005], [1.1, 0, -0.005], [0.9, 0, -0.2]])
    height = raise_to_floor(model, pos)[:, 2]  # to the rounding of the sum
    np.testing.assert_allclose(height, [FLOOR_CLEARANCE, -0.005, -0.2], rtol=1e-6, atol=1e-9)


@pytest.fixture(scope="module")
def forest():
    sim = Sim(n_drones=2)
    rng = np.random.default_rng(5)
    for primitive, name, count, options in (
        ("pole", "tree", 60, {"mocap": False}),
        ("sphere", "ball", 50, {"mocap": False, "radius": 0.3}),
        ("box", "crate", 30, {"size": (0.4, 0.3, 0.5)}),
    ):
        pos, quat = rng.uniform([-6, -6, 0.2], [6, 6, 3], (count, 3)), rng.normal(size=(count, 4))
        sim.scene.add(primitive, name, count=count, pos=pos, quat=quat, **options)
    sim.data = with_states(sim.data, pos=[[[0, 0, 1.0], [1.5, 0.2, 1.2]]])
    return sim


@pytest.mark.parametrize("platform", [None, "cpu"])
def test_rays_return_the_right_one_of_many_equal_geoms(forest, rng, platform):
    """Rays hit the same one of 140 bodies as rays of C MuJoCo do, so the test finds an index that is off by one."""
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
    geom, group, hit_names = np.zeros(1, np.int32), np.array([1, 1, 0, 0, 0, 0], np.uint8), set()
    for k in range(n):
        expected = mujoco.mj_ray(sim.mj_model, sim.mj_data, origin[k], direction[k], group, 1, -1, geom, None)
        if expected < 0:
            assert not np.isfinite(hits.distance[0, k])
            continue
        body = sim.mj_model.body(sim.mj_model.body_rootid[sim.mj_model.geom_bodyid[geom[0]]])
        assert hits.names[hits.body_index[0, k]] == (body.name if body.id else "floor")
        assert hits.distance[0, k] == pytest.approx(expected, rel=1e-4, abs=1e-4)
        hit_names.add(body.name)
    assert len(hit_names) > 50
    assert kernels.last_used.startswith("one kernel" if platform else "XLA")


def test_rays_whose_kernel_is_refused_are_cast_by_xla_with_a_warning(monkeypatch):
    """The scene has a mesh for which no cache holds a kernel, because its planes are constants of the kernel."""
    top = 0.5 + np.random.default_rng().uniform() / 2
    wedge = f"""<mujoco><asset><mesh name="wedge" vertex="0 0 0 .4 0 0 0 .5 0 0 0 {top!r}"/></asset>
    <worldbody><geom type="mesh" mesh="wedge"/></worldbody></mujoco>"""
    depths = []
    native.toolchain(tuple(native.compiler_command()))  # asks the compiler for its version, which has the same limit
    monkeypatch.setenv("CRAZYSIM_COMPILE_TIMEOUT", "1e-6")
    for engine in ("plain", "auto"):
        sim = Sim(engine=engine)
        sim.scene.add(wedge, "wedge", pos=[1, 0, 1])
        sim.data = with_states(sim.data, pos=[[[0, 0, 1]]])
        if engine == "plain":
            depths.append(sim.depth("fpv_cam", 13, 9))
        else:
            with pytest.warns(EngineWarning, match="rays have no kernel: a kernel of .* lines takes .* longer"):
                depths.append(sim.depth("fpv_cam", 13, 9))
        assert sim.scene.ray_kernels.last_used.startswith("XLA, without a kernel")
    np.testing.assert_array_equal(*depths)
    assert np.min(depths) < 2
