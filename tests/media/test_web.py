"""Recorded flights in a real browser, which is controlled by mouse events."""

import os
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from browsing import MAX_PIXEL_DISTANCE
from waiting import wait_for

from crazysim.__main__ import main
from crazysim.errors import ConfigError, RenderError
from crazysim.media import Recorder, web
from crazysim.media.browser_scene import BrowserScene
from crazysim.media.web import FOV, initial_camera_pose, page
from crazysim.sim import Sim

START, END = np.array([-0.5, 0.0, 0.8]), np.array([0.5, 0.0, 1.2])
"""Positions of the drone of world 1 at the start and at the end, m."""
BOX = np.array([0.25, 0.0, 0.05])
"""Position of the box in world 0, m. It is upright in the model, and lies along x in that world."""
MAGENTA, GREEN = (1, 0, 1), (0, 1, 0)


@pytest.fixture(scope="module")
def flight(plain_scene):
    """Return a flight of 1 s: a magenta drone flies from left to right in world 1, and stands by a box in world 0."""
    sim = Sim(n_worlds=2, xml_path=plain_scene)
    box = sim.spec.worldbody.add_body(name="box", pos=[0, 0, -5], mocap=True)
    box.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 0.02, 0.1], rgba=[0, 1, 0, 1])
    sim.build_mjx()
    sim.mj_model.mat_rgba[:] = [1, 0, 1, 1]
    ids = sim.mj_model.body("box").mocapid.item()
    half = np.sqrt(0.5)
    sim.mjx_data = sim.mjx_data.replace(
        mocap_pos=sim.mjx_data.mocap_pos.at[0, ids].set(BOX),
        mocap_quat=sim.mjx_data.mocap_quat.at[0, ids].set(jnp.array([half, 0, half, 0])),
    )
    recorder = Recorder(sim)
    for k in range(11):
        pos = jnp.zeros((2, 1, 3)).at[1, 0].set(START + 0.1 * k * (END - START))
        core = sim.data.core.replace(steps=jnp.full_like(sim.data.core.steps, 50 * k))
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos), core=core)
        recorder.add()
    return recorder.flight()


def open_flight(browser, url):
    """Open a page with a flight, and wait until its bar and its image are there."""
    browser.open(url, 640, 340)
    wait_for(lambda: browser.box(".mantine-Slider-track") and browser.box("canvas"))
    scrub(browser, 0.5)  # which stops the playback


def scrub(browser, fraction):
    """Click at a fraction of the bar of a flight of one second until the page shows that time.

    The first click may only stop the playback, one frame late; then another one is needed.
    """
    left, top, width, height = browser.box(".mantine-Slider-track")
    position = {"x": left + fraction * width, "y": top + height / 2, "button": "left", "clickCount": 1}

    def is_shown():
        return abs(float(browser.value("document.querySelector('input').value")) - fraction) < 0.06

    def click_and_check():
        for event in ("mousePressed", "mouseReleased"):
            browser.call("Input.dispatchMouseEvent", type=event, **position)
        deadline = time.monotonic() + 0.5
        while not is_shown() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.1)
        return is_shown()

    wait_for(click_and_check)


def pixel(browser, flight, point, world):
    """Return column and row of a point in the initial image of a page."""
    position, target = initial_camera_pose(flight, world)
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    left, top, width, height = browser.box("canvas")
    focal = 0.5 * height / np.tan(np.deg2rad(FOV / 2))
    x, y, z = (point - position) @ np.stack([right, np.cross(right, ahead), ahead]).T
    return left + 0.5 * width + focal * x / z, top + 0.5 * height - focal * y / z


def test_a_served_flight_is_scrubbed_in_a_browser(chromium, flight, tmp_path):
    """After a click on the bar, forwards or backwards, the drone is shown at its position of that time."""
    flight.save(tmp_path / "flight.journal")
    # Programs that a shell started in the background ignore SIGINT, and so would this one.
    start = "import browsing, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    start += "browsing.use_simple_lights(); "
    start += "from crazysim.__main__ import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", start, "replay", "flight.journal", "--world", "1", "--port", "0"]
    program = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": ":".join(sys.path)}
    )
    try:
        url = program.stdout.readline().split()[4].rstrip(";")
        open_flight(chromium, url)
        for fraction in (0.1, 0.9, 0.3):
            scrub(chromium, fraction)
            expected = pixel(chromium, flight, START + fraction * (END - START), 1)
            np.testing.assert_allclose(chromium.find(MAGENTA, expected), expected, atol=MAX_PIXEL_DISTANCE)
    finally:
        program.send_signal(signal.SIGINT)
        assert program.wait(300) == 0
        program.stdout.close()


def test_a_caption_is_asked_for_at_each_sample(flight):
    times = []
    assert "<html" in page(flight, 1, caption=lambda time: times.append(time) or "text")
    np.testing.assert_allclose(times, np.linspace(0, 1, 31))


def test_an_exported_flight_opens_from_its_file(chromium, flight, tmp_path, capsys):
    """The file needs no server and has the requested world, here with a drone and a box at rest."""
    flight.save(tmp_path / "flight.journal")
    out = tmp_path / "flight.html"
    assert main(["replay", str(tmp_path / "flight.journal"), "--export", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    open_flight(chromium, out.as_uri())
    for fraction in (0.2, 0.8):
        scrub(chromium, fraction)
        for color, point in ((MAGENTA, np.zeros(3)), (GREEN, BOX)):
            expected = pixel(chromium, flight, point, 0)
            np.testing.assert_allclose(chromium.find(color, expected), expected, atol=MAX_PIXEL_DISTANCE)
    rows, columns = chromium.mask(GREEN)
    assert np.ptp(columns) > 2 * np.ptp(rows), "the box lies"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.journal"], "expected an existing file with a recorded flight, got 'nowhere.journal'"),
        (["flight.journal", "--world", "5"], "expected a recorded world, one of [0, 1], got 5"),
        (["flight.journal", "--export", "flight.txt"], "a file that ends with .html"),
        (["flight.journal", "--export", "nowhere/flight.html"], "expected an existing folder, got 'nowhere'"),
        (["flight.journal", "--host", "nohost.invalid"], "Choose another --host"),
    ],
)
def test_an_invalid_replay_is_refused_in_one_line(viser, flight, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    flight.save("flight.journal")
    assert main(["replay", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error


def test_without_viser_the_extra_is_named(flight, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"pip install 'crazysim\[web\]'"):
        page(flight)


@pytest.mark.parametrize("wrong", [{"flight": 3}, {"lights": [[1.0], [1.0, 2.0]]}, {"lights": np.zeros((1, 3))}])
def test_wrong_flights_and_lights_are_named(flight, wrong):
    with pytest.raises(ConfigError, match=f"{next(iter(wrong))}"):
        page(**{"flight": flight} | wrong)


def test_poses_that_are_not_finite_or_have_not_changed_are_not_sent():
    scene, sent = BrowserScene.__new__(BrowserScene), []
    scene._sent_values = {}

    class Handle:
        name = "/a"
        values = property(None, lambda _, values: sent.append(values))

    for values in ([[1.0, 2.0]], [[1.0, 2.0]], [[np.nan, np.nan]], [[3.0, np.inf]]):
        scene._send(Handle(), "values", np.array(values))
    np.testing.assert_array_equal(sent, [[[1.0, 2.0]], [[3.0, 2.0]]])


class StubServer:
    """A server of pages that ends at once."""

    server_port = 8123

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def serve_forever(self):
        raise KeyboardInterrupt


def test_a_served_page_says_who_can_watch(monkeypatch, capsys):
    monkeypatch.setattr(web, "create_server", lambda html, port, host: StubServer())
    web.serve_page("", 0)
    assert capsys.readouterr().out == "serving the flight at http://127.0.0.1:8123; stop with Ctrl-C\n"
    web.serve_page("", 0, "0.0.0.0")
    assert "every machine of that network can watch" in capsys.readouterr().out


def test_a_served_page_answers_to_names_of_this_machine():
    with web.create_server("<p>flight</p>", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        address = f"http://127.0.0.1:{server.server_port}"
        with urllib.request.urlopen(address) as answer:
            assert answer.read() == b"<p>flight</p>"
        foreign = urllib.request.Request(address, headers={"Host": "example.org"})
        with pytest.raises(urllib.error.HTTPError, match="403") as refused:
            urllib.request.urlopen(foreign)
        refused.value.close()
        server.shutdown()
        thread.join()


def test_a_port_in_use_is_named():
    with web.create_server("", 0) as server:
        assert server.server_address[0] == "127.0.0.1"
        with pytest.raises(RenderError, match=f"free address, got 127.0.0.1:{server.server_port}"):
            web.create_server("", server.server_port)
