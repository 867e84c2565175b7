"""The window's mouse: callbacks, without a screen."""

import types

import mujoco
import numpy as np
import pytest

from crazysim.scene.scene_window import SceneWindow

BUTTONS = {"left": 0, "right": 1, "middle": 2}


@pytest.fixture
def window():
    """Return a window on a fake screen of 100 x 100 pixels; ``pressed`` is the name of the pressed button."""
    window = object.__new__(SceneWindow)
    window._model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    window._camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(window._model, window._camera)
    window._size, window._cursor, window.pressed = (100, 100), (0.0, 0.0), None
    window._glfw = types.SimpleNamespace(
        PRESS=1,
        **{f"MOUSE_BUTTON_{name.upper()}": number for name, number in BUTTONS.items()},
        get_mouse_button=lambda _, button: int(button == BUTTONS.get(window.pressed, -1)),
    )
    return window


def camera_view(window):
    camera = window._camera
    return np.array([camera.azimuth, camera.elevation, camera.distance, *camera.lookat])


@pytest.mark.parametrize("button, changed", [(None, []), ("left", [0, 1]), ("right", [3, 4, 5]), ("middle", [2])])
def test_dragging_rotates_moves_or_zooms_the_view(window, button, changed):
    """The left button rotates (azimuth, elevation), the right one moves (lookat), the middle one zooms (distance)."""
    window._camera.azimuth = 30  # so that a move to the side has a part along x and one along y
    window._on_move(None, 50, 50)
    before = camera_view(window)
    window.pressed = button
    window._on_move(None, 60, 45)
    np.testing.assert_array_equal(np.flatnonzero(camera_view(window) != before), changed)


def test_scrolling_zooms(window):
    before = camera_view(window)
    window._on_scroll(None, 0, 1)
    assert camera_view(window)[2] > before[2], "scrolling up moves the camera away, as in MuJoCo's own viewer"
    window._on_scroll(None, 0, -2)
    assert camera_view(window)[2] < before[2]
    np.testing.assert_array_equal(np.delete(camera_view(window), 2), np.delete(before, 2))
