"""Images: what they contain, where, at which distance, and of which world."""

import os
import queue
import subprocess
import sys
import textwrap
import threading
import time

import mujoco
import numpy as np
import pytest
from cases import CAMERA_HEIGHT, FOVY
from pictures import HEIGHT, WIDTH, pixel
from screens import screen_pixels, virtual_screen

from crazysim.drones.body import MAX_LED_DRONES
from crazysim.errors import RenderError, UnknownNameError
from crazysim.scene.build import SCENE_FILE
from crazysim.scene.render import MAX_MATERIALS
from crazysim.sim import Sim, change_material

POSITIONS = np.array([[[0.4, 0.2, 0.5]], [[-0.5, -0.3, 1.0]]])
"""Position of the drone of each world, m. (2, 1, 3)"""
SHOT = {"mode": "rgb_array", "camera": "down", "width": WIDTH, "height": HEIGHT}
"""Arguments of ``render`` for the image from above."""


def set_positions(sim, pos):
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=np.float32(pos)))


@pytest.fixture(scope="module")
def sim(opengl, plain_scene):
    sim = Sim(n_worlds=2, xml_path=plain_scene)
    set_positions(sim, POSITIONS)
    yield sim
    sim.close()


@pytest.fixture(scope="module")
def empty_image(sim):
    """Return the image from above without any drone in it."""
    set_positions(sim, POSITIONS + [100, 0, 0])
    picture = sim.render(**SHOT)
    set_positions(sim, POSITIONS)
    return picture


def difference(picture, empty_image):
    """Return the pixels that differ from the image without drones. (height, width)"""
    return np.abs(picture.astype(int) - empty_image.astype(int)).sum(-1) > 30


# Contents of an image -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", [0, 1])
def test_the_drone_of_the_world_is_drawn_where_it_is(sim, empty_image, world):
    """Pixels that differ from the empty floor lie around the drone's projection, as wide as the drone is there."""
    changed = difference(sim.render(**SHOT, world=world), empty_image)
    rows, columns = np.nonzero(changed)
    row, column = pixel(POSITIONS[world, 0])
    assert len(rows) > 20
    np.testing.assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], [row, column], atol=1.0)
    focal = 0.5 * HEIGHT / np.tan(np.deg2rad(FOVY / 2))
    reach = (
        0.09 * focal / (CAMERA_HEIGHT - POSITIONS[world, 0, 2])
    )  # the propellers' tips are within 9 cm of the centre
    assert 0.5 * reach < np.abs(np.stack([rows - row, columns - column])).max() < reach + 1


def test_the_empty_image_is_plain_floor(empty_image):
    assert empty_image.shape == (HEIGHT, WIDTH, 3)
    assert empty_image.dtype == np.uint8
    assert empty_image.min() > 100
    assert np.ptp(empty_image.reshape(-1, 3), axis=0).max() < 20


def test_a_drone_that_rolled_shows_its_side(sim, empty_image):
    """Attitude is converted to MuJoCo's order: rolled by 90 degrees the drone is narrow across, but not shorter."""

    def turn_and_measure(quat_xyzw):
        states = sim.data.states
        sim.data = sim.data.replace(states=states.replace(quat=np.tile(np.float32(quat_xyzw), (2, 1, 1))))
        rows, columns = np.nonzero(difference(sim.render(**SHOT), empty_image))
        return np.ptp(rows), np.ptp(columns)

    s = np.sqrt(0.5)
    level, rolled, pitched = (turn_and_measure(quat) for quat in ([0, 0, 0, 1.0], [s, 0, 0, s], [0, s, 0, s]))
    turn_and_measure([0, 0, 0, 1.0])  # level again for the next tests
    assert rolled[0] < 0.6 * level[0]
    assert rolled[1] > 0.8 * level[1]
    assert pitched[1] < 0.6 * level[1]
    assert pitched[0] > 0.8 * level[0]


def test_a_body_that_a_user_moved_is_drawn_where_it_is(opengl):
    """Bodies moved through mjx_data are drawn where each world has them; before that, at their initial poses."""
    sim = Sim(n_worlds=2)
    ball = sim.spec.worldbody.add_body(name="ball", pos=[0, 0, 1], mocap=True)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.3, 0, 0], rgba=[1, 0, 0, 1])
    sim.build_mjx()
    shot = {"mode": "rgb_array", "width": 64, "height": 48}
    view = {"lookat": [0, 0, 1], "distance": 4, "azimuth": 90, "elevation": 0}  # along +y: x is right

    def column_of_ball(world):
        picture = sim.render(**shot, world=world, cam_config=view).astype(int)
        columns = np.nonzero((picture[..., 0] > 80) & (picture[..., 1] < 60))[1]
        assert len(columns) > 20
        return columns.mean() + 0.5

    assert abs(column_of_ball(0) - 32) < 1
    assert not sim.scene.is_allocated
    k = sim.mj_model.body("ball").mocapid.item()
    mocap_pos = np.array(sim.mjx_data.mocap_pos)
    mocap_pos[:, k, 0] = -0.8, 0.8
    sim.mjx_data = sim.mjx_data.replace(mocap_pos=mocap_pos)
    assert column_of_ball(0) < 25
    assert column_of_ball(1) > 39
    sim.close()


# Cameras --------------------------------------------------------------------------------------------------------


def test_the_free_camera_follows_cam_config(sim, empty_image):
    """A free camera at the pose of the fixed camera has the same image; every call may set another pose."""
    free = {"lookat": [0, 0, 0], "distance": CAMERA_HEIGHT, "azimuth": 90, "elevation": -90}
    sim.mj_model.vis.global_.fovy = FOVY
    shot = SHOT | {"camera": -1}
    free_pixels = difference(sim.render(**shot, cam_config=free), empty_image)
    fixed_pixels = difference(sim.render(**SHOT), empty_image)
    assert np.mean(free_pixels == fixed_pixels) > 0.995
    moved = difference(sim.render(**shot, cam_config=free | {"lookat": [0.4, 0.2, 0]}), empty_image)
    rows, columns = np.nonzero(moved)
    x, y, z = POSITIONS[0, 0] - [0.4, 0.2, 0]
    np.testing.assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], pixel((x, y, z)), atol=1.0)
    array = sim.render(**shot, cam_config=free | {"lookat": np.array([0.4, 0.2, 0])})
    np.testing.assert_array_equal(difference(array, empty_image), moved)


def test_the_onboard_camera_turns_with_the_drone(sim):
    """A level camera sees the horizon in the middle. Pitched down by 90 degrees, it sees only floor."""
    shot = SHOT | {"mode": "depth_array", "camera": "fpv_cam:0"}
    ahead = sim.render(**shot)
    assert ahead[-1].max() < 1.0, "the floor is near below the horizon"
    assert ahead[0].min() > 10.0, "there is nothing above it"
    states = sim.data.states
    down = np.tile(np.float32([0, np.sqrt(0.5), 0, np.sqrt(0.5)]), (2, 1, 1))
    sim.data = sim.data.replace(states=states.replace(quat=down))
    depth = sim.render(**shot)
    sim.data = sim.data.replace(states=states)
    np.testing.assert_allclose(depth[0], POSITIONS[0, 0, 2] - 0.03, atol=5e-3)  # the camera is 3 cm ahead of the centre


# Arguments of each call --------------------------------------------------------------------------------------------


def test_every_call_uses_its_own_arguments(sim, empty_image):
    """Size, camera, world and mode of a later call are not those of the first."""
    first = sim.render(**SHOT)
    small = sim.render(**SHOT | {"width": 40, "height": 30})
    large = sim.render(**SHOT | {"width": 320, "height": 240})
    assert (small.shape, large.shape) == ((30, 40, 3), (240, 320, 3))
    for picture, factor in ((small, 4), (large, 0.5)):
        rows, columns = np.nonzero(np.abs(picture.astype(int) - empty_image[0, 0]).sum(-1) > 40)
        row, column = pixel(POSITIONS[0, 0])
        np.testing.assert_allclose(factor * np.array([rows.mean() + 0.5, columns.mean() + 0.5]), [row, column], atol=3)
    assert not difference(sim.render(**SHOT | {"camera": "aside"}), empty_image).any()
    assert difference(sim.render(**SHOT, world=1), first).any()
    np.testing.assert_array_equal(sim.render(**SHOT), first)


def test_a_second_simulation_draws_beside_the_first(sim):
    """Two simulations draw in turns, each its own drones; a closed one can draw again."""
    before = sim.render(**SHOT)
    other = Sim(n_worlds=2, n_drones=3)
    shot = {"mode": "rgb_array", "camera": "track_cam:2", "width": WIDTH, "height": HEIGHT}
    picture = other.render(**shot)
    np.testing.assert_array_equal(sim.render(**SHOT), before)
    np.testing.assert_array_equal(other.render(**shot), picture)
    other.close()
    other.close()
    np.testing.assert_array_equal(sim.render(**SHOT), before)
    np.testing.assert_array_equal(other.render(**shot), picture)
    other.close()


# Depth ----------------------------------------------------------------------------------------------------------


def test_depth_is_the_distance_along_the_axis_in_metres(sim):
    """From a camera that looks straight down, all floor has a depth of the camera's height; the drone is nearer."""
    depth = sim.render(**SHOT | {"mode": "depth_array"})
    assert depth.shape == (HEIGHT, WIDTH)
    assert depth.dtype == np.float32
    floor = np.abs(depth - CAMERA_HEIGHT) < 2e-3
    assert floor[[0, 0, -1, -1], [0, -1, 0, -1]].all()
    row, column = (int(x) for x in pixel(POSITIONS[0, 0]))
    around = depth[row - 6 : row + 7, column - 6 : column + 7]
    distance = CAMERA_HEIGHT - POSITIONS[0, 0, 2]
    assert distance - 0.05 < around.min() < distance
    outside = depth.copy()
    outside[row - 12 : row + 13, column - 12 : column + 13] = CAMERA_HEIGHT
    np.testing.assert_allclose(outside, CAMERA_HEIGHT, atol=2e-3)


# Windows --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def screen(tmp_path_factory):
    yield from virtual_screen(tmp_path_factory.mktemp("screen"))


WINDOW_SCRIPT = textwrap.dedent("""
    import sys
    import numpy as np
    from crazysim.media import View
    from crazysim.sim import Sim
    from crazysim.sim.visualize import draw_points, draw_text

    def wait(word):
        print(word, flush=True)
        sys.stdin.readline()

    sim = Sim(n_worlds=2)
    view = {"lookat": [0, 0, 0], "distance": 2.0, "azimuth": 90, "elevation": -90}
    shot = {"mode": "human", "width": 400, "height": 300}
    for i in range(5):
        sim.step(5)
        draw_points(sim, [[0.3, 0, 0.05]], rgba=[1, 0, 0, 1], size=0.05)
        sim.render(**shot, cam_config=view)
    wait("red")
    picture = sim.render("rgb_array", width=64, height=48)
    assert picture.shape == (48, 64, 3) and picture.std() > 1
    draw_points(sim, [[-0.3, 0, 0.05]], rgba=[0, 0, 1, 1], size=0.05)
    draw_text(sim, "the blue one", "bottom right")
    View(worlds=1, width=400, height=300, cam_config=view, text="world {world}").show(sim)
    wait("blue")
    sim.render(**shot | {"width": 200, "height": 150}, camera="track_cam:0")
    sim.close()
    sim.render(**shot)
    window = sim.viewer._windows[0]
    window._glfw.set_window_should_close(window._window, True)
    sim.step()
    sim.render(**shot)
    assert not window.is_open
    sim.render("rgb_array", width=32, height=24)
    print("done", flush=True)
""")


@pytest.mark.parametrize("backend", ["glfw", "egl"])
def test_a_window_shows_the_world_and_closes(screen, backend, tmp_path, opengl):
    """A window shows the simulation from call to call, beside images in memory, and closes without a crash.

    The program does not close its simulation: contexts are freed before the interpreter ends, so that no error is
    printed at exit.
    """
    display, pixels = screen
    errors = tmp_path / "errors.txt"
    environment = os.environ | {"DISPLAY": display, "MUJOCO_GL": backend, "PYTHONWARNINGS": "error"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors.open("w"), "text": True}
    program = subprocess.Popen([sys.executable, "-c", WINDOW_SCRIPT], env=environment, **pipes)

    def wait_for_color(word):
        """Return the screen once it shows the point of this colour: a screen server draws with a delay."""
        assert program.stdout.readline().strip() == word
        for _ in range(100):
            picture = screen_pixels(pixels).astype(int)
            red = (picture[..., 0] > 150) & (picture[..., 1:].max(-1) < 90)
            blue = (picture[..., 2] > 150) & (picture[..., :2].max(-1) < 90)
            if {"red": red, "blue": blue}[word].sum() > 100:
                break
            time.sleep(0.1)
        program.stdin.write("\n")
        program.stdin.flush()
        return picture, red, blue

    try:
        first, red, blue = wait_for_color("red")
        lit = np.nonzero(first.max(-1) > 20)
        assert np.ptp(lit[0]) + 1 == 300
        assert np.ptp(lit[1]) + 1 == 400
        assert red.sum() > 100
        assert not blue.any()
        assert np.nonzero(red)[1].mean() > lit[1].mean() + 20, "x is right in a view from above"
        second, red, blue = wait_for_color("blue")
        for picture, has_text in ((first, False), (second, True)):
            shown = picture[lit[0].min() : lit[0].max() + 1, lit[1].min() : lit[1].max() + 1]
            for corner in (shown[-40:, -150:], shown[:40, :100]):
                assert ((corner.max(-1) < 150).sum() > 500) == has_text, "letters stand on a dark ground"
        assert blue.sum() > 100
        assert not red.any(), "overlays are for one picture only"
        assert np.nonzero(blue)[1].mean() < lit[1].mean() - 20
        assert program.stdout.readline().strip() == "done"
        assert program.wait(300) == 0
        assert not errors.read_text()
    finally:
        program.kill()
        program.wait()
        for pipe in (program.stdin, program.stdout, pipes["stderr"]):
            pipe.close()


@pytest.mark.parametrize("display", [None, ":54321"])
def test_without_a_screen_a_window_is_refused_in_one_line(display, monkeypatch):
    """The error says that there is no screen, and what to do instead."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)
    sim = Sim(n_worlds=2)
    with pytest.raises(RenderError, match="mode='rgb_array'") as caught:
        sim.render("human")
    assert "\n" not in str(caught.value)
    sim.step()


def test_without_opengl_an_image_is_refused_in_one_line(monkeypatch):
    """Whatever the OpenGL bindings raise becomes one error that says what to install."""

    def broken(*args, **kwargs):
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    monkeypatch.setattr(mujoco, "Renderer", broken)
    sim = Sim(n_worlds=2)
    with pytest.raises(RenderError, match="MUJOCO_GL=egl and install libegl1") as caught:
        sim.render("rgb_array")
    assert "\n" not in str(caught.value)


def test_more_drones_are_drawn_than_mujoco_draws_materials(opengl, plain_scene):
    """1,100 drones would have 2,200 materials of LEDs; the first and the last drone are in the image."""
    sim = Sim(n_drones=1100, xml_path=plain_scene, engine="plain")
    pos = np.full((1, 1100, 3), 100.0)
    far = np.float32(pos)
    pos[0, [0, -1]] = [[0.3, 0, 1], [-0.3, 0, 1]]
    shot = {"mode": "rgb_array", "camera": "down", "width": 64, "height": 48}
    set_positions(sim, far)
    empty = sim.render(**shot)
    set_positions(sim, pos)
    changed = difference(sim.render(**shot), empty)
    assert changed[:, :32].any()
    assert changed[:, 32:].any()
    change_material(sim, "led_top", [MAX_LED_DRONES - 1], rgba=(1, 0, 0, 1))
    with pytest.raises(UnknownNameError, match=r"of the first 450 drones, .* of drones up to 450"):
        change_material(sim, "led_top", [0, MAX_LED_DRONES], rgba=(1, 0, 0, 1))
    sim.close()


@pytest.mark.parametrize(("n_materials", "is_drawn"), [(MAX_MATERIALS, True), (MAX_MATERIALS + 1, False)])
def test_more_materials_than_mujoco_draws_are_refused_with_their_number(opengl, tmp_path, n_materials, is_drawn):
    n_own = Sim(engine="plain").mj_model.nmat - mujoco.MjModel.from_xml_path(str(SCENE_FILE)).nmat
    materials = "".join(f"<material name='m{i}'/>" for i in range(n_materials - n_own))
    scene = tmp_path / "scene.xml"
    scene.write_text(f"<mujoco><asset>{materials}</asset></mujoco>")
    sim = Sim(xml_path=scene, engine="plain")
    assert sim.mj_model.nmat == n_materials
    if is_drawn:
        assert sim.render("rgb_array", width=8, height=8).shape == (8, 8, 3)
    else:
        with pytest.raises(RenderError, match=f"expected at most {MAX_MATERIALS} materials .*, got {n_materials}"):
            sim.render("rgb_array", width=8, height=8)
    sim.close()


def test_an_image_that_is_too_large_for_opengl_leaves_other_sizes_as_they_were():
    sim = Sim(engine="plain")
    sim.render("rgb_array", width=32, height=24)
    with pytest.raises(RenderError, match="of a size that OpenGL can draw here, got 33000 x 24 pixels"):
        sim.render("rgb_array", width=33000, height=24)
    assert sim.render("rgb_array", width=64, height=48).shape == (48, 64, 3)
    sim.close()


def test_any_thread_may_draw_with_and_free_contexts_of_another_thread(opengl, plain_scene):
    """Garbage collection may run in any thread while the drawing thread still runs."""
    sim, end = Sim(n_worlds=2, xml_path=plain_scene), threading.Event()
    images = queue.Queue()

    def draw():
        images.put(sim.render(**SHOT))
        end.wait(300)

    thread = threading.Thread(target=draw)
    thread.start()
    try:
        np.testing.assert_array_equal(images.get(timeout=300), sim.render(**SHOT))
        sim.close()
    finally:
        end.set()
        thread.join()
