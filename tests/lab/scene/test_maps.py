"""Maps: files of point clouds and meshes, their voxels, and boxes that drones touch and cameras see."""

import struct

import jax
import numpy as np
import pytest

from crazysim import ConfigError, ContactLog, Sim
from crazysim.lab.scene.map_files import read_map
from crazysim.lab.scene.voxels import merge_voxels, voxels_of_points, voxels_of_triangles
from crazysim.sim import use_box_collision

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0], [0, 0, 3]], float)
SQUARE_AND_SIDE = [[0, 1, 2, 3], [0, 1, 4]]
TRIANGLES = [[0, 1, 2], [0, 2, 3], [0, 1, 4]]


def ply(points, faces=(), layout="ascii"):
    order = ">" if layout == "binary_big_endian" else "<"
    lines = ["ply", f"format {layout} 1.0", "comment made by a test", f"element vertex {len(points)}"]
    lines += [f"property {kind} {name}" for kind, name in (("float", "x"), ("uchar", "red"), ("double", "y"))]
    lines += ["property float z", f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    body = b""
    for x, y, z in points:
        body += f"{x} 7 {y} {z}\n".encode() if layout == "ascii" else struct.pack(f"{order}fBdf", x, 7, y, z)
    for face in faces:
        words = (len(face), *face)
        body += (
            " ".join(map(str, words)).encode() + b"\n"
            if layout == "ascii"
            else struct.pack(f"{order}B{len(face)}i", *words)
        )
    return "\n".join(lines).encode() + b"\n" + body


def pcd(points, layout="ascii"):
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 2 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {layout}\n"
    )
    body = b"".join(
        f"{x} {y} {z} 0 0 1\n".encode() if layout == "ascii" else struct.pack("<fffBBf", x, y, z, 0, 0, 1)
        for x, y, z in points
    )
    return head.encode() + body


def stl(triangles, binary):
    if binary:
        rows = [struct.pack("<12fH", 0, 0, 1, *np.ravel(t), 0) for t in triangles]
        return b"made by a test".ljust(80) + struct.pack("<I", len(rows)) + b"".join(rows)
    facets = "".join(
        "facet normal 0 0 1\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in t) + "endloop\nendfacet\n"
        for t in triangles
    )
    return f"solid test\n{facets}endsolid test\n".encode()


def obj():
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
    return f"# a test\n{vertices}vn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\nf -5//1 -4//1 -1//1\n".encode()


MAP_FILES = {
    **{f"{name}.ply": ply(CORNERS, SQUARE_AND_SIDE, name) for name in
       ("ascii", "binary_little_endian", "binary_big_endian")},
    "equal.ply": ply(CORNERS, TRIANGLES, "binary_little_endian"),
    "cloud.ply": ply(CORNERS, (), "binary_little_endian"),
    **{f"{name}.pcd": pcd([*CORNERS, [np.nan] * 3], name) for name in ("ascii", "binary")},
    "binary.stl": stl(CORNERS[TRIANGLES], True),
    "text.stl": stl(CORNERS[TRIANGLES], False),
    "mesh.obj": obj(),
}  # fmt: skip


@pytest.mark.parametrize("name", MAP_FILES)
def test_files_of_all_kinds_are_read(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(MAP_FILES[name])
    points, triangles = read_map(path)
    if triangles is None:
        assert name.endswith(".pcd") or name == "cloud.ply"
        np.testing.assert_allclose(points, CORNERS)
    else:
        result = {tuple(map(tuple, t)) for t in points[triangles]}
        assert result == {tuple(map(tuple, t)) for t in CORNERS[TRIANGLES]}


@pytest.mark.parametrize("name", MAP_FILES)
def test_law_09_damaged_files_raise_one_kind_of_error(name, tmp_path, rng):
    """A file that is cut off, or has a changed byte, is read whole or refused by a ConfigError."""
    path, content = tmp_path / name, MAP_FILES[name]
    for cut in (0, 1, 5, len(content) // 2, len(content) - 9):
        path.write_bytes(content[:cut])
        if name.endswith((".obj", "text.stl")) and cut > 5:
            continue  # what remains of a text is a shorter mesh
        with pytest.raises(ConfigError, match=path.stem):
            read_map(path)
    for _ in range(60):
        changed = bytearray(content)
        changed[rng.integers(len(changed))] = rng.integers(256)
        path.write_bytes(changed)
        try:
            points, triangles = read_map(path)
        except ConfigError:
            continue
        assert points.shape[1:] == (3,)
        assert triangles is None or triangles.max() < len(points)


def test_law_09_maps_in_other_units_get_the_setting_that_helps(tmp_path):
    scene, rng = Sim().scene, np.random.default_rng(0)
    for name, content, options, message in (
        ("empty.ply", ply([]), {}, "has none"),
        ("mesh.obj", obj(), {"resolution": 1e-4}, "voxels of 0.0001 m near triangles"),
        ("mesh.obj", obj(), {"min_points": 2}, "min_points=1"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ConfigError, match=message):
            scene.add_map(tmp_path / name, **options)
    corners = 100 * rng.normal(size=(300, 3))  # a part of 0.5 m in millimetres
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {k} {k + 1} {k + 2}" for k in range(1, 299, 3)]
    (tmp_path / "mesh.obj").write_text("\n".join(lines))
    for source in (tmp_path / "mesh.obj", corners.repeat(200, axis=0) + rng.normal(size=(60_000, 3))):
        with pytest.raises(ConfigError, match=r"pass scale=0\.001"):
            scene.add_map(source)
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    assert len(scene.add_map(grid, scale=1e-3, resolution=1e-3)) == 1  # a scale that is given is not questioned


def test_merged_boxes_fill_the_voxels_once(rng):
    voxels = np.unique(rng.integers(-4, 5, (400, 3)), axis=0)
    boxes = merge_voxels(voxels)
    assert len(boxes) < len(voxels)
    filled = [
        np.stack(np.meshgrid(*[np.arange(low, high + 1) for low, high in zip(box[:3], box[3:], strict=True)]), -1)
        for box in boxes
    ]
    filled = np.concatenate([x.reshape(-1, 3) for x in filled])
    assert len(filled) == len(voxels)
    np.testing.assert_array_equal(np.unique(filled, axis=0), voxels)
    wall = np.stack(np.meshgrid([0], np.arange(30), np.arange(20)), axis=-1).reshape(-1, 3)
    np.testing.assert_array_equal(merge_voxels(wall), [[0, 0, 0, 0, 29, 19]])


def test_triangles_have_the_voxels_that_they_meet(rng, monkeypatch):
    """Each point of a triangle is in a voxel, and each voxel is at most 3 cm from a sampled point."""
    corners, resolution = rng.uniform(-1, 1, (3, 3, 3)), 0.1
    voxels = voxels_of_triangles(corners, resolution)
    monkeypatch.setattr("crazysim.lab.scene.voxels.MAX_CANDIDATES", 1000)
    np.testing.assert_array_equal(voxels_of_triangles(corners, resolution), voxels)
    weights = rng.dirichlet([1, 1, 1], 8000)
    points = np.einsum("nk,tkc->tnc", weights, corners).reshape(-1, 3)
    sampled = voxels_of_points(points, resolution)
    known = {tuple(v) for v in voxels}
    assert {tuple(v) for v in sampled} <= known
    assert len(sampled) > 0.9 * len(known)  # samples miss voxels that a triangle meets only at a corner
    gaps = [np.abs(points - np.array(v) * resolution).max(axis=1).min() for v in known]
    assert max(gaps) < 0.5 * resolution + 0.03


def room():
    low = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], float)
    sides = [[k, (k + 1) % 4, (k + 1) % 4 + 4, k + 4] for k in range(4)]
    faces = [[q[0], q[1], q[2]] for q in sides] + [[q[0], q[2], q[3]] for q in sides]
    return low, faces


def teleport(sim, pos):
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=np.broadcast_to(np.float32(pos), states.pos.shape)))


def test_a_mesh_is_hollow_for_drones_and_cameras(tmp_path):
    path = tmp_path / "room.ply"
    path.write_bytes(ply(*room()))
    sim = Sim(n_worlds=2)
    sin_45 = np.sqrt(0.5)  # a quarter turn about z: x of the file is y of the world, y is -x
    handle = sim.scene.add_map(path, pos=(2, -2, 0), quat=(0, 0, sin_45, sin_45), scale=4.0)
    assert handle.bodies == ("room:0",)
    assert not handle.movable
    assert len(sim.scene.collision_model.objects[0].geoms) == 4  # one for each side
    teleport(sim, [[[0, 0, 1.0]], [[0, -1.6, 1.0]]])
    report = sim.contact_report(handle, floor=False, drones=False)
    gap = np.asarray(report.object_distance)[:, 0, 0]
    np.testing.assert_allclose(gap, np.array([2.0, 0.4]) - 0.05 - 0.086, atol=1e-5)
    depth = np.asarray(sim.depth("fpv_cam", 1, 1))[:, 0, 0, 0]
    ahead = np.asarray(sim.mj_model.cam("fpv_cam:0").pos)[0]
    np.testing.assert_allclose(depth, 2.0 - 0.05 - ahead, atol=1e-4)


@pytest.mark.parametrize("kind", ["upright", "turned", "balls", "balls and a box"])
def test_code_of_one_drone_finds_the_nearest_of_many_geoms(kind, rng):
    """The search in a hierarchy, used in steps, gives the distance to the nearest geom, and its slope."""
    sim, n_worlds = Sim(n_worlds=12), 12
    if kind == "balls and a box":
        use_box_collision(sim)
    shape = "type='sphere' size='0.2'" if "balls" in kind else "type='box' size='{} {} {}'"
    geoms = [
        f"<geom {shape} pos='{p[0]} {p[1]} {p[2]}' quat='{q}' conaffinity='2'/>".format(*rng.uniform(0.02, 0.3, 3))
        for p in rng.uniform([-1.2, -1.2, 0.5], [1.2, 1.2, 2.0], (80, 3))
        for q in [" ".join(map(str, rng.normal(size=4))) if kind == "turned" else "1 0 0 0"]
    ]
    sim.scene.add(f"<mujoco><worldbody>{''.join(geoms)}</worldbody></mujoco>", "many", mocap=False)
    teleport(sim, rng.uniform([-1.2, -1.2, 0.5], [1.2, 1.2, 2.0], (n_worlds, 1, 3)))
    contacts, states = sim.scene.contact_fn(floor=False, drones=False), sim.data.states

    def gap_of_drone(pos, quat):
        return contacts(sim.data.replace(states=states.replace(pos=pos, quat=quat))).object_distance[0]

    expected = np.asarray(jax.jit(contacts)(sim.data).object_distance)[:, 0, 0]
    result, slope = jax.jit(jax.vmap(jax.value_and_grad(gap_of_drone)))(states.pos[:, 0], states.quat[:, 0])
    np.testing.assert_allclose(result, expected, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=-1), 1.0, atol=1e-3)
    assert (expected < 0).any()
    assert (expected > 0).any()
    if kind == "upright":
        log = sim.add(ContactLog("many:0", floor=False, drones=False))
        sim.step()
        np.testing.assert_array_equal(log.read(sim.data).any[:, 0], expected < 0)
        assert "not fused" not in str(sim.explain())
