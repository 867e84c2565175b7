"""A live window on a virtual screen: its picture, windows that are killed, errors, LEDs and reports of clicks."""

import sys
import threading

import mujoco
import numpy as np
import pytest
from screens import screen_pixels, virtual_screen
from waiting import wait_for

from crazysim.errors import ConfigError, RenderError
from crazysim.lab.live import Live, Window
from crazysim.lab.live.leds import Leds
from crazysim.lab.live.picture import PictureSource
from crazysim.plugins.vehicles import Cars
from crazysim.scene.scene_window import camera_ray
from crazysim.sim import Sim


@pytest.fixture(scope="module")
def screen(tmp_path_factory):
    yield from virtual_screen(tmp_path_factory.mktemp("screen"))


def mark_columns(pixels):
    """Return the columns of the pixels that show the mark of the selected drone in the right tile."""
    tile = pixels[:200, 200:400].astype(int)
    return 200 + np.nonzero(tile[..., 2] > tile[..., 0] + 25)[1]


def test_a_window_shows_worlds_and_the_run_continues_when_it_is_killed(screen, opengl, monkeypatch):
    """The run ends with its last window."""
    display, path = screen
    monkeypatch.setenv("DISPLAY", display)
    sim = Sim(n_worlds=2, control="state")
    sim.spec.visual.quality.shadowsize = sim.spec.visual.quality.offsamples = 0  # drawn sooner without a GPU
    pos = np.array([[[0.0, 0.0, 1.0]], [[0.3, 0.0, 1.0]]])
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    camera = {"lookat": [0, 0, 1], "distance": 2.0, "azimuth": 90, "elevation": -90}
    with Live(sim, fps=10) as live:
        live.selected, live.paused = None, True
        window = live.show(Window(worlds=(0, 1), width=400, height=200, cam_config=camera, setpoints=False, trail=0.0))
        other = live.show(Window(width=64, height=48))
        thread = threading.Thread(target=live.run)
        thread.start()
        try:
            live.post(lambda live: live.select(1, 0))
            wait_for(lambda: len(mark_columns(screen_pixels(path))) > 50)
            # The right tile shows world 1, whose drone is selected. It is 0.3 m to the right of the point that the
            # camera looks at from a distance of 2 m. The camera's 45 degrees fill 200 pixels, so a metre takes
            # 200 / (2 * 2 * tan 22.5 deg) = 121 pixels, and the mark is 36 pixels to the right of the middle.
            np.testing.assert_allclose(mark_columns(screen_pixels(path)).mean(), 200 + 100 + 36, atol=6)
            window._process.kill()
            wait_for(lambda: not window.is_open)
            steps = []
            live.post(lambda live: live.advance(1))
            live.post(lambda live: steps.append(live.step))
            wait_for(lambda: steps)
            assert steps == [1]
            other._process.kill()
            thread.join(300)
            assert not thread.is_alive()
            assert not other.is_open
        finally:
            live.post(lambda live: live.stop())
            thread.join(300)


def test_without_a_screen_a_window_is_refused(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform != "linux":
        pytest.skip("only on Linux do environment variables name the screen")
    with Live(Sim()) as live, pytest.raises(RenderError, match="expected a screen"):
        live.show(Window())


def test_wrong_settings(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":54321")
    with pytest.raises(ConfigError, match="positive integers as width"):
        Window(width=0)
    with pytest.raises(ConfigError, match="trail of 0 s or more"):
        Window(trail=-1.0)
    with Live(Sim()) as live:
        with pytest.raises(ConfigError, match="a world from 0 to 0, got 1"):
            live.show(Window(worlds=[1]))
        with pytest.raises(ConfigError, match="camera of the scene"):
            live.show(Window(camera="front"))


def test_a_screen_that_cannot_be_reached_is_refused(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":54321")
    with Live(Sim()) as live, pytest.raises(RenderError, match="can open a window"):
        live.show(Window())


def test_leds_have_the_colours_of_the_picture():
    model = Sim(n_drones=2).mj_model
    initial_rgba = model.mat_rgba.copy()
    leds = Leds(model)
    leds.set_colors(np.array([[0.0, 0.0, 0.0], [0.2, 0.6, 0.0]]))
    for name in ("led_top", "led_bot"):
        np.testing.assert_allclose(model.material(f"{name}:1").rgba, [0.2, 0.6, 0.0, 1.0])
        assert model.material(f"{name}:1").emission[0] == pytest.approx(0.6)
    changed = np.flatnonzero((model.mat_rgba != initial_rgba).any(-1))
    assert {model.material(int(k)).name for k in changed} == {"led_top:1", "led_bot:1"}
    leds.set_colors(np.zeros((2, 3)))
    np.testing.assert_array_equal(model.mat_rgba, initial_rgba)


def test_a_ray_through_the_cursor_hits_what_is_drawn_there():
    """The ray through a point of the image passes through the geom that MuJoCo selects there."""
    sim = Sim(n_drones=2)
    sim.sync(0)
    model, data, option = sim.mj_model, sim.mj_data, mujoco.MjvOption()
    camera, scene = mujoco.MjvCamera(), mujoco.MjvScene(model, 1000)
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.2, 0.1, 0.0), 1.5, 30.0, -40.0
    mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    for x, y in ((0.5, 0.5), (0.2, 0.3), (0.9, 0.1)):
        point, geom, flex, skin = np.zeros(3), np.full((1, 1), -1, np.int32), *np.full((2, 1, 1), -1, np.int32)
        mujoco.mjv_select(model, data, option, 1.6, x, y, scene, point, geom, flex, skin)
        origin, direction = camera_ray(scene, 1.6, x, y)
        assert geom[0, 0] >= 0
        to_point = (point - origin) / np.linalg.norm(point - origin)
        np.testing.assert_allclose(direction / np.linalg.norm(direction), to_point, atol=1e-4)


def test_a_click_follows_the_body_below_it():
    """A click on a wheel follows its car; other worlds are not below the cursor."""
    sim = Sim(n_worlds=2, n_drones=2, control="state")
    sim.add(Cars(2))
    live, clicked = Live(sim), []
    live.on_click = lambda live, world, point: clicked.append((world, *point))
    source = PictureSource(sim, [0, 1])
    picture = source.take_picture(live)
    wheel = picture.pos[1, sim.mj_model.body("cars_wheel:7").mocapid.item()]
    for target, direction in ((wheel, [0, 0, -1.0]), ([7.0, 8.0, 0.0], [0.1, 0, -1.0]), (wheel, [0, 0, 1.0])):
        origins = np.stack([np.full(3, np.nan), np.asarray(target) - 2 * np.array(direction)])
        live.click_along(source.bodies, picture, origins, np.array(direction))
    live._run_posted()
    assert live.followed == (1, "cars", 1)
    np.testing.assert_allclose(clicked, [(1, 7.0, 8.0, 0.0)])
