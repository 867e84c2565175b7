"""Gamepads, read through GLFW, which is installed with MuJoCo and has the layouts of all common gamepads."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.live.loop import Live

DEADBAND = 0.12
"""Deflection below which a stick counts as released, 0 to 1."""
N_JOYSTICKS = 16
"""Number of joysticks that GLFW distinguishes, GLFW_JOYSTICK_LAST + 1."""


class Gamepad:
    """Sticks of a gamepad, for ``Pilot(sticks=[Gamepad()])``.

    The left stick climbs and turns, the right stick moves forwards and sideways: mode 2 of model flying. Buttons call
    functions of the loop: ``gamepad.bind("a", lambda live: live.reset())``. While the gamepad is unplugged, the
    deflections are zero.
    """

    def __init__(self, number: int | None = None, glfw: Any = None):
        self._glfw = _import_glfw() if glfw is None else glfw
        numbers = range(N_JOYSTICKS) if number is None else [number]
        gamepads = [k for k in numbers if 0 <= k < N_JOYSTICKS and self._glfw.joystick_is_gamepad(k)]
        require(gamepads, "expected a gamepad, got none. Connect it before the program starts.")
        self._number = gamepads[0]
        self._callbacks: dict[int, Callable[[Live], object]] = {}
        self._last_buttons: list[int] = []

    @property
    def name(self) -> str:
        """Name of the gamepad's layout."""
        name = self._glfw.get_gamepad_name(self._number)
        return name.decode(errors="replace") if isinstance(name, bytes) else str(name or "disconnected")

    def bind(self, button: str, callback: Callable[[Live], object]) -> None:
        """Make a button call a function of the loop.

        Args:
            button: ``"a"``, ``"b"``, ``"x"``, ``"y"``, ``"left_bumper"``, ``"right_bumper"``, ``"back"``, ``"start"``,
                ``"guide"``, ``"dpad_up"``, ...: GLFW's names.
            callback: Function of the loop.
        """
        index = getattr(self._glfw, f"GAMEPAD_BUTTON_{button.upper()}", None)
        if index is None:
            raise ConfigError(f"expected the name of a button, such as 'a' or 'start', got {button!r}")
        self._callbacks[index] = callback

    def __call__(self, live: Live) -> NDArray:
        glfw = self._glfw
        state = glfw.get_gamepad_state(self._number)
        if not state:
            self._last_buttons = []
            return np.zeros(4)
        buttons, axes = list(state.buttons), state.axes
        for index, callback in self._callbacks.items():
            if buttons[index] and not (self._last_buttons and self._last_buttons[index]):
                live.post(callback)
        self._last_buttons = buttons
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
