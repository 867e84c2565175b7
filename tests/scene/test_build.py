"""The spec of the scene: its contents, bodies that users add, and invalid edits."""

import struct

import jax
import mujoco
import numpy as np
import pytest
from cases import BOX
from pictures import encode_png

from crazysim.drones import airframe_names, load_airframe
from crazysim.scene import build
from crazysim.scene.build import build_spec, compile_spec
from crazysim.sim import Sim


@pytest.fixture(scope="module")
def sim():
    """Return one world of two drones; tests do not change its spec."""
    return Sim(n_drones=2)


def write_stl(path, size):
    corners = size * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float32)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = b"".join(struct.pack("<12fH", *np.zeros(3), *corners[list(face)].ravel(), 0) for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + triangles)


SCENE = """
<mujoco>
  <asset>
    <mesh name="rock" file="meshes/rock.stl"/>
    <texture name="paint" type="2d" file="textures/paint.png"/>
    <material name="paint" texture="paint"/>
  </asset>
  <worldbody>
    <light pos="0 0 5" dir="0 0 -1" type="directional"/>
    <geom name="ground" type="plane" size="0 0 1"/>
    <geom name="rock" type="mesh" mesh="rock" material="paint" pos="2 0 1" contype="0" conaffinity="0"/>
    <camera name="above" pos="2 0 3"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def scene_file(tmp_path):
    for folder in ("meshes", "textures"):
        (tmp_path / folder).mkdir()
    write_stl(tmp_path / "meshes" / "rock.stl", 0.3)
    (tmp_path / "textures" / "paint.png").write_bytes(encode_png(np.full((8, 8, 3), [255, 0, 0])))
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


def attach_boxes(sim, positions):
    obstacle_spec = mujoco.MjSpec.from_string(BOX)
    frame = sim.spec.worldbody.add_frame()
    for i, pos in enumerate(positions):
        body = obstacle_spec.body("obstacle")
        attached = frame.attach_body(body, "", f":{i}")
        attached.pos = pos


# The drones -----------------------------------------------------------------------------------------------------


def test_drones_are_mocap_bodies_without_mass(sim):
    """MuJoCo does not simulate the drones: their poses are set, and the only joint is a dummy."""
    model = sim.mj_model
    for i in range(2):
        body = model.body(f"drone:{i}")
        assert body.mocapid.item() == int(sim.data.core.drone_mocap_ids[i])
        assert body.mass.item() == 0
    assert model.nv == 1
    assert model.opt.timestep == 1 / sim.freq


@pytest.mark.parametrize("name", airframe_names())
def test_every_airframe_has_a_body(name):
    """The body of an airframe has primitives only: a disc over each rotor, two LEDs, cameras and collision shapes."""
    airframe = load_airframe(name)
    model = compile_spec(build_spec(None, [airframe], 500, -1))
    belongs_to_drone = model.geom_bodyid == model.body("drone:0").id
    assert not np.isin(model.geom_type[belongs_to_drone], [mujoco.mjtGeom.mjGEOM_MESH]).any()
    discs = belongs_to_drone & (model.geom_matid == model.material("drone_propeller").id)
    rotors = airframe.value("rotors.position")
    np.testing.assert_allclose(model.geom_pos[discs][:, :2], rotors[:, :2], atol=1e-6)
    for led in ("led_top:0", "led_bot:0"):
        assert np.sum(model.geom_matid == model.material(led).id) == 1
    assert {model.camera(i).name for i in range(model.ncam)} == {"fpv_cam:0", "track_cam:0"}
    has_contacts = belongs_to_drone & ((model.geom_contype | model.geom_conaffinity) > 0)
    assert [model.geom(i).name for i in np.flatnonzero(has_contacts)] == ["col_sphere:0"]
    assert model.geom("col_sphere:0").size[0] >= np.linalg.norm(rotors[:, :2], axis=-1).max()


def test_the_tracking_camera_looks_at_its_drone():
    """The camera is behind and above the drone, its axis goes through the drone, and the image is upright."""
    model = compile_spec(build_spec(None, [load_airframe("cf21B_500")], 500, -1))
    data = mujoco.MjData(model)
    data.mocap_pos[0], data.mocap_quat[0] = [1, 2, 3], [np.cos(0.4), 0, np.sin(0.4), 0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    camera = model.camera("track_cam:0").id
    right, up, back = data.cam_xmat[camera].reshape(3, 3).T
    to_drone = np.array([1, 2, 3]) - data.cam_xpos[camera]
    np.testing.assert_allclose(np.cross(to_drone, -back), 0, atol=1e-6)
    assert to_drone @ -back > 0
    assert up[2] > 0
    assert abs(right[2]) < 1e-9
    fpv_camera = model.camera("fpv_cam:0").id
    np.testing.assert_allclose(
        -data.cam_xmat[fpv_camera].reshape(3, 3)[:, 2], [np.cos(0.8), 0, -np.sin(0.8)], atol=1e-6
    )


def test_a_swarm_built_in_chunks_equals_one_built_one_by_one(monkeypatch):
    """Every array of the compiled model is the same."""
    airframe = load_airframe("cf21B_500")
    one_by_one = compile_spec(build_spec(None, [airframe] * 7, 500, -1))
    monkeypatch.setattr(build, "DRONES_PER_CHUNK", 3)
    in_chunks = compile_spec(build_spec(None, [airframe] * 7, 500, -1))
    arrays = [name for name in dir(one_by_one) if isinstance(getattr(one_by_one, name), np.ndarray)]
    assert len(arrays) > 100
    for name in arrays:
        np.testing.assert_array_equal(getattr(one_by_one, name), getattr(in_chunks, name), err_msg=name)


# What users add -------------------------------------------------------------------------------------------------


def test_boxes_attached_from_a_string_are_touched():
    """The documentation's example: two boxes, attached from one body, at different positions."""
    sim = Sim(n_worlds=1, n_drones=1)
    attach_boxes(sim, [[1.0, 0.0, 0.5], [2.0, 0.0, 0.5]])
    sim.build_mjx()
    sim.reset()
    np.testing.assert_allclose(sim.mj_model.body("obstacle:1").pos, [2, 0, 0.5])
    for pos, touched in ([0, 0, 0.5], [0, 0]), ([1, 0, 0.5], [1, 0]), ([2, 0, 0.62], [0, 1]), ([1.5, 0, 0.5], [0, 0]):
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.array([[pos]], np.float32)))
        assert [bool(sim.contacts(f"obstacle:{i}").any()) for i in range(2)] == touched, pos


def test_bodies_of_a_file_keep_their_meshes(tmp_path, scene_file):
    """An MJCF of a gate is in another folder, with a mesh and a texture by relative path, as in racing."""
    (tmp_path / "gate.xml").write_text("""
        <mujoco>
          <asset>
            <mesh name="frame" file="meshes/rock.stl"/>
            <texture name="logo" type="2d" file="textures/paint.png"/>
            <material name="logo" texture="logo"/>
          </asset>
          <worldbody>
            <body name="gate">
              <geom type="mesh" mesh="frame" material="logo" contype="0" conaffinity="0"/>
              <geom name="bar" type="box" size="0.02 0.2 0.02"/>
            </body>
          </worldbody>
        </mujoco>""")
    sim = Sim(xml_path=scene_file)
    gate_spec = mujoco.MjSpec.from_file(str(tmp_path / "gate.xml"))
    frame = sim.spec.worldbody.add_frame()
    for i in range(2):
        frame.attach_body(gate_spec.body("gate"), "", f":{i}").mocap = True
    sim.build_mjx()
    assert sim.mj_model.nmocap == 3
    assert sim.mj_model.nmesh >= 2
    assert sim.mjx_data.mocap_pos.shape == (1, 3, 3)


def test_a_rebuild_keeps_the_state_of_the_drones():
    """State and time continue; a reset still returns to the default data."""
    sim = Sim(n_worlds=2, n_drones=2)
    sim.step(3)
    original_data = sim.data
    attach_boxes(sim, [[1.0, 0.0, 0.5]])
    sim.build_mjx()
    for part in ("states", "params", "controls"):
        jax.tree.map(np.testing.assert_array_equal, getattr(sim.data, part), getattr(original_data, part))
    np.testing.assert_array_equal(sim.data.core.steps, original_data.core.steps)
    sim.step(2)
    np.testing.assert_array_equal(sim.data.core.steps, 5)
    sim.reset()
    np.testing.assert_array_equal(sim.data.core.steps, 0)


def test_mocap_ids_follow_when_bodies_are_added_before_the_drones():
    """Ids are looked up by name at every rebuild, so they stay right if other mocap bodies come before the drones."""
    sim = Sim(n_drones=2)
    tower = sim.spec.worldbody.add_body(name="tower")
    tower.mocap = True
    tower.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    sim.build_mjx()
    expected = [sim.mj_model.body(f"drone:{i}").mocapid.item() for i in range(2)]
    assert sim.data.core.drone_mocap_ids.tolist() == expected
    assert sim.default_data.core.drone_mocap_ids.tolist() == expected


# Scene files of users --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_type", [str, lambda path: path], ids=["str", "Path"])
def test_a_scene_file_finds_its_meshes_and_textures(scene_file, as_type):
    """Meshes and textures are read from the folder of the scene file, whatever the working directory."""
    sim = Sim(xml_path=as_type(scene_file))
    assert sim.mj_model.mesh("rock").vertnum.item() == 4
    np.testing.assert_array_equal(sim.mj_model.tex_data[:3], [255, 0, 0])
    assert sim.mj_model.body("drone:0").mocapid.item() == 0
    assert [bool(x) for x in sim.contacts().ravel()] == [True], "the drone stands on this scene's ground"


def test_meshes_and_textures_of_a_scene_file_are_drawn(scene_file, opengl):
    """The mesh is drawn with its texture, red, in the middle of its camera's image."""
    sim = Sim(n_worlds=2, xml_path=scene_file)
    picture = sim.render("rgb_array", camera="above", width=64, height=48).astype(int)
    red = (picture[..., 0] > 60) & (picture[..., 0] > 2 * picture[..., 1]) & (picture[..., 0] > 2 * picture[..., 2])
    assert red[24, 32]
    assert 50 < red.sum() < red.size / 3
    sim.close()


def broken_scene(tmp_path, text):
    path = tmp_path / "broken.xml"
    path.write_text(text)
    return path


WORLD = "<mujoco><worldbody>{}</worldbody></mujoco>"
BROKEN_SCENES = {
    "no XML": ("this is no XML", "expected a scene that MuJoCo can read"),
    "empty": ("", "expected a scene that MuJoCo can read"),
    "cut off": ("<mujoco><worldbody>", "expected a scene that MuJoCo can read"),
    "unknown element": (WORLD.format("<wall/>"), "expected a scene that MuJoCo can read"),
    "missing include": ("<mujoco><include file='none.xml'/></mujoco>", "expected a scene that MuJoCo can read"),
    "missing mesh": ("<mujoco><asset><mesh name='m' file='none.stl'/></asset></mujoco>", "expected a scene that"),
    "geom without size": (WORLD.format("<geom type='sphere'/>"), "expected a scene that compiles"),
    "body with the name of a drone": (WORLD.format("<body name='drone:0'/>"), "reserved for the drones"),
    "nested body with the name of a drone": (
        WORLD.format("<body name='a'><body name='drone:7'/></body>"),
        "reserved for the drones, got .'drone:7'.",
    ),
}


@pytest.mark.parametrize("case", BROKEN_SCENES)
def test_a_broken_scene_is_refused_at_construction(tmp_path, case):
    text, message = BROKEN_SCENES[case]
    with pytest.raises(ValueError, match=message):
        Sim(xml_path=broken_scene(tmp_path, text))


def test_a_scene_with_names_of_the_drones_is_refused(tmp_path):
    """Names of the drones' materials, cameras and geoms are reserved, too."""
    for mjcf in (
        "<mujoco><asset><material name='led_top:0'/></asset></mujoco>",
        WORLD.format("<camera name='fpv_cam:0'/>"),
        WORLD.format("<geom name='col_sphere:0' size='1'/>"),
    ):
        with pytest.raises(ValueError):
            Sim(xml_path=broken_scene(tmp_path, mjcf))


# Rebuilds that fail --------------------------------------------------------------------------------------------


def test_after_a_spec_that_does_not_compile_the_old_scene_stays():
    """After a refused rebuild the simulation continues with the old scene, and a corrected spec replaces it."""
    sim = Sim(n_worlds=3)
    model, data = sim.mj_model, sim.data
    geom = sim.spec.worldbody.add_geom(name="wrong", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0, 0, 0])
    with pytest.raises(ValueError, match="expected a scene that compiles"):
        sim.build_mjx()
    assert sim.mj_model is model
    assert sim.data is data
    sim.step()
    assert np.asarray(sim.contacts()).all()
    geom.size = [0.1, 0, 0]
    sim.build_mjx()
    assert sim.mj_model.geom("wrong").size[0] == 0.1


@pytest.fixture(scope="module")
def unsupported_by_mjx():
    """Return a world that MJX cannot check for contacts: a box and a cylinder that are moved through mjx_data."""
    sim = Sim()
    shapes = [(mujoco.mjtGeom.mjGEOM_BOX, [0.1, 0.1, 0.1]), (mujoco.mjtGeom.mjGEOM_CYLINDER, [0.1, 0.1, 0])]
    for i, (kind, size) in enumerate(shapes):
        body = sim.spec.worldbody.add_body(name=f"shape:{i}", pos=[1, i, 1], mocap=True)
        body.add_geom(type=kind, size=size)
    sim.build_mjx()
    return sim


def test_contacts_are_refused_for_geoms_that_mjx_does_not_support(unsupported_by_mjx):
    """MJX does not support a box against a cylinder: stepping works, and contacts raise an error."""
    unsupported_by_mjx.step()
    with pytest.raises(ValueError, match="expected a scene that MJX supports"):
        unsupported_by_mjx.contacts()
