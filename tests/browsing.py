"""A real browser for tests of pages, with the pixels that it shows."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request

import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from pictures import has_colour
from waiting import wait_for

MAX_PIXEL_DISTANCE = 12
"""Tolerance of positions in the window, pixels."""


class Browser:
    def __init__(self, program, folder):
        from websockets.sync.client import connect

        options = ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader"]
        options += ["--enable-unsafe-swiftshader", "--remote-debugging-port=0", f"--user-data-dir={folder}"]
        options += ["--disable-features=BackForwardCache"]  # a page that is left must end
        options += ["--webgl-antialiasing-mode=none"]
        self._process = subprocess.Popen(
            [program, *options, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = folder / "DevToolsActivePort"
        try:
            wait_for(lambda: port_file.exists() and port_file.read_text().count("\n") > 0)
        except AssertionError:
            self._process.kill()
            raise
        with urllib.request.urlopen(f"http://127.0.0.1:{port_file.read_text().split()[0]}/json") as answer:
            tabs = json.load(answer)
        tab = next(tab for tab in tabs if tab["type"] == "page")
        self._socket = connect(tab["webSocketDebuggerUrl"], max_size=None)
        self._n = 0

    def open(self, url, width, height):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Page.navigate", url=url)

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
        return self.value(
            f"(() => {{ const e = document.querySelector('{selector}'); if (!e) return null;"
            f" const b = e.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; }})()"
        )

    def picture(self):
        """Return the window's pixels. (height, width, 3)"""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        size = self.value("[window.innerWidth, window.innerHeight]")
        decode = [get_ffmpeg_exe(), "-loglevel", "error", "-f", "png_pipe", "-i", "-"]
        decode += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
        pixels = subprocess.run(decode, input=png, capture_output=True, check=True).stdout
        return np.frombuffer(pixels, np.uint8).reshape(size[1], size[0], 3).astype(int)

    def mask(self, rgb):
        return np.nonzero(has_colour(self.picture(), rgb))

    def find(self, rgb, expected):
        """Return column and row of the centre of all pixels of a hue.

        Wait up to 300 s until the centre is near an expected position.
        """
        centre, deadline = np.full(2, np.inf), time.monotonic() + 300
        while time.monotonic() < deadline and not np.allclose(centre, expected, atol=MAX_PIXEL_DISTANCE):
            rows, columns = self.mask(rgb)
            if len(rows) > 20:
                centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        return centre

    def close(self):
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)


def start_browser(folder):
    """Return a browser, or skip the test where there is none; CI forbids the skip."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium")
    return Browser(program, folder)


def use_simple_lights(patch=setattr):
    """Let new servers of viser light their pages from all directions, without shadows and reflections.

    Without a GPU, shadows and reflections take seconds for the first image.
    """
    import viser

    class Simple(viser.ViserServer):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.scene.configure_environment_map(None)
            self.scene.configure_default_lights(cast_shadow=False)
            self.scene.add_light_ambient("/light", intensity=2.0)

    patch(viser, "ViserServer", Simple)
