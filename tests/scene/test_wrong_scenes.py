"""Law 9 for the scene, images and overlays: each row has a call and the setting, or the remedy, that its error names.

After the error the scene is as it was. ``tests/laws/test_law_09_any_input.py`` has values of any other type.
"""

import re

import numpy as np
import pytest
from splat_files import write_splats

from crazysim import ContactLog, RangeFinder, Sim, SplatScene
from crazysim.sim.visualize import change_material, draw_capsule, draw_label, draw_line, draw_points, draw_setpoints
from crazysim.sim.visualize import draw_text as text

BALL = "<mujoco><worldbody><geom size='0.1'/></worldbody></mujoco>"
PAIR, NAN = [[0, 0, 0], [1, 0, 0]], np.nan
MANY = np.random.default_rng(0).uniform(0, 100, (11_000, 3))


@pytest.fixture(scope="module")
def sim(opengl):
    sim = Sim(n_worlds=2, n_drones=2, control="attitude")
    sim.gate = sim.scene.add("gate", count=2)
    sim.pole = sim.scene.add("pole", mocap=False)
    yield sim
    sim.close()


def add(*args, **settings):
    return lambda sim: sim.scene.add(*args, **settings)


def pose(*args):
    return lambda sim: sim.gate.set_pose(sim.data, *args)


def add_map(*args, **settings):
    return lambda sim: sim.scene.add_map(*args, **settings)


def depth(*args, **settings):
    return lambda sim: sim.depth(*args, **settings)


def render(**settings):
    return lambda sim: sim.render(**{"mode": "rgb_array", "width": 16, "height": 12} | settings)


def free(**config):
    return render(camera=-1, cam_config=config)


def splats(**settings):
    return lambda sim: sim.scene.splat_fn(**settings)


def led(material="led_top", ids=(0,), rgba=(1, 0, 0, 1)):
    return lambda sim: change_material(sim, material, ids, rgba=rgba)


OBJECTS = [
    (add("gate"), "got 'gate:0', a body of the scene"),
    (add("box", "drone"), "got 'drone:0', a body of the scene"),
    (add("tree"), "got 'tree'"),
    (add(3, "q"), "got 3"),
    (add("<mujoco><worldbody><geom type='box'/></worldbody></mujoco>", "q"), "size 0"),
    (add("<mujoco><worldbody>", "q"), "an object that compiles"),
    (add([BALL, "<mujoco>"], "q", count=2), "an object that compiles"),
    (add("box", "q", length=3), "settings size=(0.2, 0.2, 0.2)"),
    (add("sphere", "q", radius=-1), "radius of 'sphere'"),
    (add(BALL, "q", radius=1), "no settings"),
    (add("box", "q", count=0), "count"),
    (add("box", "q", count=2, pos=[[0, 0]]), "pos of shape (3,) or (2, 3)"),
    (add("gate", "q", stand=0.1), "stand"),
    (add("pole", "q", height=0.1, radius=0.1), "higher than it is thick"),
    (pose([0, 0]), "pos of shape (3,) or (2, 3) or (2, 2, 3)"),
    (pose([0, 0, NAN]), "finite numbers"),
    (pose(None, [0, 0, 0, 0]), "not all zero"),
    (lambda sim: sim.pole.set_pose(sim.data, [0, 0, 0]), "mocap=True"),
    (lambda sim: sim.gate.set_pose(Sim().data, [0, 0, 0]), "a handle of this simulation"),
]
MAPS = [
    (add_map("none.ply"), "an existing file"),
    (add_map("room.bt"), "a file .ply"),
    (add_map(np.zeros((0, 3))), "shape"),
    (add_map(np.zeros((4, 2))), "shape"),
    (add_map([[0, 0, 0], [1, 0]]), "a path or points"),
    (add_map([[0, 0, 0], [1e30, 0, 0]], scale=1.0), "within 1e+06 m"),
    (add_map([[0, 0, 0], [1, NAN, 0]]), "got 1 of 2 points"),
    (add_map([[0, 0, 0], [20_000, 0, 0]]), "Pass scale="),
    (add_map([[1, 2, 3]]), "Pass scale="),
    (add_map(PAIR, scale=0), "scale"),
    (add_map(PAIR, resolution=0), "resolution"),
    (add_map(PAIR, min_points=2), "min_points"),
    (add_map(PAIR, quat=(0, 0, 0, 0)), "rotation"),
    (add_map(MANY), "at most 10000 boxes"),
]
QUERIES = [
    (lambda sim: sim.contact_report("tree"), "got 'tree'"),
    (lambda sim: sim.contact_report((), floor=False, drones=False), "report of nothing"),
    (lambda sim: sim.add(ContactLog("tree")), "got 'tree'"),
    (depth("nose"), "got 'nose'"),
    (depth(99), "got 99"),
    (depth("fpv_cam", 0, 4), "width and height"),
    (depth("fpv_cam", 4, 4, along="z"), "along='ray'"),
    (lambda sim: sim.add(RangeFinder([[0, 0, 0]])), "none of them zero"),
    (lambda sim: sim.add(RangeFinder(freq=333)), "Use the nearest rate below, 250 Hz"),
    (splats(camera="no_cam"), "no_cam"),
    (splats(camera=["fpv_cam", "track_cam:0"]), "one field of view"),
    (splats(background=(0, 0, 2)), "background"),
    (splats(min_coverage=-1), "min_coverage"),
    (splats(renderer="mujoco"), "'splax' or 'plain'"),
    (splats(renderer="splax"), "Pass device='gpu'"),
]
IMAGES = [
    (render(mode="film"), "got 'film'"),
    (render(camera="up"), "got 'up'"),
    (render(camera=9), "a camera id from 0 to"),
    (render(world=2), "a world from 0 to 1"),
    (render(width=0), "got 0 x 12 pixels"),
    (render(width=40.5), "got 40.5 x 12 pixels"),
    (free(zoom=2), "got 'zoom'"),
    (free(lookat=[1, 2]), "lookat"),
    (free(distance=NAN), "distance"),
    (render(camera=-1, cam_config=3), "cam_config as a dict"),
]
OVERLAYS = [
    (lambda sim: draw_points(sim, np.zeros((4, 2))), "shape (n, 3)"),
    (lambda sim: draw_points(sim, np.zeros((4, 3)), rgba=[1, 0]), "shape"),
    (lambda sim: draw_points(sim, np.zeros((20_000, 3))), "at most 10000 overlays"),
    (lambda sim: draw_line(sim, np.zeros((2, 2, 3))), "shape (n, 3)"),
    (lambda sim: draw_capsule(sim, np.zeros((2, 3)), [1, 1, 1]), "shape (3,)"),
    (lambda sim: text(sim, "x", "middle"), "got 'middle'"),
    (lambda sim: text(sim, ""), "a string that is not empty"),
    (lambda sim: text(sim, "5 µm"), "ASCII"),
    (lambda sim: draw_label(sim, [0, 0, 0], "x" * 100), "at most 99 characters"),
    (lambda sim: draw_label(sim, [0, 0, 0], "two\nlines"), "a label of one line"),
    (lambda sim: draw_label(sim, [0, 0], "x"), "shape (3,)"),
    (lambda sim: draw_setpoints(sim), "control='attitude'"),
    (led(ids=[2]), "drone_ids must be in range"),
    (led(ids=[-1]), "drone_ids must be in range"),
    (led(ids=[0.5]), "drone_ids must be 1D array"),
    (led("lamp"), "got 'lamp'"),
    (led(rgba=[1, 0]), "shape"),
]
ROWS = [*OBJECTS, *MAPS, *QUERIES, *IMAGES, *OVERLAYS]


@pytest.mark.parametrize(("call", "words"), ROWS, ids=[row[1] for row in ROWS])
def test_a_wrong_setting_is_named(sim, call, words):
    bodies = [body.name for body in sim.spec.worldbody.bodies]
    with pytest.raises(ValueError, match=re.escape(words)):
        call(sim)
    assert [body.name for body in sim.spec.worldbody.bodies] == bodies
    assert len(sim.overlays) == 0
    assert not sim.plugins


ZEROS = np.zeros(30)
FILES = {
    "no property 'opacity'": {"opacity": None},
    "got 44 in": {"f_rest_44": None},
    "got 30 of 30 without": {f"rot_{k}": ZEROS for k in range(4)},
    "Pass scale=": {a: ZEROS for a in "xyz"},
    "which has none": {"n": 0},
}


@pytest.mark.parametrize("words", FILES)
def test_a_wrong_file_of_splats_is_named(words, tmp_path):
    write_splats(tmp_path / "a.ply", **FILES[words])
    with pytest.raises(ValueError, match=words):
        SplatScene(tmp_path / "a.ply")


def test_a_file_of_splats_that_is_cut_off_or_compressed_is_named(tmp_path):
    path = tmp_path / "a.ply"
    write_splats(path)
    content = path.read_bytes()
    for cut in (0, 3, 90, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:cut])
        with pytest.raises(ValueError, match=r"a\.ply"):
            SplatScene(path)
    for name in ("a.spz", "a.SPLAT"):
        with pytest.raises(ValueError, match="which is compressed"):
            SplatScene(tmp_path / name)
