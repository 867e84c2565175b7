"""Objects with handles, whose poses are part of SimData; the scene is compiled at its next use."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from crazysim import Sim
from crazysim.scene import build
from crazysim.scene.objects import PRIMITIVES

TOWER = """
<mujoco>
  <asset><mesh name="tip" vertex="0 0 0.3  0.1 0 0  -0.1 0.1 0  -0.1 -0.1 0"/></asset>
  <worldbody><body name="base">
    <geom type="cylinder" size="0.1 0.2"/>
    <body pos="0 0 0.2"><geom type="mesh" mesh="tip" contype="0" conaffinity="0"/></body>
  </body></worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def course():
    sim = Sim(n_worlds=3, n_drones=2, control="attitude")
    gates = sim.scene.add("gate", count=2, pos=[[1, 0, 1], [2, 0, 1]])
    pole = sim.scene.add("pole", pos=[0, 1, 0], mocap=False)
    tower = sim.scene.add(TOWER, "tower", pos=np.array([[[0, 0, z]] for z in (1.0, 2.0, 3.0)]))
    return sim, gates, pole, tower


def test_a_handle_stays_valid_when_objects_are_added(course):
    sim, gates, _, tower = course
    assert sim.data.objects.names == ("gate:0", "gate:1", "tower:0")
    np.testing.assert_allclose(gates.pose(sim.data)[0], np.tile([[1, 0, 1], [2, 0, 1]], (3, 1, 1)))
    np.testing.assert_allclose(np.asarray(tower.pose(sim.data)[0])[:, 0, 2], [1, 2, 3])
    data = gates[1].set_pose(sim.data, [5, 5, 5])
    ball = sim.scene.add("sphere", f"ball-{len(sim.scene.object_names)}", pos=[7, 0, 0])
    later_data = sim.data
    np.testing.assert_allclose(ball.pose(later_data)[0], np.tile([[7, 0, 0]], (3, 1, 1)))
    np.testing.assert_allclose(np.asarray(gates[1].pose(data)[0])[0], [[5, 5, 5]])
    np.testing.assert_allclose(np.asarray(tower.pose(later_data)[0])[:, 0, 2], [1, 2, 3])


def test_added_objects_are_compiled_once_at_the_next_use(monkeypatch):
    sim, compiled = Sim(), []
    compile_spec = build.compile_spec
    monkeypatch.setattr(build, "compile_spec", lambda spec: (compiled.append(1), compile_spec(spec))[1])
    for k in range(4):
        sim.scene.add("box", f"box-{k}")
    assert not compiled
    sim.step()
    assert sim.mj_model.body("box-3:0").id > 0
    assert len(compiled) == 1


def test_poses_equal_those_in_mujoco(course, rng):
    """In the drawn world and in MJX, quaternions are converted and children move with their parents."""
    sim, gates, _, tower = course
    pos, quat = rng.normal(size=(3, 2, 3)), rng.normal(size=(3, 2, 4))
    sim.data = tower.set_pose(gates.set_pose(sim.data, pos, quat), pos[:, :1] + 1, quat[:, 1:])
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    sim.sync()
    model, mjx_data = sim.mj_model, jax.device_get(sim.mjx_data)
    for world in range(3):
        sim.scene.sync_one(sim.data, world)
        for state in (sim.mj_data, jax.tree.map(lambda x, w=world: x[w], mjx_data)):
            for k in range(2):
                body = model.body(f"gate:{k}").id
                np.testing.assert_allclose(state.xpos[body], pos[world, k], atol=1e-6)
                np.testing.assert_allclose(state.xquat[body], np.roll(quat[world, k], 1), atol=1e-6)
            tip = next(g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH)
            expected = mujoco.MjData(model)
            expected.mocap_pos[model.body("tower:0").mocapid] = pos[world, 0] + 1
            expected.mocap_quat[model.body("tower:0").mocapid] = np.roll(quat[world, 1], 1)
            mujoco.mj_kinematics(model, expected)
            np.testing.assert_allclose(state.geom_xpos[tip], expected.geom_xpos[tip], atol=2e-6)


def test_a_reset_moves_objects_back_in_the_worlds_of_its_mask(course):
    sim, gates, _, _ = course
    default_pos = np.asarray(gates.pose(sim.default_data)[0])
    sim.data = gates.set_pose(sim.data, [9, 9, 9])
    sim.reset(np.array([True, False, True]))
    pos = np.asarray(gates.pose(sim.data)[0])
    np.testing.assert_array_equal(pos[[0, 2]], default_pos[[0, 2]])
    np.testing.assert_array_equal(pos[1], 9.0)


def test_set_pose_is_pure_masked_and_differentiable(course):
    sim, gates, _, _ = course
    data = sim.data
    mask = np.array([True, False, False])
    moved = jax.jit(lambda d, z: gates.set_pose(d, jnp.zeros((2, 3)) + z, mask=mask))(data, 4.0)
    before, after = (np.asarray(gates.pose(d)[0]) for d in (data, moved))
    np.testing.assert_allclose(after[0], 4.0)
    np.testing.assert_array_equal(after[1:], before[1:])
    gradient = jax.jit(jax.grad(lambda z: jnp.sum(gates.set_pose(data, jnp.zeros(3) + z).objects.pos ** 2)))(2.0)
    assert gradient == pytest.approx(2 * 2.0 * 3 * 2 * 3)  # d/dz of z^2 over 3 worlds, 2 gates, 3 components


@pytest.mark.parametrize("primitive", PRIMITIVES)
def test_every_primitive_is_touched_by_drones_only(primitive):
    sim = Sim()
    sim.scene.add(primitive, pos=[0, 0, 0.3], count=2, rgba=[(1, 0, 0, 1), (0, 1, 0, 0.5)])
    model = sim.mj_model
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == model.body(f"{primitive}:0").id]
    assert geoms
    drone, floor = model.geom("col_sphere:0").id, model.geom("floor").id
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    for g in geoms:
        assert (contype[drone] & conaffinity[g]) | (contype[g] & conaffinity[drone])
        assert not (contype[floor] & conaffinity[g]) | (contype[g] & conaffinity[floor])
        np.testing.assert_allclose(model.geom_rgba[g], (1, 0, 0, 1))
    np.testing.assert_allclose(model.geom_rgba[model.body_geomadr[model.body(f"{primitive}:1").id]], (0, 1, 0, 0.5))
