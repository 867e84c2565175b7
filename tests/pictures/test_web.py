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
import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe

from crazysim.__main__ import main
from crazysim.pictures import Recorder
from crazysim.pictures.web import FOV, camera_of, page
from crazysim.sim import Sim

WIDTH, HEIGHT = 640, 480
START, END = np.array([-0.5, 0.0, 0.8]), np.array([0.5, 0.0, 1.2])
"""Where the drone of world 1 begins and ends, m."""


@pytest.fixture(scope="module")
def flight(plain_scene):
    """A second in two worlds: a magenta drone flies from left to right in world 1, and stands in world 0."""
    sim = Sim(n_worlds=2, xml_path=plain_scene)
    sim.mj_model.mat_rgba[:] = [1, 0, 1, 1]
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
        wait_for(lambda: ready.exists() and ready.read_text().count("\n") > 0)
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
        """Open a page with a flight, and wait until its bar and its picture are there."""
        self.call("Page.navigate", url=url)
        wait_for(lambda: self.box(".mantine-Slider-track") and self.box("canvas"))

    def scrub(self, part):
        """Click into the bar, and return the time that the page shows then."""
        left, top, width, height = self.box(".mantine-Slider-track")
        for event in ("mousePressed", "mouseReleased"):
            self.call(
                "Input.dispatchMouseEvent",
                type=event,
                x=left + part * width,
                y=top + height / 2,
                button="left",
                clickCount=1,
            )
        return float(self.value("document.querySelector('input').value"))

    def picture(self):
        """Return the window's pixels. (height, width, 3)"""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        size = self.value("[window.innerWidth, window.innerHeight]")
        decode = [get_ffmpeg_exe(), "-loglevel", "error", "-f", "png_pipe", "-i", "-"]
        decode += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
        pixels = subprocess.run(decode, input=png, capture_output=True, check=True).stdout
        return np.frombuffer(pixels, np.uint8).reshape(size[1], size[0], 3).astype(int)

    def drone(self):
        """Return column and row of the middle of what is magenta, once it stands still."""
        before, deadline = None, time.monotonic() + 30
        while time.monotonic() < deadline:
            picture = self.picture()
            rows, columns = np.nonzero(np.minimum(picture[..., 0], picture[..., 2]) > picture[..., 1] + 60)
            place = np.array([columns.mean() + 0.5, rows.mean() + 0.5]) if len(rows) > 20 else None
            if place is not None and before is not None and np.allclose(place, before, atol=0.1):
                return place
            before = place
            time.sleep(0.3)
        raise AssertionError("no drone is seen")

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
    """Wherever the bar is clicked, forwards and backwards, the drone is seen where it was at that time."""
    flight.save(tmp_path / "flight.npz")
    command = [sys.executable, "-m", "crazysim", "replay", "flight.npz", "--world", "1", "--port", "0"]
    program = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": ":".join(sys.path)}
    )
    try:
        url = program.stdout.readline().split()[4].rstrip(";")
        browser.open(url)
        for part in (0.1, 0.9, 0.3):
            assert abs(browser.scrub(part) - part) < 0.06
            flown = START + part * (END - START)
            np.testing.assert_allclose(browser.drone(), pixel(browser, flight, flown, 1), atol=12)
    finally:
        program.send_signal(signal.SIGINT)
        assert program.wait(30) == 0
        program.stdout.close()


def test_an_exported_flight_opens_from_its_file(viser, browser, flight, tmp_path, capsys):
    """One file, no server: it has what was recorded of the world asked for, here one where the drone stands still."""
    flight.save(tmp_path / "flight.npz")
    out = tmp_path / "flight.html"
    assert main(["replay", str(tmp_path / "flight.npz"), "--export", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    browser.open(out.as_uri())
    for part in (0.2, 0.8):
        browser.scrub(part)
        np.testing.assert_allclose(browser.drone(), pixel(browser, flight, np.zeros(3), 0), atol=12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.npz"], "there is no file nowhere.npz"),
        (["flight.npz", "--world", "5"], "world 5 was not recorded; recorded are [0, 1]"),
        (["flight.npz", "--export", "flight.txt"], "must end with .html"),
        (["flight.npz", "--export", "nowhere/flight.html"], "there is no folder nowhere"),
        (["flight.npz", "--port", "99999"], "choose another --port"),
    ],
)
def test_a_replay_that_cannot_be_is_one_line(viser, flight, tmp_path, monkeypatch, capsys, arguments, message):
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
