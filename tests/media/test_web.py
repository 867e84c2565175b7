"""A recorded flight is opened in a real browser, scrubbed with its mouse, and looked at."""

import base64
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe

from crazysim.__main__ import main
from crazysim.media import Recorder
from crazysim.media.web import FOV, camera_of, page
from crazysim.sim import Sim

WIDTH, HEIGHT = 640, 480
START, END = np.array([-0.5, 0.0, 0.8]), np.array([0.5, 0.0, 1.2])
"""Where the drone of world 1 begins and ends, m."""
BOX = np.array([0.25, 0.0, 0.05])
"""Where the obstacle of world 0 is, m; it stands on edge in the model, and lies along x in that world."""
MAGENTA, GREEN = (1, 0, 1), (0, 1, 0)
NEAR = 12
"""Pixels between where something is seen and where it is; the drone flies 10 from one of the page's moments on."""


@pytest.fixture(scope="module")
def flight(plain_scene):
    """A second in two worlds: a magenta drone flies from left to right in world 1, and stands by a box in world 0."""
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


class Browser:
    """A browser without a screen, spoken to over its debugging protocol."""

    def __init__(self, program, folder):
        from websockets.sync.client import connect

        options = ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader"]
        options += ["--enable-unsafe-swiftshader", "--remote-debugging-port=0", f"--user-data-dir={folder}"]
        self._process = subprocess.Popen(
            [program, *options, f"--window-size={WIDTH},{HEIGHT}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        ready = folder / "DevToolsActivePort"
        try:
            wait_for(lambda: ready.exists() and ready.read_text().count("\n") > 0)
        except AssertionError:
            self._process.kill()
            raise
        with urllib.request.urlopen(f"http://127.0.0.1:{ready.read_text().split()[0]}/json") as answer:
            tabs = json.load(answer)
        tab = next(tab for tab in tabs if tab["type"] == "page")
        self._socket = connect(tab["webSocketDebuggerUrl"], max_size=None)
        self._n = 0

    def call(self, method, **params):
        self._n += 1
        self._socket.send(json.dumps({"id": self._n, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(60))
            if answer.get("id") == self._n:
                assert "error" not in answer, answer
                return answer["result"]

    def value(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def box(self, selector):
        """Return left, top, width and height of an element, or None while it is not there."""
        return self.value(
            f"(() => {{ const e = document.querySelector('{selector}'); if (!e) return null;"
            f" const b = e.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; }})()"
        )

    def open(self, url):
        """Open a page with a flight, and wait until its bar and its image are there."""
        self.call("Page.navigate", url=url)
        wait_for(lambda: self.box(".mantine-Slider-track") and self.box("canvas"))
        self.scrub(0.5)  # from here on it stands still

    def scrub(self, part):
        """Click into the bar of a flight of one second until the page shows that time.

        The first click may be one too few: it ends the playing, a frame late.
        """
        left, top, width, height = self.box(".mantine-Slider-track")
        where = {"x": left + part * width, "y": top + height / 2, "button": "left", "clickCount": 1}

        def shown():
            for event in ("mousePressed", "mouseReleased"):
                self.call("Input.dispatchMouseEvent", type=event, **where)
            time.sleep(0.5)
            return abs(float(self.value("document.querySelector('input').value")) - part) < 0.06

        wait_for(shown)

    def picture(self):
        """Return the window's pixels. (height, width, 3)"""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        size = self.value("[window.innerWidth, window.innerHeight]")
        decode = [get_ffmpeg_exe(), "-loglevel", "error", "-f", "png_pipe", "-i", "-"]
        decode += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
        pixels = subprocess.run(decode, input=png, capture_output=True, check=True).stdout
        return np.frombuffer(pixels, np.uint8).reshape(size[1], size[0], 3).astype(int)

    def mask(self, rgb):
        """Return rows and columns of what has a hue."""
        picture, on = self.picture(), np.asarray(rgb) > 0
        return np.nonzero(picture[..., on].min(-1) > picture[..., ~on].max(-1) + 60)

    def find(self, rgb, near):
        """Return column and row of the middle of what has a hue, once that is near a place or half a minute is over."""
        place, deadline = np.full(2, np.inf), time.monotonic() + 30
        while time.monotonic() < deadline and not np.allclose(place, near, atol=NEAR):
            rows, columns = self.mask(rgb)
            if len(rows) > 20:
                place = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        return place

    def close(self):
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come to be"
        time.sleep(0.1)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium")
    browser = Browser(program, tmp_path_factory.mktemp("browser"))
    yield browser
    browser.close()


def pixel(browser, flight, point, world):
    """Return column and row at which a page's camera sees a point at first."""
    position, target = camera_of(flight, world)
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    left, top, width, height = browser.box("canvas")
    focal = 0.5 * height / np.tan(np.deg2rad(FOV / 2))
    x, y, z = (point - position) @ np.stack([right, np.cross(right, ahead), ahead]).T
    return left + 0.5 * width + focal * x / z, top + 0.5 * height - focal * y / z


def test_a_served_flight_is_scrubbed_in_a_browser(viser, browser, flight, tmp_path):
    """Wherever the bar is clicked, forwards and backwards, the drone is shown where it was at that time."""
    flight.save(tmp_path / "flight.npz")
    # Programs that a shell started in the background ignore SIGINT, and so would this one.
    start = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    start += "from crazysim.__main__ import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", start, "replay", "flight.npz", "--world", "1", "--port", "0"]
    program = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": ":".join(sys.path)}
    )
    try:
        url = program.stdout.readline().split()[4].rstrip(";")
        browser.open(url)
        for part in (0.1, 0.9, 0.3):
            browser.scrub(part)
            wanted = pixel(browser, flight, START + part * (END - START), 1)
            np.testing.assert_allclose(browser.find(MAGENTA, wanted), wanted, atol=NEAR)
    finally:
        program.send_signal(signal.SIGINT)
        assert program.wait(30) == 0
        program.stdout.close()


def test_an_exported_flight_opens_from_its_file(viser, browser, flight, tmp_path, capsys):
    """One file, no server: it has what was recorded of the requested world, here a drone and a box at rest."""
    flight.save(tmp_path / "flight.npz")
    out = tmp_path / "flight.html"
    assert main(["replay", str(tmp_path / "flight.npz"), "--export", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    browser.open(out.as_uri())
    for part in (0.2, 0.8):
        browser.scrub(part)
        for color, place in ((MAGENTA, np.zeros(3)), (GREEN, BOX)):
            wanted = pixel(browser, flight, place, 0)
            np.testing.assert_allclose(browser.find(color, wanted), wanted, atol=NEAR)
    rows, columns = browser.mask(GREEN)
    assert np.ptp(columns) > 2 * np.ptp(rows), "the box lies"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.npz"], "expected an existing file, got 'nowhere.npz'"),
        (["flight.npz", "--world", "5"], "expected a recorded world, one of [0, 1], got 5"),
        (["flight.npz", "--export", "flight.txt"], "to end with .html"),
        (["flight.npz", "--export", "nowhere/flight.html"], "expected an existing folder, got 'nowhere'"),
        (["flight.npz", "--port", "99999"], "Choose another --port"),
    ],
)
def test_an_invalid_replay_is_refused_in_one_line(viser, flight, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    flight.save("flight.npz")
    assert main(["replay", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error


def test_without_viser_the_extra_is_named(flight, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"pip install 'crazysim\[web\]'"):
        page(flight)
