"""Gamepads, read through GLFW, which is installed with MuJoCo and has the layouts of all common gamepads."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import require
from crazysim.lab.live.loop import Live

DEADBAND = 0.12
"""Deflection below which a stick counts as released, 0 to 1."""
N_JOYSTICKS = 16
"""Number of joysticks that GLFW distinguishes, GLFW_JOYSTICK_LAST + 1."""


class Gamepad:
    """Sticks of the first gamepad, for ``Pilot(sticks=[Gamepad()])``: smooth flight, where keys only switch.

    The left stick climbs and turns, the right stick moves forwards and sideways: mode 2 of model flying. While the
    gamepad is unplugged, the deflections are zero.
    """

    def __init__(self, glfw: Any = None):
        self._glfw = _import_glfw() if glfw is None else glfw
        gamepads = [k for k in range(N_JOYSTICKS) if self._glfw.joystick_is_gamepad(k)]
        require(gamepads, "expected a gamepad, got none. Connect it before the program starts.")
        self._number = gamepads[0]

    def __call__(self, live: Live) -> NDArray:
        glfw = self._glfw
        state = glfw.get_gamepad_state(self._number)
        if not state:
            return np.zeros(4)
        axes = state.axes
        right_y, right_x = axes[glfw.GAMEPAD_AXIS_RIGHT_Y], axes[glfw.GAMEPAD_AXIS_RIGHT_X]
        left_y, left_x = axes[glfw.GAMEPAD_AXIS_LEFT_Y], axes[glfw.GAMEPAD_AXIS_LEFT_X]
        return remove_deadband(-np.array([right_y, right_x, left_y, left_x]))  # GLFW: down and right are positive


def remove_deadband(sticks: NDArray) -> NDArray:
    """Return deflections without their dead band, stretched to -1 to 1 again; non-finite deflections become zero."""
    finite_sticks = np.where(np.isfinite(sticks), sticks, 0.0)
    return np.sign(finite_sticks) * np.clip((np.abs(finite_sticks) - DEADBAND) / (1 - DEADBAND), 0.0, 1.0)


def _import_glfw() -> Any:
    import glfw  # is installed with mujoco

    with warnings.catch_warnings(action="ignore"):
        is_initialized = glfw.init()
    require(
        is_initialized, "expected a screen, which GLFW needs for gamepads, got none. Run on a machine with a display."
    )
    return glfw
