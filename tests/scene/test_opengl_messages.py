"""MuJoCo chooses a way to draw when it is imported; where that fails, the message has the remedy that helps."""

import os
import subprocess
import sys

import pytest

DRAW = "from crazysim import Sim; Sim().render('rgb_array')"


@pytest.mark.long("processes that import JAX")
@pytest.mark.parametrize(
    "variable, first, message",
    [
        ("osmesa", "", "with which MuJoCo can draw, got 'osmesa'. Use MUJOCO_GL=egl."),
        ("", "import mujoco; ", "Import crazysim before mujoco, or set MUJOCO_GL=egl before Python starts."),
    ],
)
def test_the_message_names_the_remedy(variable, first, message):
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")}
    environment |= {"MUJOCO_GL": variable} if variable else {}
    command = [sys.executable, "-W", "ignore", "-c", first + DRAW]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert message in done.stderr
