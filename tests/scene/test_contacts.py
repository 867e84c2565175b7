"""MJX's contacts against distances from formulas, and against C MuJoCo, in many worlds at once."""

import jax
import mujoco
import numpy as np
import pytest

from crazysim.engine.sharding import world_mesh
from crazysim.sim import Sim
from crazysim.sim.sim import use_box_collision

N_WORLDS = 64
RADIUS, OFFSET = 0.086, np.array([0.0, 0.0, 0.02])  # collision sphere of cf21B_500, in its body frame
BALL, BALL_RADIUS = np.array([0.25, 0.0, 0.3]), 0.15
POLE_RADIUS, POLE_HALF = 0.03, 0.3
OBSTACLES = f"""
<mujoco>
  <worldbody>
    <body name="ball"><geom name="ball" type="sphere" size="{BALL_RADIUS}"/></body>
    <body name="pole"><geom name="pole" type="capsule" size="{POLE_RADIUS} {POLE_HALF}"/></body>
  </worldbody>
</mujoco>
"""


def add_obstacles(sim):
    spec = mujoco.MjSpec.from_string(OBSTACLES)
    frame = sim.spec.worldbody.add_frame()
    frame.attach_body(spec.body("ball"), "", "").pos = BALL
    frame.attach_body(spec.body("pole"), "", "").mocap = True
    sim.build_mjx()


def random_quats(rng, *shape):
    quat = rng.normal(size=(*shape, 4))
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def rotate_vector(quat_xyzw, vector):
    xyz, w = quat_xyzw[..., :3], quat_xyzw[..., 3:]
    t = 2 * np.cross(xyz, vector)
    return vector + w * t + np.cross(xyz, t)


def scatter_poses(sim):
    rng = np.random.default_rng(7)
    pos = rng.uniform([-0.25, -0.25, 0], [0.25, 0.25, 0.5], (sim.n_worlds, sim.n_drones, 3))
    quat = random_quats(rng, sim.n_worlds, sim.n_drones)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.float32(pos), quat=np.float32(quat)))
    pole = sim.mj_model.body("pole").mocapid.item()
    pole_pos = rng.uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 0.6], (sim.n_worlds, 3))
    pole_quat = random_quats(rng, sim.n_worlds)
    mocap_pos, mocap_quat = np.array(sim.mjx_data.mocap_pos), np.array(sim.mjx_data.mocap_quat)
    mocap_pos[:, pole], mocap_quat[:, pole] = pole_pos, np.roll(pole_quat, 1, axis=-1)
    sim.mjx_data = sim.mjx_data.replace(mocap_pos=mocap_pos, mocap_quat=mocap_quat)
    return pos, quat, pole_pos, pole_quat


@pytest.fixture(scope="module")
def scattered_scene():
    sim = Sim(n_worlds=N_WORLDS, n_drones=2)
    add_obstacles(sim)
    return sim, *scatter_poses(sim)


def touching_pairs(sim):
    """Return for every pair of geom names True for the worlds in which it touches."""
    flags = np.asarray(sim.contacts())
    contact = jax.device_get(sim.mjx_data._impl.contact)
    flags_by_pair = {}
    for world in range(sim.n_worlds):
        for slot in range(flags.shape[1]):
            ids = int(contact.geom1[world, slot]), int(contact.geom2[world, slot])
            pair = frozenset(sim.mj_model.geom(i).name for i in ids)
            flags_by_pair.setdefault(pair, np.zeros(sim.n_worlds, bool))[world] |= flags[world, slot]
    return flags_by_pair


def distance_to_segment(point, middle, half):
    """Return the distance from points to segments that reach ``half`` (n, 3) to both sides of their middle."""
    t = np.sum((point - middle) * half, -1) / np.sum(half * half, -1)
    return np.linalg.norm(point - middle - np.clip(t, -1, 1)[:, None] * half, axis=-1)


def test_contacts_of_mocap_bodies_are_not_empty():
    """MJX before 3.12 makes no contacts of mocap bodies: any() of an empty array would pass for no contact."""
    sim = Sim(n_worlds=3)
    contacts = sim.contacts()
    assert contacts.shape == (3, 1)
    assert contacts.dtype == bool
    assert np.asarray(contacts).all(), "a drone that stands on the floor touches it"


def test_geoms_touch_where_their_distance_is_negative(scattered_scene):
    """Every pair of spheres, capsules and floor touches where the distance from its formula is negative."""
    sim, pos, quat, pole_pos, pole_quat = scattered_scene
    spheres = pos + rotate_vector(quat, OFFSET)
    half = rotate_vector(pole_quat, np.array([0.0, 0.0, POLE_HALF]))
    distances = {
        ("col_sphere:0", "col_sphere:1"): np.linalg.norm(spheres[:, 0] - spheres[:, 1], axis=-1) - 2 * RADIUS,
        ("floor", "pole"): pole_pos[:, 2] - np.abs(half[:, 2]) - POLE_RADIUS,
        ("ball", "pole"): distance_to_segment(np.broadcast_to(BALL, (N_WORLDS, 3)), pole_pos, half)
        - POLE_RADIUS
        - BALL_RADIUS,
    }
    for i in range(2):
        sphere = f"col_sphere:{i}"
        distances["floor", sphere] = spheres[:, i, 2] - RADIUS
        distances["ball", sphere] = np.linalg.norm(spheres[:, i] - BALL, axis=-1) - RADIUS - BALL_RADIUS
        distances["pole", sphere] = distance_to_segment(spheres[:, i], pole_pos, half) - RADIUS - POLE_RADIUS

    flags_by_pair = touching_pairs(sim)
    assert set(flags_by_pair) == {frozenset(pair) for pair in distances}
    for pair, distance in distances.items():
        is_clear = np.abs(distance) > 1e-5  # closer cases are undecided in float32
        np.testing.assert_array_equal(
            flags_by_pair[frozenset(pair)][is_clear], distance[is_clear] < 0, err_msg=str(pair)
        )
        assert 3 < np.sum(distance < 0) < N_WORLDS - 3, f"{pair}: both outcomes must occur for this to test anything"


@pytest.mark.long("compiles MJX's contacts of boxes")
def test_boxes_touch_where_c_mujocos_distances_are_negative():
    """With box collision drones touch floor, ball, pole and each other where C MuJoCo's distances are negative."""
    sim = Sim(n_worlds=N_WORLDS, n_drones=2)
    add_obstacles(sim)
    use_box_collision(sim)
    pos, quat, pole_pos, pole_quat = scatter_poses(sim)
    flags_by_pair = touching_pairs(sim)
    pairs = [("col_box:0", "col_box:1"), ("floor", "col_box:0"), ("ball", "col_box:1"), ("pole", "col_box:0")]
    assert {frozenset(pair) for pair in pairs} < set(flags_by_pair)
    assert not any("col_sphere" in name for pair in flags_by_pair for name in pair)

    data, drones = mujoco.MjData(sim.mj_model), np.asarray(sim.data.core.drone_mocap_ids)
    pole = sim.mj_model.body("pole").mocapid.item()
    distances = np.empty((N_WORLDS, len(pairs)))
    for world in range(N_WORLDS):
        data.mocap_pos[drones], data.mocap_pos[pole] = pos[world], pole_pos[world]
        data.mocap_quat[drones] = np.roll(quat[world], 1, -1)
        data.mocap_quat[pole] = np.roll(pole_quat[world], 1)
        mujoco.mj_kinematics(sim.mj_model, data)
        for k, pair in enumerate(pairs):
            a, b = (sim.mj_model.geom(name).id for name in pair)
            distances[world, k] = mujoco.mj_geomDistance(sim.mj_model, data, a, b, 1.0, None)
    for k, pair in enumerate(pairs):
        is_clear = np.abs(distances[:, k]) > 2e-3
        np.testing.assert_array_equal(
            flags_by_pair[frozenset(pair)][is_clear], distances[is_clear, k] < 0, err_msg=f"{pair} {distances[:, k]}"
        )
        assert 3 < np.sum(distances[:, k] < 0) < N_WORLDS - 3

    use_box_collision(sim, False)
    assert {frozenset(("floor", "col_sphere:0")), frozenset(("col_sphere:0", "col_sphere:1"))} <= set(
        touching_pairs(sim)
    )


@pytest.mark.parametrize("body", ["drone:0", "drone:1", "pole", "ball", "world"])
def test_contacts_of_a_body_are_its_own_slots(scattered_scene, body):
    """Contacts of a body keep the slots of its geoms and clear the others, in every world."""
    sim = scattered_scene[0]
    sim.contacts()  # the first sync determines the geoms of each slot
    contact = jax.device_get(sim.mjx_data._impl.contact)
    bodies = sim.mj_model.geom_bodyid[np.stack([contact.geom1, contact.geom2])]
    belongs_to_body = (bodies == sim.mj_model.body(body).id).any(0)
    assert 0 < belongs_to_body.sum() < belongs_to_body.size
    np.testing.assert_array_equal(sim.contacts(body), np.asarray(sim.contacts()) & belongs_to_body)


def test_worlds_on_two_devices_have_the_same_contacts(scattered_scene):
    """Contacts on two devices equal those on one, whether sharded at construction or later, after poles have moved."""
    expected = np.asarray(scattered_scene[0].contacts())
    mesh = world_mesh(jax.devices()[:2])
    built_on_mesh = Sim(n_worlds=N_WORLDS, n_drones=2, mesh=mesh)
    add_obstacles(built_on_mesh)
    scatter_poses(built_on_mesh)
    np.testing.assert_array_equal(built_on_mesh.contacts(), expected)
    assert len(built_on_mesh.contacts().sharding.device_set) == 2

    sharded_later = Sim(n_worlds=N_WORLDS, n_drones=2)
    add_obstacles(sharded_later)
    scatter_poses(sharded_later)
    sharded_later.shard(mesh)
    np.testing.assert_array_equal(sharded_later.contacts(), expected)
    assert len(sharded_later.mjx_data.mocap_pos.sharding.device_set) == 2


def test_a_large_swarm_keeps_the_nearest_pairs():
    """With 64 drones there are fewer slots than pairs; drones that touch are among the nearest, so they keep a slot."""
    sim = Sim(n_worlds=1, n_drones=64)
    pos = np.asarray(sim.data.states.pos).copy()
    pos[..., 2] = 1.0
    pos[0, 40] = pos[0, 41] + [0.1, 0, 0]
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    contacts = np.asarray(sim.contacts())
    assert contacts.shape[1] < 64 * 63 // 2
    assert contacts.sum() == 1
    assert np.asarray(sim.contacts("drone:40")).sum() == 1
    assert np.asarray(sim.contacts("drone:41")).sum() == 1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("mocap_pos", np.zeros((3, 3)), r"of shape \(64, 3, 3\) .*, got \(3, 3\)"),
        ("mocap_quat", np.zeros((64, 2, 4)), r"of shape \(64, 3, 4\) .*, got \(64, 2, 4\)"),
        ("mocap_pos", np.full((64, 3, 3), np.nan), "expected finite numbers"),
    ],
)
def test_invalid_poses_are_refused(scattered_scene, name, value, message):
    """Poses without a world axis, for another number of bodies, or not finite raise, and change nothing."""
    sim = scattered_scene[0]
    before = sim.mjx_data
    with pytest.raises(ValueError, match=message):
        sim.mjx_data = sim.mjx_data.replace(**{name: value})
    assert sim.mjx_data is before


def test_poses_may_be_numpy_arrays_of_any_dtype(scattered_scene):
    """Positions written as integers or float64 are cast; drones do not snap to whole metres."""
    sim, pos, _quat, *_ = scattered_scene
    expected = np.asarray(sim.contacts())
    mocap_pos, mjx_data = np.asarray(sim.mjx_data.mocap_pos), sim.mjx_data
    sim.mjx_data = mjx_data.replace(mocap_pos=np.rint(mocap_pos).astype(int))
    sim.contacts()
    np.testing.assert_allclose(np.asarray(sim.mjx_data.mocap_pos)[:, sim.data.core.drone_mocap_ids], pos, rtol=1e-6)
    sim.mjx_data = sim.mjx_data.replace(mocap_pos=mocap_pos.astype(np.float64))
    np.testing.assert_array_equal(sim.contacts(), expected)
