"""A virtual screen for tests of windows, and its pixels."""

import os
import select
import shutil
import subprocess
import time

import numpy as np
import pytest


def virtual_screen(folder):
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb")
    read_end, write_end = os.pipe()
    options = ["-displayfd", str(write_end), "-screen", "0", "1280x720x24", "-fbdir", str(folder), "-nolisten", "tcp"]
    server = subprocess.Popen(["Xvfb", *options], pass_fds=[write_end], stderr=subprocess.DEVNULL)
    os.close(write_end)
    ready, _, _ = select.select([read_end], [], [], 300)
    number = os.read(read_end, 16).decode().strip() if ready else ""
    assert number, "Xvfb did not start"
    yield f":{number}", folder / "Xvfb_screen0"
    server.terminate()
    server.wait(300)
    os.close(read_end)


def screen_pixels(path, wait=True):
    """Return the pixels of a screen from its X window dump, by default once they are constant. (height, width, 3)"""
    raw, last_raw, deadline = path.read_bytes(), b"", time.monotonic() + 20
    while wait and raw != last_raw and time.monotonic() < deadline:  # the server draws an image strip by strip
        time.sleep(0.3)
        raw, last_raw = path.read_bytes(), raw
    header = np.frombuffer(raw[:100], ">u4").astype(int)
    start = header[0] + 12 * header[19]
    width, height, line = header[4], header[5], header[12]
    rows = np.frombuffer(raw[start : start + height * line], np.uint8).reshape(height, line)
    return rows[:, : 4 * width].reshape(height, width, 4)[..., 2::-1]
