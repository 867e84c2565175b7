"""A sync writes the poses in SimData, and the transforms that MuJoCo computes from them; nothing else."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from crazysim.scene.sync import sync_one_world, sync_poses
from crazysim.sim import Sim
from crazysim.sim.sim import sync_sim2mjx

TOWER = """
<mujoco>
  <worldbody>
    <body name="tower">
      <geom type="capsule" size="0.05 0.3"/>
      <body name="arm" pos="0 0.2 0.3" euler="30 0 0">
        <geom type="sphere" size="0.04" pos="0.1 0 0"/>
        <camera name="lookout" pos="0 0 0.1" euler="90 0 0"/>
        <camera name="com" mode="trackcom" pos="-1 0 0.3"/>
        <light name="beacon" pos="0 0 0.2" dir="1 0 0"/>
        <body name="hand" pos="0.2 0.1 0" euler="0 0 40">
          <geom type="box" size="0.02 0.03 0.04" pos="0 0 0.1" euler="10 20 0"/>
          <site name="palm" pos="0.01 0.02 0.03" euler="0 50 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SHELF = """
<mujoco>
  <worldbody>
    <body name="shelf" pos="1 2 0" euler="0 0 20">
      <geom type="box" size="0.5 0.2 0.02"/>
      <body name="cup" pos="0 0 0.1" euler="15 0 0">
        {joint}
        <geom type="sphere" size="0.03" pos="0.1 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
DERIVED = (
    *("xpos", "xquat", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos"),
    "cam_xmat",
)
"""Fields of MuJoCo's data that a sync computes from the poses."""


JOINT = '<joint type="hinge"/>'


@pytest.fixture(scope="module", params=["", JOINT], ids=["fixed", "joint"])
def sim(request):
    """Return three worlds with two drones and a tower, all at random poses, and a shelf; mjx_data moves the tower."""
    sim = Sim(n_worlds=3, n_drones=2)
    shelf = mujoco.MjSpec.from_string(SHELF.format(joint=request.param))
    sim.spec.worldbody.add_frame().attach_body(shelf.body("shelf"), "", "")
    tower = sim.spec.worldbody.add_frame().attach_body(mujoco.MjSpec.from_string(TOWER).body("tower"), "", "")
    tower.mocap = True
    sim.build_mjx()
    rng = np.random.default_rng(3)
    pos, quat = rng.normal(size=(3, 2, 3)), rng.normal(size=(3, 2, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.float32(pos), quat=np.float32(quat)))
    tower_quat = rng.normal(size=(3, 4))
    tower_quat /= np.linalg.norm(tower_quat, axis=-1, keepdims=True)
    tower = sim.mj_model.body("tower").mocapid.item()
    mocap_pos, mocap_quat = np.array(sim.mjx_data.mocap_pos), np.array(sim.mjx_data.mocap_quat)
    mocap_pos[:, tower], mocap_quat[:, tower] = rng.normal(size=(3, 3)), tower_quat
    sim.mjx_data = sim.mjx_data.replace(mocap_pos=mocap_pos, mocap_quat=mocap_quat)
    return sim


@pytest.fixture(scope="module")
def synced_data(sim):
    data, mjx_data = sync_sim2mjx(sim.data, sim.mjx_data, sim.mjx_model)
    return data, jax.device_get(mjx_data)


def c_mujoco_state(sim, world):
    data = mujoco.MjData(sim.mj_model)
    pos, quat = np.asarray(sim.data.states.pos)[world], np.asarray(sim.data.states.quat)[world]
    for i in range(sim.n_drones):
        k = sim.mj_model.body(f"drone:{i}").mocapid.item()
        x, y, z, w = quat[i]
        data.mocap_pos[k], data.mocap_quat[k] = pos[i], (w, x, y, z)
    k = sim.mj_model.body("tower").mocapid.item()
    data.mocap_pos[k] = np.asarray(sim.mjx_data.mocap_pos)[world, k]
    data.mocap_quat[k] = np.asarray(sim.mjx_data.mocap_quat)[world, k]
    mujoco.mj_kinematics(sim.mj_model, data)
    mujoco.mj_comPos(sim.mj_model, data)
    mujoco.mj_camlight(sim.mj_model, data)
    return data


@pytest.mark.long("compiles MJX's kinematics, for the tests after it")
@pytest.mark.parametrize("world", range(3))
def test_every_transform_equals_that_of_c_mujoco(sim, synced_data, world):
    """Bodies, geoms and cameras of every world have the poses of C MuJoCo, with quaternions as wxyz."""
    _, mjx_data = synced_data
    expected = c_mujoco_state(sim, world)
    for name in DERIVED:
        value = getattr(mjx_data, name)[world].reshape(getattr(expected, name).shape)
        np.testing.assert_allclose(value, getattr(expected, name), atol=2e-6, err_msg=name)


@pytest.mark.parametrize("world", range(3))
def test_a_world_to_draw_equals_that_of_c_mujoco(sim, world):
    """The sync of one world for an image gives the same poses, and the lights, without MJX."""
    expected = c_mujoco_state(sim, world)
    data = mujoco.MjData(sim.mj_model)
    poses = tuple(np.asarray(getattr(sim.mjx_data, name))[[world]] for name in ("mocap_pos", "mocap_quat", "qpos"))
    sync_one_world(sim.data, world, poses, sim.mj_model, data)
    for name in (*DERIVED, "light_xpos", "light_xdir"):
        np.testing.assert_allclose(getattr(data, name), getattr(expected, name), atol=1e-6, err_msg=name)


def test_a_sync_leaves_bodies_of_users_unchanged(sim, synced_data):
    """Poses of attached bodies, and positions and velocities of joints, stay as they were."""
    _, mjx_data = synced_data
    tower = sim.mj_model.body("tower").mocapid.item()
    for name in ("mocap_pos", "mocap_quat"):
        before = np.asarray(getattr(sim.mjx_data, name))[:, tower]
        np.testing.assert_array_equal(getattr(mjx_data, name)[:, tower], before)
    for name in ("qpos", "qvel", "ctrl", "time", "act", "xfrc_applied"):
        np.testing.assert_array_equal(getattr(mjx_data, name), getattr(sim.mjx_data, name), err_msg=name)


@pytest.mark.long("compiles MJX's kinematics and contacts in a scan")
@pytest.mark.parametrize("sim", [JOINT], ids=["joint"], indirect=True)
def test_a_sync_works_in_jit_and_scan(sim, synced_data):
    """In jit and scan a sync has the same result, so that rollouts may query contacts at every step."""

    @jax.jit
    def sync_twice(data, mjx_data):
        def body(carry, _):
            data, mjx_data = sync_sim2mjx(*carry, sim.mjx_model)
            return (data, mjx_data), mjx_data._impl.contact.dist

        return jax.lax.scan(body, (data, mjx_data), length=2)

    (data, _), dist = sync_twice(sim.data, sim.mjx_data)
    assert bool(data.core.mjx_synced)
    for k in range(2):
        np.testing.assert_allclose(np.asarray(dist)[k], synced_data[1]._impl.contact.dist, atol=1e-6)


def test_a_sync_compiles_once(sim):
    """A scene written with NumPy or JAX arrays, on any data, is synced by one compilation."""
    sim.contacts()
    n_programs = sync_poses._cache_size()
    mocap_pos = np.asarray(sim.mjx_data.mocap_pos)
    for poses in (mocap_pos, mocap_pos.astype(np.float64), jnp.asarray(mocap_pos)):
        sim.mjx_data = sim.mjx_data.replace(mocap_pos=poses)
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.asarray(sim.data.states.pos) + 0.0))
        sim.contacts()
    assert sync_poses._cache_size() == n_programs
